"""The check of an exported file: random sample inputs, and its comparison with the policy and the world's filter."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_flock.deploy.onnx_safety import filter_shapes
from sb3_flock.sim import Scenario, Sensing, World, episode_rng, observe
from sb3_flock.sim.safety import filter_actions
from sb3_flock.sim.sensing import find_contacts
from sb3_flock.sim.sensors import SensorErrors
from sb3_flock.sim.tracker import TrackerSettings
from sb3_flock.sim.unicycle import Unicycle

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from sb3_flock.serialization.load import LoadedPolicy
    from sb3_flock.sim.dynamics import Stopping

SampleInput = dict[str, "NDArray[np.float64]"]
"""The inputs of the graph by name."""


@dataclass(frozen=True)
class _Sample:
    """A random state of a flock, as its first vehicle measures it and as the world has it."""

    inputs: SampleInput
    sensing: Sensing
    frames: NDArray[np.float64]
    asked: NDArray[np.float64]
    """What the vehicles ask for, ``(1, vehicles, 2)``."""
    stopping: Stopping | None
    """What they need in order to stop."""


def compare(
    session: Any, policy: LoadedPolicy, scenario: Scenario, n_samples: int, seed: int, reserve: float = 0.0
) -> tuple[float, float]:
    """Largest difference of a graph to ``predict``, as a share of the action's range, and median time of a decision [s].

    With a filter the difference is that to the filtered action, and to the speed to announce.

    :param session: an ``onnxruntime.InferenceSession`` of the graph, or what has its ``run``
    :param reserve: a filter may be as slow as with a ``safety_margin`` that is larger by this [m]
    """
    wider = scenario.model_copy(update={"safety_margin": scenario.safety_margin + reserve})
    space: Any = policy.policy.action_space
    outputs, times, differences = [], [], []
    widths = (space.high - space.low)[[0, 1, 0]]  # of speed, turn rate and announced speed
    samples = list(_random_samples(scenario, n_samples, seed))
    for sample in samples:
        start = time.perf_counter()
        outputs.append(decide(session, sample.inputs))
        times.append(time.perf_counter() - start)
    for sample, (action, *announced) in zip(samples, outputs, strict=True):
        asked = policy.predict(observe(sample.sensing, scenario)[0, 0], deterministic=True)[0]
        highest, lowest = (_executed(sample, asked, task)[: len(announced) + 2] for task in (scenario, wider))
        found = np.append(action, announced)
        differences += [(np.maximum(found - highest, lowest - found) / widths[: len(found)]).max()]
    return float(np.max(differences)), float(np.median(times))


def decide(session: Any, inputs: SampleInput) -> list[NDArray[np.float64]]:
    """The outputs of a graph. With ``announce`` it is run twice, as on board: first without announcements."""
    if "neighbor_announced_speeds" in inputs:
        silent = {**inputs, "neighbor_announced_speeds": np.zeros_like(inputs["neighbor_announced_speeds"])}
        (announced,) = session.run(["announced_speed"], silent)
        (action,) = session.run(["action"], inputs)
        return [action, announced]
    return session.run(None, inputs)


def random_sample_inputs(scenario: Scenario, count: int, seed: int) -> Iterator[tuple[SampleInput, NDArray[np.float32]]]:
    """What one vehicle measures at the start of random episodes of all sizes, and its observation there.

    With motion channels, ``motion_lag`` after the start, with random actions. With a filter the neighbors' headings and
    announced speeds are among the inputs where it needs them.
    """
    for sample in _random_samples(scenario, count, seed):
        yield sample.inputs, observe(sample.sensing, scenario)[0, 0]


def _random_samples(scenario: Scenario, count: int, seed: int) -> Iterator[_Sample]:
    for number in range(count):
        rng = episode_rng(seed, number)
        n_vehicles, n_obstacles = int(rng.integers(1, 13)), int(rng.integers(0, 6))
        bodies = {"n_vehicles": n_vehicles, "n_obstacles": n_obstacles, "obstacle_motion": "walk"}
        arena = max(scenario.link_range, scenario.detection_range) * rng.uniform(2, 5)
        free_space = {"arena": arena, "obstacle_arena": arena, "obstacle_starts": None}
        exact = scenario.replace(sensors=SensorErrors(), tracker=TrackerSettings())
        world = World(exact.replace(**bodies, **free_space, max_cycles=max(1, scenario.motion_lag_steps)))
        sensing = world.sensors.measure(world.reset([rng]))
        inputs = _measured_by_first_vehicle(world, sensing)
        if scenario.motion_lag:
            before = {f"previous_{name}": positions for name, positions in inputs.items()}
            (x, y), (cos, sin), heading = world.positions[0, 0], world.frames[0, 0], world.headings[0, 0]
            for _ in range(scenario.motion_lag_steps):
                actions = rng.uniform(world.action_low, world.action_high, (1, n_vehicles, 2))
                sensing = world.sensors.measure(world.step(actions)[0])
            dx, dy = world.positions[0, 0] - (x, y)
            ego_motion = np.array([cos * dx + sin * dy, cos * dy - sin * dx, world.headings[0, 0] - heading])
            inputs = {**_measured_by_first_vehicle(world, sensing), **before, "ego_motion": ego_motion}
        asked = rng.uniform(world.action_low, world.action_high, (1, n_vehicles, 2))
        if scenario.safety_filter in {"heading", "announce"}:
            inputs["neighbor_headings"] = world.headings[0, 1:] - world.headings[0, 0]
        needed, stopping = filter_shapes(scenario), None
        if "neighbor_stds" in needed:
            inputs["neighbor_stds"] = rng.uniform(0, 0.05 * scenario.link_range, n_vehicles - 1)
            found = sensing.neighbors
            stds = np.append(0.0, inputs["neighbor_stds"])[np.maximum(found.bodies, found.observers)]  # of the first vehicle
            sensing = replace(sensing, neighbors=replace(found, stds=stds))
        if "own_speed" in needed and isinstance(world.dynamics, Unicycle):
            world.dynamics.rates[..., 0] = rng.uniform(0, scenario.max_speed, (1, n_vehicles))
            stopping = world.dynamics.stopping()
            inputs["own_speed"] = np.array(world.dynamics.rates[0, 0, 0])
        sample = _Sample(inputs, sensing, world.frames, asked, stopping)
        if scenario.safety_filter == "announce":
            inputs["neighbor_announced_speeds"] = _announced(sample, asked, scenario)[1:]
        yield sample


def _executed(sample: _Sample, action: NDArray[np.float32], scenario: Scenario) -> NDArray[np.float64]:
    """What the first vehicle executes if it asks for an action, as in ``World.step``, and which speed it announces, ``(3,)``."""
    asked, low, high = sample.asked.copy(), (0.0, -scenario.max_turn_rate), (scenario.max_speed, scenario.max_turn_rate)
    asked[0, 0] = np.clip(action, low, high)
    executed = filter_actions(asked, sample.sensing, scenario, sample.frames, stopping=sample.stopping)
    return np.append(executed[0, 0], _announced(sample, asked, scenario)[0])


def _announced(sample: _Sample, asked: NDArray[np.float64], scenario: Scenario) -> NDArray[np.float64]:
    """The speeds that the vehicles announce, ``(vehicles,)``: those that ``heading`` admits, and that they have."""
    admitted = scenario if scenario.safety_filter == "off" else scenario.replace(safety_filter="heading")
    speeds = filter_actions(asked, sample.sensing, admitted, sample.frames, stopping=sample.stopping)[0, :, 0]
    return speeds if sample.stopping is None else np.minimum(speeds, sample.stopping.speeds[0])


def _measured_by_first_vehicle(world: World, sensing: Sensing) -> SampleInput:
    """Positions in the first vehicle's frame: of all bodies, in range or not; with shared detections, of known obstacles."""
    neighbors = find_contacts(world.positions, world.frames, world.positions, np.inf, exclude_self=True)
    obstacles = sensing.obstacles
    if not world.scenario.shared_detections:
        obstacles = find_contacts(world.positions, world.frames, world.obstacle_positions, np.inf)
    own = (found.positions[found.observers == 0] for found in (neighbors, obstacles))
    return {**dict(zip(("neighbors", "obstacles"), own, strict=True)), "waypoint": sensing.waypoint_positions[0, 0]}
