import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_flock import CompactReplayBuffer, Scenario, make_vec_env
from sb3_flock._renamed import RenamedWarning
from sb3_flock.envs.flocking_v0 import action_space, observation_space
from sb3_flock.rl.buffers import load_replay_state, replay_state
from sb3_flock.settings import SettingsError

SPACES = observation_space(Scenario()), action_space(Scenario())
N_ENVS = 4


def fill(buffer, steps, seed=0):
    """Random episodes of about ten steps; some end by the time limit, some for real. Observations fit half precision."""
    rng = np.random.default_rng(seed)

    def draw():
        return rng.integers(0, 2000, (N_ENVS, *SPACES[0].shape)).astype(np.float32) / 1000

    observations = draw()
    for _ in range(steps):
        next_observations, done, timeout = draw(), rng.random(N_ENVS) < 0.1, rng.random(N_ENVS) < 0.5
        first = np.where(done[:, None, None, None], draw(), next_observations)  # of the next episode where one ended
        actions, rewards = rng.normal(size=(N_ENVS, 2)).astype(np.float32), rng.normal(size=N_ENVS).astype(np.float32)
        infos = [{"TimeLimit.truncated": bool(d and t)} for d, t in zip(done, timeout, strict=True)]
        buffer.add(observations, next_observations, actions, rewards, done, infos)
        observations = first


def samples(buffer, seed=0, env=None):
    np.random.seed(seed)  # noqa: NPY002 - what SB3 draws from
    return buffer.sample(200, env)


@pytest.mark.parametrize("steps", [1, 30])
def test_samples_equal_those_of_sb3s_buffer_up_to_rounding(steps):
    compact, sb3 = (kind(400, *SPACES, device="cpu", n_envs=N_ENVS) for kind in (CompactReplayBuffer, ReplayBuffer))
    fill(compact, steps)
    fill(sb3, steps)
    ours, theirs = samples(compact), samples(sb3)
    for name in ("actions", "dones", "rewards"):
        th.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=0, atol=0)
    for name in ("observations", "next_observations"):
        th.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=5e-4, atol=0)
        assert getattr(ours, name).dtype == th.float32


@pytest.mark.parametrize("options", [{}, {"norm_obs": False}, {"norm_reward": False}], ids=str)
def test_samples_are_normalized_as_sb3s_are(options):
    normalize = VecNormalize(make_vec_env(n_flocks=2, seed=0), **options)
    normalize.reset()
    for _ in range(30):
        normalize.step(np.stack([normalize.action_space.sample() for _ in range(6)]))
    compact, sb3 = (kind(400, *SPACES, device="cpu", n_envs=N_ENVS) for kind in (CompactReplayBuffer, ReplayBuffer))
    fill(compact, 30)
    fill(sb3, 30)
    ours, theirs = samples(compact, env=normalize), samples(sb3, env=normalize)
    for name in ("observations", "next_observations", "rewards"):
        th.testing.assert_close(getattr(ours, name), getattr(theirs, name), rtol=1e-3, atol=2e-2)
        assert getattr(ours, name).dtype == th.float32
    is_normalized = th.equal(theirs.observations, samples(sb3).observations)
    assert is_normalized == (options == {"norm_obs": False})


def test_mirror_augmentation_mirrors_half_of_a_sample_left_for_right():
    plain, mirrored = (
        CompactReplayBuffer(400, *SPACES, device="cpu", n_envs=N_ENVS, mirror_augmentation=option)
        for option in (False, True)
    )
    fill(plain, 30)
    fill(mirrored, 30)
    expected, batch = samples(plain), samples(mirrored)
    for name in ("observations", "next_observations"):
        first, second = getattr(batch, name).split(100)
        th.testing.assert_close(first, getattr(expected, name)[:100].flip(-1), rtol=0, atol=0)
        th.testing.assert_close(second, getattr(expected, name)[100:], rtol=0, atol=0)
    turned = th.cat([th.tensor([1.0, -1.0]).expand(100, 2), th.ones(100, 2)])
    th.testing.assert_close(batch.actions, expected.actions * turned, rtol=0, atol=0)
    th.testing.assert_close(batch.rewards, expected.rewards, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("observations", "actions"),
    [
        (spaces.Box(0, 1, (8,)), SPACES[1]),
        (spaces.Box(0, 1, (3, 11, 44)), SPACES[1]),
        (SPACES[0], spaces.Box(-1, 1, (3,))),
        (SPACES[0], spaces.Box(0, 1, (2,))),
        (SPACES[0], spaces.Discrete(3)),
    ],
)
def test_what_has_no_left_and_right_is_not_mirrored(observations, actions):
    with pytest.raises(
        SettingsError, match=r"^mirror_augmentation = True: observations of shape \(channels, l, l\)"
    ) as error:
        CompactReplayBuffer(80, observations, actions, device="cpu", mirror_augmentation=True)
    assert "\n" not in str(error.value)
    CompactReplayBuffer(80, observations, actions, device="cpu")


@pytest.mark.parametrize("mirror_augmentation", [False, True])
def test_expert_actions_are_scaled_and_mirrored_with_their_transition(mirror_augmentation):
    options = {"mirror_augmentation": mirror_augmentation, "store_expert_actions": True}
    buffer = CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS, **options)
    space, rng = SPACES[1], np.random.default_rng(0)
    observations = np.zeros((N_ENVS, *SPACES[0].shape), np.float32)
    for _ in range(33):
        actions = rng.uniform(-1, 1, (N_ENVS, 2)).astype(np.float32)
        infos = [{"expert_action": space.low + (action + 1) / 2 * (space.high - space.low)} for action in actions]
        buffer.add(observations, observations, actions, np.zeros(N_ENVS), np.zeros(N_ENVS, bool), infos)
    batch = samples(buffer)
    th.testing.assert_close(batch.expert_actions, batch.actions, rtol=0, atol=1e-6)
    assert len(batch.expert_actions.unique(dim=0)) > 50


def test_a_full_buffer_holds_the_newest_transitions_and_their_next_observations():
    compact, large = (
        CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS),
        ReplayBuffer(400, *SPACES, device="cpu", n_envs=N_ENVS),
    )
    fill(compact, 73)
    fill(large, 73)
    known = {
        large.rewards[step, env].item(): (step, env, large.next_observations[step, env])
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
            assert done.item() == large.dones[step, env] * (1 - large.timeouts[step, env])
    assert seen == set(range(53, 73))
    assert len(compact._last_observations) <= 21


@pytest.mark.parametrize("steps", [12, 150])
def test_steps_without_an_agent_are_not_sampled_and_the_others_evenly(steps):
    buffer = CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS)
    observations = np.zeros((N_ENVS, *SPACES[0].shape), np.float32)
    for step in range(steps):
        alive = [True, step % 2 == 0, step % 4 == 0, False]
        infos = [{"alive": acts} for acts in alive]
        rewards = step * N_ENVS + np.arange(N_ENVS)
        buffer.add(observations, observations, np.zeros((N_ENVS, 2)), rewards, np.zeros(N_ENVS, bool), infos)
    first = max(0, steps - 20)
    stored = [
        step * N_ENVS + env for step in range(first, steps) for env, every in ((0, 1), (1, 2), (2, 4)) if step % every == 0
    ]
    np.random.seed(0)  # noqa: NPY002 - what SB3 draws from
    seen = buffer.sample(20_000).rewards.numpy().ravel().astype(int)
    other = buffer.sample_indices(20_000)
    assert set(seen) == set(stored)
    assert set(buffer.rewards[other].astype(int)) == set(stored)
    counts = np.unique(seen, return_counts=True)[1] * len(stored) / 20_000
    assert 0.8 < counts.min() <= counts.max() < 1.2
    restored = CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS)
    load_replay_state(restored, replay_state(buffer))
    th.testing.assert_close(samples(restored).rewards, samples(buffer).rewards, rtol=0, atol=0)


def test_only_living_agents_need_an_expert_action():
    buffer = CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=2, store_expert_actions=True)
    observations, infos = np.zeros((2, *SPACES[0].shape), np.float32), [{"expert_action": SPACES[1].high}, {"alive": False}]
    buffer.add(observations, observations, np.zeros((2, 2)), np.zeros(2), np.zeros(2, bool), infos)
    assert (buffer.sample(9).expert_actions == 1).all()
    assert not buffer.lacks_expert_actions


def test_a_state_of_the_previous_release_has_living_agents_alone():
    buffer, other = (CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS) for _ in range(2))
    fill(buffer, 7)
    state = replay_state(buffer)
    assert state["arrays"].pop("alive").all()
    other.alive[:] = False
    load_replay_state(other, state)
    th.testing.assert_close(samples(other).rewards, samples(buffer).rewards)


def test_observations_are_rounded_to_the_nearest_half_as_numpy_does():
    buffer = CompactReplayBuffer(8, *SPACES, n_envs=N_ENVS)
    rng = np.random.default_rng(0)
    maps = (10.0 ** rng.uniform(-9, 4, (2, N_ENVS, *SPACES[0].shape))).astype(np.float32)
    buffer.add(*maps, np.zeros((N_ENVS, 2)), np.zeros(N_ENVS), np.array([True, False, False, False]), [{}] * N_ENVS)
    np.testing.assert_array_equal(buffer.observations[:2], maps.astype(np.float16))
    np.testing.assert_array_equal(buffer._last_observations[0][0], maps[1, 0].astype(np.float16))


def test_a_million_transitions_fit_into_a_gigabyte():
    buffer = CompactReplayBuffer(1_000_000, *SPACES, device="cpu", n_envs=40)
    arrays = (buffer.observations, buffer.actions, buffer.rewards, buffer.dones, buffer.timeouts)
    last_observations = 1_000_000 / Scenario().max_cycles * 363 * 2
    assert sum(array.nbytes for array in arrays) + last_observations < 0.8e9


def test_transitions_without_an_expert_action_are_known():
    buffer = CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS, store_expert_actions=True)
    assert not buffer.lacks_expert_actions
    fill(buffer, 1)
    assert buffer.lacks_expert_actions
    assert buffer.sample(5).expert_actions.isnan().all()


def test_arguments_of_the_previous_release_warn_and_work():
    with pytest.warns(RenamedWarning) as warned:
        buffer = CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS, mirror=True, advice=True)
    assert [str(warning.message).split(";")[0] for warning in warned] == [
        "CompactReplayBuffer: mirror is now mirror_augmentation",
        "CompactReplayBuffer: advice is now store_expert_actions",
    ]
    assert buffer.mirror_augmentation
    assert buffer.expert_actions is not None
    with pytest.raises(TypeError, match="got mirror_augmentation and its old name mirror"):
        CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS, mirror=True, mirror_augmentation=True)
    with pytest.raises(TypeError, match="unexpected argument 'color'"):
        CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS, color="red")


@pytest.mark.parametrize("kind", [CompactReplayBuffer, ReplayBuffer])
@pytest.mark.parametrize("steps", [7, 150])
def test_a_restored_buffer_gives_equal_samples(kind, steps):
    buffer, other = (kind(400, *SPACES, device="cpu", n_envs=N_ENVS) for _ in range(2))
    fill(buffer, steps)
    load_replay_state(other, replay_state(buffer))
    for more in range(2):
        for ours, theirs in zip(samples(buffer), samples(other), strict=True):
            if ours is not None:
                th.testing.assert_close(ours, theirs, rtol=0, atol=0)
        fill(buffer, 5, seed=1 + more)
        fill(other, 5, seed=1 + more)


def test_a_buffer_of_another_shape_is_refused():
    buffer = CompactReplayBuffer(80, *SPACES, device="cpu", n_envs=N_ENVS)
    fill(buffer, 3)
    wider = spaces.Box(0.0, 1.0, (3, 13, 13), np.float32)
    with pytest.raises(ValueError, match="replay buffer's observations"):
        load_replay_state(CompactReplayBuffer(80, wider, SPACES[1], device="cpu", n_envs=N_ENVS), replay_state(buffer))
