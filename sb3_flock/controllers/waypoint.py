"""A controller that drives straight to the waypoint and ignores everything else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sb3_flock.controllers.base import Controller, register_controller
from sb3_flock.controllers.motion import steer
from sb3_flock.sim import Scenario, Sensing


@register_controller("go-to-waypoint")
class GoToWaypoint(Controller):
    """Drives straight to the waypoint as fast as possible: the best tracking that a single vehicle could reach."""

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.float64]:
        """Actions towards the waypoint."""
        return steer(sensing.waypoint_positions / scenario.time_step, scenario)
