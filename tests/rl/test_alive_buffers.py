import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer

from sb3_flock.rl.alive_buffers import AliveReplayBuffer, AliveRolloutBuffer

SPACES = spaces.Box(-1, 99, (3,), np.float32), spaces.Box(-1, 1, (2,), np.float32)


def test_a_replay_buffer_has_room_for_living_agents_alone():
    buffer = AliveReplayBuffer(6, *SPACES, device="cpu", n_envs=4)
    for step in range(3):
        infos = [{"alive": slot > step} | {"TimeLimit.truncated": slot == 3} for slot in range(4)]
        numbers = 10 * step + np.arange(4)
        observations = np.tile(numbers[:, None], 3)
        buffer.add(observations, observations + 1, numbers[:, None] * [1, 2], numbers, np.arange(4) >= 2, infos)
    assert buffer.size() == 6
    assert buffer.full
    batch = buffer.sample(200)
    stored = [1, 2, 3, 12, 13, 23]
    assert sorted(set(batch.rewards.ravel().tolist())) == stored
    assert (batch.observations == batch.rewards).all()
    assert (batch.next_observations == batch.rewards + 1).all()
    assert (batch.actions == batch.rewards * th.tensor([1, 2])).all()
    ended, truncated = (np.isin(batch.rewards % 10, kinds) for kinds in ([2, 3], [3]))
    np.testing.assert_array_equal(batch.dones, ended & ~truncated)


@pytest.mark.parametrize("options", [{"optimize_memory_usage": True}, {"color": "red"}])
def test_other_arguments_are_refused(options):
    with pytest.raises(TypeError, match=f"AliveReplayBuffer got an unexpected argument '{next(iter(options))}'"):
        AliveReplayBuffer(6, *SPACES, n_envs=4, **options)


def rollouts(kind, steps=5, slots=3):
    rng = np.random.default_rng(0)
    buffer = kind(steps, *SPACES, "cpu", 0.9, 0.99, slots)
    for step in range(steps):
        observations = np.tile(step * slots + np.arange(slots)[:, None], 3)
        values, log_probs = th.from_numpy(rng.normal(size=(2, slots)))
        buffer.add(observations, rng.normal(size=(slots, 2)), rng.normal(size=slots), np.zeros(slots), values, log_probs)
    buffer.compute_returns_and_advantage(th.zeros(slots), np.zeros(slots))
    return buffer


@pytest.mark.parametrize("batch_size", [None, 4])
def test_where_all_live_the_rollout_buffers_minibatches_are_sb3s(batch_size):
    batches = []
    for kind in (AliveRolloutBuffer, RolloutBuffer):
        buffer = rollouts(kind)
        np.random.seed(0)  # noqa: NPY002 - what SB3 draws from
        batches.append([batch for _ in range(2) for batch in buffer.get(batch_size)])
    assert len(batches[0]) == (2 if batch_size is None else 8)
    for ours, theirs in zip(*batches, strict=True):
        for one, other in zip(ours, theirs, strict=True):
            th.testing.assert_close(one, other, rtol=0, atol=0)


def test_the_rollout_buffer_leaves_out_steps_without_an_agent():
    buffer = rollouts(AliveRolloutBuffer)
    buffer.alive[1, 2] = buffer.alive[3:, 0] = False
    for _ in range(2):
        batches = list(buffer.get(5))
        assert [len(batch.observations) for batch in batches] == [5, 5, 2]
        found = sorted(number for batch in batches for number in batch.observations[:, 0].tolist())
        assert found == sorted(set(range(15)) - {5, 9, 12})
    buffer.reset()
    assert buffer.alive.shape == (5, 3)
    assert buffer.alive.all()
