"""How bodies move: the discrete unicycle of vehicles and obstacles (section III-A), and the base class of other dynamics.

Further dynamics are a subclass of :class:`VehicleDynamics` registered with :func:`register_dynamics`; the scenario's field
``dynamics`` names them.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple, TypeVar

import numpy as np
from pydantic import AfterValidator, Field, field_validator, model_validator

from sb3_flock.settings import NotNegative, Positive, Settings, suggest
from sb3_flock.sim.actuators import Actuators
from sb3_flock.sim.obstacles import WALK, check_obstacle_motion
from sb3_flock.sim.randomization import FlockValues, own_rngs, rng_states, rngs_of

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

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
    obstacle_motion: Annotated[str, AfterValidator(check_obstacle_motion)] = Field(
        WALK,
        description="walk: random walk; crossing: straight through the flock from its far side; or the name of a registered "
        "motion (paper: walk)",
    )

    dynamics: str = Field(
        "unicycle", description="how vehicles move: unicycle, or the name of registered dynamics (paper: unicycle)"
    )
    actuators: Actuators = Field(
        default_factory=Actuators, description="how vehicles follow their commands (paper: at once and exactly)"
    )

    @field_validator("dynamics")
    @classmethod
    def _dynamics_are_registered(cls, name: str) -> str:
        if name not in DYNAMICS:
            known = ", ".join(DYNAMICS)
            raise ValueError(
                f"dynamics = {name}: the name of dynamics registered with register_dynamics is needed; registered are "
                f"{known}{suggest(name, DYNAMICS)}"
            )
        return name

    @model_validator(mode="after")
    def _min_speed_fits(self) -> DynamicsSettings:
        if self.actuators.min_speed > self.max_speed:
            raise ValueError(
                f"actuators.min_speed = {self.actuators.min_speed}: input should be at most max_speed = {self.max_speed}"
            )
        return self

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


class Stopping(NamedTuple):
    """What a vehicle needs in order to stop; the safety filter keeps as much free."""

    speeds: NDArray[np.float64]
    """Actual speeds, ``(flocks, vehicles)`` [m/s]."""
    lag: NDArray[np.float64]
    """Time constant with which a speed follows its command [s], broadcast."""
    max_acceleration: NDArray[np.float64]
    """Bound of the acceleration [m/s^2], broadcast; :data:`~sb3_flock.sim.randomization.UNBOUNDED` for none."""


class VehicleDynamics(ABC):
    """How the vehicles of every flock move by their commands. One object serves one world.

    A flock's motion may depend on its own commands, state and generator alone. A subclass names its state in :attr:`memory`
    and sets it in :meth:`reset`.

    :param settings: the task; with the time step, the bounds of the commands, and the actuators

    :ivar actuators: the numbers of ``settings.actuators``, of each flock where they are randomized: ``(flocks, 1)`` or ``(1, 1)``
    :ivar rngs: a generator for each flock, where :attr:`is_random`
    """

    memory: ClassVar[tuple[str, ...]] = ()
    """Names of the attributes that are the state: arrays ``(flocks, vehicles, ...)``."""
    is_random = False
    """Whether :meth:`step` draws random numbers; where it does not, the flocks' own generators are left as they are."""
    is_plain = False
    """Whether the vehicles move as the paper's unicycles, by compiled code: :meth:`step` is then not called."""

    margin = 0.0
    """Distance that the safety filter keeps beyond ``safety_margin``: how much farther the vehicles may come than the filter
    assumes by their :meth:`stopping` [m]."""

    def __init__(self, settings: DynamicsSettings) -> None:
        self.settings = settings
        self.actuators = FlockValues(settings.actuators)
        self.rngs: list[Generator] = []

    def reset(self, rngs: Sequence[Generator]) -> None:
        """Start an episode in every flock: a subclass sets its state after ``super().reset(rngs)``.

        :param rngs: one generator a flock
        """
        self.rngs = own_rngs(rngs) if self.is_random else []

    @abstractmethod
    def step(
        self,
        positions: NDArray[np.float64],
        headings: NDArray[np.float64],
        commands: NDArray[np.float64],
        dt: float,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Move every vehicle by one sampling period.

        :param positions: ``(flocks, vehicles, 2)`` [m]; not to be changed in place, as the other arrays
        :param headings: ``(flocks, vehicles)`` [rad]
        :param commands: speed [m/s] and turn rate [rad/s] within their bounds, ``(flocks, vehicles, 2)``
        :param dt: sampling period [s]
        :return: the next positions and headings
        """

    def stopping(self) -> Stopping | None:
        """What the vehicles need in order to stop, for the safety filter; ``None``: they stop at once."""
        return None

    def normal(self, *shape: int) -> NDArray[np.float64]:
        """Standard normal numbers ``(flocks, *shape)``, each flock's from its own generator."""
        return np.stack([rng.normal(size=shape) for rng in self.rngs])

    def state_dict(self) -> dict[str, Any]:
        """The state and the random streams: plain values and arrays."""
        return {"rngs": rng_states(self.rngs), **{name: getattr(self, name) for name in self.memory}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.rngs = rngs_of(state["rngs"])
        for name in self.memory:
            setattr(self, name, np.array(state[name], dtype=np.float64))


DYNAMICS: dict[str, type[VehicleDynamics]] = {}
"""Vehicle dynamics by name."""

_Dynamics = TypeVar("_Dynamics", bound=type[VehicleDynamics])


def register_dynamics(name: str) -> Callable[[_Dynamics], _Dynamics]:
    """Register vehicle dynamics under a name, as a decorator of a subclass of :class:`VehicleDynamics`.

    :raises ValueError: if the name is taken, or for something else than a subclass
    """

    def register(dynamics: _Dynamics) -> _Dynamics:
        if not (isinstance(dynamics, type) and issubclass(dynamics, VehicleDynamics)):
            raise ValueError(f"dynamics {name!r}: a subclass of VehicleDynamics is needed")
        if DYNAMICS.setdefault(name, dynamics) is not dynamics:
            raise ValueError(f"dynamics {name!r} are registered already")
        return dynamics

    return register
