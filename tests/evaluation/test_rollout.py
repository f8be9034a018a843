import numpy as np
import pytest
from gymnasium import spaces

from sb3_flock import FlockPolicy, Scenario, evaluate
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.envs.flocking_v0 import action_space, observation_space
from sb3_flock.evaluation import METRICS, fly
from sb3_flock.settings import SettingsError

SCENARIO = Scenario(n_vehicles=5, n_obstacles=2, max_cycles=40, arena=0.5, obstacle_arena=0.5)


class GoToWaypoint:
    """Turns to the waypoint and flies to it, heeding nothing else."""

    def act(self, sensing, scenario):
        x, y = sensing.waypoint_positions[..., 0], sensing.waypoint_positions[..., 1]
        return np.stack([np.maximum(x, 0.0) * 2, np.arctan2(y, x) * 5], axis=-1)


@pytest.fixture(scope="module")
def network():
    """Networks with large random weights, so that actions vary with the tensors."""
    return FlockPolicy(observation_space(SCENARIO), action_space(SCENARIO), lr_schedule=lambda _: 0.0, final_init=1.0)


def test_the_numbers_do_not_depend_on_the_batch(network):
    flown = [fly(PolicyController(network), SCENARIO, 23, seed=4, batch=batch) for batch in (23, 10, 1)]
    for name in METRICS:
        np.testing.assert_array_equal(flown[0][name], flown[1][name])
        np.testing.assert_array_equal(flown[0][name], flown[2][name])


def test_fewer_episodes_are_the_first_of_more(network):
    many, few = (fly(PolicyController(network), SCENARIO, episodes, seed=4) for episodes in (20, 5))
    np.testing.assert_array_equal(many["return"][:5], few["return"])


def test_seeds_change_the_episodes():
    first, second = (fly(GoToWaypoint(), SCENARIO, 5, seed=seed)["return"] for seed in (0, 1))
    assert not np.array_equal(first, second)


def test_a_controller_that_heads_for_the_waypoint_tracks_it_and_collides():
    metrics = evaluate(GoToWaypoint(), SCENARIO.replace(max_cycles=200), episodes=20, seed=0)
    assert metrics["tracking_error"].mean < 0.05
    assert metrics["neighbor_violation_rate"].mean > 0.3
    assert metrics["tracking_error"].low < metrics["tracking_error"].mean < metrics["tracking_error"].high
    assert metrics["tracking_error"].n == 20


def test_a_policy_needs_a_scenario_from_somewhere(network):
    with pytest.raises(SettingsError, match="scenario = None"):
        evaluate(network)


@pytest.mark.parametrize(("kwargs", "name"), [({"episodes": 0}, "episodes = 0"), ({"seed": -1}, "seed = -1")])
def test_bad_counts_are_told_in_one_line(kwargs, name):
    with pytest.raises(SettingsError, match=name):
        evaluate(GoToWaypoint(), SCENARIO, **{"episodes": 1, **kwargs})


def test_a_policy_controller_gives_each_vehicle_its_own_action(network):
    from sb3_flock.sim import World, episode_rng, observe

    world = World(SCENARIO, 3)
    sensing = world.reset([episode_rng(0, e) for e in range(3)])
    actions = PolicyController(network).act(sensing, SCENARIO)
    assert actions.shape == (3, 5, 2)
    alone, _ = network.predict(observe(sensing, SCENARIO)[2, 4], deterministic=True)
    np.testing.assert_allclose(actions[2, 4], alone, rtol=1e-4, atol=1e-6)
    assert isinstance(action_space(SCENARIO), spaces.Box)
    assert all(action_space(SCENARIO).contains(action.astype(np.float32)) for action in actions.reshape(-1, 2))
