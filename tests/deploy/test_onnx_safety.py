"""The safety filter in ONNX acts as the world's, and no vehicle violates a separation; ``-m slow`` takes 10^7 steps."""

import json
from collections import deque
from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch as th

from sb3_flock import load_policy
from sb3_flock.deploy.onnx_check import random_sample_inputs
from sb3_flock.deploy.onnx_export import (
    INPUTS,
    PREVIOUS_INPUTS,
    TOLERANCE,
    FilteredOnnxPolicy,
    export,
    graph_of,
    inputs_of,
    outputs_of,
)
from sb3_flock.deploy.onnx_safety import OnnxSafetyFilter, filter_shapes
from sb3_flock.evaluation.rollout import as_controller
from sb3_flock.serialization.load import PolicyError
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, World, episode_rng
from sb3_flock.sim.safety import filter_actions
from tests.sim.test_safety import DRIVERS, FILTERS, pack, random_task

pytestmark = pytest.mark.filterwarnings("ignore:.*trained with shared_detections")

KNOWN = {"motion": [], "announce": ["neighbor_headings", "neighbor_announced_speeds"]}
"""Inputs of a policy's graph that are there for the filter alone."""


def session_of(model):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model if isinstance(model, str) else model.SerializeToString(), options)


def filter_graph(scenario, *leading):
    """A session of the filter alone."""
    shapes = {name: (*leading, *shape) for name, shape in filter_shapes(scenario).items()}
    return session_of(graph_of(OnnxSafetyFilter(scenario), shapes, outputs_of(scenario)))


class OnnxFilter:
    """The filter of a scenario as a graph for all vehicles of a world, each with what it measures in rows of its own."""

    def __init__(self, scenario):
        self.scenario, self.lost = scenario, 0.0
        self.session = filter_graph(scenario, "vehicles")
        self.rng = np.random.default_rng(0)

    def __call__(self, world, asked, before):
        """The filtered actions; ``before`` are the positions ``motion_lag`` ago."""
        sensing = world.sense()
        inputs = {"asked_action": asked.reshape(-1, 2)}
        padded = self._padded(sensing.neighbors)
        inputs["neighbors"] = padded(sensing.neighbors.positions, 2 * self.scenario.link_range)
        inputs["obstacles"] = self._padded(sensing.obstacles)(sensing.obstacles.positions, 9.0)
        i, j = sensing.neighbors.observers, sensing.neighbors.vehicles
        if self.scenario.safety_filter == "motion":
            then, now = before.reshape(-1, 2), world.positions.reshape(-1, 2)
            (x, y), (cos, sin) = (now - then)[j].T, world.frames.reshape(-1, 2)[i].T
            motions = np.stack((cos * x + sin * y, cos * y - sin * x), axis=-1)
            motions[np.linalg.norm(then[j] - then[i], axis=-1) >= self.scenario.link_range] = np.nan
            inputs["neighbor_motions"] = padded(motions, 0.0)
        headings = world.headings.ravel()
        inputs["neighbor_headings"] = padded(self._received(headings[j] - headings[i]), 0.0)
        inputs["neighbor_announced_speeds"] = np.zeros_like(inputs["neighbor_headings"])
        inputs = {part.name: inputs[part.name] for part in self.session.get_inputs()}
        if self.scenario.safety_filter == "announce":
            (announced,) = self.session.run(["announced_speed"], inputs)
            inputs["neighbor_announced_speeds"] = padded(self._received(announced[j]), 0.0)
        return self.session.run(["action"], inputs)[0].reshape(asked.shape)

    @staticmethod
    def _padded(contacts):
        counts = contacts.count().ravel()
        column = np.arange(len(contacts.observers)) - (np.cumsum(counts) - counts)[contacts.observers]

        def padded(values, filling):
            rows = np.full((len(counts), counts.max(initial=0), *values.shape[1:]), filling)
            rows[contacts.observers, column] = values
            return rows

        return padded

    def _received(self, values):
        return np.where(self.rng.random(values.shape) < self.lost, np.nan, values)

    def check(self, world, executed, expected):
        """Compare executed actions with those of ``filter_actions``."""
        np.testing.assert_array_equal(executed[..., 1], expected[..., 1])
        strides = (executed[..., 0] - expected[..., 0])[has_clear_signs(world)] * self.scenario.time_step
        assert np.abs(strides).max(initial=0) < 1e-9 * self.scenario.neighbor_separation


def has_clear_signs(world):
    """The flocks in which it does not depend on rounding whether a neighbor approaches or recedes, ``(flocks,)``."""
    contacts = world.sense().neighbors
    turned = world.headings.ravel()[contacts.vehicles] - world.headings.ravel()[contacts.observers]
    along = (np.stack((np.cos(turned), np.sin(turned)), axis=-1) * contacts.positions).sum(-1)
    unclear = np.abs(along) < 1e-12 * contacts.distances
    return np.bincount(contacts.observers // contacts.shape[1], unclear, minlength=contacts.shape[0]) == 0


def simulate(exported_filter, driver, n_flocks, seed, is_packed):
    """Simulate a driver behind an exported filter; no violation may occur. The number of simulated vehicle-steps."""
    scenario, rng = exported_filter.scenario, np.random.default_rng(seed)
    world = World(scenario.replace(safety_filter="off", obstacle_filter=False), n_flocks)
    sensing = world.reset([episode_rng(seed, episode) for episode in range(n_flocks)])
    if is_packed:
        pack(world, rng)
        sensing = world.sense()
    positions = deque(maxlen=1 + scenario.motion_lag_steps)
    for _ in range(scenario.max_cycles):
        measured = world.sensors.measure(sensing)
        positions.append(world.positions)
        asked = driver(world, rng)
        executed = exported_filter(world, asked, positions[0])
        if not exported_filter.lost:
            asked = np.clip(asked, world.action_low, world.action_high)
            expected = filter_actions(asked, measured, scenario, world.frames)
            exported_filter.check(world, executed, expected)
        sensing, _ = world.step(executed)
        assert sensing.neighbors.count(scenario.neighbor_separation).sum() == 0
    return n_flocks * scenario.n_vehicles * scenario.max_cycles


@pytest.mark.parametrize("safety_filter", FILTERS)
def test_the_graph_filters_as_the_world_does_and_no_pair_violates_its_separation(safety_filter):
    onnx_filter = OnnxFilter(random_task(np.random.default_rng(3), 20, safety_filter))  # of centimeters
    for seed, driver in enumerate(DRIVERS * 2):
        simulate(onnx_filter, driver, 20, seed, is_packed=seed < len(DRIVERS))
    onnx_filter.lost = 0.3  # of the headings and of the announcements
    for seed, driver in enumerate(DRIVERS):
        simulate(onnx_filter, driver, 20, seed, is_packed=True)


def test_obstacles_and_the_margin_are_in_the_graph():
    scenario = Scenario(
        n_vehicles=8,
        n_obstacles=6,
        safety_filter="announce",
        obstacle_filter=True,
        safety_margin=0.01,
        obstacle_max_speed=0.05,
    )
    onnx_filter = OnnxFilter(scenario)
    for seed, driver in enumerate(DRIVERS):
        simulate(onnx_filter, driver, 10, seed, is_packed=False)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_ten_million_vehicle_steps_behind_the_graph_without_a_violation():
    rng, simulated = np.random.default_rng(0), 0
    while simulated < 10_000_000:
        n_vehicles = int(rng.integers(2, 1 + 200 ** rng.uniform(0.2, 1)))
        onnx_filter = OnnxFilter(random_task(rng, n_vehicles, str(rng.choice(FILTERS))))
        for driver in DRIVERS:
            seed, is_packed = int(rng.integers(2**31)), bool(rng.random() < 0.5)
            simulated += simulate(onnx_filter, driver, max(1, 1000 // n_vehicles), seed, is_packed)


# -- one vehicle ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def announcing():
    """The graph of one vehicle for ``announce`` and obstacles, as a function of what differs from a neighbor ahead."""
    session = filter_graph(Scenario(safety_filter="announce", obstacle_filter=True))

    def run(neighbors=((0.11, 0.0),), headings=(0.0,), announced=(0.1,), asked=(0.15, 1.0), obstacles=()):
        return session.run(
            None,
            {
                "asked_action": np.array(asked),
                "neighbors": np.reshape(neighbors, (-1, 2)).astype(float),
                "neighbor_headings": np.array(headings, dtype=float),
                "neighbor_announced_speeds": np.array(announced, dtype=float),
                "obstacles": np.reshape(obstacles, (-1, 2)).astype(float),
            },
        )

    return run


ROUNDING = 3e-9
"""What twice 1e-9 of the larger separation (0.15 m) in each step of 0.1 s costs [m/s]."""


def test_a_follower_uses_what_the_vehicle_ahead_announces(announcing):
    action, announced = announcing(announced=[0.04])
    np.testing.assert_allclose(action, [0.14 - ROUNDING, 1.0], rtol=1e-12)
    np.testing.assert_allclose(announced, 0.1 - ROUNDING, rtol=1e-12)


@pytest.mark.parametrize(
    ("headings", "announced", "speed"),
    [
        ([0.0], [0.0], 0.1),  # as `heading`
        ([0.0], [np.nan], 0.1),
        ([0.0], [-1.0], 0.1),
        ([np.nan], [0.1], 0.05),  # as `voronoi`
        ([np.pi], [0.1], 0.05),
        ([0.0], [99.0], 0.15),
        ([0.0], [np.inf], 0.15),
    ],
)
def test_what_is_not_received_or_senseless_is_not_used(announcing, headings, announced, speed):
    action, _ = announcing(headings=headings, announced=announced)
    np.testing.assert_allclose(action, [speed, 1.0], rtol=1e-6)


def test_what_a_vehicle_announces_does_not_depend_on_what_it_receives(announcing):
    assert announcing(announced=[0.0])[1] == announcing(announced=[0.1])[1]


def test_bodies_out_of_range_and_no_bodies_bound_nothing(announcing):
    for neighbors, headings in ((), ()), (((0.15, 0.0), (9.0, 9.0)), (np.pi, 0.0)):
        action, announced = announcing(neighbors, headings, np.zeros(len(headings)), obstacles=[(0.25, 0.0)])
        np.testing.assert_array_equal([*action, announced], [0.15, 1.0, 0.15])


def test_a_neighbor_at_the_same_place_stops_the_vehicle(announcing):
    action, announced = announcing(neighbors=[(0.0, 0.0)])
    np.testing.assert_array_equal([*action, announced], [0.0, 1.0, 0.0])


def test_actions_are_clipped(announcing):
    np.testing.assert_array_equal(announcing((), (), (), asked=(9.0, -9.0))[0], [0.15, -np.pi])
    np.testing.assert_array_equal(announcing((), (), (), asked=(-9.0, 9.0))[0], [0.0, np.pi])


def test_an_obstacle_ahead_is_bounded_by_its_own_stride(announcing):
    action, announced = announcing((), (), (), obstacles=[(0.165, 0.0)])
    np.testing.assert_allclose([action[0], announced], 0.05 - ROUNDING, rtol=1e-12)


def test_numbers_near_0_and_1_stay_in_the_graph():
    """Optimizers of graphs drop small summands, and factors near 1."""
    scenario = Scenario(safety_filter="voronoi", time_step=1.000001, max_speed=0.015, safety_margin=1e-9)
    action = filter_graph(scenario).run(None, {"asked_action": np.array([0.01, 0.0]), "neighbors": np.array([[0.11, 0.0]])})[
        0
    ]
    budget = (0.11 - 0.1 - 1e-9) / 2 - 2e-9 * (0.15 + 1e-9)
    assert action[0] == pytest.approx(budget / 1.000001, rel=1e-12)


# -- whole policies ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def policy():
    return load_policy("flock")


@pytest.fixture(scope="module", params=["motion", "announce"])
def exported(request, policy, tmp_path_factory):
    """A policy exported with a filter, for vehicles that know of the obstacles that they detect themselves."""
    scenario = policy.scenario.replace(
        safety_filter=request.param, obstacle_filter=True, safety_margin=0.01, shared_detections=False
    )
    path = tmp_path_factory.mktemp("onnx") / "policy.onnx"
    if request.param == "motion":
        return scenario, export(policy, path, n_samples=100, scenario=scenario)
    trained_with_it = replace(policy, config=policy.config.replace(scenario=scenario))
    return scenario, export(trained_with_it, path, n_samples=100)


def test_the_graph_of_a_policy_acts_as_policy_and_filter_do(exported):
    scenario, result = exported
    assert result.difference < TOLERANCE
    session = session_of(str(result.path))
    assert [part.name for part in session.get_inputs()] == [*INPUTS, *PREVIOUS_INPUTS, *KNOWN[scenario.safety_filter]]
    assert {part.type for part in (*session.get_inputs(), *session.get_outputs())} == {"tensor(double)"}
    assert tuple(part.name for part in session.get_outputs()) == outputs_of(scenario)


def test_the_check_of_an_export_sees_the_filter(exported):
    """In some of the sample inputs a vehicle is slowed down."""
    scenario, result = exported
    session = session_of(str(result.path))
    slowed = 0
    for inputs, _ in random_sample_inputs(scenario, 100, seed=0):
        far = {name: values + 9.0 if name in {"neighbors", "obstacles"} else values for name, values in inputs.items()}
        slowed += session.run(["action"], inputs)[0][0] < 0.5 * session.run(["action"], far)[0][0]
    assert slowed > 3


def test_the_file_says_how_to_use_the_filter(exported):
    scenario, result = exported
    model = onnx.load(result.path)
    assert "safety filter" in model.doc_string
    metadata = json.loads(model.metadata_props[0].value)
    for name in ("safety_filter", "obstacle_filter", "safety_margin", "obstacle_max_speed"):
        assert metadata[name] == getattr(scenario, name)
    for name in KNOWN[scenario.safety_filter]:
        assert name in metadata["inputs"]
    assert ("announced_speed" in metadata["output"]) == (scenario.safety_filter == "announce")


class TopSpeed(th.nn.Module):
    """An actor that asks for the top speed."""

    def forward(self, observations):
        return th.tensor([[1.0, 0.0]], dtype=th.float64)


@pytest.mark.parametrize(
    ("before", "speed"),
    [
        ((0.082, 0.0), 0.02),  # it heads away: the vehicle may use the whole gap of 2 mm
        ((0.102, 0.0), 0.01),
        ((0.102, 0.02), 0.01),
        ((-9.0, 0.0), 0.01),  # not sensed then
        ((np.nan, np.nan), 0.01),
    ],
)
def test_the_motion_of_a_neighbor_is_that_of_its_row(policy, before, speed):
    module = FilteredOnnxPolicy(policy.policy, policy.scenario.replace(safety_filter="motion"))
    module.actor = TopSpeed()
    nobody, waypoint = th.zeros((0, 2), dtype=th.float64), th.zeros(2, dtype=th.float64)
    neighbors, previous = (th.tensor([[9.0, 9.0], position], dtype=th.float64) for position in ((0.102, 0.0), before))
    ego_motion = th.zeros(3, dtype=th.float64)
    action = module(neighbors, nobody, waypoint, previous, nobody, waypoint, ego_motion)
    assert action[0].item() == pytest.approx(speed, rel=1e-5)


def test_a_policy_with_actuators_and_a_tracker_keeps_its_way_to_stop(policy, tmp_path):
    actuators = {"speed_lag": 0.1, "max_acceleration": 0.3}
    scenario = policy.scenario.replace(actuators=actuators, tracker={"enabled": True}, obstacle_filter=True)
    done = export(policy, tmp_path / "policy.onnx", 150, scenario=scenario)
    assert done.difference < TOLERANCE
    metadata = json.loads(onnx.load(done.path).metadata_props[0].value)
    assert metadata["max_acceleration"] == 0.3
    assert "own_speed ()" in metadata["inputs"]


def test_the_graph_keeps_the_way_to_stop_and_the_uncertainty_of_estimates():
    """The ways to stop, :func:`~sb3_flock.sim.safety.reserve_stopping`, fit the gap of 0.02 m to a neighbor that stands."""
    actuators = {"speed_lag": 0.1, "max_acceleration": 0.3}
    session = filter_graph(Scenario(safety_filter="announce", actuators=actuators, tracker={"enabled": True}))

    def run(own_speed=0.0, std=0.0, announced=0.0):
        values = [(0.15, 0.0), [(0.12, 0.0)], [0.0], [announced], [std], own_speed]
        names = [part.name for part in session.get_inputs()]
        action, announces = session.run(None, {n: np.array(v, dtype=float) for n, v in zip(names, values, strict=True)})
        return action[0], float(announces)

    v = 0.06
    bounds = (0.02 - 0.1 * v - v * v / 0.6) / 0.1, (0.02 - 0.1 * v + v * v / 0.6) / (0.1 + v / 0.3)
    assert run(own_speed=v) == (pytest.approx(min(bounds), abs=1e-7), v)
    assert run(own_speed=0.09) == (0.0, 0.0)  # the way to stop alone is longer than the gap
    assert run(own_speed=np.nan) == run(own_speed=0.15)  # the worst is assumed
    assert run(own_speed=0.0) == (0.15, 0.0)  # it has no speed yet to announce
    assert run(std=0.0075)[0] == pytest.approx(0.05, abs=1e-7)
    assert run(std=0.0075, announced=0.04)[0] == pytest.approx(0.09, abs=1e-7)
    assert run(std=np.nan)[0] == 0.0


def in_frame(position, heading, points):
    """Positions in the frame of a vehicle."""
    cos, sin = np.cos(heading), np.sin(heading)
    return (points - position) @ np.array([[cos, -sin], [sin, cos]])


def test_a_flock_of_onboard_computers_flies_as_the_world_does(exported, policy):
    scenario, result = exported
    fly_as_the_world_does(session_of(str(result.path)), scenario, policy)


def fly_as_the_world_does(session, scenario, policy, tolerance=1e-4):
    """Each vehicle runs the file with what it measures and receives, as a control engineer would write it."""
    task = scenario.replace(n_vehicles=4, n_obstacles=1, arena=0.3, max_cycles=60)
    world, other = World(task), World(task.replace(safety_filter="off", obstacle_filter=False))
    controller = as_controller(policy, task)
    sensing, _ = (each.reset([episode_rng(4, 0)]) for each in (world, other))
    controller.reset([episode_rng(4, 0)], task)
    history, slowed = deque(maxlen=1 + task.motion_lag_steps), 0
    for _ in range(task.max_cycles):
        history.append((other.positions[0], other.headings[0], other.obstacle_positions[0], other.waypoints[0]))
        all_inputs = []
        for i in range(task.n_vehicles):
            others = np.arange(task.n_vehicles) != i
            measured = [
                {
                    "neighbors": in_frame(positions[i], headings[i], positions[others]),
                    "obstacles": in_frame(positions[i], headings[i], obstacles),
                    "waypoint": in_frame(positions[i], headings[i], waypoint),
                }
                for positions, headings, obstacles, waypoint in (history[-1], history[0])
            ]
            (positions, headings, *_), (then, headings_then, *_) = history[-1], history[0]
            inputs = {
                **measured[0],
                **{f"previous_{name}": values for name, values in measured[1].items()},
                "ego_motion": np.append(in_frame(then[i], headings_then[i], positions[i]), headings[i] - headings_then[i]),
                "neighbor_headings": headings[others] - headings[i],
                "neighbor_announced_speeds": np.zeros(task.n_vehicles - 1),
            }
            all_inputs.append({name: inputs[name] for name in inputs_of(task)})
        if task.safety_filter == "announce":
            announced = np.array([session.run(["announced_speed"], inputs)[0] for inputs in all_inputs])
            for i, inputs in enumerate(all_inputs):
                inputs["neighbor_announced_speeds"] = np.delete(announced, i)
        actions = np.array([[session.run(["action"], inputs)[0] for inputs in all_inputs]])
        asked = controller.act(world.sensors.measure(sensing), task)
        sensing, executed = world.step(asked)
        truth, _ = other.step(actions)
        slowed += (executed[..., 0] < asked[..., 0] - 0.01).sum()
        np.testing.assert_allclose(other.positions, world.positions, atol=tolerance)
        assert truth.neighbors.count(task.neighbor_separation).sum() == 0
    assert slowed > 5


def test_the_bounds_of_another_scenario_are_kept(tmp_path):
    policy = load_policy("ddpg")
    with pytest.warns(UserWarning, match="max_speed = 0.15, evaluated with 0.05"):
        done = export(policy, tmp_path / "slow.onnx", 20, scenario=policy.scenario.replace(max_speed=0.05))
    assert done.difference < TOLERANCE


def test_mistakes_are_one_line(policy, tmp_path):
    path = tmp_path / "policy.onnx"
    with pytest.raises(SettingsError, match="safety_filter = motion: motion_lag > 0 is needed"):
        export(load_policy("ddpg"), path, scenario=load_policy("ddpg").scenario.replace(safety_filter="motion"))
    with pytest.raises(PolicyError, match="its observations have the shape"):
        export(policy, path, scenario=policy.scenario.replace(motion_lag=0.0, safety_filter="voronoi"))
    assert not path.exists()
