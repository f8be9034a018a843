"""A controller with random actions, the lower bound of every comparison."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.controllers.base import Controller, register_controller
from sb3_flock.sim import Scenario, Sensing


@register_controller("random")
class RandomController(Controller):
    """Speed and turn rate uniform in their bounds, drawn from each episode's own generator."""

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Draw the actions of the whole episode."""
        low, high = [0.0, -scenario.max_turn_rate], [scenario.max_speed, scenario.max_turn_rate]
        shape = (scenario.max_cycles, scenario.n_vehicles, 2)
        self._actions = iter(np.stack([rng.uniform(low, high, shape) for rng in rngs], axis=1))

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.float64]:
        """The next step's actions."""
        actions: NDArray[np.float64] = next(self._actions)
        return actions
