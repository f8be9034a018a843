"""Flocks that a teacher flies in some of the episodes, or advises in all of them, for a policy to learn from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.envs.flocking_v0 import Action, Observation, parallel_env
from sb3_flock.sim import Scenario, Sensing, World


class Teacher(Protocol):
    """Flies as a :class:`~sb3_flock.evaluation.episodes.Controller`, with a memory that can be saved."""

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
    :param teacher: makes the one who flies; it is given the world, to see more than vehicles do
    :param share: probability that an episode is the teacher's, in [0, 1]
    :param noise: standard deviation of the noise on the teacher's actions [half the action range]
    :param advises: also say in every step, whoever flies, what the teacher would do: each agent's info has it as ``advice``,
        as ``action`` an array ``(2,)`` [m/s, rad/s]
    """

    def __init__(
        self, scenario: Scenario, teacher: Callable[[World], Teacher], share: float, noise: float, advises: bool = False
    ) -> None:
        super().__init__(scenario)
        self.teacher, self.share, self.noise, self.advises = teacher(self.world), share, noise, advises
        self._advice: NDArray[np.floating] | None = None
        self._planned: NDArray[np.float64] | None = None

    def step(
        self, actions: dict[str, Action]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move everything by one sampling period."""
        advice, flown = self._advice, self._planned
        result = super().step(actions if flown is None else dict(zip(self.possible_agents, flown, strict=True)))
        for name, told in (("action", flown), ("advice", advice if self.advises else None)):
            if told is not None:
                for info, action in zip(result[-1].values(), told, strict=True):
                    info[name] = action
        return result

    def state_dict(self) -> dict[str, Any]:
        """The episode under way, the random stream and, where the teacher acts, what it remembers, says and does next."""
        taught = None
        if self._advice is not None:
            taught = {"advice": self._advice, "planned": self._planned, "memory": self.teacher.state_dict()}
        return {**super().state_dict(), "taught": taught}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with the episode of :meth:`state_dict`."""
        super().load_state_dict(state)
        self._advice = self._planned = None
        if state["taught"] is not None:
            self._planned = state["taught"]["planned"]
            self._advice = state["taught"].get("advice", self._planned)  # checkpoints without it are of teachers that flew
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
        self._advice = self._planned = None
        if taught or self.advises:
            self._advice = self.teacher.act(measured, self.scenario)[0]
            self._planned = self._noisy(self._advice, self._rng) if taught else None
        return measured

    def _noisy(self, actions: NDArray[np.floating], rng: Generator) -> NDArray[np.float64]:
        low, high = self.world.action_low, self.world.action_high
        return np.clip(actions + self.noise * (high - low) / 2 * rng.normal(size=actions.shape), low, high)
