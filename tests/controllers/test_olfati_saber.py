import numpy as np
import pytest

from sb3_flock import Scenario, evaluate
from sb3_flock.controllers import olfati_saber
from sb3_flock.controllers.olfati_saber import OlfatiGains, OlfatiSaber
from sb3_flock.sim import episode_rng
from tests.controllers.holonomic import Holonomic
from tests.helpers import place


def velocities(world, gains=None):
    """The velocities that the controller integrates at the start of an episode, from rest, in the body frames."""
    controller = OlfatiSaber(gains)
    controller.reset([episode_rng(0, 0)], world.scenario)
    controller.act(world.sense(), world.scenario)
    return controller.state_dict()["velocities"][0]


NO_WAYPOINT = OlfatiGains(gamma=0.0, gamma_damping=0.0)


@pytest.mark.parametrize(("distance", "sign"), [(0.10, -1), (0.148, 1)])
def test_neighbors_repel_below_the_spacing_and_attract_above_it(distance, sign):
    apart = velocities(place(Scenario(), [(0.0, 0.0), (distance, 0.0)], [0.0, 0.0]), NO_WAYPOINT)
    assert np.sign(apart[0, 0]) == sign
    np.testing.assert_allclose(apart[0], -apart[1], atol=1e-12)


def test_neighbors_at_the_spacing_and_obstacles_beyond_their_distance_have_no_effect():
    at_rest = place(Scenario(), [(0.0, 0.0), (0.14, 0.0)], [0.0, 0.0], obstacles=[(0.0, 0.2)])
    np.testing.assert_allclose(velocities(at_rest, NO_WAYPOINT), 0.0, atol=1e-12)
    near = place(Scenario(), [(0.0, 0.0)], [0.0], obstacles=[(0.0, 0.16)])
    assert velocities(near, NO_WAYPOINT)[0, 1] < -1e-3


def test_a_lone_vehicle_moves_towards_the_waypoint():
    velocity = velocities(place(Scenario(), [(0.0, 0.0)], [0.0], waypoint=(0.3, 0.4)))[0]
    np.testing.assert_allclose(velocity / np.linalg.norm(velocity), (0.6, 0.8), atol=1e-9)
    assert np.linalg.norm(velocity) <= 0.15 + 1e-12


def test_the_articles_functions():
    z = np.array([[3.0, -4.0], [0.2, 0.1]])
    np.testing.assert_allclose(olfati_saber._sigma_norm(z)[0], (np.sqrt(1 + 0.1 * 25) - 1) / 0.1)
    for axis in (0, 1):  # n_ij is the sigma-norm's gradient
        nudge = np.eye(2)[axis] * 1e-6
        numeric = (olfati_saber._sigma_norm(z + nudge) - olfati_saber._sigma_norm(z - nudge)) / 2e-6
        np.testing.assert_allclose(olfati_saber._direction(z)[:, axis], numeric, rtol=1e-6)
    np.testing.assert_allclose(
        olfati_saber._bump(np.array([0.0, 0.19, 0.6, 1.0, 2.0]), 0.2), [1.0, 1.0, 0.5, 0.0, 0.0], atol=1e-12
    )
    assert olfati_saber._uneven_sigmoid(np.array(0.0)) == 0.0
    assert olfati_saber._uneven_sigmoid(np.array(9.0)) == pytest.approx(5 * 9 / np.sqrt(82))


WIDE = Scenario(n_vehicles=6, n_obstacles=0, link_range=0.5, detection_range=0.5, time_step=0.001, max_speed=100.0)
"""All see each other from the start, no velocity is cut off, and steps are short."""
UNIT = 0.14 / 7
"""Meters a unit of the article's lattice, whose d is 7."""


def crowded(n_vehicles):
    rng = np.random.default_rng(3)
    return np.stack((0.13 * np.arange(n_vehicles) % 0.39, 0.12 * (np.arange(n_vehicles) // 3)), -1) + rng.uniform(
        -0.02, 0.02, (n_vehicles, 2)
    )


def sigma_norm(lengths):
    """The article's Eq. 8, epsilon = 0.1."""
    return (np.sqrt(1 + 0.1 * np.square(lengths)) - 1) / 0.1


def potential(distances, phi, top):
    """The integral of an action function over the sigma-norm, from the distance ``top``, where it is 0 (the article's Eq. 16)."""
    sigmas = sigma_norm(distances / UNIT)
    grid = np.linspace(0.0, sigma_norm(top / UNIT), 100_001)
    values = phi(grid)
    steps = 0.5 * (values[1:] + values[:-1]) * np.diff(grid)
    integral = np.concatenate(([0.0], np.cumsum(steps)))
    return np.interp(sigmas, grid, integral - integral[-1])


def pair_action(sigma):
    """phi_alpha(z) = rho_h(z / r_alpha) phi(z - d_alpha), Eq. 15, a = b = 5."""
    r, d = sigma_norm(np.array([0.5 / UNIT, 7.0]))
    rho = np.where(sigma / r < 0.2, 1.0, 0.5 * (1 + np.cos(np.pi * (sigma / r - 0.2) / 0.8)))
    return rho * 5 * (sigma - d) / np.sqrt(1 + (sigma - d) ** 2)


def obstacle_action(sigma):
    """phi_beta(z) = rho_h(z / d_beta) (sigma_1(z - d_beta) - 1), Eq. 56."""
    d = sigma_norm(0.18 / UNIT)
    rho = np.where(sigma / d < 0.9, 1.0, 0.5 * (1 + np.cos(np.pi * (np.minimum(sigma / d, 1.0) - 0.9) / 0.1)))
    return rho * ((sigma - d) / np.sqrt(1 + (sigma - d) ** 2) - 1)


def energy(flock, gains):
    """The Hamiltonian of the article's Theorem 1: potentials and kinetic energy, in units of the lattice."""
    pairs = np.triu_indices(len(flock.positions), 1)
    distances = np.linalg.norm(flock.positions[:, None] - flock.positions[None], axis=-1)[pairs]
    height = gains.alpha * potential(distances, pair_action, 0.5).sum()
    if len(flock.obstacles):
        distances = np.linalg.norm(flock.positions[:, None] - flock.obstacles[None], axis=-1)
        height += gains.beta * potential(np.minimum(distances, 0.18), obstacle_action, 0.18).sum()
    return height + 0.5 * np.square(flock.velocities / UNIT).sum()


def angular_momentum(flock):
    (x, y), (u, v) = flock.positions.T, flock.velocities.T
    return float((x * v - y * u).sum())


def test_momentum_and_angular_momentum_are_conserved(monkeypatch):
    """Forces between neighbors are equal, opposite and along their line, whatever way the frames turn."""
    gains = OlfatiGains(gamma=0.0, gamma_damping=0.0, alpha_damping=0.0)
    flock = Holonomic(olfati_saber, monkeypatch, OlfatiSaber(gains), WIDE, crowded(6))
    for _ in range(400):
        flock.step()
    assert np.abs(flock.velocities).max() > 0.1
    np.testing.assert_allclose(flock.velocities.sum(0), 0.0, atol=1e-9)
    assert angular_momentum(flock) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("obstacles", [(), [(0.17, -0.06), (0.2, 0.26)]], ids=["neighbors", "obstacles"])
def test_energy_is_conserved_without_damping(obstacles, monkeypatch):
    gains = OlfatiGains(gamma=0.0, gamma_damping=0.0, alpha_damping=0.0, beta_damping=0.0)
    scenario = WIDE.replace(n_obstacles=len(obstacles))
    flock = Holonomic(olfati_saber, monkeypatch, OlfatiSaber(gains), scenario, crowded(6), obstacles)
    energies, kinetic = [energy(flock, gains)], []
    for _ in range(30):
        for _ in range(20):
            flock.step()
        energies.append(energy(flock, gains))
        kinetic.append(0.5 * np.square(flock.velocities / UNIT).sum())
    assert np.ptp(energies) < 0.03 * max(kinetic)


@pytest.mark.parametrize("obstacles", [(), [(0.17, -0.06), (0.2, 0.26)]], ids=["neighbors", "obstacles"])
def test_damping_takes_energy_and_keeps_the_momentum_of_a_flock_without_obstacles(obstacles, monkeypatch):
    """Theorem 1: dH/dt = -c2 v'Lv <= 0. At the end all rest, or move alike."""
    gains = OlfatiGains(gamma=0.0, gamma_damping=0.0, alpha_damping=20.0, beta_damping=20.0)
    scenario = WIDE.replace(n_obstacles=len(obstacles))
    flock = Holonomic(olfati_saber, monkeypatch, OlfatiSaber(gains), scenario, crowded(6), obstacles)
    energies = []
    for _ in range(100):
        for _ in range(20):
            flock.step()
        energies.append(energy(flock, gains))
    fall = energies[0] - energies[-1]
    assert fall > 0
    assert np.diff(energies).max() < 1e-3 * fall
    if not obstacles:
        np.testing.assert_allclose(flock.velocities.sum(0), 0.0, atol=1e-9)
    assert np.ptp(flock.velocities, axis=0).max() < 0.01


def test_a_flocks_center_moves_as_one_body_towards_the_waypoint(monkeypatch):
    """The article's decomposition: forces between neighbors do not move the center, and the pull to the waypoint is the sum of
    each vehicle's c1 sigma_1(offset) - c2 velocity."""
    gains = OlfatiGains(alpha_damping=3.0)
    flock = Holonomic(olfati_saber, monkeypatch, OlfatiSaber(gains), WIDE, crowded(6))
    goal = np.array([0.5, 0.3])
    flock.step(np.tile(goal, (6, 1)))
    for _ in range(50):
        offsets, before = (goal - flock.positions) / UNIT, flock.velocities / UNIT
        pull = gains.gamma * offsets / np.sqrt(1 + np.square(offsets).sum(-1, keepdims=True)) - gains.gamma_damping * before
        flock.step(np.tile(goal, (6, 1)))
        np.testing.assert_allclose((flock.velocities / UNIT - before).mean(0), pull.mean(0) * 0.001, atol=1e-9)


def test_a_flock_tracks_stays_connected_and_keeps_its_separations():
    metrics = evaluate(OlfatiSaber(), Scenario(n_vehicles=3, n_obstacles=1), episodes=30, seed=1)
    assert 0.06 <= metrics["tracking_error"].mean <= 0.1
    assert metrics["connectivity"].mean >= 0.8
    assert metrics["neighbor_violation_rate"].mean <= 0.005
    assert metrics["obstacle_violation_rate"].mean <= 0.005
