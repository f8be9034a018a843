"""SuperSuit's flattening of one PettingZoo parallel env, with its defects fixed."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.vector.utils import create_empty_array, iterate
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from supersuit.vector.markov_vector_wrapper import MarkovVectorEnv

from sb3_flock.settings import RunError

RESET_INFO = "sb3_flock/reset_info"
"""Key of a last step's info under which the next episode's reset info is passed on."""


class FlatEnv(MarkovVectorEnv):
    """One parallel env as a vector env: slot i is agent ``possible_agents[i]``, and the env is reset when no agent is left.

    SuperSuit's own flattening needs all agents to live from the first step to the last, and its automatic reset overwrites the
    infos of the last step by those of the reset. Here an agent may end or join in any step:

    * The infos of a step have ``alive``: whether the slot's agent acted in it.
    * An agent that ends has its own flag, termination or truncation, and its own ``terminal_observation``. One that is no
      longer among the env's agents, without a flag, is truncated.
    * Where no agent acts, the slot's action is ignored, its observation and reward are 0, and it does not end.

    :param par_env: the env; :func:`~sb3_flock.envs.wrappers.check_parallel_env` says what is accepted
    """

    def __init__(self, par_env: ParallelEnv) -> None:
        for name, default in (("render_mode", None), ("metadata", {})):
            if not hasattr(par_env.unwrapped, name):
                setattr(par_env.unwrapped, name, default)
        super().__init__(par_env, black_death=True)
        self._nothing = next(iter(iterate(self.observation_space, create_empty_array(self.observation_space, 1))))

    def concat_obs(self, obs_dict: Mapping[str, Any]) -> Any:
        """The observations of all slots.

        :param obs_dict: observations by agent
        :raises RunError: if an agent that lives has none
        """
        living = set(self.par_env.agents)
        if not living <= obs_dict.keys():
            raise RunError(f"{min(living - obs_dict.keys())} is in the env's agents and has no observation")
        agents = self.par_env.possible_agents
        return super().concat_obs({name: obs_dict[name] if name in living else self._nothing for name in agents})

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, list[dict[str, Any]]]:
        """Start an episode.

        :raises RunError: if there is no agent in it
        """
        result = super().reset(seed, options)
        if not self.par_env.agents:
            raise RunError("the env has no agents after its reset")
        return result

    def is_over(self, ended: set[str]) -> bool:
        """Whether no agent is left.

        :param ended: the agents that ended in the last step
        """
        return set(self.par_env.agents) <= ended

    def step(
        self, actions: Any
    ) -> tuple[Any, NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], list[dict[str, Any]]]:
        """Take a step, and start the next episode where no agent is left; its reset infos are under :data:`RESET_INFO`."""
        env, names, acting = self.par_env, self.par_env.possible_agents, set(self.par_env.agents)
        given = zip(names, iterate(self.action_space, actions), strict=True)
        observations, *values, infos_of = env.step({name: action for name, action in given if name in acting})
        left = set(env.agents)

        def of_slots(part: Mapping[str, Any], kind: type) -> NDArray[Any]:
            return np.array([part.get(name, 0) if name in acting else 0 for name in names], kind)

        rewards, terminations, truncations = map(of_slots, values, (np.float32, bool, bool))
        infos: list[dict[str, Any]] = [
            {**infos_of.get(name, {}), "alive": True} if name in acting else {"alive": False} for name in names
        ]
        for slot, name in enumerate(names):
            if name in acting and name not in left and not terminations[slot]:
                truncations[slot] = True
        ends = np.flatnonzero(terminations | truncations).tolist()
        for slot in ends:
            infos[slot]["terminal_observation"] = copy.deepcopy(observations.get(names[slot], self._nothing))
        if self.is_over({names[slot] for slot in ends}):
            next_observations, reset_infos = self.reset()
            for info, reset_info in zip(infos, reset_infos, strict=True):
                info[RESET_INFO] = reset_info
        else:
            next_observations = self.concat_obs(observations)
        return next_observations, rewards, terminations, truncations, infos
