import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from sb3_flock import (
    CompactReplayBuffer,
    FlockDDPG,
    FlockPolicy,
    NeighborInclusiveReward,
    Scenario,
    VecNeighborInclusiveReward,
    flatten,
    make_vec_env,
)
from sb3_flock.envs.vec_reward import mix_by_infos
from sb3_flock.settings import SettingsError
from tests.envs.scripted import Scripted

CROWDED = Scenario(n_vehicles=4, n_obstacles=1, arena=0.2, obstacle_arena=0.4, neighbor_separation=0.02, max_cycles=5)
OPTIONS = {"learning_starts": 10**9, "buffer_size": 400, "device": "cpu", "seed": 0}


class Keep(BaseCallback):
    """Keeps the infos of every step."""

    def __init__(self):
        super().__init__()
        self.infos = []

    def _on_step(self):
        self.infos.append(self.locals["infos"])
        return True


def ddpg(env, callbacks, buffer=CompactReplayBuffer):
    model = FlockDDPG(FlockPolicy, env, replay_buffer_class=buffer, **OPTIONS)
    model.learn(12 * env.num_envs, callback=callbacks)
    return model


def test_the_rewards_are_those_of_the_callback():
    wrapped = ddpg(VecMonitor(VecNeighborInclusiveReward(make_vec_env(CROWDED, 2, seed=1), 0.6)), keep := Keep())
    other = ddpg(VecMonitor(make_vec_env(CROWDED, 2, seed=1)), callback := NeighborInclusiveReward(0.6))
    np.testing.assert_array_equal(wrapped.replay_buffer.rewards[:12], other.replay_buffer.rewards[:12])
    raw = [[sum(info["reward_terms"].values()) for info in infos] for infos in keep.infos]
    np.testing.assert_allclose([[info["reward"] for info in infos] for infos in keep.infos], raw, rtol=1e-5)
    assert np.abs(wrapped.replay_buffer.rewards[:12] - raw).max() > 1e-3
    returns = [episode["r"] for episode in wrapped.ep_info_buffer]  # VecMonitor around the wrapper has the mixed return
    np.testing.assert_allclose(returns, list(callback._finished), rtol=1e-5)


def test_vec_monitor_below_logs_the_raw_return():
    below = ddpg(VecNeighborInclusiveReward(VecMonitor(make_vec_env(CROWDED, 1, seed=1))), None)
    raw = ddpg(VecMonitor(make_vec_env(CROWDED, 1, seed=1)), None)
    assert [e["r"] for e in below.ep_info_buffer] == [e["r"] for e in raw.ep_info_buffer]


@pytest.mark.parametrize("buffer", [CompactReplayBuffer, ReplayBuffer])
def test_off_policy_vec_normalize_around_it_stores_the_mixed_rewards(buffer):
    env = VecNormalize(VecNeighborInclusiveReward(make_vec_env(CROWDED, 2, seed=1), 0.6))
    model = ddpg(env, None, buffer)
    expected = ddpg(make_vec_env(CROWDED, 2, seed=1), NeighborInclusiveReward(0.6))
    first = model.replay_buffer.rewards[0], expected.replay_buffer.rewards[0]  # later actions differ by the normalization
    np.testing.assert_array_equal(*first)
    sampled = model.replay_buffer.sample(20, env).rewards.numpy()
    assert set(sampled.ravel()) <= set(env.normalize_reward(model.replay_buffer.rewards).ravel())


def test_on_policy_vec_normalize_around_it_normalizes_the_mixed_rewards():
    env = VecNormalize(VecNeighborInclusiveReward(make_vec_env(CROWDED.replace(max_cycles=40), 2, seed=1), 0.6), gamma=0.9)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=64, device="cpu", policy_kwargs={"net_arch": [8]}, seed=0)
    model.learn(8 * env.num_envs, callback=(keep := Keep()))
    last = keep.infos[-1]
    raw = np.array([info["reward"] for info in last])
    mixed = mix_by_infos(raw, last, 4, 0.6)
    np.testing.assert_allclose(model.rollout_buffer.rewards[-1], env.normalize_reward(mixed), rtol=1e-4)


def test_a_dead_neighbor_does_not_count():
    env = VecNeighborInclusiveReward(
        flatten(Scripted(), 2, seed=0), 0.5
    )  # the neighbor of all is a, which dies after 3 steps
    env.reset()
    rewards = [env.step(np.zeros((8, 2), np.float32))[1] for _ in range(6)]
    np.testing.assert_array_equal(rewards[2], [10, 15, 20, 25] * 2)
    np.testing.assert_array_equal(rewards[3], [0, 20, 30, 40] * 2)


def test_mixing_twice_or_normalized_rewards_is_refused_in_one_line():
    env = make_vec_env(CROWDED, 2, seed=1)
    for wrong in (VecNormalize(env), VecMonitor(VecNeighborInclusiveReward(env))):
        with pytest.raises(SettingsError, match="needed below VecNormalize, once, not around Vec"):
            VecNeighborInclusiveReward(wrong)
    with pytest.raises(SettingsError, match="the env's VecNeighborInclusiveReward mixes the rewards already"):
        ddpg(VecMonitor(VecNeighborInclusiveReward(env)), NeighborInclusiveReward())


@pytest.mark.parametrize(
    ("options", "line"), [({"lambda_": 1.1}, "lambda_ = 1.1: input"), ({"n_agents": 3}, "n_agents = 3: .*which is 4")]
)
def test_bad_parameters_are_refused_in_one_line(options, line):
    with pytest.raises(SettingsError, match=line):
        VecNeighborInclusiveReward(make_vec_env(CROWDED, 2), **options)
    for lambda_ in (0.0, 1.0):
        VecNeighborInclusiveReward(make_vec_env(CROWDED, 2), lambda_=lambda_)
