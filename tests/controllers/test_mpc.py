import sys

import numpy as np
import pytest

from sb3_flock import Scenario
from sb3_flock.controllers import CONTROLLERS, MPC
from sb3_flock.controllers.mpc import MPCConfig
from sb3_flock.settings import SettingsError
from sb3_flock.sim import World, episode_rng
from tests.helpers import mean_metrics

pytest.importorskip("numba")

from sb3_flock.controllers.mpc_kernels import CostParams, slope


def cost(ways, waypoint, obstacles, wants):
    """What :func:`slope` is the slope of, written down plainly."""
    between = np.linalg.norm(ways[:, None] - ways, axis=-1)
    pairs = between[np.triu_indices(len(ways), 1)]
    away = np.linalg.norm(ways[:, None] - obstacles, axis=-1)
    inside, missing = {0}, 0.0
    while len(inside) < len(ways):  # the shortest tree, by its next shortest link
        link, new = min((between[i, j], j) for i in inside for j in range(len(ways)) if j not in inside)
        inside.add(new)
        lack = min(max(0.0, link - wants.reach), wants.slack)
        missing += lack**2 / 2 - 2 * lack**3 / (3 * wants.slack) + lack**4 / (4 * wants.slack**2)
    return (
        np.sqrt(((ways - waypoint) ** 2).sum(-1) + 0.02**2).mean()
        + wants.separation_weight / 2 * (np.maximum(0.0, wants.separation - pairs) ** 2).sum()
        + wants.clearance_weight / 2 * (np.maximum(0.0, wants.clearance - away) ** 2).sum()
        + wants.reach_weight * missing
    )


@pytest.mark.parametrize("seed", range(20))
def test_the_slope_is_that_of_the_cost(seed):
    rng, wants = np.random.default_rng(seed), CostParams(0.11, 0.16, 0.12, 0.1, 500.0, 1000.0, 60.0)
    ways, obstacles, waypoint = (rng.uniform(-size, size, (count, 2)) for size, count in ((0.12, 5), (0.3, 2), (0.05, 1)))
    down, numeric = np.empty((5, 2)), np.empty((5, 2))
    slope(down, ways, waypoint[0], obstacles, wants)
    for i, axis in np.ndindex(5, 2):
        nudge = np.zeros((5, 2))
        nudge[i, axis] = 1e-6
        numeric[i, axis] = (
            cost(ways + nudge, waypoint, obstacles, wants) - cost(ways - nudge, waypoint, obstacles, wants)
        ) / 2e-6
    np.testing.assert_allclose(down, numeric, rtol=1e-4, atol=1e-5)


def begun(scenario, episodes=1):
    world, rngs = World(scenario, episodes), [episode_rng(0, episode) for episode in range(episodes)]
    return world, world.reset(rngs)


def test_only_the_state_decides():
    task = Scenario(n_vehicles=5, n_obstacles=2)
    world, sensing = begun(task, 3)
    veteran = MPC(world)
    for _ in range(30):
        sensing, _ = world.step(veteran.act(sensing, task))
    np.testing.assert_array_equal(veteran.act(sensing, task), MPC(world).act(sensing, task))


def test_a_task_of_another_size_is_the_same_task():
    task = Scenario(n_vehicles=4, n_obstacles=2)
    lengths = ("max_speed", "obstacle_max_speed", "waypoint_speed", "arena", "link_range")
    ranges = ("neighbor_separation", "detection_range", "obstacle_separation", "goal_radius")
    large = task.replace(**{name: 64 * getattr(task, name) for name in lengths + ranges})
    (small, sensing), (other, others) = begun(task), begun(large)
    for _ in range(60):
        actions = MPC(small).act(sensing, task)
        np.testing.assert_allclose(MPC(other).act(others, large), actions * [64, 1], rtol=1e-6, atol=1e-9)
        (sensing, _), (others, _) = small.step(actions), other.step(actions * [64, 1])


def test_what_no_vehicle_detects_is_not_known_of():
    task = Scenario(n_vehicles=3, n_obstacles=1)
    world, sensing = begun(task)
    world.positions, world.headings = np.array([[[0.0, 0.0], [0.0, 0.12], [-0.12, 0.0]]]), np.zeros((1, 3))
    world.waypoints, expert = np.array([[1.0, 0.0]]), MPC(world)
    advice = []
    for x in (0.2, task.detection_range + 0.01, 0.5):
        world.obstacle_positions, world.obstacle_headings = np.array([[[x, 0.0]]]), np.array([[np.pi]])
        advice.append(teacher.act(sensing, task))
    np.testing.assert_array_equal(advice[1], advice[2])
    assert np.abs(advice[0] - advice[1]).max() > 0.1


def test_who_has_lost_the_others_goes_to_the_waypoint_and_not_to_them():
    task = Scenario(n_vehicles=3, n_obstacles=0, waypoint_speed=0.0)
    world, sensing = begun(task)
    world.waypoints, world.headings, expert = np.array([[1.0, 0.0]]), np.zeros((1, 3)), MPC(world)
    world.positions = np.array([[[0.0, 0.0], [0.0, 0.4], [0.0, -0.5]]])
    np.testing.assert_allclose(teacher.act(sensing, task)[0, 0], [task.max_speed, 0.0], atol=1e-6)
    world.positions[0, 1] = 0.0, 0.16
    assert teacher.act(sensing, task)[0, 0, 1] > 0.1  # out of sight, but not yet given up
    careless = MPC(world, MPCConfig(reach_weight=0.0))
    np.testing.assert_allclose(careless.act(sensing, task)[0, 0], [task.max_speed, 0.0], atol=1e-6)


def test_a_lone_vehicle_turns_round_meets_the_waypoint_and_stays_with_it():
    task = Scenario(n_vehicles=1, n_obstacles=0, waypoint_route=[(0.0, 0.0), (3.0, 0.0)])
    world, sensing = begun(task)
    world.positions, world.headings = np.array([[[-0.3, 0.0]]]), np.array([[np.pi]])
    expert = MPC(world)
    for _ in range(150):
        sensing, _ = world.step(teacher.act(sensing, task))
    assert sensing.waypoint_distances.item() < 0.01
    assert world.waypoints[0, 0] > 1.0


def test_its_flocks_stand_close_keep_their_distances_and_hold_together():
    found = mean_metrics(MPC, Scenario(n_vehicles=5, n_obstacles=2), 10)
    assert found["tracking_error"] < 0.087
    assert found["connectivity"] > 0.99
    assert found["neighbor_violation_rate"] < 0.002
    assert found["obstacle_violation_rate"] < 0.01


def test_who_sees_everything_is_no_peer_and_a_missing_library_is_told_in_one_line(monkeypatch):
    assert "mpc" not in CONTROLLERS
    monkeypatch.delitem(sys.modules, "sb3_flock.controllers.mpc_kernels")
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(SettingsError, match=r"expert = 'mpc': needs numba, pip install 'sb3_flock\[fast\]'"):
        MPC(World(Scenario()))
