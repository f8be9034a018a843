import numpy as np
import pytest

from sb3_flock import Scenario, evaluate
from sb3_flock.controllers import olfati_saber
from sb3_flock.controllers.olfati_saber import OlfatiGains, OlfatiSaber
from sb3_flock.sim import episode_rng
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


def test_a_flock_tracks_stays_connected_and_keeps_its_separations():
    metrics = evaluate(OlfatiSaber(), Scenario(n_vehicles=3, n_obstacles=1), episodes=30, seed=1)
    assert 0.06 <= metrics["tracking_error"].mean <= 0.1
    assert metrics["connectivity"].mean >= 0.8
    assert metrics["neighbor_violation_rate"].mean <= 0.005
    assert metrics["obstacle_violation_rate"].mean <= 0.005
