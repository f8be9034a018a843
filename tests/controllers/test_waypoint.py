import numpy as np
import pytest

from sb3_flock import Scenario, evaluate
from sb3_flock.controllers.waypoint import GoToWaypoint
from tests.helpers import place


@pytest.mark.parametrize(
    ("waypoint", "action"),
    [
        ((0.5, 0.0), (0.15, 0.0)),
        ((0.006, 0.0), (0.06, 0.0)),  # the speed that reaches the waypoint in one step
        ((-0.5, 1e-9), (0.0, np.pi)),
        ((0.0, -0.5), (0.0, -np.pi)),
        ((0.0, 0.0), (0.0, 0.0)),
    ],
)
def test_a_vehicle_turns_to_the_waypoint_and_drives_to_it(waypoint, action):
    world = place(Scenario(), [(0.0, 0.0)], [0.0], waypoint=waypoint)
    actions = GoToWaypoint().act(world.sense(), world.scenario)
    assert actions.shape == (1, 1, 2)
    np.testing.assert_allclose(actions[0, 0], action, atol=1e-7)


def test_vehicles_track_the_waypoint_and_violate_separations():
    metrics = evaluate(GoToWaypoint(), Scenario(n_vehicles=3, n_obstacles=1), episodes=30, seed=1)
    assert metrics["tracking_error"].mean <= 0.01
    assert metrics["neighbor_violation_rate"].mean >= 0.5
