"""Flocks of several sizes as one env, for a policy that learns to drive all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from pettingzoo import ParallelEnv

from sb3_flock.envs.flocking_v0 import Action, Observation, parallel_env


class MultiFlockEnv(ParallelEnv[str, Observation, Action]):
    """Independent flocks as one env: ``flock_0/vehicle_0``, ``flock_0/vehicle_1``, ..., ``flock_1/vehicle_0``, ...

    SuperSuit needs the same number of agents in every copy of an env; with several flocks in each copy their sizes may differ.
    Where each of the envs holds several flocks, the first copy has the first flock of each, the second copy the second, ...

    :param flocks: the envs, of equally many flocks, whose episodes last equally long and whose vehicles have the same spaces

    :ivar n_copies: number of copies; ``info["neighbors"]`` are indices into the agents of the same copy
    """

    def __init__(self, flocks: Sequence[parallel_env]) -> None:
        self.flocks = list(flocks)
        self.n_copies = self.flocks[0].n_copies
        self.metadata, self.render_mode = self.flocks[0].metadata, self.flocks[0].render_mode
        self._sizes = [flock.scenario.n_vehicles for flock in self.flocks]
        self.possible_agents = [
            f"flock_{number}/vehicle_{i}" for number, size in enumerate(self._sizes * self.n_copies) for i in range(size)
        ]
        self.agents: list[str] = []
        names = iter(self.possible_agents)
        by_copy = [[[next(names) for _ in range(size)] for size in self._sizes] for _ in range(self.n_copies)]
        self._names = [[name for copy in by_copy for name in copy[kind]] for kind in range(len(self.flocks))]

    def observation_space(self, agent: str) -> spaces.Box:
        """The observation space of an agent; the same object for all of them."""
        return self.flocks[0].observation_space(self.flocks[0].possible_agents[0])

    def action_space(self, agent: str) -> spaces.Box:
        """The action space of an agent; the same object for all of them."""
        return self.flocks[0].action_space(self.flocks[0].possible_agents[0])

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Start an episode of every flock, each with a random stream of its own.

        :param seed: seeds the streams of copy i by ``seed + i``
        """
        if seed is not None:
            seeds = [np.random.SeedSequence(seed + copy).generate_state(len(self.flocks)) for copy in range(self.n_copies)]
            for flock, own in zip(self.flocks, np.array(seeds).T.tolist(), strict=True):
                flock.rngs = [np.random.default_rng(number) for number in own]
        starts = [flock.reset(None, options) for flock in self.flocks]
        self.agents = list(self.possible_agents)
        return self._joined([observations for observations, _ in starts]), self._joined([infos for _, infos in starts])

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move every flock by one sampling period; ``info["neighbors"]`` counts the agents of all flocks of a copy."""
        results, first = [], 0
        for flock, names in zip(self.flocks, self._names, strict=True):
            result = flock.step({agent: actions[name] for agent, name in zip(flock.possible_agents, names, strict=True)})
            for info in result[-1].values():
                info["neighbors"] = info["neighbors"] + first
            results.append(result)
            first += flock.scenario.n_vehicles
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

    def copy_at(self, index: int) -> MultiFlockEnv:
        """The env of one copy alone, to look at its present state; the env itself if there is one copy."""
        if self.n_copies == 1:
            return self
        one = MultiFlockEnv([flock.copy_at(index) for flock in self.flocks])
        one.agents = list(one.possible_agents) if self.agents else []
        return one

    def state_dict(self) -> dict[str, Any]:
        """The current episodes and the random streams."""
        return {"flocks": [flock.state_dict() for flock in self.flocks]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the episodes of :meth:`state_dict`."""
        for flock, saved in zip(self.flocks, state["flocks"], strict=True):
            flock.load_state_dict(saved)
        self.agents = list(self.possible_agents) if self.flocks[0].agents else []

    def _joined(self, parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """Each env's values by agent, under the agents' names in this env and in their order."""
        by_name = {
            name: value
            for names, part in zip(self._names, parts, strict=True)
            for name, value in zip(names, part.values(), strict=True)
        }
        return {name: by_name[name] for name in self.possible_agents}
