"""Scenario: every number of the task, with its unit and where it comes from."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from sb3_flock.settings import Coordinate, NotNegative, Positive, Settings
from sb3_flock.sim.reward import RewardWeights
from sb3_flock.sim.sensors import SensorErrors

MAX_BODIES = 1_000_000
"""Vehicles or obstacles at most. Each adds at most 1 to an anchor, so this bounds the tensor, whatever their number."""


Points = Annotated[tuple[tuple[Coordinate, Coordinate], ...], Field(min_length=1, max_length=10_000)]
"""Places ``[[x, y], ...]`` [m]."""


class Scenario(Settings):
    """The flocking task of Lyu et al. (2018), sections III to V.

    Frozen; ``scenario.replace(n_vehicles=5)`` gives a changed copy. Lengths are in meters, times in seconds, angles in
    radians; the paper's arena is 2 m wide.

    :raises SettingsError: one line naming the parameter, its value and what is accepted
    """

    n_vehicles: int = Field(3, ge=1, le=MAX_BODIES, description="number of vehicles n (paper, V: 3 or 5)")
    n_obstacles: int = Field(1, ge=0, le=MAX_BODIES, description="number of randomly walking obstacles (paper, V: 1 or 2)")
    max_cycles: int = Field(200, ge=1, le=1_000_000, description="episode length T [steps] (paper leaves it open)")
    time_step: Positive = Field(0.1, description="sampling period [s] (paper, V)")

    max_speed: Positive = Field(0.15, description="top speed of a vehicle [m/s] (paper, V)")
    max_turn_rate: Positive = Field(math.pi, description="bound of a vehicle's turn rate omega [rad/s] (open)")
    obstacle_max_speed: NotNegative = Field(0.1, description="top speed of an obstacle [m/s] (paper, V)")
    obstacle_turn_std: NotNegative = Field(
        2.0, description="standard deviation of an obstacle's turn rate, drawn each step [rad/s] (open)"
    )
    waypoint_speed: NotNegative = Field(0.1, description="speed of the waypoint towards the origin [m/s] (paper, V)")

    waypoint_route: Points | None = Field(
        None,
        description="points [x, y] the waypoint visits one after the other [m]; null: from anywhere to the origin (paper, V)",
    )

    obstacle_motion: Literal["walk", "crossing"] = Field(
        "walk",
        description="walk: at random (paper, V); crossing: straight through the flock from its far side (ours)",
    )

    arena: Positive = Field(1.0, description="half side of the square in which all bodies start [m] (paper, V)")
    obstacle_arena: Positive | None = Field(
        None, description="half side of the square in which obstacles start and walk [m]; null: arena (paper, V)"
    )
    obstacle_starts: Points | None = Field(
        None,
        description="points [x, y] where obstacles start [m], to stay if their top speed is 0; null: drawn (paper, V)",
    )
    link_range: Positive = Field(0.15, description="proximity network threshold r_n [m] (paper, V)")
    neighbor_separation: NotNegative = Field(0.1, description="minimum separation to neighbors r_n' [m] (paper, V)")
    detection_range: Positive = Field(0.25, description="obstacle detection range r_o [m] (paper, V)")
    obstacle_separation: NotNegative = Field(0.15, description="minimum separation to obstacles r_o' [m] (paper, V)")

    n_anchors: int = Field(11, ge=2, le=101, description="anchors per side l of each tensor channel (paper, IV-A: 11)")
    neighbor_radius: Positive | None = Field(
        None, description="half width of the neighbor channel [m]; null: link_range (paper, IV-A: r_c)"
    )
    obstacle_radius: Positive | None = Field(
        None, description="half width of the obstacle channel [m]; null: detection_range (paper, IV-A)"
    )
    goal_radius: Positive = Field(
        0.3, description="half width r_g of the goal channel [m]; a farther waypoint shows on its circle (open)"
    )
    anchor_width: float = Field(
        1.0, ge=0.1, le=1e6, description="standard deviation sigma of the anchors' Gaussian [anchor spacings] (open)"
    )

    look_back: NotNegative = Field(
        0.0,
        le=100,
        description="age of a second look, which adds three channels of what has changed, a multiple of time_step [s]; "
        "0: none (paper, IV-A)",
    )

    sensors: SensorErrors = Field(default_factory=SensorErrors, description="errors of what vehicles measure (paper: none)")
    reward: RewardWeights = Field(default_factory=RewardWeights, description="weights of the reward (paper, IV-B)")

    @model_validator(mode="after")
    def _ranges_fit(self) -> Scenario:
        for near, far in (("neighbor_separation", "link_range"), ("obstacle_separation", "detection_range")):
            if getattr(self, near) > getattr(self, far):
                raise ValueError(f"{near} = {getattr(self, near)}: input should be at most {far} = {getattr(self, far)}")
        if not math.isclose(self.look_back, self.look_back_steps * self.time_step, rel_tol=1e-6):
            raise ValueError(f"look_back = {self.look_back}: input should be a multiple of time_step = {self.time_step}")
        if len(self.obstacle_starts or ()) > self.n_obstacles:
            raise ValueError(
                f"obstacle_starts has {len(self.obstacle_starts or ())} points: n_obstacles = {self.n_obstacles}"
            )
        for point in self.obstacle_starts or ():
            if max(map(abs, point)) > self.obstacle_half_side:
                square = f"the obstacles' square of half side {self.obstacle_half_side}"
                raise ValueError(f"obstacle_starts: {point} is outside {square}")
        return self

    @property
    def obstacle_half_side(self) -> float:
        """Half side of the square in which obstacles start and walk [m]."""
        return self.arena if self.obstacle_arena is None else self.obstacle_arena

    @property
    def channel_radii(self) -> tuple[float, float, float]:
        """Half width of the neighbor, the obstacle and the goal channel [m]."""
        return (
            self.link_range if self.neighbor_radius is None else self.neighbor_radius,
            self.detection_range if self.obstacle_radius is None else self.obstacle_radius,
            self.goal_radius,
        )

    @property
    def look_back_steps(self) -> int:
        """Age of the second look [steps]; 0 where there is none."""
        return round(self.look_back / self.time_step)

    @property
    def bodies(self) -> str:
        """How many fly and walk, in words: ``5 vehicles, 2 obstacles``."""
        counts = ((self.n_vehicles, "vehicle"), (self.n_obstacles, "obstacle"))
        return ", ".join(f"{count} {name}{'' if count == 1 else 's'}" for count, name in counts)

    @property
    def observation_shape(self) -> tuple[int, int, int]:
        """Shape of one vehicle's tensor: ``(3, l, l)``, or ``(6, l, l)`` with a second look."""
        return (6 if self.look_back else 3, self.n_anchors, self.n_anchors)
