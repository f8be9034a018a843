"""Flocks that a hand-written controller flies in some of the episodes, for a policy to learn from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.envs.flocking_v0 import Action, Observation, parallel_env
from sb3_flock.sim import Scenario, Sensing


class Teacher(Protocol):
    """A controller (:class:`~sb3_flock.evaluation.episodes.Controller`) whose memory can be saved."""

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Episodes begin, one generator a flock."""

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.floating]:
        """The actions ``(flocks, vehicles, 2)`` [m/s, rad/s]."""

    def state_dict(self) -> dict[str, Any]:
        """What is remembered of the episodes under way: plain values and arrays."""

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from there."""


class DemonstratedEnv(parallel_env):
    """:class:`~sb3_flock.envs.flocking_v0.parallel_env`, some of whose episodes a teacher flies.

    In those the actions given to :meth:`step` are not flown. What is flown instead stands in each agent's info, as
    ``action``: :class:`~sb3_flock.rl.callbacks.DemonstratedActions` stores it. Whether an episode is the teacher's, and the
    noise on its actions, is drawn from the env's own random stream.

    :param scenario: the task
    :param teacher: who flies
    :param share: probability that an episode is the teacher's, in [0, 1]
    :param noise: standard deviation of the noise on the teacher's actions [half the action range]
    """

    def __init__(self, scenario: Scenario, teacher: Teacher, share: float, noise: float) -> None:
        super().__init__(scenario)
        self.teacher, self.share, self.noise = teacher, share, noise
        self._planned: NDArray[np.float64] | None = None

    def step(
        self, actions: dict[str, Action]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move everything by one sampling period."""
        flown = self._planned
        if flown is None:
            return super().step(actions)
        result = super().step(dict(zip(self.possible_agents, flown, strict=True)))
        for info, action in zip(result[-1].values(), flown, strict=True):
            info["action"] = action
        return result

    def state_dict(self) -> dict[str, Any]:
        """The episode under way, the random stream and, in an episode of the teacher's, what it remembers and does next."""
        taught = None if self._planned is None else {"planned": self._planned, "memory": self.teacher.state_dict()}
        return {**super().state_dict(), "taught": taught}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with the episode of :meth:`state_dict`."""
        super().load_state_dict(state)
        self._planned = None
        if state["taught"] is not None:
            self._planned = state["taught"]["planned"]
            self.teacher.load_state_dict(state["taught"]["memory"])

    def _measure(self, sensing: Sensing) -> Sensing:
        """Once a step: the teacher, too, decides from what is measured."""
        assert self._rng is not None
        measured = super()._measure(sensing)
        if self.world.steps == 0:
            taught = self._rng.random() < self.share
            self.teacher.reset([self._rng], self.scenario)
        else:
            taught = self._planned is not None
        self._planned = self._decide(measured, self._rng) if taught else None
        return measured

    def _decide(self, measured: Sensing, rng: Generator) -> NDArray[np.float64]:
        actions = self.teacher.act(measured, self.scenario)[0]
        low, high = self.world.action_low, self.world.action_high
        return np.clip(actions + self.noise * (high - low) / 2 * rng.normal(size=actions.shape), low, high)
