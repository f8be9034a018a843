"""navground: its differential drive with a bounded torque of the wheels, and a controller of the motors, at 100 Hz."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_flock.sim.simulators import Simulator, import_extra, register_simulator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.dynamics import DynamicsSettings

AXLE = 0.053
"""Distance between the wheels [m]; the sizes are about those of an e-puck2."""
RADIUS = 0.035
"""Of a vehicle [m]."""
PERIOD = 0.01
"""navground's time step [s]."""
MOTOR_GAIN = 0.5
"""Share of its error by which a motor's torque changes in a time step."""
STRONG = 1000.0
"""The acceleration of vehicles without a bound [m/s^2]."""


@register_simulator("navground")
class Navground(Simulator):
    """Vehicles with navground's kinematics ``2WDiffDyn``, its ``LimitAcceleration`` and its ``MotorPID``.

    The drive bounds the acceleration and the turn acceleration, the latter by default to what takes as much torque as the
    former. The torque of the wheels suffices for both at once. Vehicles that touch are moved apart. Numbers are float32.

    :raises SettingsError: without the extra ``navground``
    """

    period = PERIOD
    actuators = ("max_acceleration", "max_turn_acceleration")
    margin = 0.001  # arcs

    def __init__(self, settings: DynamicsSettings, n_flocks: int) -> None:
        super().__init__(settings, n_flocks)
        self._core, self._sim = (import_extra(f"navground.{part}", "navground") for part in ("core", "sim"))
        core = self._core

        class Commanded(core.Behavior):  # type: ignore[name-defined]
            """Does what it is commanded."""

            command: Any = core.Twist2((0.0, 0.0), 0.0, core.Frame.relative)

            def compute_cmd_internal(self, time_step: float) -> Any:
                """The command; called by navground in each of its time steps."""
                return self.command

        self._behavior = Commanded

    def reset(self, poses: NDArray[np.float64]) -> None:
        """Place every vehicle, at rest."""
        self._worlds = [self._world(flock) for flock in poses]

    def _world(self, poses: NDArray[np.float64]) -> Any:
        world = self._sim.World()
        for x, y, heading in poses.tolist():
            agent = self._agent()
            agent.pose = self._core.Pose2((x, y), heading)
            world.add_agent(agent)
        return world

    def _agent(self) -> Any:
        core, settings = self._core, self.settings
        kinematics = core.Kinematics.make_type("2WDiffDyn")
        kinematics.wheel_axis = AXLE
        kinematics.max_speed = settings.max_speed + settings.max_turn_rate * AXLE / 2  # of a wheel
        kinematics.max_acceleration = bound = settings.actuators.max_acceleration or STRONG
        turn_bound = settings.actuators.max_turn_acceleration or kinematics.max_angular_acceleration
        kinematics.max_acceleration *= 1 + turn_bound / kinematics.max_angular_acceleration
        motors, drive = (core.BehaviorModulation.make_type(name) for name in ("MotorPID", "LimitAcceleration"))
        motors.k_p = MOTOR_GAIN
        drive.max_acceleration, drive.max_angular_acceleration = bound, turn_bound
        behavior = self._behavior(kinematics, RADIUS)
        for modulation in (motors, drive):  # the last one changes the command first
            behavior.add_modulation(modulation)
        return self._sim.Agent(radius=RADIUS, behavior=behavior, kinematics=kinematics, control_period=PERIOD)

    def step(self, commands: NDArray[np.float64]) -> NDArray[np.float64]:
        """Hold the commands for one time step of the task."""
        core, steps = self._core, round(self.settings.time_step / PERIOD)
        for world, flock in zip(self._worlds, commands.tolist(), strict=True):
            for agent, (speed, turn_rate) in zip(world.agents, flock, strict=True):
                agent.behavior.command = core.Twist2((speed, 0.0), turn_rate, core.Frame.relative)
            world.run(steps, PERIOD)
        return self._of_agents(lambda agent: (*agent.position, agent.orientation))

    def speeds(self) -> NDArray[np.float64]:
        """The agents' speeds, ``(flocks, vehicles)`` [m/s]."""
        return self._of_agents(lambda agent: agent.twist.relative(agent.pose).velocity[0])

    def _of_agents(self, read: Callable[[Any], Any]) -> NDArray[np.float64]:
        """What is read of each agent, ``(flocks, vehicles, ...)``."""
        return np.array([[read(agent) for agent in world.agents] for world in self._worlds], dtype=np.float64)
