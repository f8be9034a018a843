import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_flock import CompactReplayBuffer, Scenario
from sb3_flock.envs.flocking_v0 import action_space, observation_space

SPACES = observation_space(Scenario()), action_space(Scenario())
N_ENVS = 4


def fill(buffer, steps, seed=0):
    """Random episodes of about ten steps; some end by the time limit, some for real. Observations fit half precision."""
    rng = np.random.default_rng(seed)

    def draw():
        return rng.integers(0, 2000, (N_ENVS, *SPACES[0].shape)).astype(np.float32) / 1000

    observations = draw()
    for _ in range(steps):
        after, done, timeout = draw(), rng.random(N_ENVS) < 0.1, rng.random(N_ENVS) < 0.5
        first = np.where(done[:, None, None, None], draw(), after)  # of the next episode where one ended
        actions, rewards = rng.normal(size=(N_ENVS, 2)).astype(np.float32), rng.normal(size=N_ENVS).astype(np.float32)
        infos = [{"TimeLimit.truncated": bool(d and t)} for d, t in zip(done, timeout, strict=True)]
        buffer.add(observations, after, actions, rewards, done, infos)
        observations = first


def samples(buffer, seed=0):
    np.random.seed(seed)  # noqa: NPY002 - what SB3 draws from
    return buffer.sample(200)


@pytest.mark.parametrize("steps", [1, 30])
def test_it_returns_what_sb3s_buffer_returns_but_for_the_last_digits(steps):
    compact, stock = (kind(400, *SPACES, device="cpu", n_envs=N_ENVS) for kind in (CompactReplayBuffer, ReplayBuffer))
    fill(compact, steps)
    fill(stock, steps)
    ours, theirs = samples(compact), samples(stock)
    for name in ("actions", "dones", "rewards"):
        th.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=0, atol=0)
    for name in ("observations", "next_observations"):
        th.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=5e-4, atol=0)
        assert getattr(ours, name).dtype == th.float32


@pytest.mark.parametrize("mirror", [False, True])
def test_advice_comes_with_its_transition_scaled_and_mirrored_as_the_action_is(mirror):
    buffer = CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS, mirror=mirror, advice=True)
    space, rng = SPACES[1], np.random.default_rng(0)
    tensors = np.zeros((N_ENVS, *SPACES[0].shape), np.float32)
    for _ in range(33):
        actions = rng.uniform(-1, 1, (N_ENVS, 2)).astype(np.float32)
        infos = [{"advice": space.low + (action + 1) / 2 * (space.high - space.low)} for action in actions]
        buffer.add(tensors, tensors, actions, np.zeros(N_ENVS), np.zeros(N_ENVS, bool), infos)
    batch = samples(buffer)
    th.testing.assert_close(batch.advice, batch.actions, rtol=0, atol=1e-6)
    assert len(batch.advice.unique(dim=0)) > 50


def test_once_full_it_holds_the_newest_transitions_and_the_right_next_observations():
    compact, everything = (
        CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS),
        ReplayBuffer(400, *SPACES, device="cpu", n_envs=N_ENVS),
    )
    fill(compact, 73)
    fill(everything, 73)
    known = {
        everything.rewards[step, env].item(): (step, env, everything.next_observations[step, env])
        for step in range(73)
        for env in range(N_ENVS)
    }
    seen = set()
    for seed in range(5):
        batch = samples(compact, seed)
        for reward, after, done in zip(batch.rewards, batch.next_observations, batch.dones, strict=True):
            step, env, expected = known[reward.item()]
            seen.add(step)
            np.testing.assert_allclose(after.numpy(), expected, rtol=5e-4)
            assert done.item() == everything.dones[step, env] * (1 - everything.timeouts[step, env])
    assert seen == set(range(53, 73))
    assert len(compact._last_observations) <= 21


def test_a_million_transitions_fit_into_a_gigabyte():
    buffer = CompactReplayBuffer(1_000_000, *SPACES, device="cpu", n_envs=40)
    arrays = (buffer.observations, buffer.actions, buffer.rewards, buffer.dones, buffer.timeouts)
    kept_aside = 1_000_000 / Scenario().max_cycles * 363 * 2
    assert sum(array.nbytes for array in arrays) + kept_aside < 0.8e9
