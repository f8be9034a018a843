"""MuJoCo: vehicles on two wheels, with motors, friction and contacts, simulated every millisecond."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from sb3_flock.settings import RunError
from sb3_flock.sim.actuators import follow
from sb3_flock.sim.mujoco_view import View
from sb3_flock.sim.randomization import FlockValues
from sb3_flock.sim.simulators import Simulator, import_extra, register_simulator

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.dynamics import DynamicsSettings
    from sb3_flock.sim.sensing import SensingSettings

WHEEL_RADIUS = 0.0205
"""[m]; the sizes are about those of an e-puck2, which is 7 cm wide."""
HALF_AXLE = 0.0265
"""Half the distance between the wheels [m]."""
PERIOD = 0.001
"""MuJoCo's time step [s]."""
DRIVE_PERIOD = 0.01
"""Time between two commands of the drive to the motors [s]."""


@register_simulator("mujoco")
class MuJoCo(Simulator):
    """Each vehicle is a body of 160 g on two driven wheels and two skids without friction; vehicles that touch push each other.

    The drive turns commands into those of the motors every 10 ms: speed and turn rate follow as ``actuators`` says
    (:func:`~sb3_flock.sim.actuators.follow`). A motor holds its wheel's speed with a bounded torque, and the friction of the
    wheels on the floor moves the vehicle. One physical model serves all flocks, each has its own state.

    :raises SettingsError: without the extra ``mujoco``
    :raises RunError: in a step, if the simulation is unstable
    """

    period = DRIVE_PERIOD
    actuators = ("speed_lag", "turn_lag", "max_acceleration", "max_turn_acceleration", "min_speed")
    margin = 0.002  # the motors' delay, and arcs

    def __init__(self, settings: DynamicsSettings, n_flocks: int) -> None:
        super().__init__(settings, n_flocks)
        self._mujoco = import_extra("mujoco", "mujoco")
        self._model: Any = self._mujoco.MjModel.from_xml_string(model_xml(settings.n_vehicles))
        self._states = [self._mujoco.MjData(self._model) for _ in range(n_flocks)]
        self._actuators = FlockValues(settings.actuators)
        self._view: View | None = None

    def reset(self, poses: NDArray[np.float64]) -> None:
        """Place every vehicle, at rest, with its wheels on the floor."""
        self._rates = np.zeros((*poses.shape[:2], 2))
        self._rates[..., 0] = self.settings.actuators.min_speed
        for state, flock in zip(self._states, poses, strict=True):
            self._mujoco.mj_resetData(self._model, state)
            bodies = state.qpos.reshape(len(flock), -1)
            bodies[:, :2] = flock[:, :2]
            bodies[:, 3], bodies[:, 6] = np.cos(flock[:, 2] / 2), np.sin(flock[:, 2] / 2)

    def step(self, commands: NDArray[np.float64]) -> NDArray[np.float64]:
        """Hold the commands for one time step of the task."""
        actuators, follows = self.settings.actuators, self._actuators
        wanted = np.maximum(commands[..., 0], actuators.min_speed)
        for _ in range(round(self.settings.time_step / DRIVE_PERIOD)):
            (speeds, _), (turn_rates, _) = (
                follow(self._rates[..., 0], wanted, follows.speed_lag, follows.max_acceleration, DRIVE_PERIOD),
                follow(self._rates[..., 1], commands[..., 1], follows.turn_lag, follows.max_turn_acceleration, DRIVE_PERIOD),
            )
            self._rates = np.stack((speeds, turn_rates), axis=-1)
            sides = HALF_AXLE * turn_rates
            wheels = np.stack((speeds - sides, speeds + sides), axis=-1) / WHEEL_RADIUS
            for state, rates in zip(self._states, wheels, strict=True):
                state.ctrl[:] = rates.ravel()
                self._mujoco.mj_step(self._model, state, round(DRIVE_PERIOD / PERIOD))
        if any(state.warning.number.any() for state in self._states):  # MuJoCo goes on, with a state that it resets
            raise RunError("mujoco: the simulation is unstable, or too many bodies touch")
        bodies = self._bodies("qpos")
        w, x, y, z = np.moveaxis(bodies[..., 3:7], -1, 0)
        self._headings = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return np.concatenate((bodies[..., :2], self._headings[..., None]), axis=-1)

    def speeds(self) -> NDArray[np.float64]:
        """The bodies' speeds along their headings, ``(flocks, vehicles)`` [m/s]."""
        velocities = self._bodies("qvel")
        return np.cos(self._headings) * velocities[..., 0] + np.sin(self._headings) * velocities[..., 1]

    def image(self, obstacles: NDArray[np.float64], waypoint: NDArray[np.float64]) -> NDArray[np.uint8]:
        """The vehicles by MuJoCo's renderer, with the obstacles, the waypoint and the links.

        :raises RunError: where MuJoCo finds no OpenGL
        """
        ranges = cast("SensingSettings", self.settings)  # the whole scenario
        self._view = self._view or View(self._mujoco, self._model, ranges)
        return self._view.image(self._states[0], self._bodies("qpos")[0, :, :2], obstacles, waypoint)

    def _bodies(self, name: str) -> NDArray[np.float64]:
        """Coordinates of all vehicles: the body's first, then the wheels', ``(flocks, vehicles, ...)``."""
        return np.stack([getattr(state, name).reshape(self.settings.n_vehicles, -1) for state in self._states])


def model_xml(n_vehicles: int) -> str:
    """The model of a flock in MuJoCo's MJCF: vehicles on an endless floor."""
    bodies = "".join(_BODY.format(number=number) for number in range(n_vehicles))
    motors = "".join(
        f'<velocity class="motor" joint="{side}{number}"/>' for number in range(n_vehicles) for side in ("left", "right")
    )
    return _MODEL.format(bodies=bodies, motors=motors)


_MODEL = f"""
<mujoco>
  <option timestep="{PERIOD}" integrator="implicitfast"/>
  <visual><headlight ambient="0.4 0.4 0.4" diffuse="0.4 0.4 0.4" specular="0 0 0"/><map znear="0.005"/></visual>
  <statistic extent="3"/>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" rgb1="1 1 1" width="16" height="96"/>
    <texture name="tiles" type="2d" builtin="checker" rgb1="0.95 0.95 0.95" rgb2="0.9 0.9 0.9" width="256" height="256"/>
    <material name="floor" texture="tiles" texrepeat="2 2" texuniform="true"/>
  </asset>
  <default>
    <geom solref="0.005 1"/>
    <default class="body">
      <geom type="cylinder" size="0.035 0.015" pos="0 0 0.005" mass="0.15" condim="3" friction="0.3 0 0" rgba="0 0.45 0.7 0.35"/>
    </default>
    <default class="wheel">
      <geom type="ellipsoid" size="{WHEEL_RADIUS} 0.003 {WHEEL_RADIUS}" mass="0.005" condim="3" friction="1 0 0"
        contype="2" conaffinity="0" rgba="0.15 0.15 0.15 1"/>
    </default>
    <default class="mark"><geom type="box" mass="0" contype="0" conaffinity="0" rgba="1 1 1 1"/></default>
    <default class="skid">
      <geom type="sphere" size="0.004" mass="0" condim="1" friction="0 0 0" contype="2" conaffinity="0"/>
    </default>
    <default class="motor"><velocity kv="0.003" forcerange="-0.006 0.006"/></default>
  </default>
  <worldbody>
    <light pos="0 0 3" dir="0.3 0.2 -1" directional="true" castshadow="false" diffuse="0.5 0.5 0.5" specular="0 0 0"/>
    <geom type="plane" size="0 0 1" material="floor" condim="1" friction="0 0 0" contype="0" conaffinity="2"/>
    {{bodies}}
  </worldbody>
  <actuator>{{motors}}</actuator>
</mujoco>
"""

_SPOKE = '<geom class="mark" size="0.015 0.004 0.0015"/>'

_BODY = f"""
    <body pos="0 0 {WHEEL_RADIUS}">
      <freejoint/>
      <geom class="body"/>
      <geom class="skid" pos="0.028 0 {0.004 - WHEEL_RADIUS}"/>
      <geom class="skid" pos="-0.028 0 {0.004 - WHEEL_RADIUS}"/>
      <geom class="mark" size="0.01 0.002 0.001" pos="0.024 0 0.021"/>
      <body pos="0 {HALF_AXLE} 0"><joint name="left{{number}}" axis="0 1 0"/><geom class="wheel"/>{_SPOKE}</body>
      <body pos="0 -{HALF_AXLE} 0"><joint name="right{{number}}" axis="0 1 0"/><geom class="wheel"/>{_SPOKE}</body>
    </body>"""
