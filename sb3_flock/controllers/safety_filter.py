"""The safety filter around any controller, for vehicles that this package's world does not move."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.controllers.base import Controller
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, Sensing, check_actions
from sb3_flock.sim.safety import filter_actions

_LEVELS = ("voronoi", "motion")


class SafetyFilter(Controller):
    """Drives by another controller, with speeds bounded by :func:`~sb3_flock.sim.safety.filter_actions`.

    A controller senses no headings, so two levels are possible. The guarantee of ``docs/safety.md`` holds if all vehicles are
    filtered, sense exactly, and move as the task's unicycles do.

    :param controller: a controller, or anything with SB3's ``predict``
    :param safety_filter: ``"voronoi"``: headings of neighbors are unknown; ``"motion"``: inferred over ``motion_lag``
    :param obstacle_filter: also bound speeds towards obstacles
    :param safety_margin: distance kept beyond the minimum separations [m]
    :raises SettingsError: for another level
    """

    def __init__(
        self,
        controller: Any,
        safety_filter: Literal["voronoi", "motion"] = "voronoi",
        obstacle_filter: bool = False,
        safety_margin: float = 0.0,
    ) -> None:
        if safety_filter not in _LEVELS:
            raise SettingsError(f"safety_filter = {safety_filter!r}: a controller needs one of {', '.join(_LEVELS)}")
        self.controller = controller if isinstance(controller, Controller) else PolicyController(controller)
        self._fields = {
            "safety_filter": safety_filter,
            "obstacle_filter": obstacle_filter,
            "safety_margin": safety_margin,
        }
        self._scenarios: tuple[Scenario, Scenario] | None = None

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Start episodes.

        :raises SettingsError: if the scenario's ranges are too short for the filter
        """
        self._filtered(scenario)
        self.controller.reset(rngs, scenario)

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.float64]:
        """The controller's actions ``(flocks, vehicles, 2)`` [m/s, rad/s], clipped and filtered.

        :raises ActionError: if the controller's actions have another shape, or are not finite
        """
        given = np.asarray(self.controller.act(sensing, scenario), dtype=np.float64)
        check_actions(given, (*sensing.waypoint_distances.shape, 2), "flock", "vehicle")
        low, high = (0.0, -scenario.max_turn_rate), (scenario.max_speed, scenario.max_turn_rate)
        return filter_actions(np.clip(given, low, high), sensing, self._filtered(scenario))

    def state_dict(self) -> dict[str, Any]:
        """The memory of the controller."""
        return self.controller.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.controller.load_state_dict(state)

    def _filtered(self, scenario: Scenario) -> Scenario:
        """The scenario with the filter on; validated once for each scenario."""
        if self._scenarios is None or self._scenarios[0] is not scenario:
            self._scenarios = (scenario, scenario.replace(**self._fields))
        return self._scenarios[1]
