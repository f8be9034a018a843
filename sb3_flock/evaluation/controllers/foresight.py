"""A teacher that plans the next twenty steps of all vehicles at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, Sensing, World
from sb3_flock.sim.sensing import nearest

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ForesightGains:
    """What is free in foresight."""

    separation: float = 1.06
    """Distance between vehicles that plans keep, relative to the minimum separation to neighbors."""
    clearance: float = 1.033
    """Distance to obstacles that plans keep, relative to the minimum separation to them."""
    reach: float = 0.93
    """Length of links that plans keep, relative to the link range."""
    slack: float = 2 / 3
    """Longer than that by this much [link ranges] a link is given up: who has lost the others finds them at the waypoint."""
    sight: float = 1.0
    """Distance from a vehicle at which an obstacle is known of, relative to the detection range."""
    steps: int = 20
    """Steps planned ahead."""
    rounds: int = 200
    """Rounds of descent."""
    pace: float = 0.06
    """How far a control moves in the first round at most, relative to its bound."""


class Foresight:
    """Plans the controls of all vehicles together, as the unicycles they are, and advises the first ones.

    All are to stay with the waypoint on its way ahead, to keep their distances to each other and to obstacles, and the flock its
    links. Obstacles that no vehicle detects are not known of; the others are expected to walk straight on at their mean speed of
    the episode. Every plan begins with standing still, so where everything is and goes decides, nothing that was planned
    before: that is what a policy can imitate.

    :param world: the world that it sees, whatever is sensed in it
    :param gains: found by a few trials
    :raises SettingsError: if ``numba`` is not installed
    """

    def __init__(self, world: World, gains: ForesightGains | None = None) -> None:
        try:
            from sb3_flock.evaluation.controllers.descent import LINK, Wants, descend
        except (ImportError, RuntimeError) as error:  # RuntimeError: as in sb3_flock.sim.backend
            raise SettingsError(f"teacher = 'foresight': needs numba, pip install 'sb3_flock[fast]' ({error})") from None
        self.world, self.gains, self._descend = world, gains or ForesightGains(), descend
        scenario = world.scenario
        self._unit = scenario.link_range / LINK
        self._wants = Wants(
            self.gains.separation * scenario.neighbor_separation / self._unit,
            self.gains.clearance * scenario.obstacle_separation / self._unit,
            self.gains.reach * LINK,
            self.gains.slack * LINK,
        )

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Nothing is remembered."""

    def act(self, sensing: Sensing, scenario: Scenario) -> Array:
        """The first controls of the plans."""
        world, gains = self.world, self.gains
        steps = np.arange(1, gains.steps + 1)
        waypoints = world.waypoints_after(np.broadcast_to(steps, (world.n_flocks, gains.steps)))
        known = nearest(world.obstacle_positions, world.positions) < gains.sight * scenario.detection_range
        positions, waypoints, obstacles = (
            points / self._unit for points in (world.positions, waypoints, world.obstacles_after(steps))
        )
        stride, turn = world.action_high * scenario.time_step / (self._unit, 1.0)
        plans = np.zeros((world.n_flocks, scenario.n_vehicles, gains.steps, 2))
        for flock, plan in enumerate(plans):
            start, seen = (positions[flock], world.headings[flock]), np.ascontiguousarray(obstacles[flock][:, known[flock]])
            self._descend(plan, *start, waypoints[flock], seen, stride, turn, self._wants, gains.rounds, gains.pace)
        return plans[:, :, 0] * world.action_high

    def state_dict(self) -> dict[str, Any]:
        """Nothing is remembered."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Nothing is remembered."""
