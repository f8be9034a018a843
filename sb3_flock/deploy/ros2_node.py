"""A ROS 2 node that drives one vehicle by a policy: poses in, velocities out."""

from __future__ import annotations

import math
import signal
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from sb3_flock.deploy.vehicle import STOP, Body, VehicleController, heading_of
from sb3_flock.settings import Positive, Settings, SettingsError
from sb3_flock.sim import Scenario

_OF_ROS = ("use_sim_time", "start_type_description_service", "qos_overrides.")
"""Parameters that every node of ROS has."""

_AFTER = 1e-4
"""How long after a loss the timer checks for it [s]."""

_SIGNAL_CHECK = 0.02
"""How often the node checks for signals [s]."""

PoseMessage = Literal["nav_msgs/Odometry", "geometry_msgs/PoseStamped"]


class Ros2Settings(Settings):
    """The parameters of the node. In names of topics ``{i}`` is the number of a vehicle, ``{j}`` that of an obstacle."""

    n_vehicles: int = Field(3, description="number of vehicles [as trained]")
    n_obstacles: int = Field(1, description="number of obstacles [as trained]")
    vehicle_topic: str = Field("/vehicle_{i}/odom", description="poses of the vehicles, in a frame that all share")
    vehicle_message: PoseMessage = Field("nav_msgs/Odometry", description="type of vehicle_topic")
    obstacle_topic: str = Field("/obstacle_{j}/pose", description="poses of the obstacles")
    obstacle_message: PoseMessage = Field("geometry_msgs/PoseStamped", description="type of obstacle_topic")
    waypoint_topic: str = Field("/waypoint", description="the waypoint's pose")
    waypoint_message: PoseMessage = Field("geometry_msgs/PoseStamped", description="type of waypoint_topic")
    command_topic: str = Field("/vehicle_{i}/cmd_vel", description="geometry_msgs/Twist: linear.x [m/s], angular.z [rad/s]")
    announcement_topic: str = Field(
        "/vehicle_{i}/announced", description="geometry_msgs/TwistStamped: linear.x is the announced speed [m/s]"
    )
    frame: str = Field("", description="frame_id that every pose must have; empty: not checked")
    rate: Positive = Field(10.0, description="decisions in a second [1 / time_step]")
    timeout: Positive = Field(0.15, description="age from which a pose is lost [s]")
    announcement_wait: Positive = Field(0.02, description="how long to wait in a cycle for announcements [s]")
    lockstep: bool = Field(
        False, description="decide once for each set of poses with equal stamps, as a simulation needs it, not by the clock"
    )

    @model_validator(mode="after")
    def _topics_differ(self) -> Ros2Settings:
        numbered = [("vehicle_topic", "{i}", self.n_vehicles), ("announcement_topic", "{i}", self.n_vehicles)]
        for name, number, count in [*numbered, ("obstacle_topic", "{j}", self.n_obstacles)]:
            if count > 1 and number not in getattr(self, name):
                raise ValueError(
                    f"{name} = {getattr(self, name)!r}: {number} is needed, the number of one of {count} bodies"
                )
        if not self.lockstep and self.announcement_wait * self.rate >= 1:
            raise ValueError(f"announcement_wait = {self.announcement_wait}: input should be less than 1 / rate")
        return self


def defaults_for(scenario: Scenario) -> dict[str, Any]:
    """The parameters whose defaults depend on the policy's task."""
    return {"n_vehicles": scenario.n_vehicles, "n_obstacles": scenario.n_obstacles, "rate": 1.0 / scenario.time_step}


def scenario_of(settings: Ros2Settings, scenario: Scenario) -> Scenario:
    """The task with the node's numbers of bodies and its period.

    :raises SettingsError: if they do not fit, such as a filter that needs a shorter period
    """
    starts = scenario.obstacle_starts
    if starts is not None and len(starts) > settings.n_obstacles:
        scenario = scenario.replace(obstacle_starts=None)
    changes: dict[str, Any] = {"n_vehicles": settings.n_vehicles, "n_obstacles": settings.n_obstacles}
    if not math.isclose(settings.rate * scenario.time_step, 1.0, rel_tol=1e-9):
        changes["time_step"] = 1.0 / settings.rate
    return scenario.replace(**changes)


class VehicleNode:
    """The node of one vehicle: subscriptions, publishers, and a timer.

    By the clock, cycles start at whole multiples of the period, so that vehicles with synchronized clocks decide at the same
    time. In lockstep a cycle starts when the poses of all bodies have the same new stamp.

    :param policy: a loaded policy, or anything with SB3's ``predict``
    :param scenario: the task
    :param vehicle: the number of the vehicle, from 0
    :param context: of ``rclpy``; its arguments set the parameters of :class:`Ros2Settings`
    :param parameters: other defaults of these parameters
    :raises SettingsError: for a parameter or a vehicle that is not accepted
    """

    def __init__(self, policy: Any, scenario: Scenario, vehicle: int, context: Any = None, **parameters: Any) -> None:
        from rclpy.clock import Clock, ClockType
        from rclpy.exceptions import NameValidationException
        from rclpy.node import Node

        if vehicle < 0:
            raise SettingsError(f"vehicle = {vehicle}: input should be at least 0")
        self.decision_times: deque[float] = deque(maxlen=100_000)
        """How long the last decisions took, without the wait for announcements [s]."""
        self.missed_cycles = 0
        self.reason = "no pose received"
        """Why the vehicle stands still; empty while it drives."""
        self._cycle, self._spent = -1, 0.0  # the start of the last cycle, or its stamp [ns]; time spent in it [s]
        self._wait_until = math.inf  # end of the wait for announcements [s]; infinite while there is none
        self._announced: dict[int, tuple[int, float]] = {}  # cycle and speed by vehicle
        name = f"flock_vehicle_{vehicle}"
        self.node = Node(name, context=context, automatically_declare_parameters_from_overrides=True)
        try:
            self.settings = self._read_parameters({**defaults_for(scenario), **parameters})
            scenario = scenario_of(self.settings, scenario)
            self.controller = VehicleController(policy, scenario, vehicle, self.settings.timeout)
            self.controller.warm_up()
            self._period = round(1e9 / self.settings.rate)
            self._ros_clock = self.node.get_clock()
            is_simulated = self.node.get_parameter("use_sim_time").value
            self._clock = self._ros_clock if is_simulated else Clock(clock_type=ClockType.STEADY_TIME)
            self._connect()
        except NameValidationException as error:
            self.node.destroy_node()
            raise SettingsError(" ".join(str(error).split())) from None
        except BaseException:
            self.node.destroy_node()
            raise

    def close(self) -> None:
        """Stop the vehicle, and end the node."""
        from rclpy.duration import Duration

        if self.node.context.ok():
            self._command(*STOP)
            self._commands.wait_for_all_acked(Duration(seconds=0.1))
        self.node.destroy_node()

    def summary(self) -> str:
        """One line about all cycles."""
        times = 1000 * np.array(self.decision_times or [math.nan])
        median, high = np.percentile(times, (50, 99))
        return (
            f"{len(self.decision_times)} decisions, median {median:.2f} ms, 99th percentile {high:.2f} ms; "
            f"{self.missed_cycles} missed cycles"
        )

    def _read_parameters(self, defaults: dict[str, Any]) -> Ros2Settings:
        """Validate what ROS was given, and declare the rest, so that tools of ROS list every parameter."""
        given = {name: parameter.value for name, parameter in self.node.get_parameters_by_prefix("").items()}
        ours = {name: value for name, value in given.items() if not name.startswith(_OF_ROS)}
        settings = Ros2Settings(**{**defaults, **ours})
        for name in Ros2Settings.model_fields:
            if name not in given:
                self.node.declare_parameter(name, getattr(settings, name))
        return settings

    def _connect(self) -> None:
        """Make the publishers, the subscriptions and the timer."""
        from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
        from nav_msgs.msg import Odometry
        from rclpy.qos import QoSProfile, ReliabilityPolicy

        settings, controller = self.settings, self.controller
        reliable = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        messages = {"nav_msgs/Odometry": Odometry, "geometry_msgs/PoseStamped": PoseStamped}

        def subscribe(body: Body, topic: str, message: str, has_heading: bool) -> None:
            callback = self._receiver(body, has_heading)
            self.node.create_subscription(messages[message], topic, callback, reliable if settings.lockstep else newest)

        self._twist, self._twist_stamped = Twist, TwistStamped
        own = str(controller.vehicle)
        self._commands = self.node.create_publisher(Twist, settings.command_topic.replace("{i}", own), reliable)
        for number, body in enumerate(controller.vehicles):
            subscribe(body, settings.vehicle_topic.replace("{i}", str(number)), settings.vehicle_message, True)
        for number, body in enumerate(controller.obstacles):
            subscribe(body, settings.obstacle_topic.replace("{j}", str(number)), settings.obstacle_message, False)
        subscribe(controller.waypoint, settings.waypoint_topic, settings.waypoint_message, False)
        if controller.announces:
            topic = settings.announcement_topic
            self._announcements = self.node.create_publisher(TwistStamped, topic.replace("{i}", own), reliable)
            for number in range(len(controller.vehicles)):
                if number != controller.vehicle:
                    listen = self._listener(number)
                    self.node.create_subscription(TwistStamped, topic.replace("{i}", str(number)), listen, reliable)
        self._timer = self.node.create_timer(self._period / 1e9, self._update, clock=self._clock)

    def _receiver(self, body: Body, has_heading: bool) -> Callable[[Any], None]:
        """The callback for the poses of a body."""

        def receive(message: Any) -> None:
            header, measured, fault = message.header, self._now(), ""
            stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
            pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
            if self.settings.frame and header.frame_id != self.settings.frame:
                fault = f"its frame_id is {header.frame_id!r}, not {self.settings.frame!r}"
            if stamp and not self.settings.lockstep:  # a stamp of 0 is none
                age = (self._ros_clock.now().nanoseconds - stamp) / 1e9
                measured -= max(age, 0.0)
                if age < -self.settings.timeout:
                    fault = fault or "its stamp is ahead of the clock"
            turned = pose.orientation
            heading = heading_of(turned.x, turned.y, turned.z, turned.w) if has_heading else 0.0
            body.receive(pose.position.x, pose.position.y, heading, measured, stamp, fault)
            if self.settings.lockstep or body.fault:
                self._update()

        return receive

    def _listener(self, number: int) -> Callable[[Any], None]:
        """The callback for the announcements of a neighbor."""

        def receive(message: Any) -> None:
            stamp = message.header.stamp
            self._announced[number] = stamp.sec * 10**9 + stamp.nanosec, message.twist.linear.x
            if self._wait_until < math.inf:
                self._update()

        return receive

    def _update(self) -> None:
        """Begin a cycle that is due, end the wait for announcements, and stop if something is lost."""
        now, cycle = self._now(), self._present_cycle()
        is_due = cycle != self._cycle
        reason = self.controller.reason_to_stop(now)
        if reason:
            if is_due or not self.reason:
                self._stop(reason)
            self._cycle = cycle
        elif is_due:
            self._begin(cycle, now)
        if self._wait_until < math.inf and (now >= self._wait_until or self._has_all_announcements()):
            self._finish()
        self._schedule()

    def _present_cycle(self) -> int:
        """By the clock the start of the cycle; in lockstep the stamp of all poses, or the last cycle's if they differ [ns]."""
        if self.settings.lockstep:
            stamps = {body.stamp for body in self.controller.bodies}
            return stamps.pop() if len(stamps) == 1 else self._cycle
        return self._ros_clock.now().nanoseconds // self._period * self._period

    def _begin(self, cycle: int, now: float) -> None:
        """Ask the policy, and announce the speed where that is needed."""
        start = time.perf_counter()
        if self.reason:
            self.node.get_logger().info("driving")
        elif abs(cycle - self._cycle - self._period) > self._period / 100:
            self.missed_cycles += max(round((cycle - self._cycle) / self._period) - 1, 0)
            self.controller.forget()
        self.reason, self._cycle = "", cycle
        try:
            speed = self.controller.ask()
        except ValueError as error:
            self._stop(str(error))
            return
        self._spent = time.perf_counter() - start
        self._wait_until = now
        if self.controller.announces:
            self._wait_until += self.settings.announcement_wait
            message = self._twist_stamped()
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(cycle, 10**9)
            message.twist.linear.x = speed
            self._announcements.publish(message)

    def _has_all_announcements(self) -> bool:
        return all(self._announced.get(number, (-1, 0.0))[0] == self._cycle for number in self.controller.neighbors())

    def _finish(self) -> None:
        """Publish the command, with the announcements of this cycle that have arrived."""
        start, self._wait_until = time.perf_counter(), math.inf
        announced = {number: speed for number, (cycle, speed) in self._announced.items() if cycle == self._cycle}
        self._command(*self.controller.act(announced))
        self.decision_times.append(self._spent + time.perf_counter() - start)

    def _stop(self, reason: str) -> None:
        """Publish zero velocity, in lockstep once, and forget earlier measurements."""
        if reason != self.reason:
            self.node.get_logger().warning(f"stopped: {reason}")
        if not (self.settings.lockstep and self.reason):
            self._command(*STOP)
        self.reason, self._wait_until = reason, math.inf
        self.controller.forget()

    def _schedule(self) -> None:
        """Set the timer to what comes next: a cycle, the end of a wait, or a loss."""
        now, period = self._now(), self._period
        next_cycle = period if self.settings.lockstep else period - self._ros_clock.now().nanoseconds % period
        seconds = min(self._wait_until, self.controller.next_loss(now) + _AFTER) - now
        self._timer.timer_period_ns = max(int(min(next_cycle, seconds * 1e9)), 10_000)
        self._timer.reset()

    def _command(self, speed: float, turn_rate: float) -> None:
        message = self._twist()
        message.linear.x, message.angular.z = speed, turn_rate
        self._commands.publish(message)

    def _now(self) -> float:
        """The clock by which poses are lost [s]. It never goes back, unless a simulation's time does."""
        return self._clock.now().nanoseconds / 1e9


def drive(policy: Any, scenario: Scenario, vehicle: int, ros_arguments: Sequence[str] = ()) -> str:
    """Run a node until the process is interrupted or terminated; then the vehicle is stopped.

    :param ros_arguments: what follows ``--ros-args`` on a command line of ROS
    :return: :meth:`VehicleNode.summary`
    :raises SettingsError: if rclpy is missing, or an argument, a parameter or the vehicle is not accepted
    """
    try:
        import nav_msgs.msg  # noqa: F401 - one of the packages that rclpy alone does not bring
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.signals import SignalHandlerOptions
    except ImportError as error:
        raise SettingsError(f"{error.name} is missing: it comes with ROS 2; source its setup.bash first") from None
    is_ending = False

    def end(*_: Any) -> None:
        nonlocal is_ending
        is_ending = True

    context = Context()
    try:
        rclpy.init(args=["--ros-args", *ros_arguments], context=context, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise SettingsError(" ".join(str(error).split(", at /", maxsplit=1)[0].split())) from None
    handlers = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        node = VehicleNode(policy, scenario, vehicle, context)
        executor = SingleThreadedExecutor(context=context)
        try:
            executor.add_node(node.node)
            while not is_ending and context.ok():
                executor.spin_once(timeout_sec=_SIGNAL_CHECK)
        finally:
            node.close()
            executor.shutdown()
    finally:
        context.try_shutdown()
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return node.summary()
