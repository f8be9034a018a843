"""How bodies move: the discrete unicycle of vehicles and obstacles (section III-A)."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from sb3_flock.settings import NotNegative, Positive, Settings

if TYPE_CHECKING:
    from numpy.typing import NDArray

ObstacleMotion = Literal["walk", "crossing"]

MAX_BODIES = 1_000_000
"""Largest number of vehicles or obstacles. Each body adds at most 1 to an anchor, so this also bounds the observation."""


class DynamicsSettings(Settings):
    """How many bodies move, for how long, and within which bounds."""

    n_vehicles: int = Field(3, ge=1, le=MAX_BODIES, description="number of vehicles n (paper: 3 or 5)")
    n_obstacles: int = Field(1, ge=0, le=MAX_BODIES, description="number of obstacles (paper: 1 or 2)")
    max_cycles: int = Field(200, ge=1, le=1_000_000, description="episode length T [steps] (paper: not stated)")
    time_step: Positive = Field(0.1, description="sampling period [s] (paper: 0.1)")

    max_speed: Positive = Field(0.15, description="top speed of a vehicle [m/s] (paper: 0.15)")
    max_turn_rate: Positive = Field(math.pi, description="bound of a vehicle's turn rate omega [rad/s] (paper: not stated)")
    obstacle_max_speed: NotNegative = Field(0.1, description="top speed of an obstacle [m/s] (paper: 0.1)")
    obstacle_turn_std: NotNegative = Field(
        2.0, description="standard deviation of an obstacle's turn rate, drawn each step [rad/s] (paper: not stated)"
    )
    obstacle_motion: ObstacleMotion = Field(
        "walk",
        description="walk: random walk; crossing: straight through the flock from its far side (paper: walk)",
    )

    @property
    def bodies(self) -> str:
        """The number of bodies in words: ``5 vehicles, 2 obstacles``."""
        counts = ((self.n_vehicles, "vehicle"), (self.n_obstacles, "obstacle"))
        return ", ".join(f"{count} {name}{'' if count == 1 else 's'}" for count, name in counts)


def move(
    positions: NDArray[np.float64], directions: NDArray[np.float64], speeds: NDArray[np.float64], dt: float
) -> NDArray[np.float64]:
    """The unicycle's next position, x^{k+1} = x^k + v dt (cos Theta^k, sin Theta^k): the heading turns afterwards.

    :param positions: ``(..., 2)`` [m]
    :param directions: cosine and sine of the present headings, ``(..., 2)``
    :param speeds: v, ``(...)`` [m/s]
    :param dt: sampling period [s]
    :return: ``(..., 2)`` [m]
    """
    return positions + (speeds * dt)[..., None] * directions


def turn(headings: NDArray[np.float64], turn_rates: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
    """The unicycle's next heading, Theta^{k+1} = Theta^k + omega dt, in [-pi, pi) [rad]."""
    return wrap_angle(headings + turn_rates * dt)


def move_bodies(
    positions: NDArray[np.float64],
    directions: NDArray[np.float64],
    headings: NDArray[np.float64],
    controls: NDArray[np.float64],
    obstacle_positions: NDArray[np.float64],
    obstacle_directions: NDArray[np.float64],
    obstacle_headings: NDArray[np.float64],
    obstacle_speeds: NDArray[np.float64],
    obstacle_turn_rates: NDArray[np.float64],
    dt: float,
    half_side: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The unicycles' next state: vehicles by their controls, obstacles by drawn ones and turned back at the edge of their square.

    :param positions: of the vehicles, ``(flocks, vehicles, 2)`` [m]
    :param directions: cosine and sine of their headings, ``(flocks, vehicles, 2)``
    :param headings: ``(flocks, vehicles)`` [rad]
    :param controls: v [m/s] and omega [rad/s], ``(flocks, vehicles, 2)``
    :param obstacle_positions: ``(flocks, obstacles, 2)`` [m], as the further ones
    :param dt: sampling period [s]
    :param half_side: of the obstacles' square [m]
    :return: the next ``positions``, ``headings``, ``obstacle_positions`` and ``obstacle_headings``
    """
    moved = move(obstacle_positions, obstacle_directions, obstacle_speeds, dt)
    outside = np.maximum(np.abs(moved[..., 0]), np.abs(moved[..., 1])) > half_side
    return (
        move(positions, directions, controls[..., 0], dt),
        turn(headings, controls[..., 1], dt),
        np.clip(moved, -half_side, half_side),
        wrap_angle(obstacle_headings + obstacle_turn_rates * dt + np.pi * outside),
    )


def directions_of(headings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cosine and sine of headings ``(...)`` [rad], ``(..., 2)``."""
    directions = np.empty((*headings.shape, 2))
    np.cos(headings, out=directions[..., 0])
    np.sin(headings, out=directions[..., 1])
    return directions


def wrap_angle(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles in [-pi, pi) [rad]."""
    return angles - 2 * np.pi * np.floor((angles + np.pi) / (2 * np.pi))
