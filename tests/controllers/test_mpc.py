import sys
from itertools import combinations

import numpy as np
import pytest

from sb3_flock import Scenario
from sb3_flock.controllers import CONTROLLERS, EXPERTS
from sb3_flock.controllers.mpc import MPC, MPCConfig, predict_obstacles, predict_waypoints
from sb3_flock.settings import SettingsError
from sb3_flock.sim import World, episode_rng
from tests.helpers import mean_metrics

pytest.importorskip("numba")


def started(scenario, episodes=1):
    """A world at the start of its episodes, and what is sensed there."""
    world, rngs = World(scenario, episodes), [episode_rng(0, episode) for episode in range(episodes)]
    return world, world.reset(rngs)


@pytest.mark.parametrize("route", [None, [(0.0, 0.0), (0.25, 0.0), (0.25, 1.0)]])
def test_the_predicted_waypoints_are_the_worlds(route):
    task = Scenario(n_vehicles=2, waypoint_route=route)
    world, _ = started(task, 3)
    world.step(np.zeros((3, 2, 2)))
    ahead = np.array([1, 4, 20, 40])
    predicted = predict_waypoints(world, ahead)
    assert predicted.shape == (3, 4, 2)
    for step in range(1, 41):
        world.step(np.zeros((3, 2, 2)))
        if step in ahead:
            np.testing.assert_allclose(predicted[:, ahead == step][:, 0], world.waypoints, atol=1e-12)
    assert np.ptp(predicted, axis=1).max() > 10 * task.waypoint_speed * task.time_step


def test_the_predicted_positions_of_crossing_obstacles_are_the_worlds():
    world, _ = started(Scenario(n_vehicles=2, n_obstacles=3, obstacle_motion="crossing"), 2)
    ahead = np.array([1, 4, 20])
    predicted = predict_obstacles(world, ahead)
    assert predicted.shape == (2, 3, 3, 2)
    for step in range(1, 21):
        world.step(np.zeros((2, 2, 2)))
        if step in ahead:
            np.testing.assert_allclose(world.obstacle_positions, predicted[:, ahead == step][:, 0])


def test_a_randomly_walking_obstacle_is_predicted_straight_ahead_at_its_mean_speed():
    world, _ = started(Scenario(n_vehicles=2, n_obstacles=1, max_cycles=50))
    world.obstacle_positions, world.obstacle_headings = np.array([[[0.1, 0.2]]]), np.array([[np.pi / 2]])
    stride = world.obstacle_speeds.mean() * 0.1
    assert 0.0 < stride < 0.01
    np.testing.assert_allclose(predict_obstacles(world, np.array([10]))[0, 0, 0], (0.1, 0.2 + 10 * stride))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("separation", 0.0),
        ("clearance", -1.0),
        ("max_link_length", 0.0),
        ("link_cutoff", 0.0),
        ("separation_weight", -1.0),
        ("clearance_weight", -1.0),
        ("link_weight", -1.0),
        ("obstacle_visibility", -0.1),
        ("horizon", 0),
        ("n_iterations", 0),
        ("step_size", 0.0),
    ],
)
def test_every_field_of_the_config_is_described_and_checked(name, value):
    assert MPCConfig.model_fields[name].description
    with pytest.raises(SettingsError, match=f"{name} = {value}"):
        MPCConfig(**{name: value})


@pytest.mark.parametrize(
    "changes",
    [
        {"separation": 1.5},
        {"clearance": 1.5},
        {"max_link_length": 0.6},
        {"link_cutoff": 0.05, "max_link_length": 0.6},
        {"separation_weight": 0.0},
        {"clearance_weight": 0.0},
        {"link_weight": 0.0, "max_link_length": 0.6},
        {"obstacle_visibility": 0.1},
        {"horizon": 5},
        {"n_iterations": 20},
        {"step_size": 0.01},
    ],
    ids=lambda changes: next(iter(changes)),
)
def test_every_field_of_the_config_changes_the_actions(changes):
    task = Scenario(n_vehicles=3, n_obstacles=1)
    world, sensing = started(task)
    world.positions, world.headings = np.array([[[0.0, 0.0], [0.0, 0.09], [-0.12, 0.0]]]), np.zeros((1, 3))
    world.obstacle_positions, world.obstacle_headings = np.array([[[0.16, 0.05]]]), np.array([[np.pi]])
    world.waypoints = np.array([[1.0, 0.0]])
    base = {name: value for name, value in changes.items() if name == "max_link_length" and len(changes) > 1}
    actions = [MPC(world, MPCConfig(**fields)).act(sensing, task) for fields in (base, changes)]
    assert np.abs(actions[0] - actions[1]).max() > 1e-3


def test_the_expert_plans_with_the_safety_filter_of_its_world():
    """The one behind may come nearer the more is known of the one ahead: its place, its heading, its announced speed."""
    actions = {}
    for level in ("off", "voronoi", "heading", "announce"):
        task = Scenario(n_vehicles=3, n_obstacles=0, safety_filter=level)
        world, sensing = started(task)
        world.positions, world.headings = np.array([[[0.0, 0.0], [0.102, 0.0], [-0.12, 0.0]]]), np.zeros((1, 3))
        world.waypoints = np.array([[0.3, 0.05]])
        actions[level] = MPC(world).act(sensing, task)
    for one, other in combinations(actions, 2):
        assert np.abs(actions[one] - actions[other]).max() > 1e-3, (one, other)


def test_the_config_lists_its_fields():
    assert set(MPCConfig.model_fields) == {
        "separation", "clearance", "max_link_length", "link_cutoff", "separation_weight", "clearance_weight",
        "link_weight", "obstacle_visibility", "horizon", "n_iterations", "step_size",
    }  # fmt: skip


def test_the_present_state_alone_determines_the_actions():
    task = Scenario(n_vehicles=5, n_obstacles=2)
    world, sensing = started(task, 3)
    used = MPC(world)
    for _ in range(30):
        sensing, _ = world.step(used.act(sensing, task))
    np.testing.assert_array_equal(used.act(sensing, task), MPC(world).act(sensing, task))


def test_scaling_all_lengths_scales_the_actions():
    task = Scenario(n_vehicles=4, n_obstacles=2)
    lengths = ("max_speed", "obstacle_max_speed", "waypoint_speed", "arena", "link_range")
    ranges = ("neighbor_separation", "detection_range", "obstacle_separation", "goal_radius")
    large = task.replace(**{name: 64 * getattr(task, name) for name in lengths + ranges})
    (small, sensing), (other, others) = started(task), started(large)
    for _ in range(60):
        actions = MPC(small).act(sensing, task)
        np.testing.assert_allclose(MPC(other).act(others, large), actions * [64, 1], rtol=1e-6, atol=1e-9)
        (sensing, _), (others, _) = small.step(actions), other.step(actions * [64, 1])


def test_an_obstacle_that_no_vehicle_detects_has_no_effect():
    task = Scenario(n_vehicles=3, n_obstacles=1)
    world, sensing = started(task)
    world.positions, world.headings = np.array([[[0.0, 0.0], [0.0, 0.12], [-0.12, 0.0]]]), np.zeros((1, 3))
    world.waypoints, expert = np.array([[1.0, 0.0]]), MPC(world)
    actions = []
    for x in (0.2, task.detection_range + 0.01, 0.5):
        world.obstacle_positions, world.obstacle_headings = np.array([[[x, 0.0]]]), np.array([[np.pi]])
        actions.append(expert.act(sensing, task))
    np.testing.assert_array_equal(actions[1], actions[2])
    assert np.abs(actions[0] - actions[1]).max() > 0.1


def test_beyond_the_link_cutoff_a_vehicle_drives_to_the_waypoint_and_not_to_the_others():
    task = Scenario(n_vehicles=3, n_obstacles=0, waypoint_speed=0.0)
    world, sensing = started(task)
    world.waypoints, world.headings, expert = np.array([[1.0, 0.0]]), np.zeros((1, 3)), MPC(world)
    world.positions = np.array([[[0.0, 0.0], [0.0, 0.4], [0.0, -0.5]]])
    np.testing.assert_allclose(expert.act(sensing, task)[0, 0], [task.max_speed, 0.0], atol=1e-6)
    world.positions[0, 1] = 0.0, 0.16
    assert expert.act(sensing, task)[0, 0, 1] > 0.1  # the link is broken, but within the cutoff
    without_links = MPC(world, MPCConfig(link_weight=0.0))
    np.testing.assert_allclose(without_links.act(sensing, task)[0, 0], [task.max_speed, 0.0], atol=1e-6)


def test_a_lone_vehicle_turns_around_and_follows_the_waypoint():
    task = Scenario(n_vehicles=1, n_obstacles=0, waypoint_route=[(0.0, 0.0), (3.0, 0.0)])
    world, sensing = started(task)
    world.positions, world.headings = np.array([[[-0.3, 0.0]]]), np.array([[np.pi]])
    expert = MPC(world)
    for _ in range(150):
        sensing, _ = world.step(expert.act(sensing, task))
    assert sensing.waypoint_distances.item() < 0.01
    assert world.waypoints[0, 0] > 1.0


def test_a_flock_tracks_keeps_its_separations_and_stays_connected():
    found = mean_metrics(MPC, Scenario(n_vehicles=5, n_obstacles=2), 10)
    assert found["tracking_error"] < 0.087
    assert found["connectivity"] > 0.99
    assert found["neighbor_violation_rate"] < 0.002
    assert found["obstacle_violation_rate"] < 0.01


def test_the_privileged_expert_is_no_baseline_and_a_missing_library_is_reported_in_one_line(monkeypatch):
    assert "mpc" not in CONTROLLERS
    assert EXPERTS["mpc"] is MPC
    monkeypatch.delitem(sys.modules, "sb3_flock.controllers.mpc_kernels")
    monkeypatch.setitem(sys.modules, "numba", None)
    with pytest.raises(SettingsError, match=r"expert = 'mpc': needs numba, pip install 'sb3_flock\[fast\]'"):
        MPC(World(Scenario()))
