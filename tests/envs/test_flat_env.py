"""Agents that die or join, and infos of the last step, each with a test that fails on SuperSuit's own flattening."""

import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecMonitor

from sb3_flock import Scenario, flatten, make_vec_env
from sb3_flock.settings import RunError
from tests.envs.scripted import LIVES, Scripted

N = len(LIVES)
EPISODE = 6


def roll(env, steps=2 * EPISODE):
    """The reset's observations, and all steps, with the step's number as the first action of every slot, in hundredths."""
    observations = env.reset()
    return observations, [env.step(np.full((env.num_envs, 2), (step + 1) / 100, np.float32)) for step in range(steps)]


def lives_in(step):
    """Which agents act in a step of an episode, from 1."""
    return np.array([start < step <= end for start, end, _ in LIVES.values()])


@pytest.mark.parametrize("num_cpus", [0, 2])
def test_agents_die_and_join_each_by_itself(num_cpus):
    env = flatten(Scripted(), n_copies=2, num_cpus=num_cpus, seed=0)
    first, steps = roll(env)
    env.close()
    numbers = np.tile(np.arange(1, N + 1), 2)
    np.testing.assert_array_equal(first[:, 0], np.where(np.tile(lives_in(1), 2), numbers, 0))
    for index, (observations, rewards, dones, infos) in enumerate(steps):
        step = index % EPISODE + 1
        alive, next_alive = np.tile(lives_in(step), 2), np.tile(lives_in(step % EPISODE + 1), 2)
        ends = np.tile([end == step for _, end, _ in LIVES.values()], 2)
        cuts = np.tile([kind == "truncation" for *_, kind in LIVES.values()], 2)
        assert [info["alive"] for info in infos] == alive.tolist()
        np.testing.assert_array_equal(dones, ends)
        np.testing.assert_array_equal(rewards, 10 * numbers * alive)
        np.testing.assert_array_equal(observations[:, 0], numbers * next_alive)
        assert not observations[~next_alive].any()
        for slot, info in enumerate(infos):
            assert ("neighbors" in info) == alive[slot]
            assert ("terminal_observation" in info) == ends[slot]
            if ends[slot]:
                action = np.float32((index + 1) / 100)
                np.testing.assert_array_equal(info["terminal_observation"], [numbers[slot], step + 1, action])
                assert info["TimeLimit.truncated"] == cuts[slot]


@pytest.mark.parametrize("num_cpus", [0, 2])
def test_the_infos_of_a_reset_stay_apart_from_those_of_the_last_step(num_cpus):
    env = flatten(Scripted(), n_copies=2, num_cpus=num_cpus, seed=0)
    env.reset()
    start = {"neighbors": [3], "start": True}
    assert env.reset_infos[1] == start
    env.reset_infos = [{} for _ in range(2 * N)]
    _, steps = roll(env, EPISODE)
    env.close()
    for *_, infos in steps:
        assert all(info["neighbors"] == [0] for info in infos if info["alive"])
        assert not any("start" in info or len(info) > 4 for info in infos)
    assert env.reset_infos == 2 * [start, start, {}, start]


def test_only_living_agents_get_actions_and_no_step_is_added_to_an_episode():
    env = flatten(Scripted(), seed=0)
    env.reset()
    (copy,) = env.get_attr("unwrapped", indices=0)
    for step in range(1, EPISODE):
        env.step(np.full((N, 2), step, np.float32))
        names = [name for name, acts in zip(LIVES, lives_in(step), strict=True) if acts]
        assert list(copy.received[-1]) == names
    assert len(copy.received) == EPISODE - 1
    env.step(np.zeros((N, 2), np.float32))
    assert (copy.steps, copy.received) == (0, [])


class Sloppy(Scripted):
    """Ends without flags, after two steps."""

    def step(self, actions):
        observations, rewards, *_, infos = super().step(actions)
        if self.steps == 2:
            self.agents = []
        never = dict.fromkeys(rewards, False)
        return observations, rewards, never, never, infos


def test_an_agent_that_is_gone_without_a_flag_is_truncated():
    _, steps = roll(flatten(Sloppy(), seed=0), 4)
    for index, (_, _, dones, infos) in enumerate(steps):
        assert dones.tolist() == [index % 2 == 1, index % 2 == 1, False, index % 2 == 1]
        assert [info.get("TimeLimit.truncated", False) for info in infos] == dones.tolist()


class Blind(Scripted):
    def observe(self, *args):
        return {name: numbers for name, numbers in super().observe(*args).items() if name != "d"}


def test_a_living_agent_without_an_observation_and_an_empty_episode_are_one_line():
    with pytest.raises(RunError, match="^d is in the env's agents and has no observation$"):
        flatten(Blind(), seed=0).reset()
    with pytest.raises(RunError, match="^the env has no agents after its reset$"):
        flatten(Scripted({"a": (1, 2, "termination")}), seed=0).reset()


def test_flocks_that_live_together_say_so():
    env = make_vec_env(n_flocks=2, seed=0)
    env.reset()
    *_, infos = env.step(np.zeros((6, 2), np.float32))
    assert all(info["alive"] is True for info in infos)


def test_an_env_needs_no_render_mode_and_no_metadata(monkeypatch):
    monkeypatch.delattr(Scripted, "render_mode")
    monkeypatch.delattr(Scripted, "metadata")
    env = flatten(Scripted(), 2, seed=0)
    assert env.render_mode is None
    assert env.reset().shape == (2 * N, 3)


class Optional(Scripted):
    """Each reset's infos hold its options."""

    def reset(self, seed=None, options=None):
        observations, infos = super().reset(seed, options)
        return observations, {name: {"options": options} for name in infos}


@pytest.mark.parametrize("num_cpus", [0, 2])
def test_the_options_of_a_reset_reach_every_copy_for_one_reset(num_cpus):
    env = flatten(Optional(), 2, num_cpus=num_cpus, seed=0)
    env.set_options({"wind": 3})
    found = []
    for options in (None, None, {"wind": 4}):
        env.reset(options=options)
        found.append([info["options"] for info in env.reset_infos if info])
    env.close()
    assert found == [[{"wind": 3}] * 6, [None] * 6, [{"wind": 4}] * 6]


@pytest.mark.parametrize("num_cpus", [0, 2])
def test_the_monitor_counts_living_agents_alone(num_cpus):
    env = flatten(Scripted(), n_copies=2, num_cpus=num_cpus, seed=0, monitor=True)
    roll(env, 4)  # what a reset breaks off does not count
    _, steps = roll(env)
    assert env.env_is_wrapped(Monitor) == [True] * 2 * N
    env.close()
    lengths = np.tile([end - start for start, end, _ in LIVES.values()], 2)
    episodes = {
        (step, slot): info["episode"]
        for step, (*_, infos) in enumerate(steps)
        for slot, info in enumerate(infos)
        if "episode" in info
    }
    ends = [end for _, end, _ in LIVES.values()] * 2
    assert set(episodes) == {(first + end - 1, slot) for first in (0, EPISODE) for slot, end in enumerate(ends)}
    for (_, slot), episode in episodes.items():
        assert episode["l"] == lengths[slot]
        assert episode["r"] == 10 * (slot % N + 1) * lengths[slot]
        assert 0 <= episode["t"] < 60


def test_the_monitor_agrees_with_sb3s_where_all_live():
    scenario = Scenario(max_cycles=5)
    ours, sb3s = make_vec_env(scenario, 2, seed=0, monitor=True), VecMonitor(make_vec_env(scenario, 2, seed=0))
    for (*_, infos), (*_, expected) in zip(roll(ours, 10)[1], roll(sb3s, 10)[1], strict=True):
        for info, other in zip(infos, expected, strict=True):
            assert ("episode" in info) == ("episode" in other)
            if "episode" in info:
                assert info["episode"]["r"] == pytest.approx(other["episode"]["r"], rel=1e-5)
                assert info["episode"]["l"] == other["episode"]["l"] == 5
    assert not any("episode" in info for info in roll(make_vec_env(scenario, 2, seed=0), 5)[1][-1][-1])


def test_evaluate_policy_counts_the_monitors_episodes():
    env = flatten(Scripted(), n_copies=2, seed=0, monitor=True)
    model = PPO("MlpPolicy", env, n_steps=8, batch_size=8, device="cpu")
    returns, lengths = evaluate_policy(model, env, n_eval_episodes=8, return_episode_rewards=True)
    assert sorted(zip(returns, lengths, strict=True)) == sorted([(30, 3), (120, 6), (90, 3), (240, 6)] * 2)


@pytest.mark.parametrize("steps", [2, 4])
def test_an_episode_continues_from_its_state_where_agents_died_or_have_not_joined(steps):
    env, other = (flatten(Scripted(), n_copies=2, seed=0, monitor=True) for _ in range(2))
    roll(env, steps)
    other.reset()
    other.load_state_dict(env.state_dict())
    for step in range(8):
        ours, theirs = (one.step(np.full((2 * N, 2), step / 10, np.float32)) for one in (env, other))
        for mine, yours in zip(ours[:3], theirs[:3], strict=True):
            np.testing.assert_array_equal(mine, yours)
        for infos in (ours[3], theirs[3]):
            for info in infos:
                info.get("episode", {}).pop("t", None)
        assert data_equivalence(ours[3], theirs[3], exact=True)


def test_an_env_that_cannot_save_its_state_is_named_in_one_line(monkeypatch):
    monkeypatch.delattr(Scripted, "state_dict")
    with pytest.raises(NotImplementedError, match="^Scripted has no state_dict and load_state_dict to save its episodes$"):
        flatten(Scripted(), seed=0).state_dict()
