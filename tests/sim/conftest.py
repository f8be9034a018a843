"""A world placed by hand."""

import numpy as np
import pytest

from sb3_flock import flocking_v0
from sb3_flock.sim import Scenario, World, episode_rng


def place(scenario, positions, headings, obstacles=(), waypoint=(0.0, 0.0)):
    """A world of one flock with every body where the caller wants it."""
    world = World(scenario.replace(n_vehicles=len(positions), n_obstacles=len(obstacles)))
    world.reset([episode_rng(0, 0)])
    world.positions = np.array([positions], dtype=float)
    world.headings = np.array([headings], dtype=float)
    world.obstacle_positions = np.array([obstacles], dtype=float).reshape(1, -1, 2)
    world.obstacle_headings = np.zeros((1, len(obstacles)))
    world.waypoints = np.array([waypoint], dtype=float)
    return world


def assert_another_goes_on_alike(env, actions, steps):
    """An env like this one, made to go on from its state, shows the same to the last bit, within the space."""
    other = flocking_v0.parallel_env(env.scenario)
    other.load_state_dict(env.state_dict())
    for _ in range(steps):
        ours, theirs = env.step(actions)[0], other.step(actions)[0]
        for agent in env.agents:
            np.testing.assert_array_equal(ours[agent], theirs[agent])
            assert env.observation_space(agent).contains(ours[agent])


@pytest.fixture(name="place")
def _place():
    return place


@pytest.fixture
def scenario():
    return Scenario()
