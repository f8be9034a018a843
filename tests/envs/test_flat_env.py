"""Agents that die or join, and infos of the last step, each with a test that fails on SuperSuit's own flattening."""

import functools

import gymnasium
import numpy as np
import pytest
import supersuit
from gymnasium import spaces
from pettingzoo.utils import BaseParallelWrapper

from sb3_flock import flatten, flocking_v0, make_vec_env
from sb3_flock.settings import RunError, SettingsError
from tests.envs.scripted import LIVES, Scripted
from tests.helpers import assert_equal_rollouts

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


class Halved(BaseParallelWrapper):
    """A wrapper around another one."""

    def reset(self, seed=None, options=None):
        observations, infos = super().reset(seed, options)
        return {name: numbers / 2 for name, numbers in observations.items()}, infos

    def step(self, actions):
        observations, *rest = super().step(actions)
        return {name: numbers / 2 for name, numbers in observations.items()}, *rest


def test_black_death_changes_nothing_wherever_it_is_in_the_chain():
    assert_equal_rollouts(flatten(Scripted(), 2, seed=0), flatten(supersuit.black_death_v3(Scripted()), 2, seed=0), 15)
    outer = Halved(supersuit.black_death_v3(Scripted()))
    assert_equal_rollouts(flatten(Halved(Scripted()), seed=0), flatten(outer, seed=0), 15)
    assert isinstance(outer.env, type(supersuit.black_death_v3(Scripted())))  # the given env stays as it is


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


class Mixed(Scripted):
    """Agents with spaces of their own."""

    def __init__(self, kind):
        super().__init__()
        self.kind = kind

    def observation_space(self, agent):
        return spaces.Box(0, 1, (3 + (agent == "c" and self.kind == "observation"),))

    def action_space(self, agent):
        return spaces.Box(0, 1, (2 + (agent == "c" and self.kind == "action"),))


NOT_PARALLEL = [
    (flocking_v0.parallel_env, "not what makes one: call it"),
    (functools.partial(flocking_v0.parallel_env, n_vehicles=2), "not what makes one: call it"),
    (flocking_v0, r"not a module: call its parallel_env\(\)"),
    (flocking_v0.raw_env(), "not an AEC env: pettingzoo.utils.conversions.aec_to_parallel converts it"),
    (gymnasium.make("Pendulum-v1"), "not a gymnasium env, which has one agent: SB3's make_vec_env takes it"),
    (make_vec_env(n_flocks=1), "not a vector env"),
    (None, "needed$"),
]


@pytest.mark.parametrize(("env", "hint"), NOT_PARALLEL, ids=[hint for _, hint in NOT_PARALLEL])
def test_something_else_than_a_parallel_env_is_refused_in_one_line(env, hint):
    with pytest.raises(SettingsError, match=f"^env = .*: a PettingZoo parallel env is .*{hint}") as error:
        flatten(env)
    assert "\n" not in str(error.value)


def test_agents_that_differ_in_a_space_are_refused_in_one_line():
    for kind, wrapper in (("observation", "pad_observations_v0"), ("action", "pad_action_space_v0")):
        with pytest.raises(SettingsError, match=f"env: {kind}_space of a and of c differ.*{wrapper}"):
            flatten(Mixed(kind))
    with pytest.raises(SettingsError, match="env has no possible_agents"):
        flatten(Scripted({}))
