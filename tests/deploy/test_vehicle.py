"""One vehicle's decisions without ROS: equal to those of the world, and a stop where a pose is lost."""

import math

import numpy as np
import pytest

from sb3_flock import Scenario, load_policy
from sb3_flock.controllers.policy import PolicyController
from sb3_flock.deploy.vehicle import Measurement, VehicleController, heading_of
from sb3_flock.settings import SettingsError
from sb3_flock.sim import World, episode_rng
from sb3_flock.sim.visibility import select

TIMEOUT = 0.15
LEVELS = ["off", "voronoi", "motion", "heading", "announce"]


class Straight:
    """A policy that goes straight ahead at top speed."""

    def predict(self, observation, deterministic):
        return np.array([0.15, 0.0]), None


class Diverged:
    """A policy that has diverged."""

    def predict(self, observation, deterministic):
        return np.array([math.nan, 0.0]), None


def show(controller, world, now):
    """Give a controller all poses of a world."""
    for body, (x, y), heading in zip(controller.vehicles, world.positions[0], world.headings[0], strict=True):
        body.receive(x, y, heading, now)
    for body, (x, y) in zip(controller.obstacles, world.obstacle_positions[0], strict=True):
        body.receive(x, y, 0.0, now)
    controller.waypoint.receive(*world.waypoints[0], 0.0, now)


def differences(policy, scenario, steps, episode=0):
    """By how much the commands of all vehicles differ from the world's actions in each step of an episode."""
    world = World(scenario)
    sensing = world.reset([episode_rng(0, episode)])
    flock = [VehicleController(policy, scenario, number, TIMEOUT) for number in range(scenario.n_vehicles)]
    for step in range(steps):
        for controller in flock:
            show(controller, world, step * scenario.time_step)
            assert controller.reason_to_stop(step * scenario.time_step) == ""
        announced = {number: controller.ask() for number, controller in enumerate(flock)}
        commands = np.array([controller.act(announced) for controller in flock])
        expected = PolicyController(policy).act(world.sensors.measure(sensing), scenario)
        sensing, executed = world.step(expected)
        yield np.abs(commands - executed[0]).max()


def placed(*positions, policy=None, **settings):
    """The controller of vehicle 0, among vehicles at positions, an obstacle far away and a waypoint, at time 0."""
    scenario = Scenario(n_vehicles=len(positions), n_obstacles=1, **settings)
    controller = VehicleController(policy or Straight(), scenario, 0, TIMEOUT)
    for body, (x, y) in zip(controller.vehicles, positions, strict=True):
        body.receive(x, y, 0.0, 0.0)
    controller.obstacles[0].receive(9.0, 9.0, 0.0, 0.0)
    controller.waypoint.receive(0.0, 0.0, 0.0, 0.0)
    return controller


def refresh(controller, now):
    """The vehicle's own pose and the waypoint are received again."""
    for body in (controller.own, controller.waypoint):
        body.receive(body.x, body.y, body.heading, now)


ROUNDING = 5e-5
"""In float32 a network's turn rate [rad/s] for one vehicle differs so much from the same in a batch."""


@pytest.mark.parametrize(("name", "level"), [*(("flock", level) for level in LEVELS), ("ddpg", "announce")])
def test_commands_are_those_of_the_world(name, level):
    policy = load_policy(name)
    scenario = policy.scenario.replace(safety_filter=level, arena=0.4)
    assert max(differences(policy, scenario, 60)) < ROUNDING


def test_commands_are_those_of_the_world_with_shared_detections_and_a_filter_of_obstacles():
    policy = load_policy("ddpg")
    scenario = policy.scenario.replace(
        safety_filter="announce", obstacle_filter=True, shared_detections=True, arena=0.5, n_vehicles=7, n_obstacles=4
    )
    assert max(differences(policy, scenario, 60)) < ROUNDING


def test_commands_are_those_of_the_world_without_shared_detections():
    policy = load_policy("flock")
    with pytest.warns(UserWarning, match="shared_detections"):
        assert max(differences(policy, policy.scenario.replace(shared_detections=False, arena=0.5), 60)) < ROUNDING


def test_simulated_sensor_errors_are_not_added_to_poses():
    controller = placed((0, 0), sensors={"position_noise": 0.5, "delay": 1.0})
    assert controller.ask() == controller.ask()


@pytest.mark.parametrize("which", ["own", "waypoint"])
def test_it_stops_when_its_own_pose_or_the_waypoint_is_lost(which):
    controller = placed((0, 0), (5, 0))
    assert controller.reason_to_stop(TIMEOUT) == ""
    for body in (controller.own, controller.waypoint):
        if body is not getattr(controller, which):
            body.receive(body.x, body.y, 0.0, 0.1)
    name = "vehicle 0" if which == "own" else "the waypoint"
    assert controller.reason_to_stop(TIMEOUT + 0.01) == f"{name}: no pose for 0.15 s"


def test_it_stops_when_a_lost_neighbor_may_be_in_range():
    controller = placed((0, 0), (0.3, 0))  # link_range 0.15, max_speed 0.15: in range after 1 s at the earliest
    for now, expected in [(0.5, ""), (0.99, ""), (1.01, "vehicle 1: no pose for 0.15 s")]:
        refresh(controller, now)
        assert controller.reason_to_stop(now) == expected


def test_it_stops_when_a_lost_obstacle_may_be_in_range():
    controller = placed((0, 0))
    controller.obstacles[0].receive(0.35, 0.0, 0.0, 0.0)  # detection_range 0.25, obstacle_max_speed 0.1
    for now, expected in [(0.99, ""), (1.01, "obstacle 0: no pose for 0.15 s")]:
        refresh(controller, now)
        assert controller.reason_to_stop(now) == expected


def test_an_obstacle_that_stands_still_may_be_lost_while_it_is_out_of_range():
    controller = placed((0, 0), obstacle_max_speed=0.0)
    refresh(controller, 1000.0)
    assert controller.reason_to_stop(1000.0) == ""


def test_it_stops_until_every_body_was_received_once():
    controller = VehicleController(Straight(), Scenario(n_vehicles=2, n_obstacles=1), 0, TIMEOUT)
    reasons = []
    for body in controller.bodies:
        reasons.append(controller.reason_to_stop(0.0))
        body.receive(float(len(reasons)), 0.0, 0.0, 0.0)
    assert sorted(reasons) == sorted(["vehicle 0: no pose received", *["the waypoint: no pose received"] * 3])
    assert controller.reason_to_stop(0.0) == ""


@pytest.mark.parametrize("body", ["vehicle 0", "vehicle 1", "obstacle 0", "the waypoint"])
@pytest.mark.parametrize("bad", [(math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, math.nan)])
def test_it_stops_for_a_pose_that_is_not_finite_until_there_is_a_finite_one(body, bad):
    controller = placed((0, 0), (5, 0))
    (found,) = (each for each in controller.bodies if each.name == body)
    before = found.x, found.y, found.heading
    found.receive(*bad, 0.05)
    assert controller.reason_to_stop(0.05) == f"{body}: its pose is not finite"
    found.receive(*before, 0.1)
    assert controller.reason_to_stop(0.1) == ""


def test_a_pose_with_a_fault_stops_the_vehicle():
    controller = placed((0, 0))
    controller.waypoint.receive(0.0, 0.0, 0.0, 0.0, fault="its frame is wrong")
    assert controller.reason_to_stop(0.0) == "the waypoint: its frame is wrong"


def test_it_stops_when_the_clock_goes_back():
    controller = placed((0, 0))
    assert "no pose for" in controller.reason_to_stop(-1.0)


def test_the_next_loss_is_that_of_the_oldest_pose_that_is_not_lost():
    controller = placed((0, 0), (5, 0))
    refresh(controller, 0.1)
    assert controller.next_loss(0.1) == TIMEOUT
    assert controller.next_loss(0.2) == 0.1 + TIMEOUT
    assert controller.next_loss(9.0) == math.inf


def test_a_missing_announcement_costs_speed_and_announced_speeds_are_bounded():
    def speed(announced):
        controller = placed((0, 0), (0.11, 0), safety_filter="announce")
        assert controller.ask() == pytest.approx(0.1, abs=1e-6)  # the gap of 0.01 m in a step
        assert controller.neighbors() == [1]
        return controller.act(announced)[0]

    assert speed({}) == speed({1: math.nan}) == speed({1: -1.0}) == speed(None) == pytest.approx(0.1, abs=1e-6)
    assert speed({1: 0.02}) == pytest.approx(0.12, abs=1e-6)
    assert speed({1: 99.0}) == 0.15


def test_a_command_that_is_not_finite_is_an_error():
    controller = placed((0, 0), policy=Diverged())
    with pytest.raises(ValueError, match="the policy's action is not finite"):
        controller.ask()


def test_after_a_stop_motion_channels_start_anew():
    policy = load_policy("flock")
    world = World(policy.scenario)
    world.reset([episode_rng(0, 0)])
    fresh, used = (VehicleController(policy, policy.scenario, 0, TIMEOUT) for _ in range(2))
    show(used, world, 0.0)
    used.ask()
    world.step(np.full((1, 5, 2), 0.15))
    for controller in (fresh, used):
        show(controller, world, 0.1)
    used.forget()
    assert fresh.ask() == used.ask()
    assert fresh.act() == used.act()


def test_warming_up_leaves_no_trace():
    controller = VehicleController(Straight(), Scenario(motion_lag=0.2), 1, TIMEOUT)
    controller.warm_up()
    assert "no pose received" in controller.reason_to_stop(0.0)
    assert {body.stamp for body in controller.bodies} == {-1}


@pytest.mark.parametrize("vehicle", [-1, 3])
def test_a_vehicle_that_is_not_there_is_refused(vehicle):
    with pytest.raises(SettingsError, match=f"vehicle = {vehicle}: input should be from 0 to n_vehicles - 1 = 2"):
        VehicleController(Straight(), Scenario(), vehicle, TIMEOUT)


def test_headings_of_quaternions():
    for heading in np.linspace(-3.1, 3.1, 13):
        for length in (1.0, 1e-3, 7.0):
            assert heading_of(0.0, 0.0, length * math.sin(heading / 2), length * math.cos(heading / 2)) == pytest.approx(
                heading
            )
    tilted = np.array([math.sin(0.2), 0.0, 0.0, math.cos(0.2)])  # a roll changes no heading
    assert heading_of(*tilted) == 0.0
    assert math.isnan(heading_of(0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    "actuators", [{"speed_lag": 0.1}, {"speed_lag": 0.1, "max_acceleration": 0.3, "min_speed": 0.02}, {"turn_lag": 0.3}]
)
def test_commands_with_actuators_are_those_of_the_world(actuators):
    """The filter keeps the way to stop free, by the speed that the actuators make of the commands."""
    policy = load_policy("flock")
    scenario = policy.scenario.replace(actuators=actuators, arena=0.4, obstacle_filter=True)
    assert max(differences(policy, scenario, 80)) < ROUNDING
    reserve, world = [], World(scenario.replace(safety_filter="off", obstacle_filter=False))
    world.reset([episode_rng(0, 0)])
    controller = VehicleController(Straight(), scenario, 0, TIMEOUT)
    for _ in range(5):
        show(controller, world, 0.0)
        controller.ask()
        reserve.append(controller.act()[0])
    assert reserve[-1] <= reserve[0]


def test_after_a_stop_a_vehicle_is_as_fast_as_before_at_most():
    controller = placed((0, 0), (0.14, 0), actuators={"speed_lag": 0.2}, safety_filter="announce")
    speeds = []
    for _ in range(3):
        speeds.append(controller.ask())
        controller.act({1: 0.15})
    assert speeds[0] == 0.0 < speeds[1] < speeds[2]  # it announces the speed that it has
    controller.forget()
    assert controller.ask() == pytest.approx(speeds[2], abs=0.03)


FIELD = {"position_noise": 0.01, "dropout": 0.1, "delay": 0.1, "odometry_noise": 0.02}


def measured_by(vehicle, world, measured, ego_motion):
    """What one vehicle of a world measures, as :class:`Measurement`."""
    neighbors, obstacles = (select(found, found.observers == vehicle) for found in (measured.neighbors, measured.obstacles))
    heard = world.sense().neighbors.by_observer()[vehicle].tolist()
    return Measurement(
        neighbors.positions, neighbors.bodies, obstacles.positions, measured.waypoint_positions[0, vehicle],
        ego_motion[0, vehicle], world.headings[0], {number: ego_motion[0, number] for number in heard},
    )  # fmt: skip


@pytest.mark.parametrize("tracker", [{}, {"shared_motion": True}])
@pytest.mark.parametrize("level", ["motion", "announce"])
def test_with_a_tracker_the_commands_from_one_vehicles_measurements_are_those_of_the_world(level, tracker):
    policy = load_policy("flock")
    scenario = policy.scenario.replace(
        safety_filter=level, obstacle_filter=True, arena=0.4, sensors=FIELD, tracker={"enabled": True, **tracker}
    )
    world = World(scenario)
    sensing = world.reset([episode_rng(0, 0)])
    flock = [VehicleController(policy, scenario, number, TIMEOUT) for number in range(scenario.n_vehicles)]
    limited = 0
    for _ in range(60):
        estimate = world.sensors.measure(sensing)
        detections = world.sensors.delayed()
        announced = {
            number: controller.ask(measured_by(number, world, detections, estimate.ego_motion))
            for number, controller in enumerate(flock)
        }
        commands = np.array([controller.act(announced) for controller in flock])
        asked = PolicyController(policy).act(estimate, scenario)
        sensing, executed = world.step(asked)
        limited += (executed[0, :, 0] < asked[0, :, 0] - 1e-6).sum()
        assert np.abs(commands - executed[0]).max() < ROUNDING
    assert limited > 5  # the filter had work to do


@pytest.mark.parametrize("delay", [0.0, 0.2])
def test_a_tracker_takes_late_poses_of_the_others(delay):
    """Where the others go straight on at a constant speed, poses of some time ago give what poses of now give."""
    settings = {
        "safety_filter": "announce",
        "tracker": {"enabled": True, "shared_motion": True},
        "sensors": {"delay": delay},
    }
    controller = placed((0, 0), (0.12, 0), **settings)
    for step in range(12):
        late = max(step - round(delay / 0.1), 0)
        controller.own.receive(0.012 * step, 0.0, 0.0, 0.1 * step)
        controller.vehicles[1].receive(0.12 + 0.012 * late, 0.0, 0.0, 0.1 * step)
        controller.waypoint.receive(5.0, 0.0, 0.0, 0.1 * step)
        controller.ask()
    assert controller.act({1: 0.12})[0] == pytest.approx(0.15)
    # without an announcement the gap of 0.02 m in a step is left, which admits 0.2 m/s
    assert controller.act({})[0] == pytest.approx(0.15)


def test_after_a_stop_there_are_no_tracks():
    controller = placed((0, 0), (0.12, 0), tracker={"enabled": True}, sensors={"dropout": 0.1})
    controller.ask()
    controller.vehicles[1].receive(5.0, 0.0, 0.0, 0.0)
    controller.ask()
    assert controller.neighbors() == [1]  # it may have been missed
    controller.forget()
    controller.ask()
    assert controller.neighbors() == []
