"""Actuators: how a vehicle's speed and turn rate follow their commands, with a lag and a bound of their change."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from sb3_flock.settings import NotNegative, Positive, Settings

if TYPE_CHECKING:
    from numpy.typing import NDArray

_TINY = 1e-300
"""Smallest time that is divided by [s]."""


class Actuators(Settings):
    """How a vehicle differs from the paper's unicycle, which does what it is commanded at once and exactly."""

    speed_lag: NotNegative = Field(
        0.0, le=1e3, description="time constant with which the speed follows its command [s] (paper: 0)"
    )
    turn_lag: NotNegative = Field(
        0.0, le=1e3, description="time constant with which the turn rate follows its command [s] (paper: 0)"
    )
    max_acceleration: Positive | None = Field(
        None, description="bound of a vehicle's acceleration, also when it brakes [m/s^2]; null: none (paper: null)"
    )
    max_turn_acceleration: Positive | None = Field(
        None, description="bound of the change of a vehicle's turn rate [rad/s^2]; null: none (paper: null)"
    )
    min_speed: NotNegative = Field(
        0.0, description="lowest speed of a vehicle, such as a boat's or an aircraft's [m/s] (paper: 0)"
    )
    slip: float = Field(
        0.0,
        ge=0,
        le=1,
        description="standard deviation of the slip, the relative error of the distance that a vehicle travels in a step "
        "(paper: 0)",
    )
    disturbance: NotNegative = Field(
        0.0,
        description="standard deviation of a vehicle's displacement by wind or current in one second, along each axis "
        "[m/sqrt(s)] (paper: 0)",
    )


Rates = tuple["NDArray[np.float64]", "NDArray[np.float64]"]


def follow(
    rates: NDArray[np.float64],
    commands: NDArray[np.float64],
    lag: NDArray[np.float64],
    bound: NDArray[np.float64],
    dt: float,
) -> Rates:
    """A rate r after a step in which its command c is constant, and the integral of r over the step.

    r follows r' = clip((c - r) / lag, -bound, bound). The solution is exact: r changes at the bound until the gap |c - r| is
    bound * lag, and from there the gap decays by exp(-t / lag). With a lag of 0 the rate reaches the command as soon as the bound
    lets it, and without a bound at once.

    :param rates: r at the start of the step, any shape
    :param commands: c, of the same shape
    :param lag: time constant [s], broadcast
    :param bound: of the change of r in a second, broadcast
    :param dt: length of the step [s]
    :return: r at the end, and the integral of r
    """
    gap, sign = np.abs(commands - rates), np.sign(commands - rates)
    at_bound = np.minimum(np.maximum(gap / bound - lag, 0.0), dt)
    left = np.maximum(gap - bound * at_bound, 0.0)
    decay = np.expm1(-(dt - at_bound) / np.maximum(lag, _TINY))
    missed = (gap + left) / 2 * at_bound - left * lag * decay
    return commands - sign * (left + left * decay), commands * dt - sign * missed
