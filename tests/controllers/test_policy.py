import numpy as np
import pytest
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flock import FlockPolicy, Scenario, make_vec_env
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.envs.flocking_v0 import action_space, observation_space
from sb3_flock.sim import World, episode_rng, observe

SCENARIO = Scenario(n_vehicles=5, n_obstacles=2, max_cycles=40, arena=0.5, obstacle_arena=0.5)


@pytest.fixture(scope="module")
def network():
    """Networks with large random weights, so that actions vary with the observations."""
    return FlockPolicy(observation_space(SCENARIO), action_space(SCENARIO), lr_schedule=lambda _: 0.0, final_init=1.0)


def sensed(n_flocks):
    return World(SCENARIO, n_flocks).reset([episode_rng(0, episode) for episode in range(n_flocks)])


def test_each_vehicle_gets_its_own_action(network):
    sensing = sensed(3)
    actions = PolicyController(network).act(sensing, SCENARIO)
    assert actions.shape == (3, 5, 2)
    alone, _ = network.predict(observe(sensing, SCENARIO)[2, 4], deterministic=True)
    np.testing.assert_allclose(actions[2, 4], alone, rtol=1e-4, atol=1e-6)
    assert all(action_space(SCENARIO).contains(action.astype(np.float32)) for action in actions.reshape(-1, 2))


def test_an_action_does_not_depend_on_the_other_rows(network):
    many = PolicyController(network).act(sensed(60), SCENARIO)  # 300 rows: two calls of the network
    few = PolicyController(network).act(sensed(2), SCENARIO)
    np.testing.assert_array_equal(many[:2], few)


class FirstAnchor:
    """SB3's ``predict`` with actions that can be checked by hand."""

    def __init__(self):
        self.calls = []

    def predict(self, observations, deterministic):
        self.calls.append((observations.shape, deterministic))
        return observations[:, [0, 2], 5, 5], None


@pytest.mark.parametrize(("n_flocks", "calls"), [(1, 1), (51, 1), (52, 2)])
def test_predict_is_called_with_blocks_of_one_shape_deterministically(n_flocks, calls):
    policy, sensing = FirstAnchor(), sensed(n_flocks)
    actions = PolicyController(policy).act(sensing, SCENARIO)
    assert policy.calls == [((256, 3, 11, 11), True)] * calls
    np.testing.assert_array_equal(actions, observe(sensing, SCENARIO)[..., [0, 2], 5, 5])


def test_a_model_with_vec_normalize_sees_normalized_observations():
    env = VecNormalize(make_vec_env(SCENARIO, 2, seed=0))
    model = DDPG(FlockPolicy, env, buffer_size=20, device="cpu", policy_kwargs={"final_init": 1.0}, seed=0)
    observations = model.env.reset()  # its own observations, and the statistics of them
    for copy, start in zip(env.get_attr("unwrapped", indices=[0, 5]), (0, 5), strict=True):
        actions = PolicyController(model).act(copy.world.sense(), SCENARIO)
        expected, _ = model.predict(observations[start : start + 5], deterministic=True)
        np.testing.assert_allclose(actions[0], expected, rtol=1e-4, atol=1e-6)
