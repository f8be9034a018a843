"""A world placed by hand."""

import numpy as np
import pytest

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


@pytest.fixture(name="place")
def _place():
    return place


@pytest.fixture
def scenario():
    return Scenario()
