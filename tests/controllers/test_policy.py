import functools

import numpy as np
import pytest
from sb3_contrib import RecurrentPPO
from stable_baselines3 import DDPG
from stable_baselines3.common.vec_env import VecFrameStack, VecNormalize

from sb3_flock import FlockPolicy, Scenario, make_vec_env
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.envs.flocking_v0 import action_space, observation_space
from sb3_flock.sim import World, episode_rng, observe
from tests.helpers import place

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


class Counts:
    """A recurrent policy: its action is the number of the row's steps, in hundredths."""

    def predict(self, observations, state=None, episode_start=None, deterministic=False):
        steps = np.zeros((1, len(observations))) if state is None else np.where(episode_start, 0, state)
        return np.repeat(steps.T / 100, 2, axis=1), steps + 1


def test_a_recurrent_policy_keeps_its_state_within_an_episode_and_in_checkpoints():
    controller, sensing = PolicyController(Counts()), sensed(60)  # 300 rows: two blocks
    for _ in range(2):
        controller.reset([], SCENARIO)
        for step in range(3):
            assert (controller.act(sensing, SCENARIO) == step / 100).all()
    other = PolicyController(Counts())
    other.load_state_dict(controller.state_dict())
    assert (other.act(sensing, SCENARIO) == 0.03).all()
    assert (controller.act(sensed(2), SCENARIO) == 0).all()  # other flocks
    assert PolicyController(FirstAnchor()).state_dict() == {}


def test_recurrent_ppo_acts_as_in_sb3s_loop():
    env = make_vec_env(SCENARIO, 2, seed=0)
    kwargs = {"lstm_hidden_size": 8, "net_arch": [8], "log_std_init": -9.0}
    model = RecurrentPPO("MlpLstmPolicy", env, n_steps=8, batch_size=8, policy_kwargs=kwargs, device="cpu", seed=0)
    controller, observations, state = PolicyController(model), env.reset(), None
    starts = np.ones(env.num_envs, bool)
    for _ in range(6):
        worlds = [copy.world for copy in env.get_attr("unwrapped", indices=[0, 5])]
        expected, state = model.predict(observations, state=state, episode_start=starts, deterministic=True)
        one = place(SCENARIO, worlds[1].positions[0], worlds[1].headings[0], worlds[1].obstacle_positions[0])
        one.waypoints = worlds[1].waypoints
        np.testing.assert_allclose(controller.act(one.sense(), SCENARIO)[0], expected[5:], rtol=1e-4, atol=1e-6)
        observations, _, starts, _ = env.step(expected)
    stateless, _ = model.predict(observations, deterministic=True)
    assert np.abs(stateless - model.predict(observations, state, starts, True)[0]).max() > 1e-4


def test_a_model_with_vec_normalize_sees_normalized_observations():
    env = VecNormalize(make_vec_env(SCENARIO, 2, seed=0))
    model = DDPG(FlockPolicy, env, buffer_size=20, device="cpu", policy_kwargs={"final_init": 1.0}, seed=0)
    observations = model.env.reset()  # its own observations, and the statistics of them
    for copy, start in zip(env.get_attr("unwrapped", indices=[0, 5]), (0, 5), strict=True):
        actions = PolicyController(model).act(copy.world.sense(), SCENARIO)
        expected, _ = model.predict(observations[start : start + 5], deterministic=True)
        np.testing.assert_allclose(actions[0], expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("order", ["normalize first", "stack first"])
def test_a_model_with_a_stack_of_frames_acts_as_in_sb3s_loop(order):
    flat = make_vec_env(SCENARIO, 2, seed=0)
    stack = functools.partial(VecFrameStack, n_stack=3, channels_order="first")
    env = stack(VecNormalize(flat)) if order == "normalize first" else VecNormalize(stack(flat))
    model = DDPG(FlockPolicy, env, buffer_size=20, device="cpu", policy_kwargs={"final_init": 1.0}, seed=0)
    controller, observations = PolicyController(model), model.env.reset()
    for step in range(5):
        sensing = env.get_attr("unwrapped", indices=[5])[0].world.sense()
        model.get_vec_normalize_env().training = False
        expected, _ = model.predict(observations, deterministic=True)
        if step == 3:  # another controller goes on from its state
            other = PolicyController(model)
            other.load_state_dict(controller.state_dict())
            controller = other
        np.testing.assert_allclose(controller.act(sensing, SCENARIO)[0], expected[5:], rtol=1e-4, atol=1e-6)
        observations, *_ = model.env.step(expected)
    controller.reset([], SCENARIO)
    again = controller.act(sensing, SCENARIO)[0]
    assert np.abs(again - expected[5:]).max() > 1e-4  # without the earlier frames
