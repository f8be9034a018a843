"""A teacher that plans the next twenty steps of all vehicles at once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from pydantic import Field

from sb3_flock.settings import NotNegative, Positive, Settings, SettingsError
from sb3_flock.sim import Scenario, Sensing, World
from sb3_flock.sim.sensing import nearest

Array = NDArray[np.float64]


class ForesightGains(Settings):
    """What its plans keep, what that weighs beside the mean distance to the waypoint, and how it plans.

    A weight is that of half the square of what is missing, in lengths where the link range is 0.15 m: the same for any task.
    """

    separation: Positive = Field(
        1.06, description="distance between vehicles [minimum separations to neighbors in practice]"
    )
    clearance: Positive = Field(1.033, description="distance to obstacles [minimum separations to them in practice]")
    reach: Positive = Field(0.93, description="length of links [link ranges]")
    slack: Positive = Field(2 / 3, description="longer than that by this much a link is given up [link ranges]")
    separation_weight: NotNegative = Field(500.0, description="weight of the distance between vehicles [1/m]")
    clearance_weight: NotNegative = Field(1000.0, description="weight of the distance to obstacles [1/m]")
    reach_weight: NotNegative = Field(60.0, description="weight of the length of links [1/m]")
    sight: NotNegative = Field(1.0, description="distance to a vehicle at which an obstacle is known of [detection ranges]")
    steps: int = Field(20, ge=1, le=1000, description="steps planned ahead")
    rounds: int = Field(200, ge=1, le=1_000_000, description="rounds of descent")
    pace: Positive = Field(0.06, description="how far a control moves in the first round at most [of its bound]")


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
            self.gains.separation_weight,
            self.gains.clearance_weight,
            self.gains.reach_weight,
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
