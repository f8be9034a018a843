"""The node of ROS 2, on the loopback interface. Without rclpy only the parameters are tested."""

import importlib.util
import math
import os
import random
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from sb3_flock import Scenario, load_policy
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.deploy.ros2_node import Ros2Settings, VehicleNode, defaults_for, drive, scenario_of
from sb3_flock.settings import SettingsError
from sb3_flock.sim import World, episode_rng
from sb3_flock.sim.safety import filter_actions

needs_ros = pytest.mark.skipif(importlib.util.find_spec("rclpy") is None, reason="rclpy, which comes with ROS 2, is missing")

PATIENCE = 60.0
"""How long a test waits for what has to come [s]."""


class Straight:
    """A policy that goes straight ahead at top speed."""

    def predict(self, observation, deterministic):
        return np.array([0.15, 0.5]), None


class Ros:
    """A context with a domain of its own, and an executor for all nodes of a test."""

    def __init__(self, *arguments):
        import rclpy
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor

        self.context, self.nodes = Context(), []
        rclpy.init(args=["--ros-args", *arguments], context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)

    def vehicle(self, *args, **kwargs):
        """A node that drives a vehicle."""
        made = VehicleNode(*args, context=self.context, **kwargs)
        self.nodes.append(made)
        self.executor.add_node(made.node)
        return made

    def spin_until(self, is_done, patience=PATIENCE):
        """Run all nodes until something is true, for some time at most; returns whether it is."""
        end = time.monotonic() + patience
        while not is_done() and time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.02)
        return is_done()

    def close(self):
        self.executor.shutdown()
        for made in self.nodes:
            made.close()
        self.context.try_shutdown()


class Simulation:
    """A node that publishes the poses of a world's bodies and receives commands."""

    def __init__(self, ros, world, vehicle_message="nav_msgs/Odometry"):
        from geometry_msgs.msg import PoseStamped, Twist
        from nav_msgs.msg import Odometry
        from rclpy.node import Node

        self.ros, self.world = ros, world
        self.node = Node("simulation", context=ros.context)
        ros.executor.add_node(self.node)
        scenario, message = world.scenario, {"nav_msgs/Odometry": Odometry}.get(vehicle_message, PoseStamped)
        numbers = range(scenario.n_vehicles)
        self.vehicles = [self.node.create_publisher(message, f"/vehicle_{i}/odom", 10) for i in numbers]
        self.obstacles = [
            self.node.create_publisher(PoseStamped, f"/obstacle_{j}/pose", 10) for j in range(scenario.n_obstacles)
        ]
        self.waypoint = self.node.create_publisher(PoseStamped, "/waypoint", 10)
        self.commands = [[] for _ in numbers]
        """What each vehicle was sent, as (time, speed, turn rate)."""
        for i in numbers:
            self.node.create_subscription(Twist, f"/vehicle_{i}/cmd_vel", self._receiver(i), 10)

    def _receiver(self, number):
        return lambda twist: self.commands[number].append((time.monotonic(), twist.linear.x, twist.angular.z))

    def wait_for(self, n_nodes, patience=PATIENCE):
        """Wait until a number of nodes receive the poses and send commands."""
        poses = [*self.vehicles, *self.obstacles, self.waypoint]
        topics = [f"/vehicle_{i}/cmd_vel" for i in range(n_nodes)]
        return self.ros.spin_until(
            lambda: (
                all(publisher.get_subscription_count() == n_nodes for publisher in poses)
                and all(self.node.count_publishers(topic) for topic in topics)
            ),
            patience,
        )

    def publish(self, stamp=None, which=("vehicles", "obstacles", "waypoint"), frame="map", **changed):
        """Publish all poses, at a stamp [ns]; the default is the present time. Positions and headings may be replaced."""
        stamp = self.node.get_clock().now().nanoseconds if stamp is None else stamp
        positions = changed.get("positions", self.world.positions[0])
        headings = changed.get("headings", self.world.headings[0])
        waypoints = changed.get("waypoints", self.world.waypoints)
        groups = {
            "vehicles": (self.vehicles, positions, headings),
            "obstacles": (self.obstacles, self.world.obstacle_positions[0], self.world.obstacle_headings[0]),
            "waypoint": ([self.waypoint], waypoints, [0.0]),
        }
        for name in which:
            for publisher, (x, y), heading in zip(*groups[name], strict=True):
                message = publisher.msg_type()
                message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 10**9)
                message.header.frame_id = frame
                pose = message.pose if hasattr(message.pose, "position") else message.pose.pose
                pose.position.x, pose.position.y = float(x), float(y)
                pose.orientation.z, pose.orientation.w = math.sin(heading / 2), math.cos(heading / 2)
                publisher.publish(message)

    def step(self, number):
        """The commands ``(vehicles, 2)`` for the present state in lockstep. What was lost is published again."""
        for received in self.commands:
            received.clear()
        for _ in range(30):
            self.publish(round(number * self.world.scenario.time_step * 1e9))
            if self.ros.spin_until(lambda: all(self.commands), 2.0):
                break
        assert [len(received) for received in self.commands] == [1] * len(self.commands)
        return np.array([received[0][1:] for received in self.commands])


def largest_difference(simulation, policy, steps, period=0.0):
    """Let nodes drive a world in lockstep; by which share of the range commands differ at most from actions computed here."""
    world, scenario = simulation.world, simulation.world.scenario
    sensing, differences = world.reset([episode_rng(0, 0)]), []
    start = time.monotonic()
    for number in range(steps):
        measured = world.sensors.measure(sensing)
        asked = np.clip(PolicyController(policy).act(measured, scenario), world.action_low, world.action_high)
        expected = filter_actions(asked.astype(np.float64), measured, scenario, world.frames)
        commands = simulation.step(number)
        differences.append((np.abs(commands - expected[0]) / (world.action_high - world.action_low)).max())
        sensing, _ = world.step(commands[None])
        simulation.ros.spin_until(lambda: False, start + (number + 1) * period - time.monotonic())
    return max(differences)


@pytest.fixture
def loopback(monkeypatch, tmp_path):
    """Nodes of this test and its processes find only each other."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(random.SystemRandom().randint(1, 100)))
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))


@pytest.fixture
def ros(loopback):
    """Nodes in this process; call it with arguments of ROS."""
    made = []

    def make(*arguments):
        made.append(Ros(*arguments))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def alone(ros):
    """Call it with parameters: a vehicle without obstacles, driven by the clock, and what publishes its pose."""

    def make(*arguments, **parameters):
        scenario = Scenario(n_vehicles=1, n_obstacles=0)
        world = World(scenario)
        world.reset([episode_rng(0, 0)])
        started = ros(*arguments)
        simulation = Simulation(started, world)
        vehicle = started.vehicle(Straight(), scenario, 0, **parameters)
        assert simulation.wait_for(1)
        return simulation, vehicle

    return make


def published_until(simulation, is_done, **changed):
    """Publish poses at 50 Hz until something is true; returns whether it is."""
    end = time.monotonic() + PATIENCE
    while not is_done() and time.monotonic() < end:
        simulation.publish(**changed)
        simulation.ros.spin_until(is_done, 0.02)
    return is_done()


def sends(simulation, *command):
    """Whether the last command of the first vehicle is this one."""
    return bool(simulation.commands[0]) and simulation.commands[0][-1][1:] == command


def drives(simulation, **changed):
    """Publish poses at 50 Hz until the vehicle drives; returns whether it does."""
    return published_until(simulation, lambda: sends(simulation, 0.15, 0.5), **changed)


def stops(simulation, patience=PATIENCE):
    """Wait until the vehicle stops; returns whether it does."""
    return simulation.ros.spin_until(lambda: sends(simulation, 0.0, 0.0), patience)


@needs_ros
@pytest.mark.parametrize(("level", "message"), [("announce", "nav_msgs/Odometry"), ("off", "geometry_msgs/PoseStamped")])
def test_five_nodes_in_lockstep_send_the_actions_of_a_rollout(level, message, ros):
    policy = load_policy("flock")
    scenario = policy.scenario.replace(safety_filter=level, arena=0.5)
    started = ros("-p", "lockstep:=true", "-p", "timeout:=60", "-p", f"vehicle_message:={message}")
    simulation = Simulation(started, World(scenario), message)
    nodes = [started.vehicle(policy, scenario, number, announcement_wait=30.0) for number in range(5)]
    assert simulation.wait_for(5)
    assert largest_difference(simulation, policy, 150) < 1e-5
    assert [(len(node.decision_times), node.missed_cycles, node.reason) for node in nodes] == [(150, 0, "")] * 5
    assert "150 decisions, median " in nodes[0].summary()


@needs_ros
def test_it_stands_until_poses_come_and_stops_within_a_fifth_of_a_second_when_they_end(alone):
    simulation, _ = alone()
    assert simulation.ros.spin_until(lambda: len(simulation.commands[0]) >= 3)
    assert {command[1:] for command in simulation.commands[0]} == {(0.0, 0.0)}
    delays = []
    for _ in range(5):  # the machine may be busy once
        assert drives(simulation)
        last = time.monotonic()
        assert stops(simulation)
        delays.append(simulation.commands[0][-1][0] - last)
    assert min(delays) <= 0.2


@needs_ros
@pytest.mark.parametrize("lost", ["vehicles", "waypoint"])
def test_its_own_pose_and_the_waypoint_are_needed(lost, alone):
    simulation, vehicle = alone()
    assert drives(simulation)
    rest = [name for name in ("vehicles", "waypoint") if name != lost]
    assert published_until(simulation, lambda: vehicle.reason != "", which=rest)
    assert vehicle.reason == {"vehicles": "vehicle 0", "waypoint": "the waypoint"}[lost] + ": no pose for 0.15 s"
    assert stops(simulation)


@needs_ros
@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"positions": [[math.nan, 0.0]]}, "vehicle 0: its pose is not finite"),
        ({"headings": [math.nan]}, "vehicle 0: its pose is not finite"),
        ({"waypoints": [[0.0, -math.inf]]}, "the waypoint: its pose is not finite"),
        ({"stamp": 1_000_000_000}, "vehicle 0: no pose for 5.0 s"),
        ({"stamp": 2_000_000_000_000_000_000}, "vehicle 0: its stamp is ahead of the clock"),
        ({"frame": "odom"}, "vehicle 0: its frame_id is 'odom', not 'map'"),
    ],
)
def test_it_stops_at_once_for_a_pose_that_it_cannot_use(changed, reason, alone):
    simulation, vehicle = alone(frame="map", timeout=5.0)
    assert drives(simulation)
    simulation.publish(**changed)
    assert stops(simulation, 2.0)
    assert vehicle.reason == reason
    assert drives(simulation)


@needs_ros
def test_a_stamp_of_zero_is_none(alone):
    assert drives(alone()[0], stamp=0)


@needs_ros
def test_a_pose_that_is_sent_again_and_again_ages(alone):
    simulation, vehicle = alone()
    assert drives(simulation)
    stamp = simulation.node.get_clock().now().nanoseconds
    assert published_until(simulation, lambda: vehicle.reason != "", stamp=stamp)


@needs_ros
def test_it_stops_as_the_node_is_closed(alone):
    simulation, vehicle = alone()
    assert drives(simulation)
    simulation.ros.nodes.clear()
    vehicle.close()
    assert stops(simulation, 2.0)


@needs_ros
def test_a_policy_that_diverges_stops_the_vehicle(alone, monkeypatch):
    simulation, vehicle = alone()
    assert drives(simulation)
    monkeypatch.setattr(vehicle.controller.policy, "predict", lambda *_, **__: (np.array([math.nan, 0.0]), None))
    assert published_until(simulation, lambda: sends(simulation, 0.0, 0.0))
    assert vehicle.reason == "the policy's action is not finite: [nan, 0.0]"


@needs_ros
def test_parameters_are_read_from_ros_and_all_of_them_are_declared(alone):
    _, vehicle = alone("-p", "rate:=20", "-p", "timeout:=0.1")
    assert (vehicle.settings.rate, vehicle.settings.timeout, vehicle.controller.scenario.time_step) == (20.0, 0.1, 0.05)
    declared = {name: vehicle.node.get_parameter(name).value for name in Ros2Settings.model_fields}
    assert declared == vehicle.settings.model_dump()


@needs_ros
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-p", "timout:=1"], "timout is not a parameter of Ros2Settings; did you mean timeout?"),
        (["-p", "rate:=often"], "rate = 'often': input should be a valid number"),
        (["-p", "n_vehicles:=1"], "vehicle = 1: input should be from 0 to n_vehicles - 1 = 0"),
        (["-p", "n_vehicles:=0"], "n_vehicles = 0"),
        (["-p", "waypoint_topic:=a b"], "Invalid topic name"),
        (["-p", "rate"], "Couldn't parse parameter override rule: '-p rate'"),
    ],
)
def test_a_wrong_argument_is_one_line(arguments, message, loopback):
    with pytest.raises(SettingsError, match=re.escape(message)) as caught:
        drive(Straight(), Scenario(), 1, arguments)
    assert "\n" not in str(caught.value)


@needs_ros
def test_the_command_stops_the_vehicle_when_it_is_terminated(ros):
    policy = load_policy("ddpg")
    world = World(policy.scenario.replace(n_vehicles=1, n_obstacles=0))
    world.reset([episode_rng(0, 0)])
    simulation = Simulation(ros(), world)
    with Processes(["ddpg"], 1, "-p", "n_vehicles:=1", "-p", "n_obstacles:=0") as nodes:
        assert simulation.wait_for(1)
        assert published_until(simulation, lambda: simulation.commands[0] and simulation.commands[0][-1][1] > 0)
        (output,) = nodes.terminate()
        assert simulation.ros.spin_until(lambda: simulation.commands[0][-1][1:] == (0.0, 0.0), 5.0)
    assert " decisions, median " in output


class Processes:
    """The command in processes of their own, one for each vehicle."""

    def __init__(self, words, count, *arguments):
        command = [sys.executable, "-m", "sb3_flock.cli", "ros2", *words]
        self.nodes = [
            subprocess.Popen(
                [*command, "--vehicle", str(number), "--ros-args", *arguments], stderr=subprocess.PIPE, text=True
            )
            for number in range(count)
        ]

    def __enter__(self):
        return self

    def terminate(self):
        """End all of them; returns what each printed."""
        for node in self.nodes:
            node.send_signal(signal.SIGTERM)
        outputs = [node.communicate(timeout=PATIENCE)[1] for node in self.nodes]
        assert [node.returncode for node in self.nodes] == [0] * len(self.nodes), outputs
        return outputs

    def __exit__(self, *_):
        for node in self.nodes:
            node.kill()
            node.wait()
            node.stderr.close()


@needs_ros
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("seconds", [60, pytest.param(600, marks=pytest.mark.slow)])
def test_five_processes_at_10_hz_decide_as_a_rollout(seconds, ros, capsys):
    policy = load_policy("flock")
    scenario = policy.scenario.replace(safety_filter="announce", max_cycles=10 * seconds)
    simulation = Simulation(ros(), World(scenario))
    settings = ("--set", "safety_filter=announce")
    lockstep = ("-p", "lockstep:=true", "-p", "timeout:=60", "-p", "announcement_wait:=1")
    with Processes(["flock", *settings], 5, *lockstep) as nodes:
        assert simulation.wait_for(5, 2 * PATIENCE)
        start = time.monotonic()
        difference = largest_difference(simulation, policy, 10 * seconds, scenario.time_step)
        took = time.monotonic() - start
        outputs = nodes.terminate()
    summaries = [output.splitlines()[-1] for output in outputs]
    with capsys.disabled():
        load = os.getloadavg()[0] / (os.cpu_count() or 1)
        print(f"\n{seconds} s took {took:.1f} s, commands differ by {difference:.1g} of the range, load {load:.1f} a core")
        print(*summaries, sep="\n")
    assert difference < 1e-5
    for summary in summaries:
        assert summary.startswith(f"{10 * seconds} decisions")
        assert summary.endswith("; 0 missed cycles")


def test_the_defaults_are_those_of_the_task():
    assert defaults_for(Scenario(n_vehicles=5, n_obstacles=2)) == {"n_vehicles": 5, "n_obstacles": 2, "rate": 10.0}


def test_the_rate_and_the_numbers_of_bodies_change_the_task():
    trained = Scenario(n_obstacles=2, obstacle_starts=((0.0, 0.0), (0.5, 0.0)))
    task = scenario_of(Ros2Settings(rate=20.0, n_vehicles=7, n_obstacles=1), trained)
    assert (task.time_step, task.n_vehicles, task.n_obstacles, task.obstacle_starts) == (0.05, 7, 1, None)
    assert scenario_of(Ros2Settings(rate=1 / trained.time_step, n_vehicles=3, n_obstacles=2), trained) == trained


def test_a_rate_at_which_the_filter_cannot_hold_is_refused():
    with pytest.raises(SettingsError, match=r"link_range = 0.15: safety_filter needs more than"):
        scenario_of(Ros2Settings(rate=2.0), Scenario(safety_filter="heading"))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"vehicle_topic": "/odom"}, "vehicle_topic = '/odom': {i} is needed, the number of one of 3 bodies"),
        ({"announcement_topic": "/a", "n_vehicles": 2}, "announcement_topic = '/a': {i} is needed"),
        ({"obstacle_topic": "/o", "n_obstacles": 2}, "obstacle_topic = '/o': {j} is needed"),
        ({"announcement_wait": 0.1}, "announcement_wait = 0.1: input should be less than 1 / rate"),
        ({"vehicle_message": "Odom"}, "vehicle_message = 'Odom': input should be 'nav_msgs/Odometry' or"),
        ({"timeout": 0}, "timeout = 0: input should be greater than"),
    ],
)
def test_parameters_that_are_not_accepted_are_one_line(settings, message):
    with pytest.raises(SettingsError, match=re.escape(message)):
        Ros2Settings(**settings)


def test_one_vehicle_and_one_obstacle_need_no_number():
    assert Ros2Settings(n_vehicles=1, vehicle_topic="/odom", announcement_topic="/a", obstacle_topic="/o").n_vehicles == 1
    assert Ros2Settings(lockstep=True, announcement_wait=5.0).announcement_wait == 5.0


def test_without_rclpy_there_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    monkeypatch.setitem(sys.modules, "nav_msgs", None)
    with pytest.raises(SettingsError, match="is missing: it comes with ROS 2; source its setup.bash first"):
        drive(Straight(), Scenario(), 0)
