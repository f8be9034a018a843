"""The unicycle with actuators: lag, bounds of acceleration, a minimum speed, slip and disturbance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from sb3_flock.sim.actuators import Actuators, follow
from sb3_flock.sim.backend import compiled
from sb3_flock.sim.dynamics import Stopping, VehicleDynamics, directions_of, move, register_dynamics, wrap_angle

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from sb3_flock.sim.dynamics import DynamicsSettings


@register_dynamics("unicycle")
class Unicycle(VehicleDynamics):
    """The paper's unicycle, whose speed and turn rate follow their commands as ``actuators`` says.

    In a step a vehicle moves along its heading at the start of the step, x^{k+1} = x^k + s (1 + slip) (cos Theta^k, sin Theta^k)
    + disturbance, and then turns, Theta^{k+1} = Theta^k + phi. The distance s and the angle phi are the exact integrals of
    speed and turn rate over the step (:func:`~sb3_flock.sim.actuators.follow`). A vehicle starts with its minimum speed and
    without turning. The speed's command is raised to the minimum speed; slip never moves a vehicle backwards. With the default
    actuators this is the paper's unicycle to the last bit.
    """

    memory = ("rates",)
    rates: NDArray[np.float64]
    """Actual speed [m/s] and turn rate [rad/s], ``(flocks, vehicles, 2)``."""

    def __init__(self, settings: DynamicsSettings) -> None:
        super().__init__(settings)
        self._are_papers = settings.actuators == Actuators()

    @property
    def is_plain(self) -> bool:  # type: ignore[override]
        """Whether the actuators are the paper's."""
        return self._are_papers and not self.actuators.are_drawn

    @property
    def is_random(self) -> bool:  # type: ignore[override]
        """Whether there is slip or disturbance."""
        return self.actuators.is_on("slip") or self.actuators.is_on("disturbance")

    def reset(self, rngs: Sequence[Generator]) -> None:
        """Start an episode in every flock."""
        super().reset(rngs)
        self.rates = np.zeros((len(rngs), self.settings.n_vehicles, 2))
        self.rates[..., 0] = self.actuators.min_speed

    def step(
        self,
        positions: NDArray[np.float64],
        headings: NDArray[np.float64],
        commands: NDArray[np.float64],
        dt: float,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Move every vehicle by one sampling period; see the class."""
        flocks, vehicles = headings.shape
        noise = self.normal(vehicles, 3) if self.rngs else np.zeros((flocks, vehicles, 3))
        kernels = compiled()
        step = step_unicycles if kernels is None else kernels.step_unicycles
        names = ("speed_lag", "turn_lag", "max_acceleration", "max_turn_acceleration", "min_speed", "slip", "disturbance")
        values = np.stack([self.actuators.of_flocks(name, flocks) for name in names])
        positions, headings, self.rates = step(
            positions, directions_of(headings), headings, self.rates, commands, noise, values, dt
        )
        return positions, headings

    def stopping(self) -> Stopping | None:
        """What the vehicles need in order to stop; ``None`` if their speeds follow at once."""
        if self.is_plain:
            return None
        return Stopping(self.rates[..., 0], self.actuators.speed_lag, self.actuators.max_acceleration)


def step_unicycles(
    positions: NDArray[np.float64],
    directions: NDArray[np.float64],
    headings: NDArray[np.float64],
    rates: NDArray[np.float64],
    commands: NDArray[np.float64],
    noise: NDArray[np.float64],
    values: NDArray[np.float64],
    dt: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The next state of unicycles with actuators, the equations of :class:`Unicycle`.

    :param positions: ``(flocks, vehicles, 2)`` [m]
    :param directions: cosine and sine of the headings, ``(flocks, vehicles, 2)``
    :param headings: ``(flocks, vehicles)`` [rad]
    :param rates: actual speed and turn rate, ``(flocks, vehicles, 2)`` [m/s, rad/s]
    :param commands: commanded ones, ``(flocks, vehicles, 2)`` [m/s, rad/s]
    :param noise: standard normal numbers of slip and disturbance, ``(flocks, vehicles, 3)``
    :param values: the actuators of each flock, in the order of :class:`~sb3_flock.sim.actuators.Actuators`, ``(7, flocks)``
    :param dt: sampling period [s]
    :return: the next positions, headings and rates
    """
    speed_lag, turn_lag, acceleration, turn_acceleration, min_speed, slip, disturbance = values[..., None]
    speeds, strides = follow(rates[..., 0], np.maximum(commands[..., 0], min_speed), speed_lag, acceleration, dt)
    turn_rates, turns = follow(rates[..., 1], commands[..., 1], turn_lag, turn_acceleration, dt)
    strides = strides * np.maximum(1.0 + slip * noise[..., 0], 0.0)
    drifts = (disturbance * np.sqrt(dt))[..., None] * noise[..., 1:]
    next_positions = move(positions, directions, strides, 1.0) + drifts
    return next_positions, wrap_angle(headings + turns), np.stack((speeds, turn_rates), axis=-1)
