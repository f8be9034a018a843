import numpy as np
import pytest

from sb3_flock import Scenario, evaluate
from sb3_flock.controllers.random import RandomController
from sb3_flock.sim import World, episode_rng

SCENARIO = Scenario(n_vehicles=4, n_obstacles=0, max_cycles=50)


def actions_of(episodes):
    """All actions of these episodes, ``(steps, episodes, vehicles, 2)``."""
    controller, rngs = RandomController(), [episode_rng(0, episode) for episode in episodes]
    world = World(SCENARIO, len(rngs))
    sensing = world.reset(rngs)
    controller.reset(rngs, SCENARIO)
    return np.array([controller.act(sensing, SCENARIO) for _ in range(SCENARIO.max_cycles)])


def test_actions_are_uniform_in_their_bounds():
    actions = actions_of(range(50))
    for values, low, high in ((actions[..., 0], 0.0, 0.15), (actions[..., 1], -np.pi, np.pi)):
        assert low <= values.min() < values.max() <= high
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.02 * (high - low))
        assert values.std() == pytest.approx((high - low) / np.sqrt(12), rel=0.03)


def test_each_episode_draws_from_its_own_generator():
    together = actions_of([3, 5])
    np.testing.assert_array_equal(together[:, 1], actions_of([5])[:, 0])
    assert not np.array_equal(together[:, 0], together[:, 1])


def test_random_actions_neither_track_nor_connect():
    metrics = evaluate(RandomController(), Scenario(n_vehicles=3, n_obstacles=1), episodes=30, seed=1)
    assert 0.5 <= metrics["tracking_error"].mean <= 2.0
    assert metrics["connectivity"].mean <= 0.01
