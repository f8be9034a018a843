import sys

import numpy as np
import pytest

from sb3_flock import Scenario, evaluate
from sb3_flock.controllers import make_controller, orca
from sb3_flock.controllers.orca import Orca, OrcaGains
from sb3_flock.settings import SettingsError
from sb3_flock.sim import episode_rng
from tests.controllers.holonomic import Holonomic
from tests.helpers import place


def actions_in(world, gains=None):
    controller = Orca(gains)
    controller.reset([episode_rng(0, 0)], world.scenario)
    return controller.act(world.sense(), world.scenario)[0]


def test_a_vehicle_drives_to_the_waypoint_where_nothing_is_in_its_way():
    pytest.importorskip("pyrvo")
    world = place(Scenario(), [(0.0, 0.0)], [0.0], waypoint=(0.1, 0.0))
    np.testing.assert_allclose(actions_in(world), [(0.08, 0.0)], atol=1e-6)  # 0.8 m/s for each meter
    np.testing.assert_allclose(actions_in(world, OrcaGains(approach=0.5)), [(0.05, 0.0)], atol=1e-6)


def test_a_body_ahead_slows_a_vehicle_and_one_behind_does_not():
    pytest.importorskip("pyrvo")
    speeds = []
    for obstacle in ((0.16, 0.0), (-0.2, 0.0)):
        world = place(Scenario(), [(0.0, 0.0)], [0.0], obstacles=[obstacle], waypoint=(0.5, 0.0))
        speeds.append(actions_in(world)[0, 0])
    assert speeds[0] < 0.05
    assert speeds[1] == pytest.approx(0.15, abs=1e-6)


CIRCLE = Scenario(
    n_vehicles=16,
    n_obstacles=0,
    time_step=0.25,
    max_speed=2.0,
    neighbor_separation=3.0,
    link_range=60.0,
    obstacle_separation=2.5,
    detection_range=60.0,
)
"""The numbers of RVO2's example Circle: discs of radius 1.5 m that drive at up to 2 m/s to the other side. All see all, so that
velocities of bodies are known from the second step on."""


def rvo2_velocities(flock, velocities, goals, obstacle_velocities=()):
    """What RVO2 computes for all agents in one simulation, which know each other's velocities."""
    import pyrvo

    simulator = pyrvo.RVOSimulator()
    simulator.set_time_step(0.25)
    for position, velocity, goal in zip(flock.positions, velocities, goals, strict=True):
        agent = simulator.add_agent(tuple(position), 60.0, 20, 10.0, 10.0, 1.5, 2.0, tuple(velocity))
        offset = goal - position
        simulator.set_agent_pref_velocity(agent, tuple(offset * min(1.0, 2.0 / np.linalg.norm(offset))))
    for position, velocity in zip(flock.obstacles, obstacle_velocities, strict=True):
        simulator.add_agent(tuple(position), 0.0, 20, 10.0, 10.0, 1.0, 2.0, tuple(velocity))
    simulator.do_step()
    found = (simulator.get_agent_velocity(agent) for agent in range(len(goals)))
    return np.array([(velocity.x, velocity.y) for velocity in found])


@pytest.mark.parametrize("n_obstacles", [0, 3])
def test_the_circle_example_of_rvo2(n_obstacles, monkeypatch):
    """Each vehicle's own problem has the solution that RVO2 finds for it in a simulation of all, whatever way its frame turns."""
    pytest.importorskip("pyrvo")
    angles = 2 * np.pi * np.arange(16) / 16
    start = 14.0 * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    start += np.random.default_rng(1).uniform(-0.5, 0.5, start.shape)  # symmetric discs wait for each other forever
    obstacles = np.array([(2.0, 6.0), (-5.0, -3.0), (0.0, 0.5)])[:n_obstacles]
    obstacle_velocities = np.array([(0.0, -0.5), (0.4, 0.3), (0.0, 0.0)])[:n_obstacles]
    controller = Orca(OrcaGains(time_horizon=10.0, margin=0.0, approach=1.0))
    scenario = CIRCLE.replace(n_obstacles=n_obstacles)
    flock = Holonomic(orca, monkeypatch, controller, scenario, start, obstacles)
    flock.advance(np.zeros_like(start), obstacle_velocities)
    equal, nearest, velocities = [], np.inf, np.zeros_like(start)
    known = obstacle_velocities * 0.0  # from the second measurement on, bodies have velocities
    for _ in range(240):
        expected = rvo2_velocities(flock, velocities, -start, known)
        flock.step(-start, obstacle_velocities)
        equal.append(np.abs(flock.velocities - expected).max(-1) < 5e-3)
        velocities, known = flock.velocities, obstacle_velocities
        distances = np.linalg.norm(flock.positions[:, None] - flock.positions[None], axis=-1)
        nearest = min(nearest, distances[~np.eye(16, dtype=bool)].min())
    assert np.mean(equal) > 0.99  # where discs touch, single precision decides between far solutions
    assert nearest > 3.0 - 0.02
    if n_obstacles == 0:
        assert np.linalg.norm(flock.positions + start, axis=-1).max() < 1.5  # as the example ends


def test_a_flock_tracks_stays_connected_and_keeps_its_separations():
    pytest.importorskip("pyrvo")
    metrics = evaluate(Orca(), Scenario(n_vehicles=3, n_obstacles=1), episodes=30, seed=1)
    assert 0.06 <= metrics["tracking_error"].mean <= 0.09
    assert metrics["connectivity"].mean >= 0.95
    assert metrics["neighbor_violation_rate"].mean <= 0.005
    assert metrics["obstacle_violation_rate"].mean <= 0.005


def test_a_missing_library_is_reported_in_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrvo", None)
    with pytest.raises(SettingsError, match=r"controller = 'orca': needs pyrvo, pip install 'sb3_flock\[orca\]'"):
        make_controller("orca")
