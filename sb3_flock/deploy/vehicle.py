"""One vehicle's decisions from the poses of all bodies, by the simulation's own sensing, policy and safety filter."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_flock.evaluation.rollout import as_controller
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Contacts, Scenario, Sensing, observe
from sb3_flock.sim.actuators import follow
from sb3_flock.sim.dynamics import Stopping, directions_of, wrap_angle
from sb3_flock.sim.randomization import UNBOUNDED, FlockValues
from sb3_flock.sim.safety import filter_actions
from sb3_flock.sim.sensing import sense
from sb3_flock.sim.sensors import SensorErrors, Sensors
from sb3_flock.sim.tracker import Messages, Tracker, TrackerSettings
from sb3_flock.sim.visibility import select

STOP = (0.0, 0.0)
"""The action of a vehicle that stands still: speed [m/s] and turn rate [rad/s]."""


@dataclass
class Body:
    """The last pose of a vehicle, an obstacle or the waypoint, in a frame that all bodies share."""

    name: str
    max_speed: float
    """How fast it moves at most [m/s]."""
    x: float = math.nan
    """[m]"""
    y: float = math.nan
    """[m]"""
    heading: float = math.nan
    """[rad]"""
    measured: float = -math.inf
    """When it was there [s]; minus infinity: never, or what was received last has a fault."""
    stamp: int = -1
    """The stamp of its message [ns]."""
    fault: str = "no pose received"
    """What is wrong with what was received last; empty if nothing is."""

    def receive(self, x: float, y: float, heading: float, measured: float, stamp: int = 0, fault: str = "") -> None:
        """Take a pose. One with a fault, or that is not finite, is not used: the body may then be anywhere."""
        if not fault and not all(map(math.isfinite, (x, y, heading, measured))):
            fault = "its pose is not finite"
        self.stamp, self.fault = stamp, fault
        if fault:
            self.measured = -math.inf
        else:
            self.x, self.y, self.heading, self.measured = x, y, heading, measured

    def age(self, now: float) -> float:
        """Time since the pose was measured [s]; infinite where there is none, or if the clock was set back."""
        return now - self.measured if now >= self.measured else math.inf


@dataclass
class Measurement:
    """What one vehicle measures, and what the others share with it by communication.

    Positions are in the vehicle's own frame when its sensors measured, ``sensors.delay`` ago: forward is +x, left is +y. Odometry
    and messages are those of now.
    """

    neighbors: NDArray[np.float64]
    """Detected vehicles, ``(any, 2)`` [m]."""
    senders: NDArray[np.int64]
    """The number of the vehicle from which messages come from there, ``(any,)``, ascending. No position is estimated by it."""
    obstacles: NDArray[np.float64]
    """Detected obstacles, and with ``shared_detections`` those that neighbors detect, ``(any, 2)`` [m]."""
    waypoint: NDArray[np.float64]
    """``(2,)`` [m]."""
    ego_motion: NDArray[np.float64]
    """Since the last cycle: forward [m], turn [rad], and to the left [m], ``(3,)``."""
    headings: NDArray[np.float64]
    """Of all vehicles, the own one, too, in any frame that they share, ``(vehicles,)`` [rad]; of one out of range any number."""
    motions: Mapping[int, NDArray[np.float64]] = field(default_factory=dict)
    """With ``tracker.shared_motion`` the ego-motion of each neighbor whose message was received, by number."""


class VehicleController:
    """What one vehicle of a flock does: poses in, speed and turn rate out.

    Everything is computed as the world and an evaluation compute it for this vehicle. Its sensors are exact: errors are those of
    the poses. The vehicle's ego-motion is taken from its own poses. Where the scenario has a tracker, the vehicle acts on the
    tracker's estimates; ``sensors`` says which errors the tracker expects. Where it has ``actuators``, the filter keeps the way
    free that the vehicle needs in order to stop; its speed is then what the actuators make of its commands.

    A cycle is :meth:`reason_to_stop`, :meth:`ask`, and :meth:`act`. All times are those of one clock that never goes back [s].

    :param policy: a loaded policy, or anything with SB3's ``predict``
    :param scenario: the task, with the numbers of vehicles and obstacles, and the safety filter
    :param vehicle: the number of the vehicle, from 0
    :param timeout: age from which a pose is lost [s]
    :raises SettingsError: if there is no such vehicle
    :raises PolicyError: if a loaded policy's observations differ in shape; it warns where they have another meaning
    """

    def __init__(self, policy: Any, scenario: Scenario, vehicle: int, timeout: float) -> None:
        if not 0 <= vehicle < scenario.n_vehicles:
            raise SettingsError(f"vehicle = {vehicle}: input should be from 0 to n_vehicles - 1 = {scenario.n_vehicles - 1}")
        as_controller(policy, scenario)  # checks the policy
        self.policy, self.vehicle, self.timeout = policy, vehicle, timeout
        self.scenario = scenario.replace(sensors=SensorErrors())
        self.vehicles = [Body(f"vehicle {number}", scenario.max_speed) for number in range(scenario.n_vehicles)]
        self.obstacles = [Body(f"obstacle {number}", scenario.obstacle_max_speed) for number in range(scenario.n_obstacles)]
        self.waypoint = Body("the waypoint", scenario.waypoint_speed)
        self._announcing = self.scenario.replace(safety_filter="heading") if self.announces else self.scenario
        self._sensors = Sensors(self.scenario.replace(tracker=TrackerSettings()), self.scenario)
        self._tracker = None
        if scenario.tracker.enabled:
            self._tracker = Tracker(scenario.tracker, scenario, scenario, FlockValues(scenario.sensors))
        self._own_poses: deque[NDArray[np.float64]] = deque(maxlen=1 + (self._tracker.delay_steps if self._tracker else 0))
        self._speed, self._command = scenario.actuators.min_speed, STOP
        self._bounds = (0.0, -scenario.max_turn_rate), (scenario.max_speed, scenario.max_turn_rate)
        self._before: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._cycle: tuple[NDArray[np.float64], Sensing, NDArray[np.float64], Stopping | None] | None = None

    @property
    def own(self) -> Body:
        """The vehicle itself."""
        return self.vehicles[self.vehicle]

    @property
    def bodies(self) -> list[Body]:
        """All bodies and the waypoint."""
        return [*self.vehicles, *self.obstacles, self.waypoint]

    @property
    def announces(self) -> bool:
        """Whether the vehicles announce speeds to each other."""
        return self.scenario.safety_filter == "announce"

    def warm_up(self) -> None:
        """Decide twice for made-up poses, so that no later decision waits for a compiler; call it before the first pose."""
        for number, body in enumerate(self.bodies):
            body.receive(0.9 * number * self.scenario.link_range, 0.0, 0.0, 0.0)
        for _ in range(2):
            self.ask()
            self.act()
        self.forget()
        self._speed, self._command = self.scenario.actuators.min_speed, STOP
        for body in self.bodies:
            body.receive(0.0, 0.0, 0.0, 0.0, stamp=-1, fault=Body.fault)

    def reason_to_stop(self, now: float) -> str:
        """Why the vehicle may not move; empty if it may.

        Its own pose and the waypoint must not be lost. A neighbor or an obstacle that is lost is a reason if it may be in
        range by now: at its top speed from where it was last. Otherwise its last position is used, which is out of range.
        """
        for body in (self.own, self.waypoint):
            if body.age(now) > self.timeout:
                return self._describe(body)
        scenario = self.scenario
        near = [(body, scenario.link_range) for body in self.vehicles if body is not self.own]
        near += [(body, scenario.known_obstacle_range) for body in self.obstacles]
        for body, reach in near:
            age = body.age(now)
            if age > self.timeout:
                distance = math.hypot(body.x - self.own.x, body.y - self.own.y)
                if math.isinf(age) or distance - age * body.max_speed < reach:
                    return self._describe(body)
        return ""

    def next_loss(self, now: float) -> float:
        """When the first pose that is not lost is lost if nothing is received; infinite without one [s]."""
        return min((body.measured + self.timeout for body in self.bodies if body.age(now) <= self.timeout), default=math.inf)

    def ask(self, measurement: Measurement | None = None) -> float:
        """Sense, and ask the policy for an action.

        :param measurement: what the vehicle measures; ``None``: the poses that were received. With a tracker, the poses of other
            bodies are then taken as those of ``sensors.delay`` ago, and the own one as that of now
        :return: the speed to announce [m/s], that of the action if the vehicles do not announce any
        :raises ValueError: if the policy's action is not finite
        """
        truth, frames, messages = self._from_poses() if measurement is None else self._from(measurement)
        if self._tracker is not None:
            truth = self._tracker.update(truth, truth.ego_motion, messages)
        sensing = self._sensors.measure(truth)
        observation = observe(sensing, self.scenario)[0, self.vehicle]
        actions = np.zeros((1, len(self.vehicles), 2))
        asked = self.policy.predict(observation, deterministic=True)[0]
        if not np.isfinite(asked).all():
            raise ValueError(f"the policy's action is not finite: {asked.tolist()}")
        actions[0, self.vehicle] = np.clip(asked, *self._bounds)
        stopping = None
        if self.scenario.is_reserving:
            neighbors, obstacles = (_of(contacts, self.vehicle) for contacts in (sensing.neighbors, sensing.obstacles))
            sensing, stopping = replace(sensing, neighbors=neighbors, obstacles=obstacles), self._stopping()
        self._cycle = (actions, sensing, frames, stopping)
        speed = float(filter_actions(actions, sensing, self._announcing, frames, stopping=stopping)[0, self.vehicle, 0])
        return min(speed, self._speed) if stopping is not None and self.announces else speed

    def _stopping(self) -> Stopping:
        """What the vehicle needs in order to stop; the others announce no more than they reach."""
        actuators, dt = self.scenario.actuators, self.scenario.time_step
        bound = UNBOUNDED if actuators.max_acceleration is None else actuators.max_acceleration
        lag, most = np.array(actuators.speed_lag), np.array(bound)
        commanded = np.array(max(self._command[0], actuators.min_speed))
        self._speed = float(follow(np.array(self._speed), commanded, lag, most, dt)[0])
        speeds = np.full((1, len(self.vehicles)), self.scenario.max_speed)
        speeds[0, self.vehicle] = self._speed
        return Stopping(speeds, lag, most)

    def _from(self, measurement: Measurement) -> tuple[Sensing, NDArray[np.float64], Messages]:
        """What the vehicle senses, the frames of all vehicles, and what neighbors share."""
        shape = (1, len(self.vehicles))
        waypoints, motions = np.zeros((*shape, 2)), np.zeros((*shape, 3))
        waypoints[0, self.vehicle] = measurement.waypoint
        for number, motion in measurement.motions.items():
            motions[0, number, : len(motion)] = motion
        motions[0, self.vehicle, : len(measurement.ego_motion)] = measurement.ego_motion
        neighbors = self._contacts(measurement.neighbors, measurement.senders)
        obstacles = self._contacts(measurement.obstacles, np.arange(len(measurement.obstacles)))
        frames, senders = directions_of(measurement.headings[None]), np.array(sorted(measurement.motions), dtype=np.int64)
        messages = Messages(frames, motions, np.full(len(senders), self.vehicle), senders)
        return Sensing(neighbors, obstacles, waypoints, np.hypot(*np.moveaxis(waypoints, -1, 0)), motions), frames, messages

    def _contacts(self, positions: NDArray[np.float64], bodies: NDArray[np.int64]) -> Contacts:
        """Bodies that this vehicle detects."""
        observers = np.full(len(bodies), self.vehicle)
        return Contacts((1, len(self.vehicles)), observers, bodies, positions, np.hypot(positions[:, 0], positions[:, 1]))

    def _from_poses(self) -> tuple[Sensing, NDArray[np.float64], Messages]:
        """What the vehicle senses by the poses, the frames of all vehicles, and what neighbors share by their poses."""
        positions, obstacles, waypoints = (
            np.array([(body.x, body.y) for body in bodies], dtype=np.float64).reshape(1, -1, 2)
            for bodies in (self.vehicles, self.obstacles, [self.waypoint])
        )
        headings = np.array([[body.heading for body in self.vehicles]], dtype=np.float64)
        frames = directions_of(headings)
        ego_motion = self._ego_motion(positions, headings)
        self._before = (positions.copy(), headings)
        sensed_from = frames.copy()
        if self._tracker is not None:  # the others' poses are late
            self._own_poses.append(np.concatenate((positions[0, self.vehicle], frames[0, self.vehicle])))
            positions[0, self.vehicle], sensed_from[0, self.vehicle] = np.split(self._own_poses[0], 2)
        truth = sense(positions, sensed_from, obstacles, waypoints[0], self.scenario, ego_motion)
        neighbors, known = (_of(contacts, self.vehicle) for contacts in (truth.neighbors, truth.obstacles))
        messages = Messages(frames, truth.ego_motion, neighbors.observers, neighbors.bodies)
        return (truth if self._tracker is None else replace(truth, neighbors=neighbors, obstacles=known)), frames, messages

    def neighbors(self) -> list[int]:
        """The vehicles that were in range at the last :meth:`ask`."""
        assert self._cycle is not None
        found: list[int] = self._cycle[1].neighbors.by_observer()[self.vehicle].tolist()
        return found

    def act(self, announced: Mapping[int, float] | None = None) -> tuple[float, float]:
        """The action to hold for one period, after :meth:`ask`: speed [m/s] and turn rate [rad/s], filtered.

        :param announced: speeds that neighbors announced for this cycle [m/s], by number; a missing one counts as 0, which
            costs speed and no separation
        """
        assert self._cycle is not None
        actions, sensing, frames, stopping = self._cycle
        for number, speed in (announced or {}).items():
            if number != self.vehicle and speed > 0:
                actions[0, number, 0] = min(speed, self.scenario.max_speed)
        filtered = filter_actions(actions, sensing, self.scenario, frames, stopping=stopping)
        self._command = speed, turn_rate = tuple(filtered[0, self.vehicle].tolist())
        return speed, turn_rate

    def forget(self) -> None:
        """Start anew after a stop or a missed cycle: earlier measurements are not used any more."""
        self._sensors.forget()
        self._own_poses.clear()
        if self._tracker is not None:
            self._tracker.reset()
        self._before = self._cycle = None
        self._command = (self._speed, 0.0)  # a vehicle that stops is not faster than it was

    def _ego_motion(self, positions: NDArray[np.float64], headings: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """The vehicles' motion since the last cycle, forward and turn; motion across the heading is left out."""
        if self._before is None:
            return None
        before, earlier = self._before
        forward = ((positions - before) * directions_of(earlier)).sum(-1)
        return np.stack((forward, wrap_angle(headings - earlier)), axis=-1)

    def _describe(self, body: Body) -> str:
        return f"{body.name}: {body.fault or f'no pose for {self.timeout} s'}"


def _of(contacts: Contacts, vehicle: int) -> Contacts:
    """What one vehicle of a single flock senses."""
    return select(contacts, contacts.observers == vehicle)


def heading_of(x: float, y: float, z: float, w: float) -> float:
    """The heading of a quaternion of any length but 0, its yaw [rad]; NaN for 0."""
    sin, cos = 2.0 * (w * z + x * y), w * w + x * x - y * y - z * z
    return math.atan2(sin, cos) if sin or cos else math.nan
