from dataclasses import asdict

import numpy as np
from gymnasium.utils.env_checker import data_equivalence

from sb3_flock.envs.batch import copy_flocks, select_flocks
from sb3_flock.sim import Scenario, World, episode_rng

CROWD = Scenario(n_vehicles=6, n_obstacles=3, arena=0.3, obstacle_arena=0.5, neighbor_separation=0.05, motion_lag=0.2)
SOME = np.array([1, 4, 5])


def after_three_steps(episodes):
    """A world of these episodes, and what is measured in it."""
    world = World(CROWD, len(episodes))
    sensing = world.reset([episode_rng(0, episode) for episode in episodes])
    for _ in range(3):
        world.sensors.measure(sensing)
        sensing, _ = world.step(np.full((len(episodes), 6, 2), 0.1))
    return world, world.sensors.measure(sensing)


def test_some_flocks_sense_what_they_sense_alone():
    _, measured = after_three_steps(range(7))
    _, alone = after_three_steps(SOME)
    assert len(alone.previous.neighbors.bodies)
    assert len(alone.obstacles.bodies)
    assert data_equivalence(asdict(select_flocks(measured, SOME)), asdict(alone), exact=True)


def test_copied_flocks_are_those_of_a_world_of_their_own():
    world, _ = after_three_steps(range(7))
    alone, _ = after_three_steps(SOME)
    copied = World(CROWD)
    copy_flocks(world, SOME, copied)
    assert copied.n_flocks == 3
    ours, theirs = copied.state_dict(), alone.state_dict()
    assert not ours.pop("sensors")["history"]
    assert theirs.pop("sensors")["history"]
    assert data_equivalence(ours, theirs, exact=True)
    copied.positions += 1.0
    assert not np.array_equal(copied.positions, world.positions[SOME])
