import sys

import numpy as np
import pytest

from sb3_flock import Scenario
from sb3_flock.evaluation.controllers import CONTROLLERS, Orca, Planner
from sb3_flock.evaluation.controllers.planner import Packs, PlannerGains, _connected, way_lengths
from sb3_flock.settings import SettingsError
from sb3_flock.sim import World, episode_rng
from tests.evaluation.controllers.flights import flown

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
    obstacle, packs = np.array([[0.0, -0.01]]), Packs(5, 0.104)
    places, ways = packs.given(packs.free(obstacle, 0.155)[0], ring, obstacle, 0.155)
    assert (ways >= np.linalg.norm(places - ring, axis=-1).mean(1)).all()
    assert np.linalg.norm(places[np.argmin(ways)] - ring, axis=-1).max() < 0.12


def test_each_vehicle_gets_a_place_of_its_own_and_the_ways_are_short():
    packs = Packs(5, 0.104)
    found, _ = packs.free(np.empty((0, 2)), 0.15)
    places, ways = packs.given(found, found[0][::-1], np.empty((0, 2)), 0.15)
    np.testing.assert_array_equal(places[0], found[0][::-1])
    assert ways[0] == 0
    np.testing.assert_allclose(np.sort(places, axis=1), np.sort(found, axis=1))
    assert (ways <= np.linalg.norm(found - found[0][::-1], axis=-1).mean(1) + 1e-12).all()


def test_vehicles_head_for_where_they_meet_the_waypoint():
    """A waypoint passing by is met ahead, on a straight way, and not followed from behind."""
    task = Scenario(n_vehicles=1, n_obstacles=0, waypoint_route=[(0.0, 0.0), (3.0, 0.0)])
    world, rngs = World(task), [episode_rng(0, 0)]
    planner = Planner(world)
    sensing = world.reset(rngs)
    planner.reset(rngs, task)
    world.positions, world.headings = np.array([[[0.0, -0.6]]]), np.array([[0.0]])
    meets_after = 0.6 / np.sqrt(task.max_speed**2 - task.waypoint_speed**2)
    for step in range(task.max_cycles):
        sensing, _ = world.step(planner.act(sensing, task))
        if step == 20:
            assert world.headings.item() == pytest.approx(np.arccos(task.waypoint_speed / task.max_speed), abs=0.05)
        if np.linalg.norm(world.positions[0, 0] - world.waypoints[0]) < 0.05:
            break
    assert step * task.time_step < meets_after + 0.8  # following it takes 7.2 s


def test_a_flock_holds_together_on_its_way_where_it_can():
    task = Scenario(n_vehicles=5, n_obstacles=2)
    world = World(task)
    world.reset([episode_rng(0, 0)])
    world.waypoints = np.zeros((1, 2))
    careless, careful = (Planner(world, PlannerGains(apart=apart)) for apart in (0.0, 100.0))
    rng, gained = np.random.default_rng(0), []
    for _ in range(60):
        vehicles = np.cumsum(rng.uniform(-0.14, 0.14, (5, 2)), axis=0)
        world.positions, world.obstacle_positions = vehicles[None], rng.uniform(-0.2, 0.2, (1, 2, 2))
        whole = []
        for planner in (careless, careful):
            offsets = planner._places(0) - vehicles
            lengths = np.linalg.norm(offsets, axis=-1, keepdims=True)
            later = [vehicles + offsets * np.minimum(1.0, way / lengths) for way in (0.0375, 0.075, 0.1125, 0.15)]
            whole.append(sum(bool(_connected(looked, 0.9 * task.link_range)) for looked in later))
        gained.append(whole[1] - whole[0])
    assert min(gained) == 0
    assert max(gained) > 0


def test_vehicles_hold_together_over_others():
    chain = np.stack((0.1 * np.arange(6), np.zeros(6)), axis=-1)
    gap = chain + np.where(np.arange(6) > 2, 0.05, 0.0)[:, None]
    np.testing.assert_array_equal(_connected(np.stack((chain, gap)), 0.11), [True, False])
    assert _connected(chain[:1], 0.1)


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
