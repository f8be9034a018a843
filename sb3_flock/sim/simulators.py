"""Other simulators: the interface of a simulator, and the dynamics that move the vehicles of a world in it.

A further simulator is a subclass of :class:`Simulator` registered with :func:`register_simulator`; the scenario's field
``dynamics`` names it. Sensing, controllers, the safety filter, obstacles, the waypoint and metrics stay those of the world, which
reads the simulator's poses after each step.
"""

from __future__ import annotations

import importlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from sb3_flock.settings import SettingsError, first_line
from sb3_flock.sim.actuators import Actuators
from sb3_flock.sim.dynamics import DYNAMICS, Stopping, VehicleDynamics, directions_of, wrap_angle

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from sb3_flock.sim.dynamics import DynamicsSettings


class Simulator(ABC):
    """The vehicles of all flocks in another simulator, or real ones: poses in, then commands in and poses out.

    Flocks do not meet each other. The same poses and commands give the same poses.

    :param settings: the task; with the number of vehicles, the time step, and the actuators
    :param n_flocks: number of flocks
    """

    period: ClassVar[float | None] = None
    """The simulator's own time step [s], of which the task's is a multiple; ``None``: the task may have any."""
    actuators: ClassVar[tuple[str, ...]] = ("speed_lag", "max_acceleration")
    """Which fields of the scenario's ``actuators`` the simulator simulates, or its vehicles have anyway; others are refused."""

    margin: ClassVar[float] = 0.0
    """Distance that the safety filter keeps beyond the scenario's ``safety_margin``: how much farther the vehicles may come than
    by ``speed_lag`` and ``max_acceleration``, along their headings [m]."""

    def __init__(self, settings: DynamicsSettings, n_flocks: int) -> None:
        self.settings, self.n_flocks = settings, n_flocks

    @abstractmethod
    def reset(self, poses: NDArray[np.float64]) -> None:
        """Place every vehicle, at rest.

        :param poses: x and y [m] and heading [rad], ``(flocks, vehicles, 3)``
        """

    @abstractmethod
    def step(self, commands: NDArray[np.float64]) -> NDArray[np.float64]:
        """Hold every vehicle's command for one time step of the task.

        :param commands: speed [m/s] and turn rate [rad/s], to the left positive, ``(flocks, vehicles, 2)``
        :return: the poses afterwards, ``(flocks, vehicles, 3)``, of any range of headings
        """

    def speeds(self) -> NDArray[np.float64] | None:
        """Actual speeds after the last step, for the safety filter, ``(flocks, vehicles)`` [m/s].

        ``None``: the mean speed of the step is used, from the poses.
        """
        return None

    def image(self, obstacles: NDArray[np.float64], waypoint: NDArray[np.float64]) -> NDArray[np.uint8] | None:
        """A picture of the first flock as the simulator shows it, ``(height, width, 3)``, the same size every time.

        :param obstacles: where they are, which no simulator knows, ``(obstacles, 2)`` [m]
        :param waypoint: ``(2,)`` [m]
        :return: ``None``: the simulator shows none
        """
        return None


class SimulatorDynamics(VehicleDynamics):
    """The vehicles move as in the registered simulator that ``settings.dynamics`` names.

    The simulator is reset wherever the poses are not those that it returned last. Its own state is in no checkpoint.
    ``actuators.speed_lag`` and ``actuators.max_acceleration`` are what the safety filter assumes of the vehicles.

    :raises SettingsError: for actuators that the simulator does not simulate, or a time step that is no multiple of its own
    """

    memory = ("speeds",)
    speeds: NDArray[np.float64]
    """Actual speeds, ``(flocks, vehicles)`` [m/s]."""

    def __init__(self, settings: DynamicsSettings) -> None:
        super().__init__(settings)
        self._class = SIMULATORS[settings.dynamics]
        self.margin = self._class.margin
        self._simulator: Simulator | None = None
        self._poses: NDArray[np.float64] | None = None
        for name in Actuators.model_fields:
            if self.actuators.is_on(name) and name not in self._class.actuators:
                simulated = ", ".join(self._class.actuators) or "none"
                raise SettingsError(
                    f"actuators.{name} = {getattr(settings.actuators, name):g}: of the actuators the simulator "
                    f"{settings.dynamics} has {simulated}"
                )
        period = self._class.period
        if period is not None and abs(settings.time_step / period - round(settings.time_step / period)) > 1e-6:
            raise SettingsError(
                f"time_step = {settings.time_step:g}: the simulator {settings.dynamics} needs a multiple of {period:g} s"
            )

    def reset(self, rngs: Sequence[Generator]) -> None:
        """Start an episode in every flock; the simulator is reset at the first step, which has the poses."""
        super().reset(rngs)
        if self.actuators.are_drawn:
            raise SettingsError(
                f"randomization: the simulator {self.settings.dynamics} has the same actuators in all flocks"
            )
        self._simulator_of(len(rngs))
        self._poses = None
        self.speeds = np.zeros((len(rngs), self.settings.n_vehicles))

    def step(
        self,
        positions: NDArray[np.float64],
        headings: NDArray[np.float64],
        commands: NDArray[np.float64],
        dt: float,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Move every vehicle by one sampling period; see the class."""
        simulator = self._simulator_of(len(positions))
        before = np.concatenate((positions, headings[..., None]), axis=-1)
        if self._poses is None or not np.array_equal(before, self._poses):
            self._place(simulator, before)
        after = np.array(simulator.step(commands), dtype=np.float64)
        if after.shape != before.shape:
            raise ValueError(
                f"dynamics = {self.settings.dynamics}: its step returns poses of shape {after.shape}: {before.shape} is needed"
            )
        after[..., 2] = wrap_angle(after[..., 2])
        self._poses = after.copy()
        speeds = simulator.speeds()
        if speeds is None:
            halfway = before[..., 2] + wrap_angle(after[..., 2] - before[..., 2]) / 2
            speeds = ((after - before)[..., :2] * directions_of(halfway)).sum(-1) / dt
        self.speeds = np.maximum(speeds, 0.0)
        return after[..., :2], after[..., 2]

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`; the simulator is reset at the next step, in which the vehicles start at rest."""
        super().load_state_dict(state)
        self._poses = None

    def image(
        self, poses: NDArray[np.float64], obstacles: NDArray[np.float64], waypoint: NDArray[np.float64]
    ) -> NDArray[np.uint8]:
        """The simulator's own picture of the first flock, ``(height, width, 3)``.

        :param poses: of all flocks, for a simulator in which no vehicle has moved yet, ``(flocks, vehicles, 3)``
        :param obstacles: as for :meth:`Simulator.image`
        :raises SettingsError: if it has none
        """
        simulator = self._simulator_of(len(poses))
        if self._poses is None:
            self._place(simulator, poses)
        image = simulator.image(obstacles, waypoint)
        if image is None:
            raise SettingsError(f"view = simulator: the simulator {self.settings.dynamics} shows no pictures")
        return image

    def _place(self, simulator: Simulator, poses: NDArray[np.float64]) -> None:
        simulator.reset(poses)
        self._poses = poses

    def _simulator_of(self, n_flocks: int) -> Simulator:
        if self._simulator is None or self._simulator.n_flocks != n_flocks:
            self._simulator = self._class(self.settings, n_flocks)
        return self._simulator

    def stopping(self) -> Stopping:
        """The actual speeds, and what ``actuators`` says of lag and acceleration."""
        return Stopping(self.speeds, self.actuators.speed_lag, self.actuators.max_acceleration)


SIMULATORS: dict[str, type[Simulator]] = {}
"""Simulators by name."""

_Simulator = TypeVar("_Simulator", bound=type[Simulator])


def register_simulator(name: str) -> Callable[[_Simulator], _Simulator]:
    """Register a simulator under a name, as a decorator of a subclass of :class:`Simulator`.

    The scenario's field ``dynamics`` names it.

    :raises ValueError: if the name is taken, or for something else than a subclass
    """

    def register(simulator: _Simulator) -> _Simulator:
        if not (isinstance(simulator, type) and issubclass(simulator, Simulator)):
            raise ValueError(f"simulator {name!r}: a subclass of Simulator is needed")
        if name in DYNAMICS and SIMULATORS.get(name) is not simulator:
            raise ValueError(f"dynamics {name!r} are registered already")
        SIMULATORS[name], DYNAMICS[name] = simulator, SimulatorDynamics
        return simulator

    return register


def import_extra(module: str, extra: str) -> Any:
    """A module of an optional dependency.

    :raises SettingsError: if it is not installed, or its import fails
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise SettingsError(f"dynamics = {extra}: {error.name} is needed: pip install 'sb3_flock[{extra}]'") from None
    except Exception as error:  # MuJoCo imports the OpenGL library that MUJOCO_GL names
        raise SettingsError(f"dynamics = {extra}: {module} cannot be imported: {first_line(error)}") from None
