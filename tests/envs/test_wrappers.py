import functools

import gymnasium
import pytest
import supersuit
from gymnasium import spaces
from pettingzoo.utils import BaseParallelWrapper
from pettingzoo.utils.conversions import aec_to_parallel

from sb3_flock import Scenario, flatten, flocking_v0, make_vec_env
from sb3_flock.settings import SettingsError
from tests.envs.scripted import Scripted
from tests.helpers import assert_equal_rollouts


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


class Leveled(Halved):
    """A wrapper with an attribute and a method of its own."""

    def __init__(self, env, level=1):
        super().__init__(env)
        self.level, self._private = level, 7

    def level_up(self, by):
        self.level += by
        return self.level


def test_attributes_and_methods_are_those_of_the_outermost_wrapper_that_has_them():
    env = flatten(Halved(Leveled(Leveled(Scripted(), level=5))), n_copies=2, seed=0)
    env.reset()
    wrappers = [copy.env for copy in env.venv.vec_envs for copy in [copy.par_env]]
    assert env.get_attr("level") == [1] * 8
    assert env.get_attr("_private", indices=0) == [7]
    assert env.get_attr("steps") == [0] * 8
    env.set_attr("level", 3, indices=[4])
    assert env.get_attr("level") == [1] * 4 + [3] * 4
    assert [(wrapper.level, wrapper.env.level) for wrapper in wrappers] == [(1, 5), (3, 5)]
    assert not any("level" in vars(copy) for copy in env.get_attr("unwrapped"))
    assert env.env_method("level_up", 2, indices=[0, 4]) == [3, 5]
    env.set_attr("steps", 2)
    assert [copy.steps for copy in env.get_attr("unwrapped", indices=[0, 4])] == [2, 2]
    assert not any("steps" in vars(wrapper) for wrapper in wrappers)
    env.set_attr("anything", 1)
    assert env.get_attr("anything") == [1] * 8
    assert env.has_attr("anything")
    assert not env.has_attr("nothing")
    with pytest.raises(AttributeError, match="nothing"):
        env.get_attr("nothing")
    assert env.env_is_wrapped(Leveled) == [True] * 8
    assert env.env_is_wrapped(flocking_v0.parallel_env) == [False] * 8


def test_attributes_of_a_wrapper_around_a_batch_and_of_a_turn_based_env():
    batch = flatten(Leveled(flocking_v0.parallel_env(n_flocks=2)), seed=0)
    batch.reset()
    assert batch.get_attr("level") == [1] * 6
    assert batch.get_attr("n_copies") == [1] * 6  # each flock alone
    batch.set_attr("level", 4)
    assert batch.get_attr("level") == [4] * 6
    converted = flatten(aec_to_parallel(flocking_v0.env()), seed=0)
    converted.reset()
    assert converted.get_attr("scenario") == [Scenario()] * 3


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
