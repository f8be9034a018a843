"""The flocking env with an expert that drives some of the episodes, and whose actions a policy can imitate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.controllers import Controller
from sb3_flock.envs.flocking_v0 import Action, Observation, parallel_env
from sb3_flock.sim import Scenario, Sensing, World


class ExpertEnv(parallel_env):
    """:class:`~sb3_flock.envs.flocking_v0.parallel_env` with an expert, as in DAgger's interactive collection.

    The expert drives a share of the episodes. In those the actions given to :meth:`step` are not executed. Which episodes the
    expert drives, and the noise on its actions, are drawn from the env's own random stream. The infos of a step also hold:

    * ``expert_drives``: whether the expert drives this episode;
    * ``executed_action``: in its episodes, the executed action ``(2,)`` [m/s, rad/s], unfiltered, which
      :class:`~sb3_flock.rl.callbacks.StoreExecutedActions` stores in place of the policy's;
    * ``expert_action``: with ``queries``, what the expert would do, ``(2,)`` [m/s, rad/s], in every episode.

    :param scenario: the task
    :param make_expert: makes the expert; it is given the world, which an expert may see whole
    :param fraction: probability that the expert drives an episode, in [0, 1] (DAgger's beta)
    :param noise_std: standard deviation of the noise on the expert's executed actions [half the action range]
    :param queries: put ``expert_action`` into every info
    """

    def __init__(
        self,
        scenario: Scenario,
        make_expert: Callable[[World], Controller],
        fraction: float,
        noise_std: float,
        queries: bool = False,
    ) -> None:
        super().__init__(scenario)
        self.expert, self.fraction, self.noise_std, self.queries = make_expert(self.world), fraction, noise_std, queries
        self._expert_actions: NDArray[np.floating] | None = None
        self._next_actions: NDArray[np.float64] | None = None

    @property
    def expert_drives(self) -> bool:
        """Whether the expert drives the current episode."""
        return self._next_actions is not None

    def step(
        self, actions: dict[str, Action]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move everything by one sampling period, by the expert's actions in its episodes."""
        queried, executed = self._expert_actions if self.queries else None, self._next_actions
        if executed is not None:
            actions = dict(zip(self.possible_agents, executed, strict=True))
        result = super().step(actions)
        for info in result[-1].values():
            info["expert_drives"] = executed is not None
        for name, by_agent in (("executed_action", executed), ("expert_action", queried)):
            if by_agent is not None:
                for info, action in zip(result[-1].values(), by_agent, strict=True):
                    info[name] = action
        return result

    def state_dict(self) -> dict[str, Any]:
        """The current episode and the random stream and, where the expert acts, its memory and its next actions."""
        expert = None
        if self._expert_actions is not None:
            expert = {
                "expert_actions": self._expert_actions,
                "next_actions": self._next_actions,
                "memory": self.expert.state_dict(),
            }
        return {**super().state_dict(), "expert": expert}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the episode of :meth:`state_dict`."""
        super().load_state_dict(state)
        self._expert_actions = self._next_actions = None
        if state["expert"] is not None:
            self._expert_actions, self._next_actions = state["expert"]["expert_actions"], state["expert"]["next_actions"]
            self.expert.load_state_dict(state["expert"]["memory"])

    def measure(self, sensing: Sensing) -> Sensing:
        """What the vehicles measure, once a step; the expert decides on its next actions from the same measurement."""
        assert self.rng is not None
        measured = super().measure(sensing)
        if self.world.steps == 0:
            expert_drives = self.rng.random() < self.fraction
            self.expert.reset([self.rng], self.scenario)
        else:
            expert_drives = self.expert_drives
        self._expert_actions = self._next_actions = None
        if expert_drives or self.queries:
            self._expert_actions = self.expert.act(measured, self.scenario)[0]
            self._next_actions = self._noisy(self._expert_actions, self.rng) if expert_drives else None
        return measured

    def _noisy(self, actions: NDArray[np.floating], rng: Generator) -> NDArray[np.float64]:
        low, high = self.world.action_low, self.world.action_high
        return np.clip(actions + self.noise_std * (high - low) / 2 * rng.normal(size=actions.shape), low, high)
