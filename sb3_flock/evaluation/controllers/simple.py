"""Controllers that need no law of flocking: a lower and an upper mark for the others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.evaluation.controllers.motion import steer
from sb3_flock.sim import Scenario, Sensing


class RandomController:
    """Speed and turn rate uniform in their bounds, drawn from each episode's own stream."""

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Draw the episode's actions."""
        low, high = [0.0, -scenario.max_turn_rate], [scenario.max_speed, scenario.max_turn_rate]
        shape = (scenario.max_cycles, scenario.n_vehicles, 2)
        self._actions = iter(np.stack([rng.uniform(low, high, shape) for rng in rngs], axis=1))

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.float64]:
        """The next step's actions."""
        actions: NDArray[np.float64] = next(self._actions)
        return actions


class GoToWaypoint:
    """Straight to the waypoint as fast as possible, blind to everyone: how well a lone vehicle could track."""

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.float64]:
        """Actions towards the waypoint."""
        return steer(sensing.waypoint_positions / scenario.time_step, scenario)
