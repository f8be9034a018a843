import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.settings import ActionError, SettingsError
from sb3_flock.sim import Scenario, World, episode_rng
from sb3_flock.sim.sensing import nearest
from sb3_flock.sim.world import WorldError, along, waypoints_ahead
from tests.helpers import place


def test_the_position_moves_with_the_old_heading_then_the_heading_turns(scenario):
    world = place(scenario, [(0.0, 0.0), (0.5, 0.5), (-0.5, 0.2)], [0.0, np.pi / 2, np.pi])
    world.step([[[0.1, 1.0], [0.15, -2.0], [0.0, 3.0]]])
    np.testing.assert_allclose(world.positions[0], [(0.01, 0.0), (0.5, 0.515), (-0.5, 0.2)], atol=1e-15)
    np.testing.assert_allclose(world.headings[0], [0.1, np.pi / 2 - 0.2, -np.pi + 0.3], atol=1e-12)


def test_actions_are_clipped_to_their_bounds(scenario):
    world = place(scenario, [(0.0, 0.0), (0.5, 0.0), (0.9, 0.0)], [0.0, 0.0, 0.0])
    _, clipped = world.step([[[9.0, 9.0], [-9.0, -9.0], [0.1, 1.0]]])
    np.testing.assert_allclose(clipped[0], [(0.15, np.pi), (0.0, -np.pi), (0.1, 1.0)])
    np.testing.assert_allclose(world.positions[0, :, 0], [0.015, 0.5, 0.91])


def test_the_waypoint_moves_to_the_origin_and_stays_there(scenario):
    world = place(scenario, [(0.5, 0.5)], [0.0], waypoint=(0.03, 0.04))
    seen = []
    for _ in range(7):
        world.step(np.zeros((1, 1, 2)))
        seen.append(np.linalg.norm(world.waypoints[0]))
    np.testing.assert_allclose(seen, [0.04, 0.03, 0.02, 0.01, 0.0, 0.0, 0.0], atol=1e-12)
    assert np.isfinite(world.waypoints).all()


@pytest.mark.parametrize("route", [None, [(0.0, 0.0), (0.25, 0.0), (0.25, 1.0)]])
def test_the_predicted_waypoints_are_the_later_ones(scenario, route):
    world = World(scenario.replace(waypoint_route=route), 3)
    world.reset([np.random.default_rng(seed) for seed in range(3)])
    world.step(np.zeros((3, scenario.n_vehicles, 2)))
    steps = np.array([[0, 5, 30, 40], [0, 5, 30, 40], [40, 0, 5, 30]])
    predicted = waypoints_ahead(world.scenario, world.waypoints, world.steps, steps)
    seen = [world.waypoints]
    for _ in range(40):
        world.step(np.zeros((3, scenario.n_vehicles, 2)))
        seen.append(world.waypoints)
    np.testing.assert_allclose(predicted, np.stack(seen, axis=1)[np.arange(3)[:, None], steps], atol=1e-12)
    assert np.ptp(predicted, axis=1).max() > 10 * scenario.waypoint_speed * scenario.time_step


def test_a_waypoint_on_the_origin_or_without_speed_stays(scenario):
    world = place(scenario.replace(waypoint_speed=0.0), [(0.5, 0.5)], [0.0], waypoint=(0.3, 0.4))
    world.step(np.zeros((1, 1, 2)))
    np.testing.assert_array_equal(world.waypoints[0], (0.3, 0.4))
    world.waypoints = np.zeros((1, 2))
    world.step(np.zeros((1, 1, 2)))
    np.testing.assert_array_equal(world.waypoints[0], (0.0, 0.0))


def test_an_obstacle_walks_as_a_unicycle_and_turns_back_at_the_edge(scenario):
    world = place(scenario, [(0.0, 0.0)], [0.0], obstacles=[(0.0, 0.5), (0.999, 0.0)])
    world.obstacle_headings = np.array([[np.pi / 2, 0.0]])
    world.obstacle_speeds[0] = [[0.05, 0.1]]
    world.obstacle_turn_rates[0] = [[1.0, 0.5]]
    world.step(np.zeros((1, 1, 2)))
    np.testing.assert_allclose(world.obstacle_positions[0], [(0.0, 0.505), (1.0, 0.0)], atol=1e-12)
    np.testing.assert_allclose(world.obstacle_headings[0], [np.pi / 2 + 0.1, 0.05 - np.pi], atol=1e-12)


def test_crossing_obstacles_start_opposite_the_waypoint_and_move_straight_past_the_origin():
    scenario = Scenario(n_vehicles=5, n_obstacles=4, obstacle_motion="crossing")
    world = World(scenario, 50)
    world.reset([episode_rng(2, e) for e in range(50)])
    starts, waypoints = world.obstacle_positions, world.waypoints[:, None]
    np.testing.assert_allclose(np.linalg.norm(starts, axis=-1), 1.0)
    cosines = -(starts * waypoints).sum(-1) / np.linalg.norm(waypoints, axis=-1)
    assert (cosines >= np.cos(np.pi / 4) - 1e-12).all()
    assert nearest(world.positions, world.obstacle_positions).min() >= scenario.obstacle_separation
    headings, closest, arrival = world.obstacle_headings, np.full((50, 4), np.inf), np.zeros((50, 4))
    for k in range(170):
        world.step(np.zeros((50, 5, 2)))
        np.testing.assert_allclose(world.obstacle_headings, headings, atol=1e-12)
        distance = np.linalg.norm(world.obstacle_positions, axis=-1)
        arrival[distance < closest] = k
        closest = np.minimum(closest, distance)
    assert closest.max() <= np.sqrt(2) * scenario.link_range
    assert arrival.min() >= 75  # a chord that misses the origin is shorter than the way to it
    assert arrival.max() < 169


def test_the_random_walk_has_the_stated_distribution():
    scenario = Scenario(n_vehicles=1, n_obstacles=50)
    world = World(scenario, 20)
    world.reset([episode_rng(1, e) for e in range(20)])
    assert world.obstacle_speeds.min() >= 0
    assert world.obstacle_speeds.max() <= scenario.obstacle_max_speed
    assert world.obstacle_speeds.mean() == pytest.approx(0.05, rel=0.01)
    assert world.obstacle_turn_rates.std() == pytest.approx(2.0, rel=0.01)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 12), st.integers(0, 6))
def test_starts_lie_in_their_squares_and_keep_their_separations(seed, n_vehicles, n_obstacles):
    scenario = Scenario(n_vehicles=n_vehicles, n_obstacles=n_obstacles, obstacle_arena=0.7)
    world = World(scenario)
    world.reset([episode_rng(seed, 0)])
    assert np.abs(world.positions).max() <= 1.0
    assert np.abs(world.waypoints).max() <= 1.0
    assert np.abs(world.obstacle_positions).max(initial=0.0) <= 0.7
    assert nearest(world.positions, world.positions, exclude_self=True).min() >= scenario.neighbor_separation
    assert nearest(world.positions, world.obstacle_positions).min() >= scenario.obstacle_separation


def test_a_crowded_arena_is_an_error_that_names_the_bodies():
    with pytest.raises(WorldError, match=r"n_vehicles = 500: no start at least 0\.1 m"):
        World(Scenario(n_vehicles=500)).reset([episode_rng(0, 0)])
    with pytest.raises(WorldError, match="n_obstacles = 1"):
        World(Scenario(n_vehicles=30, n_obstacles=1, arena=0.5, obstacle_arena=0.01)).reset([episode_rng(0, 0)])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**31))
def test_no_body_exceeds_its_speed_and_obstacles_stay_in_their_square(seed):
    scenario = Scenario(n_vehicles=4, n_obstacles=3, obstacle_arena=0.5, max_cycles=40)
    world = World(scenario, 2)
    world.reset([episode_rng(seed, e) for e in range(2)])
    rng = np.random.default_rng(seed)
    for _ in range(scenario.max_cycles):
        before, obstacles, waypoints = world.positions, world.obstacle_positions, world.waypoints
        world.step(rng.normal(0, 5, (2, 4, 2)))
        assert np.linalg.norm(world.positions - before, axis=-1).max() <= 0.015 + 1e-12
        assert np.linalg.norm(world.obstacle_positions - obstacles, axis=-1).max() <= 0.01 + 1e-12
        assert np.linalg.norm(world.waypoints - waypoints, axis=-1).max() <= 0.01 + 1e-12
        assert np.abs(world.obstacle_positions).max() <= 0.5
        assert (np.abs(world.headings) <= np.pi).all()


def test_a_flocks_trajectory_does_not_depend_on_the_batch():
    scenario = Scenario(n_vehicles=5, n_obstacles=2, max_cycles=30)
    actions = np.random.default_rng(0).uniform(-1, 1, (30, 4, 5, 2))
    together = World(scenario, 4)
    together.reset([episode_rng(3, e) for e in range(4)])
    alone = [World(scenario) for _ in range(4)]
    for e, world in enumerate(alone):
        world.reset([episode_rng(3, e)])
    for step in actions:
        together.step(step)
        for e, world in enumerate(alone):
            world.step(step[e : e + 1])
            np.testing.assert_array_equal(world.positions[0], together.positions[e])
            np.testing.assert_array_equal(world.obstacle_positions[0], together.obstacle_positions[e])
            np.testing.assert_array_equal(world.headings[0], together.headings[e])


def test_stepping_without_a_reset_or_past_the_end_is_an_error():
    world = World(Scenario(max_cycles=1))
    with pytest.raises(RuntimeError, match="reset"):
        world.step(np.zeros((1, 3, 2)))
    world.reset([episode_rng(0, 0)])
    world.step(np.zeros((1, 3, 2)))
    with pytest.raises(RuntimeError, match="reset"):
        world.step(np.zeros((1, 3, 2)))


def test_every_flock_needs_its_generator():
    with pytest.raises(ValueError, match="rngs has 1 generators"):
        World(Scenario(), 2).reset([episode_rng(0, 0)])


def test_a_route_is_followed_at_the_waypoints_speed_to_its_end():
    scenario = Scenario(waypoint_route=[(0.0, 0.0), (0.1, 0.0), (0.1, 0.2)], waypoint_speed=0.5, n_vehicles=1)
    world = World(scenario, 2)
    world.reset([episode_rng(0, 0), episode_rng(0, 1)])
    seen = [world.waypoints.copy()]
    for _ in range(8):
        world.step(np.zeros((2, 1, 2)))
        seen.append(world.waypoints.copy())
    expected = [(0, 0), (0.05, 0), (0.1, 0), (0.1, 0.05), (0.1, 0.1), (0.1, 0.15), (0.1, 0.2), (0.1, 0.2), (0.1, 0.2)]
    np.testing.assert_allclose(np.stack(seen), np.array(expected)[:, None].repeat(2, axis=1), atol=1e-12)


def test_with_a_route_of_one_point_the_waypoint_stays_there():
    world = World(Scenario(waypoint_route=[(0.3, -0.2)]))
    world.reset([episode_rng(0, 0)])
    world.step(np.zeros((1, 3, 2)))
    np.testing.assert_allclose(world.waypoints, [[0.3, -0.2]])


@pytest.mark.parametrize("motion", ["walk", "crossing"])
def test_obstacles_start_at_the_given_points_and_vehicles_start_apart_from_them(motion):
    starts = [(0.0, 0.0), (0.5, 0.5)]
    scenario = Scenario(
        n_vehicles=8, n_obstacles=3, arena=0.4, obstacle_arena=0.6, obstacle_starts=starts, obstacle_motion=motion
    )
    for episode in range(20):
        world = World(scenario.replace(obstacle_max_speed=0.0))
        world.reset([episode_rng(0, episode)])
        np.testing.assert_array_equal(world.obstacle_positions[0, :2], starts)
        distances = np.linalg.norm(world.positions[0, :, None] - world.obstacle_positions[0], axis=-1)
        assert distances.min() >= scenario.obstacle_separation
        world.step(np.zeros((1, 8, 2)))
        np.testing.assert_array_equal(world.obstacle_positions[0, :2], starts)  # with no speed they stay


def test_too_many_obstacle_starts_and_starts_outside_are_refused():
    with pytest.raises(SettingsError, match=r"obstacle_starts has 2 points: n_obstacles = 1"):
        Scenario(obstacle_starts=[(0, 0), (1, 1)])
    with pytest.raises(
        SettingsError, match=r"obstacle_starts: \(2\.0, 0\.0\) is outside the obstacles' square of half side 1\.0"
    ):
        Scenario(obstacle_starts=[(2, 0)])
    with pytest.raises(SettingsError, match="waypoint_route = "):
        Scenario(waypoint_route=[])


def test_points_along_a_route_and_beyond_its_end():
    route = np.array([(0.0, 0.0), (3.0, 0.0), (3.0, 4.0)])
    points = along(route, np.array([[0.0, 1.5, 3.0], [5.0, 7.0, 99.0]]))
    np.testing.assert_allclose(points, [[(0, 0), (1.5, 0), (3, 0)], [(3, 2), (3, 4), (3, 4)]])


def test_a_state_continues_in_another_world_and_one_of_other_sizes_is_refused():
    scenario = Scenario(n_vehicles=3, n_obstacles=2, max_cycles=8)
    world, other = World(scenario, 2), World(scenario, 2)
    world.reset([episode_rng(0, e) for e in range(2)])
    world.step(np.full((2, 3, 2), 0.1))
    other.load_state_dict(world.state_dict())
    for _ in range(7):
        world.step(np.full((2, 3, 2), 0.1))
        other.step(np.full((2, 3, 2), 0.1))
    for name in ("positions", "headings", "obstacle_positions", "obstacle_headings", "waypoints"):
        np.testing.assert_array_equal(getattr(world, name), getattr(other, name))
    assert other.steps == 8
    for changes in ({"n_vehicles": 4}, {"n_obstacles": 1}, {"max_cycles": 9}):
        with pytest.raises(ValueError, match=r"has the shape .* is needed"):
            World(scenario.replace(**changes), 2).load_state_dict(world.state_dict())


def test_headings_are_changed_as_a_whole():
    world = place(Scenario(), [(0.0, 0.0)], [0.0])
    np.testing.assert_allclose(world.frames[0, 0], (1.0, 0.0))
    with pytest.raises(ValueError, match="read-only"):
        world.headings[0, 0] = 1.0  # the frames would be of the headings before
    world.headings = np.array([[np.pi / 2]])
    np.testing.assert_allclose(world.frames[0, 0], (0.0, 1.0), atol=1e-15)


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_actions_that_are_not_finite_are_refused_in_one_line(number):
    world = World(Scenario(n_vehicles=3), 2)
    world.reset([episode_rng(0, 0), episode_rng(0, 1)])
    actions = np.zeros((2, 3, 2))
    actions[1, 2, 0] = number
    before = world.positions.copy()
    with pytest.raises(ActionError, match=rf"^action of flock 1 vehicle 2 = \[{number}, 0.0\]: finite numbers are needed$"):
        world.step(actions)
    np.testing.assert_array_equal(world.positions, before)
    assert world.steps == 0


@pytest.mark.parametrize("shape", [(2,), (3, 2), (1, 3, 2), (2, 1, 2), (2, 3, 1), (2, 3), ()])
def test_actions_of_another_shape_are_refused_and_not_broadcast(shape):
    world = World(Scenario(n_vehicles=3), 2)
    world.reset([episode_rng(0, 0), episode_rng(0, 1)])
    with pytest.raises(ActionError) as error:
        world.step(np.zeros(shape))
    assert str(error.value) == f"actions have the shape {shape}: (2, 3, 2) is needed"
