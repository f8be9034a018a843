"""A PettingZoo parallel env and the wrappers around it."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import gymnasium
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.wrappers import BaseParallelWrapper
from stable_baselines3.common.vec_env import VecEnv
from supersuit.multiagent_wrappers.black_death import black_death_par

from sb3_flock.settings import SettingsError, format_value


def layers_of(env: ParallelEnv) -> Iterator[ParallelEnv]:
    """An env's wrappers, from the outermost, and the env itself."""
    while isinstance(env, BaseParallelWrapper):
        yield env
        env = env.env
    yield env
    if env.unwrapped is not env:  # a turn-based env behind PettingZoo's conversion
        yield env.unwrapped


def owner_of(env: ParallelEnv, name: str) -> Any:
    """The outermost layer that has an attribute, or ``None``. PettingZoo's wrappers show those of the layers below as theirs."""
    for layer in layers_of(env):
        has_own = name in vars(layer) or hasattr(type(layer), name)
        if has_own if isinstance(layer, BaseParallelWrapper) else hasattr(layer, name):
            return layer
    return None


def check_is_parallel(env: Any) -> None:
    """Check that something is a PettingZoo parallel env with agents.

    :raises SettingsError: if it is not
    """
    if not isinstance(env, ParallelEnv):
        raise SettingsError(f"env = {format_value(env)}: a PettingZoo parallel env is needed{_hint(env)}")
    if not getattr(env, "possible_agents", None):
        raise SettingsError("env has no possible_agents: each of them gets a slot of the vector env")


def check_parallel_env(env: Any) -> None:
    """Check that an env can be flattened.

    :raises SettingsError: if it is no PettingZoo parallel env, or its agents differ in a space
    """
    check_is_parallel(env)
    for kind in ("observation_space", "action_space"):
        first, *others = env.possible_agents
        space = getattr(env, kind)(first)
        for agent in others:
            if getattr(env, kind)(agent) != space:
                raise SettingsError(
                    f"env: {kind} of {first} and of {agent} differ, and all agents share one policy; SuperSuit's "
                    f"pad_{kind.split('_')[0]}{'s' if kind[0] == 'o' else '_space'}_v0 makes them equal"
                )


def _hint(env: Any) -> str:
    if isinstance(env, AECEnv):
        return ", not an AEC env: pettingzoo.utils.conversions.aec_to_parallel converts it"
    if isinstance(env, gymnasium.Env):
        return ", not a gymnasium env, which has one agent: SB3's make_vec_env takes it"
    if isinstance(env, VecEnv):
        return ", not a vector env"
    if hasattr(env, "parallel_env"):
        return ", not a module: call its parallel_env()"
    return ", not what makes one: call it" if callable(env) else ""


def without_black_death(env: ParallelEnv) -> ParallelEnv:
    """The env without SuperSuit's ``black_death_v3``, whatever is around it.

    The wrapper passes on no agent's end and adds a step without agents to each episode;
    :class:`~sb3_flock.envs.flat_env.FlatEnv` does its work.
    """
    if isinstance(env, black_death_par):
        return without_black_death(env.env)
    if not isinstance(env, BaseParallelWrapper):
        return env
    inner = without_black_death(env.env)
    if inner is env.env:
        return env
    outer = copy.copy(env)
    outer.env = inner
    return outer
