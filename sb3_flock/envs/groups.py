"""Groups of agents with different spaces: one vector env and one SB3 model for each group, all in the same episodes."""

from __future__ import annotations

import copy
import re
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

from pettingzoo import ParallelEnv
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import unwrap_vec_wrapper
from supersuit.vector.concat_vec_env import ConcatVecEnv

from sb3_flock._compat import last_observations
from sb3_flock.envs.flat_env import FlatEnv
from sb3_flock.envs.vec_env import ParameterSharingVecEnv
from sb3_flock.envs.wrappers import check_is_parallel, check_parallel_env, without_black_death
from sb3_flock.settings import RunError, SettingsError, check_integer


class GroupVecEnv(ParameterSharingVecEnv):
    """The slots of one group of agents; :func:`flatten_groups` builds one for each group.

    It is stepped by a model that :func:`learn_groups` trains beside those of the other groups.
    """

    turns: _Turns
    group: str


def flatten_groups(
    env: ParallelEnv,
    groups: Mapping[str, Sequence[str]] | None = None,
    n_copies: int = 1,
    seed: int | None = None,
    monitor: bool = False,
) -> dict[str, GroupVecEnv]:
    """A PettingZoo parallel env whose agents have different spaces, as one SB3 vector env for each group of agents.

    In each vector env slot ``copy * n_agents + i`` is the group's i-th agent of a copy. Agents may die or join, as in
    :func:`~sb3_flock.envs.vec_env.flatten`; an episode lasts until no agent of any group is left. ``info["neighbors"]`` keeps
    the neighbors of the own group, as indices into it.

    :param env: the env
    :param groups: agents by group; by default agents are grouped by their names without the number at the end
    :param n_copies: number of independent copies
    :param seed: seeds all copies, each with a stream of its own
    :param monitor: as in :func:`~sb3_flock.envs.vec_env.flatten`
    :return: the vector envs by group, for one model each
    :raises SettingsError: for something else than a parallel env, groups that do not hold each agent once, or agents of a group
        that differ in a space
    """
    check_integer("n_copies", n_copies, least=1)
    check_is_parallel(env)
    members = {name: list(agents) for name, agents in (groups or _by_name(env.possible_agents)).items()}
    if sorted(agent for agents in members.values() for agent in agents) != sorted(env.possible_agents):
        raise SettingsError(f"groups = {members}: each of {', '.join(env.possible_agents)} is needed once")
    turns = _Turns(list(members))
    joints = [_Joint(without_black_death(copy.deepcopy(env)), members, turns) for _ in range(n_copies)]
    turns.joints = joints
    made = {}
    for name in members:
        views = [_GroupView(joint, name) for joint in joints]
        check_parallel_env(views[0])
        made[name] = GroupVecEnv(ConcatVecEnv([partial(_GroupFlatEnv, view) for view in views]), views[0], monitor)
        made[name].turns, made[name].group = turns, name
        made[name].seed(seed)
    return made


def learn_groups(
    models: Mapping[str, BaseAlgorithm], steps: int, callbacks: Mapping[str, MaybeCallback] | None = None, **options: Any
) -> None:
    """Train the models of all groups side by side, in the same episodes.

    Each model's own ``learn`` runs in a thread. One thread runs at a time, in a fixed order, so that seeded trainings repeat.
    A model that needs fewer steps than the others, because a rollout of another one is longer, goes on acting.

    :param models: a model for each vector env of one :func:`flatten_groups`, by group
    :param steps: vector steps; model by model ``steps * n_envs`` transitions
    :param callbacks: SB3 callbacks by group
    :param options: further arguments of every ``learn``, such as ``log_interval``
    :raises SettingsError: if a group has no model, or a model's env is another group's
    """
    check_integer("steps", steps, least=1)
    envs = {name: _group_env(name, model) for name, model in models.items()}
    for name in callbacks or {}:
        if name not in models:
            raise SettingsError(f"callbacks: {name} is none of the groups {', '.join(models)}")
    all_turns = {id(env.turns): env.turns for env in envs.values()}
    if len(all_turns) != 1:
        raise SettingsError("models: their envs are not of one flatten_groups")
    (turns,) = all_turns.values()
    missing = [name for name in turns.names if name not in models]
    if missing:
        raise SettingsError(f"models: the group {missing[0]} has none")

    def learn(name: str) -> None:
        with turns.taken_by(name):
            model = models[name]
            model.learn(steps * model.n_envs, (callbacks or {}).get(name), **options)
            turns.finish(name)
            env, observations = model.get_env(), last_observations(model)
            assert env is not None
            while not turns.all_finished:
                observations, *_ = env.step(model.predict(observations)[0])

    turns.start()
    threads = [threading.Thread(target=learn, args=(name,), name=f"learn {name}", daemon=True) for name in turns.names]
    for thread in threads:
        thread.start()
    try:
        for thread in threads:
            thread.join()
    finally:
        turns.stop()
    if turns.error is not None:
        raise turns.error


def _by_name(agents: Sequence[str]) -> dict[str, list[str]]:
    groups: dict[str, list[str]] = {}
    for agent in agents:
        groups.setdefault(re.sub(r"_?\d+$", "", agent) or agent, []).append(agent)
    return groups


def _group_env(name: str, model: BaseAlgorithm) -> GroupVecEnv:
    env = unwrap_vec_wrapper(model.get_env(), GroupVecEnv)  # type: ignore[arg-type]
    if env is None or env.group != name:
        raise SettingsError(f"models: the env of the model of {name} is not that of its group, made by flatten_groups")
    return env


class _StoppedError(Exception):
    """Another thread has failed, or all models have learned."""


class _Turns:
    """Threads of which one runs at a time; one that has to wait passes the turn on, in a fixed order."""

    joints: Sequence[_Joint]

    def __init__(self, names: list[str]) -> None:
        self.names = names
        self.error: BaseException | None = None
        self._change = threading.Condition()
        self._finished: set[str] = set()
        self._stopped = True
        self._current = names[0]
        self._passes = 0

    def start(self) -> None:
        """Begin: the first group has the turn."""
        self._stopped, self._finished, self.error, self._current, self._passes = False, set(), None, self.names[0], 0
        for joint in self.joints:
            joint.forget_actions()

    def stop(self) -> None:
        """Let every waiting thread end."""
        with self._change:
            self._stopped = True
            self._change.notify_all()

    @property
    def all_finished(self) -> bool:
        """Whether all models have learned."""
        return len(self._finished) == len(self.names)

    def finish(self, name: str) -> None:
        """Note that a model has learned."""
        self._finished.add(name)
        if self.all_finished:
            self.stop()

    @contextmanager
    def taken_by(self, name: str) -> Iterator[None]:
        """Run a thread in its turns, and end all others if it fails."""
        try:
            with self._change:
                self._wait_for_turn(name)
            yield
        except _StoppedError:
            pass
        except BaseException as error:  # raised again by learn_groups
            self.error = self.error or error
            self.stop()

    def wait(self, name: str, is_ready: Callable[[], bool]) -> None:
        """Let the others run until something is ready.

        :raises RunError: if no thread makes it ready
        """
        while not is_ready():
            if self._stopped and self.error is None and not self.all_finished:
                raise RunError(f"the group {name} cannot step alone: learn_groups trains the models of all groups")
            with self._change:
                self._passes += 1
                if self._passes > 3 * len(self.names):
                    raise RunError("the groups wait for each other: one has reset its env while another one has not")
                self._current = self.names[(self.names.index(name) + 1) % len(self.names)]
                self._change.notify_all()
                self._wait_for_turn(name)
        self._passes = 0

    def _wait_for_turn(self, name: str) -> None:
        self._change.wait_for(lambda: self._stopped or self._current == name)
        if self._stopped:
            raise _StoppedError


class _Joint:
    """One copy of the env, which takes a step as soon as all groups have given their actions."""

    def __init__(self, env: ParallelEnv, members: Mapping[str, list[str]], turns: _Turns) -> None:
        self.env, self.members, self.turns = env, members, turns
        self._actions: dict[str, dict[str, Any]] = {}
        self._steps, self._episodes = 0, 0
        self._resets = dict.fromkeys(members, 0)
        self._start: _Start | None = None
        self._result: _Result | None = None

    def forget_actions(self) -> None:
        """Forget actions of a step that was not taken."""
        self._actions = {}
        self._resets = dict.fromkeys(self.members, self._episodes)

    def reset(self, group: str, seed: int | None, options: dict[str, Any] | None) -> _Start:
        """Start an episode with the first group that asks for it; the others join it."""
        self._resets[group] += 1
        if self._start is None or self._resets[group] > self._episodes:
            observations, infos = self.env.reset(seed=seed, options=options)
            self._start = _Start(list(self.env.agents), observations, infos)
            self._episodes, self._actions = self._episodes + 1, {}
        return self._start

    def step(self, group: str, actions: dict[str, Any]) -> _Result:
        """Give the actions of a group, and wait for the step."""
        self._actions[group] = actions
        number = self._steps + 1
        if len(self._actions) == len(self.members):
            together = {agent: action for given in self._actions.values() for agent, action in given.items()}
            parts = self.env.step(together)
            ended = {agent for agent in together if parts[2].get(agent) or parts[3].get(agent)}
            left, is_over = list(self.env.agents), set(self.env.agents) <= ended
            if is_over:  # the first group resets the env, which may use its arrays again, before the others read them
                parts = copy.deepcopy(parts)
            self._result, self._actions, self._steps = _Result(left, is_over, parts), {}, number
        self.turns.wait(group, lambda: self._steps >= number)
        assert self._result is not None
        return self._result


@dataclass(frozen=True)
class _Start:
    """The start of an episode: the agents, their observations and infos."""

    agents: list[str]
    observations: Mapping[str, Any]
    infos: Mapping[str, Any]


@dataclass(frozen=True)
class _Result:
    """A step: the agents that are left, whether the episode is over, and what the env's ``step`` returned."""

    agents: list[str]
    is_over: bool
    parts: Sequence[Mapping[str, Any]]


class _GroupView(ParallelEnv):
    """The agents of one group, as an env of their own."""

    def __init__(self, joint: _Joint, group: str) -> None:
        self.joint, self.group = joint, group
        self.possible_agents = joint.members[group]
        self.agents: list[str] = []
        self.is_over = False
        self.metadata = getattr(joint.env, "metadata", {})
        self.render_mode = getattr(joint.env, "render_mode", None)
        self._places = {joint.env.possible_agents.index(agent): i for i, agent in enumerate(self.possible_agents)}

    def observation_space(self, agent: str) -> Any:
        """The env's."""
        return self.joint.env.observation_space(agent)

    def action_space(self, agent: str) -> Any:
        """The env's."""
        return self.joint.env.action_space(agent)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """The group's part of a reset of the env."""
        start = self.joint.reset(self.group, seed, options)
        self._take_up(start.agents, False)
        return self._of_group(start.observations), self._infos_of_group(start.infos)

    def step(self, actions: dict[str, Any]) -> Any:
        """The group's part of a step of the env."""
        result = self.joint.step(self.group, actions)
        self._take_up(result.agents, result.is_over)
        *parts, infos = result.parts
        return (*map(self._of_group, parts), self._infos_of_group(infos))

    def _take_up(self, living: Sequence[str], is_over: bool) -> None:
        # Not from the env itself, which may be in its next episode by now: another group has started it.
        self.agents, self.is_over = [agent for agent in self.possible_agents if agent in living], is_over

    def render(self) -> Any:
        """The env's picture."""
        return self.joint.env.render()

    def close(self) -> None:
        """Close the env."""
        self.joint.env.close()

    def _of_group(self, part: Mapping[str, Any]) -> dict[str, Any]:
        return {agent: part[agent] for agent in self.possible_agents if agent in part}

    def _infos_of_group(self, infos: Mapping[str, Any]) -> dict[str, Any]:
        own = self._of_group(infos)
        return {agent: self._with_own_neighbors(info) if "neighbors" in info else info for agent, info in own.items()}

    def _with_own_neighbors(self, info: Mapping[str, Any]) -> dict[str, Any]:
        return {**info, "neighbors": [self._places[i] for i in info["neighbors"] if i in self._places]}


class _GroupFlatEnv(FlatEnv):
    """A group's slots; the next episode starts when no agent of any group is left."""

    def is_over(self, ended: set[str]) -> bool:
        """Whether the whole env's episode is."""
        over: bool = self.par_env.is_over
        return over
