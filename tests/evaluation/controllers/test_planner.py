import sys

import numpy as np
import pytest

from sb3_flock import Scenario
from sb3_flock.evaluation.controllers import CONTROLLERS, Orca, Planner
from sb3_flock.evaluation.controllers.planner import Packs, way_lengths
from sb3_flock.evaluation.metrics import EpisodeMetrics
from sb3_flock.settings import SettingsError
from sb3_flock.sim import World, episode_rng, own_reward, reward_terms

pytest.importorskip("pyrvo")
pytest.importorskip("scipy")


@pytest.mark.parametrize("n_vehicles", [1, 2, 5, 30])
def test_packs_are_connected_lattices_free_of_obstacles_the_nearest_first(n_vehicles):
    packs = Packs(n_vehicles, 0.1)
    obstacles = np.array([[0.05, 0.02], [-0.3, 0.1]])
    found, distances = packs.free(obstacles, 0.15)
    assert found.shape == (20, n_vehicles, 2)
    np.testing.assert_allclose(distances, np.linalg.norm(found, axis=-1).mean(1))
    assert (np.diff(distances) >= 0).all()
    assert np.linalg.norm(found[:, :, None] - obstacles, axis=-1).min() >= 0.15
    between = np.linalg.norm(found[:, :, None] - found[:, None], axis=-1) + np.eye(n_vehicles)
    assert between.min() > 0.0999
    for pack in between:
        reached = {0}
        for _ in pack:
            reached |= {j for i in reached for j in np.flatnonzero(pack[i] < 0.1001).tolist()}
        assert reached == set(range(n_vehicles))


def test_where_there_is_no_room_obstacles_are_not_minded():
    everywhere = np.stack(np.meshgrid(*[np.linspace(-1, 1, 21)] * 2), axis=-1).reshape(-1, 2)
    found, distances = Packs(5, 0.1).free(everywhere, 0.15)
    assert found.shape == (20, 5, 2)
    assert distances.min() < 0.085


def test_packs_of_five_stand_as_near_as_geometry_allows():
    _, distances = Packs(5, 0.1, lattices=200).free(np.empty((0, 2)), 0.15)
    assert distances.min() == pytest.approx(0.0780, abs=0.0015)


def test_ways_go_around_obstacles():
    left, right, above = np.array([-1.0, 0.0]), np.array([1.0, 0.0]), np.array([0.0, 1.0])
    middle = np.zeros((1, 2))
    tangents_and_arc = 2 * np.sqrt(0.75) + 0.5 * (np.pi - 2 * np.arccos(0.5))
    assert way_lengths(left, right, middle, 0.5) == pytest.approx(tangents_and_arc)
    assert way_lengths(left, above, middle, 0.5) == pytest.approx(np.sqrt(2))  # it passes at 0.7
    assert way_lengths(left, right, np.empty((0, 2)), 0.5) == pytest.approx(2)
    assert way_lengths(left, right, np.array([[0.0, 3.0], [0.0, 0.0], [0.0, 0.45]]), 0.5) == pytest.approx(tangents_and_arc)
    assert way_lengths(0.4 * left, right, middle, 0.5) == pytest.approx(np.sqrt(0.84) + 0.4 * (np.pi - np.arccos(0.4)))
    assert way_lengths(middle, right, middle, 0.5) == pytest.approx(1)


def test_places_across_an_obstacle_are_far():
    ring = 0.16 * np.array([[np.cos(angle), np.sin(angle)] for angle in np.deg2rad([0, 40, 80, 120, 160])])
    places = Packs(5, 0.104).given(ring, np.array([[0.0, -0.01]]), 0.155, way=1.0)
    assert np.linalg.norm(places - ring, axis=-1).max() < 0.12


def flown(pilot, scenario, episodes):
    world = World(scenario, episodes)
    pilot = pilot(world)
    rngs = [episode_rng(5, episode) for episode in range(episodes)]
    sensing = world.reset(rngs)
    pilot.reset(rngs, scenario)
    metrics = EpisodeMetrics(scenario, episodes)
    for _ in range(scenario.max_cycles):
        sensing, clipped = world.step(pilot.act(sensing, scenario))
        metrics.update(world, sensing, own_reward(reward_terms(sensing, clipped, scenario)))
    return {name: np.nanmean(values) for name, values in metrics.result().items()}


def test_its_flocks_stand_nearer_and_hold_together_better_than_those_without_full_sight():
    task = Scenario(n_vehicles=5, n_obstacles=2)
    planned, alone = flown(Planner, task, 20), flown(lambda world: Orca(), task, 20)
    assert planned["tracking_error"] < 0.095 < alone["tracking_error"]
    assert planned["connectivity"] > 0.99
    assert planned["neighbor_violation_rate"] < 0.005
    assert planned["obstacle_violation_rate"] < 0.005


def test_a_vehicle_on_its_place_rests():
    task = Scenario(n_vehicles=1, n_obstacles=0, waypoint_speed=0.0)
    world = World(task)
    rngs = [episode_rng(0, 0)]
    planner = Planner(world)
    sensing = world.reset(rngs)
    planner.reset(rngs, task)
    for _ in range(task.max_cycles):
        actions = planner.act(sensing, task)
        sensing, _ = world.step(actions)
    nearest = planner.packs.free(world.obstacle_positions[0], 0.15)[1].min()
    assert sensing.waypoint_distances.item() == pytest.approx(nearest, abs=2 * planner.gains.tolerance)
    np.testing.assert_allclose(actions, 0, atol=1e-3)


def test_who_sees_everything_is_no_peer_and_a_missing_library_is_told_in_one_line(monkeypatch):
    assert "planner" not in CONTROLLERS
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)
    with pytest.raises(SettingsError, match=r"teacher = 'planner': needs scipy, pip install 'sb3_flock\[orca\]'"):
        Planner(World(Scenario()))
