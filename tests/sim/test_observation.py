import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.sim import Scenario, observe, sense
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
    return observe(sense(world), world.scenario)[0]


def test_a_single_anchor_by_hand(scenario, place):
    # Ahead by 0.09 and left by 0.03: three anchor spacings of 0.03 forward, one left, so the peak is at (5 + 3, 5 + 1).
    world = place(scenario, [(0.0, 0.0), (-0.03, 0.09)], [np.pi / 2, 0.0], waypoint=(0.0, 0.0))
    tensor = observation(world)[0]
    assert tensor.dtype == np.float32
    assert tensor.shape == (3, 11, 11)
    assert tensor[0, 8, 6] == np.float32(1.0)
    np.testing.assert_allclose(tensor[0, 8, 7], math.exp(-0.5), rtol=1e-6)
    np.testing.assert_allclose(tensor[0, 6, 5], math.exp(-0.5 * (2**2 + 1**2)), rtol=1e-6)
    assert tensor[1].max() == 0.0
    assert tensor[2, 5, 5] == np.float32(1.0)  # the waypoint is on the vehicle


def test_bodies_add_up_in_their_own_channel_with_its_own_radius(scenario, place):
    world = place(
        scenario, [(0.0, 0.0), (0.09, 0.0), (0.09, 0.0)], [0.0] * 3, obstacles=[(0.15, 0.0)], waypoint=(0.12, -0.18)
    )
    tensor = observation(world)[0]
    np.testing.assert_allclose(tensor[0, 8, 5], 2.0, rtol=1e-6)  # two neighbors 3 spacings of 0.03 ahead
    np.testing.assert_allclose(tensor[1, 8, 5], 1.0, rtol=1e-6)  # 3 spacings of 0.05 ahead
    np.testing.assert_allclose(tensor[2, 7, 2], 1.0, rtol=1e-6)  # 2 ahead, 3 to the right, spacing 0.06


def test_the_whole_tensor_against_the_sum_over_bodies(place):
    world = random_world(5)
    sensing = sense(world)
    tensor = observe(sensing, SCENARIO)[0]
    for i in range(4):
        anchors = np.linspace(-0.25, 0.25, 11)
        for a in range(11):
            for b in range(11):
                expected = sum(
                    math.exp(-0.5 * ((x - anchors[a]) ** 2 + (y - anchors[b]) ** 2) / 0.05**2)
                    for x, y in sensing.obstacles.positions[sensing.obstacles.observers == i]
                )
                np.testing.assert_allclose(tensor[i, 1, a, b], expected, rtol=1e-5, atol=1e-12)


def test_a_far_waypoint_shows_on_the_circle(scenario, place):
    near = observation(place(scenario, [(0.0, 0.0)], [0.0], waypoint=(0.0, 0.4)))
    far = observation(place(scenario, [(0.0, 0.0)], [0.0], waypoint=(0.0, 5.0)))
    np.testing.assert_allclose(near, far, rtol=1e-5)
    assert far[0, 2, 5, 10] == np.float32(1.0)


@settings(max_examples=50, deadline=None)
@given(seeds, st.floats(-np.pi, np.pi), st.floats(-3, 3), st.floats(-3, 3))
def test_rotating_and_translating_the_world_changes_nothing(seed, angle, dx, dy):
    world, moved = random_world(seed), random_world(seed)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for name in ("positions", "obstacle_positions", "waypoints"):
        setattr(moved, name, getattr(world, name) @ rotation.T + (dx, dy))
    moved.headings = world.headings + angle
    bodies = ((world.positions, True), (world.obstacle_positions, False))
    distances = np.concatenate(
        [block.ravel() for there, others in bodies for _, block in distance_blocks(world.positions, there, others)]
    )
    edge = np.abs(distances[:, None] - np.array([SCENARIO.link_range, SCENARIO.detection_range])).min() < 1e-9
    if not edge:  # rounding may carry a body over the edge of a sensing range
        np.testing.assert_allclose(observation(moved), observation(world), atol=1e-5)


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_mirroring_the_world_mirrors_the_tensor(seed):
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
def test_nothing_outside_its_sensing_range_shows(seed):
    world, near = random_world(seed), random_world(seed)
    sensing = sense(world)
    for i in range(4):
        rest = sorted([i, *sensing.neighbors.by_observer()[i]])
        seen = sensing.obstacles.by_observer()[i]
        near = place(
            SCENARIO,
            world.positions[0, rest],
            world.headings[0, rest],
            world.obstacle_positions[0, seen],
            world.waypoints[0],
        )
        alone = observe(sense(near), near.scenario)[0, rest.index(i)]
        np.testing.assert_allclose(alone, observe(sensing, SCENARIO)[0, i], atol=1e-6)


def test_every_call_returns_a_fresh_array():
    sensing = sense(random_world(0))
    assert not np.shares_memory(observe(sensing, SCENARIO), observe(sensing, SCENARIO))


@settings(max_examples=50, deadline=None)
@given(seeds, st.integers(2, 17), st.floats(0.1, 4.0), st.sampled_from([0.03, 0.15, 0.6]))
def test_compiled_and_plain_paint_the_same(seed, n_anchors, anchor_width, radius):
    pytest.importorskip("numba")
    scenario = SCENARIO.replace(
        n_anchors=n_anchors, anchor_width=anchor_width, neighbor_radius=radius, obstacle_radius=radius, goal_radius=radius
    )
    sensing = sense(random_world(seed, scenario))
    compiled, plain = observe(sensing, scenario), observe(sensing, scenario, use_numba=False)
    np.testing.assert_allclose(compiled, plain, rtol=1e-5, atol=1e-20)
