"""Flocks of several sizes as one env, for a policy that learns to drive all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from sb3_flock.envs.flocking_v0 import Action, Observation, parallel_env


class MultiFlockEnv(ParallelEnv[str, Observation, Action]):
    """Independent flocks as one env: ``flock_0/vehicle_0``, ``flock_0/vehicle_1``, ..., ``flock_1/vehicle_0``, ...

    SuperSuit needs the same number of agents in every copy of an env; with several flocks in each copy their sizes may differ.

    :param flocks: the flocks, whose episodes last equally long and whose vehicles have the same spaces
    """

    def __init__(self, flocks: Sequence[parallel_env]) -> None:
        self.flocks = list(flocks)
        self.metadata, self.render_mode = self.flocks[0].metadata, self.flocks[0].render_mode
        self.possible_agents = [
            f"flock_{number}/{agent}" for number, flock in enumerate(self.flocks) for agent in flock.possible_agents
        ]
        self.agents: list[str] = []
        self._firsts = np.cumsum([0, *(len(flock.possible_agents) for flock in self.flocks)]).tolist()

    def observation_space(self, agent: str) -> spaces.Box:
        """The observation space of an agent; the same object for all of them."""
        return self.flocks[0].observation_space(self.flocks[0].possible_agents[0])

    def action_space(self, agent: str) -> spaces.Box:
        """The action space of an agent; the same object for all of them."""
        return self.flocks[0].action_space(self.flocks[0].possible_agents[0])

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start an episode of every flock, each with a random stream of its own."""
        seeds = [None] * len(self.flocks) if seed is None else np.random.SeedSequence(seed).generate_state(len(self.flocks))
        starts = [
            flock.reset(None if own is None else int(own), options) for flock, own in zip(self.flocks, seeds, strict=True)
        ]
        self.agents = list(self.possible_agents)
        return self._joined([observations for observations, _ in starts]), self._joined([infos for _, infos in starts])

    def step(
        self, actions: dict[str, Action]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move every flock by one sampling period; ``info["neighbors"]`` counts the agents of all flocks."""
        results = []
        for number, (first, flock) in enumerate(zip(self._firsts, self.flocks, strict=False)):
            result = flock.step({agent: actions[f"flock_{number}/{agent}"] for agent in flock.possible_agents})
            for info in result[-1].values():
                info["neighbors"] = info["neighbors"] + first
            results.append(result)
        observations, rewards, terminations, truncations, infos = (
            self._joined(parts) for parts in zip(*results, strict=True)
        )
        if any(truncations.values()):
            self.agents = []
        return observations, rewards, terminations, truncations, infos

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the first flock."""
        return self.flocks[0].render()

    def close(self) -> None:
        """Close the first flock's window, if there is one."""
        self.flocks[0].close()

    def state_dict(self) -> dict[str, Any]:
        """The current episodes and the random streams."""
        return {"flocks": [flock.state_dict() for flock in self.flocks]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the episodes of :meth:`state_dict`."""
        for flock, saved in zip(self.flocks, state["flocks"], strict=True):
            flock.load_state_dict(saved)
        self.agents = list(self.possible_agents) if self.flocks[0].agents else []

    def _joined(self, parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Each flock's values by agent, under the agents' names in this env."""
        return dict(zip(self.possible_agents, (value for part in parts for value in part.values()), strict=True))
