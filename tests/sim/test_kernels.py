"""The compiled functions against their twins in NumPy; numba's own options are covered by the twins' tests of whole sensings."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_flock.sim import Scenario, World, dynamics, episode_rng, mix_rewards, reward, reward_terms, sensing, unicycle
from sb3_flock.sim.randomization import UNBOUNDED

kernels = pytest.importorskip("sb3_flock.sim.kernels")


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 3), st.integers(1, 12), st.integers(0, 8), st.floats(0.01, 3.0), st.booleans())
def test_contacts_are_those_of_numpy(seed, flocks, vehicles, obstacles, sensing_range, exclude_self):
    rng = np.random.default_rng(seed)
    positions, bodies = (rng.uniform(-1, 1, (flocks, count, 2)) for count in (vehicles, obstacles))
    if exclude_self:
        bodies = positions
    angles = rng.uniform(-np.pi, np.pi, (flocks, vehicles))
    frames = np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    plain = sensing.find_contacts(positions, frames, bodies, sensing_range, exclude_self, use_numba=False)
    found = kernels.find_contacts(positions, frames, bodies, sensing_range, exclude_self)
    for values, name in zip(found, ("observers", "bodies", "positions", "distances"), strict=True):
        np.testing.assert_array_equal(values, getattr(plain, name), err_msg=name)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 3), st.integers(1, 6), st.integers(0, 4))
def test_bodies_move_as_in_numpy(seed, flocks, vehicles, obstacles):
    rng = np.random.default_rng(seed)
    positions, controls = rng.uniform(-1, 1, (2, flocks, vehicles, 2))
    headings, obstacle_headings = (rng.uniform(-np.pi, np.pi, (flocks, count)) for count in (vehicles, obstacles))
    arguments = (
        positions,
        dynamics.directions_of(headings),
        headings,
        controls,
        rng.uniform(-1, 1, (flocks, obstacles, 2)),
        dynamics.directions_of(obstacle_headings),
        obstacle_headings,
        *rng.uniform(-20, 20, (2, flocks, obstacles)),
        0.1,
        0.8,  # some obstacles are outside
    )
    for fast, plain in zip(kernels.move_bodies(*arguments), dynamics.move_bodies(*arguments), strict=True):
        np.testing.assert_array_equal(fast, plain)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**31), st.integers(1, 3), st.integers(1, 6))
def test_unicycles_with_actuators_move_as_in_numpy(seed, flocks, vehicles):
    """Up to the rounding of the exponential; each actuator is switched off in some flocks."""
    rng = np.random.default_rng(seed)
    off = np.array([0.0, 0.0, UNBOUNDED, UNBOUNDED, 0.0, 0.0, 0.0])[:, None]
    values = np.where(rng.random((7, flocks)) < 0.4, off, rng.uniform(0.01, [[1], [1], [2], [20], [0.1], [1], [0.1]]))
    headings = rng.uniform(-np.pi, np.pi, (flocks, vehicles))
    arrays = rng.uniform(-1, 1, (4, flocks, vehicles, 2))
    noise = rng.normal(size=(flocks, vehicles, 3))
    arguments = arrays[0], dynamics.directions_of(headings), headings, arrays[1], arrays[2], noise, values, 0.1
    for fast, plain in zip(kernels.step_unicycles(*arguments), unicycle.step_unicycles(*arguments), strict=True):
        np.testing.assert_allclose(fast, plain, atol=1e-13)


def test_sensing_and_rewards_are_those_of_numpy(monkeypatch):
    def sensed():
        world = World(Scenario(n_vehicles=9, n_obstacles=4, arena=0.3), 5)
        seen = world.reset([episode_rng(0, episode) for episode in range(5)])
        graph = seen.neighbors
        mixed = mix_rewards(np.arange(45.0).reshape(5, 9), graph.observers, graph.vehicles, 0.7)
        terms = reward_terms(seen, np.full((5, 9, 2), 0.1), Scenario().reward, Scenario())
        counts = graph.count(), graph.count(0.12), seen.obstacles.count(0.2)
        contacts = [getattr(of, name) for of in (graph, seen.obstacles) for name in ("bodies", "positions", "distances")]
        return [mixed, *terms.values(), *counts, *contacts, seen.waypoint_positions, seen.waypoint_distances]

    fast = sensed()
    for module in (sensing, reward):
        monkeypatch.setattr(module, "compiled", lambda: None)
    for compiled, plain in zip(fast, sensed(), strict=True):
        np.testing.assert_array_equal(compiled, plain)
