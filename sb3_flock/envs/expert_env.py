"""The flocking env with an expert that drives some of the episodes, and whose actions a policy can imitate."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sb3_flock.controllers import Controller
from sb3_flock.envs.batch import copy_flocks, select_flocks
from sb3_flock.envs.flocking_v0 import Observation, parallel_env
from sb3_flock.sim import Scenario, Sensing, World
from sb3_flock.sim.sensors import SensorErrors, Sensors
from sb3_flock.sim.tracker import TrackerSettings

if TYPE_CHECKING:
    from typing_extensions import Self

    from sb3_flock.sim.randomization import Ranges
    from sb3_flock.sim.safety import SafetySettings


class ExpertEnv(parallel_env):
    """:class:`~sb3_flock.envs.flocking_v0.parallel_env` with an expert, as in DAgger's interactive collection.

    The expert drives a share of the episodes. In those the actions given to :meth:`step` are not executed. Which episodes the
    expert drives, and the noise on its actions, are drawn from each flock's own random stream. The expert senses without errors,
    whatever the vehicles measure. The infos of a step also hold:

    * ``expert_drives``: whether the expert drives this episode;
    * ``executed_action``: in its episodes, the executed action ``(2,)`` [m/s, rad/s], unfiltered, which
      :class:`~sb3_flock.rl.callbacks.StoreExecutedActions` stores in place of the policy's;
    * ``expert_action``: with ``queries``, what the expert would do, ``(2,)`` [m/s, rad/s], in every episode.

    :param scenario: the task
    :param make_expert: makes the expert; it is given a world of the flocks that it acts for, which an expert may see whole
    :param fraction: probability that the expert drives an episode, in [0, 1] (DAgger's beta)
    :param noise_std: standard deviation of the noise on the expert's executed actions [half the action range]
    :param queries: put ``expert_action`` into every info; otherwise the expert acts only for the flocks that it drives
    :param n_flocks: number of independent flocks
    :param action_repeat: sampling periods that a step takes, with the same actions
    :param safety: the filters and their separations, if they are not the scenario's
    :param randomization: ranges of randomized fields, as in :class:`~sb3_flock.envs.flocking_v0.parallel_env`
    """

    def __init__(
        self,
        scenario: Scenario,
        make_expert: Callable[[World], Controller],
        fraction: float,
        noise_std: float,
        queries: bool = False,
        n_flocks: int = 1,
        action_repeat: int = 1,
        safety: SafetySettings | None = None,
        randomization: Ranges | None = None,
    ) -> None:
        super().__init__(
            scenario, n_flocks=n_flocks, action_repeat=action_repeat, safety=safety, randomization=randomization
        )
        exact = scenario.replace(sensors=SensorErrors(), tracker=TrackerSettings())
        has_errors = scenario != exact or any(name.startswith("sensors.") for name in self.world.randomization)
        self._exact_sensors = Sensors(exact, exact) if has_errors else None
        acts_for_all = queries or n_flocks == 1
        self._seen = self.world if acts_for_all else World(scenario, safety=safety)
        self.expert, self.fraction, self.noise_std, self.queries = make_expert(self._seen), fraction, noise_std, queries
        self._drives = np.zeros(n_flocks, bool)
        self._expert_actions: NDArray[np.floating] | None = None
        self._next_actions: NDArray[np.float64] | None = None

    @property
    def expert_drives(self) -> bool:
        """Whether the expert drives the current episode; with several flocks, that of any of them."""
        return bool(self._drives.any())

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """Move everything by one sampling period, by the expert's actions in its episodes."""
        drives = np.repeat(self._drives, self.scenario.n_vehicles)
        queried, executed = self._expert_actions if self.queries else None, self._next_actions
        result = super().step(actions)
        infos = list(result[-1].values())
        for info, driven in zip(infos, drives.tolist(), strict=True):
            info["expert_drives"] = driven
        if executed is not None:
            for slot, action in zip(np.flatnonzero(drives).tolist(), executed.reshape(-1, 2), strict=True):
                infos[slot]["executed_action"] = action
        if queried is not None:
            for info, expert_action in zip(infos, queried.reshape(-1, 2), strict=True):
                info["expert_action"] = expert_action
        return result

    def commands(self, actions: Mapping[str, ArrayLike]) -> NDArray[np.float64]:
        """The actions for the world, ``(flocks, vehicles, 2)`` [m/s, rad/s]: the expert's in its episodes."""
        commands = super().commands(actions)
        if self._next_actions is not None:
            commands[self._drives] = self._next_actions
        return commands

    def copy_at(self, index: int) -> Self:
        """The env of one flock alone, to look at its present state; the expert is that of all flocks."""
        one = super().copy_at(index)
        if one is not self:
            one._drives = self._drives[index : index + 1]
        return one

    def state_dict(self) -> dict[str, Any]:
        """The current episodes and the random streams and, where the expert acts, its memory and its next actions."""
        expert = None
        if self._expert_actions is not None:
            expert = {
                "drives": self._drives,
                "expert_actions": self._expert_actions,
                "next_actions": self._next_actions,
                "memory": self.expert.state_dict(),
            }
        exact = {} if self._exact_sensors is None else {"exact_sensors": self._exact_sensors.state_dict()}
        return {**super().state_dict(), "expert": expert, **exact}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the episodes of :meth:`state_dict`."""
        super().load_state_dict(state)
        if self._exact_sensors is not None:
            self._exact_sensors.forget()
            if "exact_sensors" in state:  # files of earlier versions do not have them
                self._exact_sensors.load_state_dict(state["exact_sensors"])
        self._drives = np.zeros(self.n_copies, bool)
        self._expert_actions = self._next_actions = None
        if state["expert"] is not None:
            self._drives = np.array(state["expert"]["drives"])
            self._expert_actions, self._next_actions = state["expert"]["expert_actions"], state["expert"]["next_actions"]
            self.expert.load_state_dict(state["expert"]["memory"])

    def measure(self, sensing: Sensing) -> Sensing:
        """What the vehicles measure, once a step; the expert decides on its next actions from what there is."""
        measured = truth = super().measure(sensing)
        is_start = self.world.steps == 0
        if self._exact_sensors is not None:
            if is_start:
                self._exact_sensors.forget()
            truth = self._exact_sensors.measure(sensing)
        if is_start:
            self._drives = np.array([rng.random() < self.fraction for rng in self.rngs])
        self._expert_actions = self._next_actions = None
        flocks = np.arange(self.n_copies) if self.queries else np.flatnonzero(self._drives)
        if is_start:
            self.expert.reset([self.rngs[flock] for flock in flocks], self.scenario)
        if len(flocks):
            seen = truth if len(flocks) == self.n_copies else select_flocks(truth, flocks)
            if self._seen is not self.world:
                copy_flocks(self.world, flocks, self._seen)
            self._expert_actions = self.expert.act(seen, self.scenario)
        if self._drives.any():
            assert self._expert_actions is not None
            self._next_actions = self._noisy(self._expert_actions[self._drives] if self.queries else self._expert_actions)
        return measured

    def remember(self, sensing: Sensing) -> None:
        """Let the sensors measure between two steps of the env, also those of the expert."""
        super().remember(sensing)
        if self._exact_sensors is not None:
            self._exact_sensors.measure(sensing)

    def _noisy(self, actions: NDArray[np.floating]) -> NDArray[np.float64]:
        """The actions for the flocks that the expert drives, each with noise from the flock's own stream."""
        low, high = self.world.action_low, self.world.action_high
        driven = (rng for rng, drives in zip(self.rngs, self._drives, strict=True) if drives)
        noise = np.stack([rng.normal(size=actions.shape[1:]) for rng in driven])
        return np.clip(actions + self.noise_std * (high - low) / 2 * noise, low, high)
