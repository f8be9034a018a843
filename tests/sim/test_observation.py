import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.serialization.yaml_io import load_config, to_yaml
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Channel, Scenario, World, episode_rng, observe, register_channel
from sb3_flock.sim.observation import CHANNELS
from sb3_flock.sim.sensing import distance_blocks
from tests.helpers import place

SCENARIO = Scenario(n_vehicles=4, n_obstacles=2)
seeds = st.integers(0, 2**31)


def random_world(seed, scenario=SCENARIO):
    """Bodies close enough to sense each other."""
    rng = np.random.default_rng(seed)
    return place(
        scenario,
        rng.uniform(-0.15, 0.15, (4, 2)),
        rng.uniform(-np.pi, np.pi, 4),
        rng.uniform(-0.2, 0.2, (2, 2)),
        rng.uniform(-0.6, 0.6, 2),
    )


def observation(world):
    return observe(world.sense(), world.scenario)[0]


def test_a_single_anchor_by_hand(scenario):
    # Ahead by 0.09 and left by 0.03: three anchor spacings of 0.03 forward, one left, so the peak is at (5 + 3, 5 + 1).
    world = place(scenario, [(0.0, 0.0), (-0.03, 0.09)], [np.pi / 2, 0.0], waypoint=(0.0, 0.0))
    channels = observation(world)[0]
    assert channels.dtype == np.float32
    assert channels.shape == (3, 11, 11)
    assert channels[0, 8, 6] == np.float32(1.0)
    np.testing.assert_allclose(channels[0, 8, 7], math.exp(-0.5), rtol=1e-6)
    np.testing.assert_allclose(channels[0, 6, 5], math.exp(-0.5 * (2**2 + 1**2)), rtol=1e-6)
    assert channels[1].max() == 0.0
    assert channels[2, 5, 5] == np.float32(1.0)  # the waypoint is on the vehicle


def test_bodies_add_up_in_their_own_channel_with_its_own_radius(scenario):
    world = place(
        scenario, [(0.0, 0.0), (0.09, 0.0), (0.09, 0.0)], [0.0] * 3, obstacles=[(0.15, 0.0)], waypoint=(0.12, -0.18)
    )
    channels = observation(world)[0]
    np.testing.assert_allclose(channels[0, 8, 5], 2.0, rtol=1e-6)  # two neighbors 3 spacings of 0.03 ahead
    np.testing.assert_allclose(channels[1, 8, 5], 1.0, rtol=1e-6)  # 3 spacings of 0.05 ahead
    np.testing.assert_allclose(channels[2, 7, 2], 1.0, rtol=1e-6)  # 2 ahead, 3 to the right, spacing 0.06


def test_a_whole_channel_against_the_sum_over_bodies():
    world = random_world(5)
    sensing = world.sense()
    observations = observe(sensing, SCENARIO)[0]
    for i in range(4):
        anchors = np.linspace(-0.25, 0.25, 11)
        for a in range(11):
            for b in range(11):
                expected = sum(
                    math.exp(-0.5 * ((x - anchors[a]) ** 2 + (y - anchors[b]) ** 2) / 0.05**2)
                    for x, y in sensing.obstacles.positions[sensing.obstacles.observers == i]
                )
                np.testing.assert_allclose(observations[i, 1, a, b], expected, rtol=1e-5, atol=1e-12)


def test_a_far_waypoint_shows_on_the_circle(scenario):
    near = observation(place(scenario, [(0.0, 0.0)], [0.0], waypoint=(0.0, 0.4)))
    far = observation(place(scenario, [(0.0, 0.0)], [0.0], waypoint=(0.0, 5.0)))
    np.testing.assert_allclose(near, far, rtol=1e-5)
    assert far[0, 2, 5, 10] == np.float32(1.0)


@settings(max_examples=50, deadline=None)
@given(seeds, st.floats(-np.pi, np.pi), st.floats(-3, 3), st.floats(-3, 3))
def test_rotating_and_translating_the_world_changes_no_observation(seed, angle, dx, dy):
    world, transformed = random_world(seed), random_world(seed)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for name in ("positions", "obstacle_positions", "waypoints"):
        setattr(transformed, name, getattr(world, name) @ rotation.T + (dx, dy))
    transformed.headings = world.headings + angle
    bodies = ((world.positions, True), (world.obstacle_positions, False))
    distances = np.concatenate(
        [
            block.ravel()
            for there, exclude_self in bodies
            for _, block in distance_blocks(world.positions, there, exclude_self)
        ]
    )
    edge = np.abs(distances[:, None] - np.array([SCENARIO.link_range, SCENARIO.detection_range])).min() < 1e-9
    if not edge:  # rounding may carry a body over the edge of a sensing range
        np.testing.assert_allclose(observation(transformed), observation(world), atol=1e-5)


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_mirroring_the_world_mirrors_the_observation(seed):
    world, mirrored = random_world(seed), random_world(seed)
    for name in ("positions", "obstacle_positions", "waypoints"):
        setattr(mirrored, name, getattr(world, name) * (1, -1))
    mirrored.headings = -world.headings
    np.testing.assert_allclose(observation(mirrored), observation(world)[..., ::-1], atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(seeds, st.permutations(range(4)))
def test_permuting_the_vehicles_permutes_the_observations(seed, order):
    world, permuted = random_world(seed), random_world(seed)
    permuted.positions, permuted.headings = world.positions[:, order], world.headings[:, order]
    np.testing.assert_allclose(observation(permuted), observation(world)[list(order)], atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_bodies_beyond_the_sensing_range_do_not_show(seed):
    world = random_world(seed)
    sensing = world.sense()
    for i in range(4):
        rest = sorted([i, *sensing.neighbors.by_observer()[i]])
        detected = sensing.obstacles.by_observer()[i]
        near = place(
            SCENARIO,
            world.positions[0, rest],
            world.headings[0, rest],
            world.obstacle_positions[0, detected],
            world.waypoints[0],
        )
        alone = observe(near.sense(), near.scenario)[0, rest.index(i)]
        np.testing.assert_allclose(alone, observe(sensing, SCENARIO)[0, i], atol=1e-6)


def test_every_call_returns_a_fresh_array():
    sensing = random_world(0).sense()
    assert not np.shares_memory(observe(sensing, SCENARIO), observe(sensing, SCENARIO))


@settings(max_examples=50, deadline=None)
@given(seeds, st.integers(2, 17), st.floats(0.1, 4.0), st.sampled_from([0.03, 0.15, 0.6]))
def test_numba_and_numpy_give_equal_observations(seed, n_anchors, anchor_width, radius):
    pytest.importorskip("numba")
    scenario = SCENARIO.replace(
        n_anchors=n_anchors, anchor_width=anchor_width, neighbor_radius=radius, obstacle_radius=radius, goal_radius=radius
    )
    sensing = random_world(seed, scenario).sense()
    fast, plain = observe(sensing, scenario), observe(sensing, scenario, use_numba=False)
    np.testing.assert_allclose(fast, plain, rtol=1e-5, atol=1e-20)


# Channels registered outside the package


@pytest.fixture
def _extra_channels(restored):
    restored(CHANNELS)
    register_channel(
        Channel(
            "obstacles_ahead",
            "obstacles",
            radius=lambda settings: settings.detection_range / 2,
            select=lambda positions: positions[..., 0] > 0,
        )
    )
    register_channel(Channel("all_neighbors", "neighbors", radius=lambda settings: settings.link_range))
    left = register_channel(
        Channel("waypoint_left", "waypoint", lambda settings: 0.5, select=lambda positions: positions[..., 1] > 0)
    )
    assert register_channel(left) is left  # the same object again is no error


EXTRA = ("obstacles_ahead", "all_neighbors", "waypoint_left")


@pytest.mark.usefixtures("_extra_channels")
def test_extra_channels_follow_the_papers_and_show_the_selected_bodies_alone():
    world = random_world(5)
    scenario = world.scenario.replace(extra_channels=EXTRA)
    assert scenario.observation_shape == (6, 11, 11)
    assert scenario.channel_radii == (0.15, 0.25, 0.3, 0.125, 0.15, 0.5)
    sensing = world.sense()
    observations = observe(sensing, scenario)[0]
    assert observations.shape == (4, 6, 11, 11)
    np.testing.assert_array_equal(observations[:, :3], observe(sensing, world.scenario)[0])
    np.testing.assert_array_equal(observations[:, 4], observations[:, 0])
    anchors = np.linspace(-0.125, 0.125, 11)
    grid = np.stack(np.meshgrid(anchors, anchors, indexing="ij"), axis=-1)
    ahead = behind = 0
    for i in range(4):
        expected = np.zeros((11, 11))
        for x, y in sensing.obstacles.positions[sensing.obstacles.observers == i]:
            if x > 0:
                expected += np.exp(-0.5 * np.square(grid - (x, y)).sum(-1) / 0.025**2)
            ahead, behind = ahead + (x > 0), behind + (x <= 0)
        np.testing.assert_allclose(observations[i, 3], expected, rtol=1e-5, atol=1e-12)
    assert ahead
    assert behind


@pytest.mark.usefixtures("_extra_channels")
def test_an_extra_channel_of_the_waypoint_is_empty_where_it_is_not_selected(scenario):
    scenario = scenario.replace(extra_channels=["waypoint_left"])
    for y, peak in ((0.2, np.float32(1.0)), (-0.2, 0.0), (7.0, np.float32(1.0))):
        world = place(scenario, [(0.0, 0.0)], [0.0], waypoint=(0.0, y))
        assert observation(world)[0, 3].max() == peak
        assert observation(world)[0, 3, 5, 10] == (1.0 if y == 7.0 else pytest.approx(0.0, abs=0.02))  # on the circle


@pytest.mark.usefixtures("_extra_channels")
def test_motion_channels_come_in_the_order_of_the_present_channels():
    scenario = Scenario(
        n_vehicles=8, n_obstacles=6, arena=0.3, obstacle_arena=0.4, motion_lag=0.2, extra_channels=EXTRA, max_cycles=9
    )
    assert scenario.observation_shape == (12, 11, 11)
    world, rng = World(scenario, 3), np.random.default_rng(0)
    measured = world.sensors.measure(world.reset([episode_rng(0, episode) for episode in range(3)]))
    for _ in range(4):
        actions = rng.uniform(world.action_low, world.action_high, (3, 8, 2))
        measured = world.sensors.measure(world.step(actions)[0])
    observations = observe(measured, scenario)
    present = scenario.replace(motion_lag=0.0)
    now, then = observe(measured, present), observe(measured.previous, present)
    np.testing.assert_array_equal(observations[:, :, :6], now)
    np.testing.assert_allclose(observations[:, :, 6:], now - then, atol=1e-6)
    assert (np.abs(observations[:, :, 6:]).max((0, 1, 3, 4)) > 0.01).all()


@pytest.mark.usefixtures("_extra_channels")
@pytest.mark.parametrize("motion_lag", [0.0, 0.1])
def test_numba_and_numpy_give_equal_extra_channels(motion_lag):
    pytest.importorskip("numba")
    scenario = Scenario(
        n_vehicles=8, n_obstacles=6, arena=0.3, obstacle_arena=0.4, motion_lag=motion_lag, extra_channels=EXTRA
    )
    world = World(scenario, 4)
    world.sensors.measure(world.reset([episode_rng(1, episode) for episode in range(4)]))
    measured = world.sensors.measure(world.step(np.full((4, 8, 2), 0.1))[0])
    fast, plain = observe(measured, scenario), observe(measured, scenario, use_numba=False)
    np.testing.assert_allclose(fast, plain, rtol=1e-5, atol=1e-6 if motion_lag else 1e-20)
    assert fast[:, :, 3].max() > 0.1


@pytest.mark.usefixtures("_extra_channels")
def test_a_scenario_with_extra_channels_is_read_back(tmp_path):
    scenario = Scenario(extra_channels=EXTRA[:2], motion_lag=0.2)
    assert Scenario(**scenario.model_dump(mode="json")) == scenario
    (tmp_path / "scenario.yaml").write_text(to_yaml(scenario))
    assert load_config(Scenario, tmp_path / "scenario.yaml") == scenario


@pytest.mark.parametrize("name", ["obstacles_ahead", "neighbors"])
def test_a_channel_that_is_not_registered_is_refused(name):
    with pytest.raises(SettingsError, match=f"extra_channels = {name}: .*register_channel are needed; none is registered"):
        Scenario(extra_channels=[name])


@pytest.mark.usefixtures("_extra_channels")
@pytest.mark.parametrize(
    ("names", "message"),
    [
        (
            ["obstacle_ahead"],
            "extra_channels = obstacle_ahead: .*; registered are obstacles_ahead, .*did you mean obstacles_ahead",
        ),
        (["obstacles"], "extra_channels = obstacles: different channels"),
        (["obstacles_ahead", "obstacles_ahead"], "extra_channels = obstacles_ahead: different channels"),
    ],
)
def test_unknown_and_repeated_extra_channels_are_refused_in_one_line(names, message):
    with pytest.raises(SettingsError, match=message) as error:
        Scenario(extra_channels=names)
    assert "\n" not in str(error.value)


@pytest.mark.usefixtures("_extra_channels")
@pytest.mark.parametrize("name", ["obstacles_ahead", "waypoint"])
def test_a_channels_name_is_taken_once(name):
    with pytest.raises(ValueError, match=f"channel '{name}' is registered already"):
        register_channel(Channel(name, "obstacles", radius=lambda settings: 1.0))
