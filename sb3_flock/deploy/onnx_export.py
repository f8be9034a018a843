"""Export of a policy as one ONNX graph for a vehicle's computer: from measured positions to speed and turn rate."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import logging
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_flock.serialization.load import LoadedPolicy
from sb3_flock.serialization.save import atomic_write, versions
from sb3_flock.settings import RunError, SettingsError
from sb3_flock.sim import Scenario, Sensing, World, episode_rng, observe
from sb3_flock.sim.sensing import find_contacts
from sb3_flock.sim.sensors import SensorErrors

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

INPUTS = ("neighbors", "obstacles", "waypoint")
PREVIOUS_INPUTS = ("previous_neighbors", "previous_obstacles", "previous_waypoint", "ego_motion")
"""Further inputs of a policy with motion channels."""
TOLERANCE = 1e-5
"""Largest difference to ``predict`` that an exported policy may have, as a share of the action's range; it is float32's."""

SampleInput = dict[str, "NDArray[np.float64]"]
"""The inputs of the graph by name."""


@dataclass(frozen=True)
class ExportResult:
    """The written file, and its comparison with the policy."""

    path: Path
    n_samples: int
    difference: float
    """Largest difference to ``predict`` over the sample inputs, as a share of the action's range."""
    latency: float
    """Median time of a decision on one core [s]."""


_NOTHING = th.empty(0)
"""Placeholder of the previous measurement for a policy without motion channels."""


class OnnxPolicy(nn.Module):
    """The on-board part of a policy: the observation of section IV-A, the actor, and physical units.

    ``forward(neighbors, obstacles, waypoint)`` takes the positions of other vehicles ``(any number, 2)``, of obstacles ``(any
    number, 2)`` and of the waypoint ``(2,)``, all in the body frame [m] (forward is +x, left is +y) and float64. Bodies
    out of sensing range are ignored. The output is ``(2,)``: speed [m/s] and turn rate [rad/s].

    With motion channels the graph also takes what was measured ``motion_lag`` ago in the body frame of that time,
    ``previous_neighbors``, ``previous_obstacles`` and ``previous_waypoint``, and ``ego_motion`` ``(3,)``: the vehicle's present
    position in that frame [m, m] and its turn since [rad]. Before ``motion_lag`` has passed these are the first measurement.

    All computations are in float64: float32 is off by 1e-5 rad/s where a policy is steep, and is hardly faster.

    :param policy: a policy of DDPG, TD3 or SAC for the flock's observation
    :param scenario: the task with its sensing ranges
    :raises SettingsError: for another kind of policy
    """

    low: th.Tensor
    high: th.Tensor

    def __init__(self, policy: Any, scenario: Scenario) -> None:
        super().__init__()
        self.scenario = scenario
        actor: Any = getattr(policy, "actor", None)
        if isinstance(policy, TD3Policy):
            parts = [actor.features_extractor, actor.mu]
        elif isinstance(policy, SACPolicy):
            parts = [actor.features_extractor, actor.latent_pi, actor.mu, nn.Tanh()]
        else:
            raise SettingsError(f"export: a policy of DDPG, TD3 or SAC is needed, not {type(policy).__name__}")
        self.actor = copy.deepcopy(nn.Sequential(*parts)).double()
        self.register_buffer("low", th.tensor(policy.action_space.low, dtype=th.float64))
        self.register_buffer("high", th.tensor(policy.action_space.high, dtype=th.float64))

    def forward(
        self,
        neighbors: th.Tensor,
        obstacles: th.Tensor,
        waypoint: th.Tensor,
        previous_neighbors: th.Tensor = _NOTHING,
        previous_obstacles: th.Tensor = _NOTHING,
        previous_waypoint: th.Tensor = _NOTHING,
        ego_motion: th.Tensor | None = None,
    ) -> th.Tensor:
        """The deterministic action, ``(2,)``."""
        present = self._channels({"neighbors": neighbors, "obstacles": obstacles, "waypoint": waypoint[None]})
        if ego_motion is None:
            observation = present
        else:
            cos, sin = ego_motion[2].cos(), ego_motion[2].sin()
            frame = th.stack((th.stack((cos, -sin)), th.stack((sin, cos))))  # the present frame, in the previous one
            previous = {
                "neighbors": previous_neighbors,
                "obstacles": previous_obstacles,
                "waypoint": previous_waypoint[None],
            }
            observation = th.cat((present, present - self._channels(previous, lambda at: (at - ego_motion[:2]) @ frame)))
        action = self.actor(observation[None])[0]
        return self.low + (action + 1) / 2 * (self.high - self.low)

    def _channels(
        self, bodies: dict[str, th.Tensor], to_present: Callable[[th.Tensor], th.Tensor] = lambda positions: positions
    ) -> th.Tensor:
        """The channels ``(channels, l, l)`` of one measurement, all at once for speed: bodies carry their channel's number,
        lengths are in units of its sigma."""
        scenario, side = self.scenario, self.scenario.n_anchors
        ranges = {"neighbors": scenario.link_range, "obstacles": scenario.detection_range}
        marked, shown = [], []
        for number, (channel, radius) in enumerate(zip(scenario.channels, scenario.channel_radii, strict=True)):
            measured = bodies[channel.source]
            positions = to_present(measured)
            in_range = _norm(measured) < ranges.get(channel.source, float("inf"))
            if channel.source == "waypoint":
                positions = positions / (_norm(positions) / radius).clamp(min=1.0)[:, None]
            marked.append(nn.functional.pad(positions, (0, 1), value=float(number)))
            shown.append(in_range)
        positions, channel_of, visible = th.cat(marked)[:, :2], th.cat(marked)[:, 2].long(), th.cat(shown)
        for number, channel in enumerate(scenario.channels):
            if channel.select is not None:  # of all bodies at once: onnxruntime fails on a selection of none
                visible = visible & ((channel_of != number) | channel.select(positions))
        radii = th.tensor(scenario.channel_radii, dtype=th.float64)
        anchors = th.linspace(-1, 1, side, dtype=th.float64) * (side - 1) / (2 * scenario.anchor_width)
        sigma = scenario.anchor_width * 2 * radii / (side - 1)
        factors = th.exp(-0.5 * ((positions / sigma[channel_of, None])[:, :, None] - anchors).square())
        gaussians = (factors[:, 0, :, None] * factors[:, 1, None, :]).flatten(1)
        counts = (channel_of == th.arange(len(radii))[:, None]) & visible
        return (counts.double() @ gaussians).view(len(radii), side, side)


def _norm(vectors: th.Tensor) -> th.Tensor:
    return vectors.square().sum(-1).sqrt()


def export(policy: LoadedPolicy, path: str | Path, n_samples: int = 1000, seed: int = 0) -> ExportResult:
    """Write a policy as ONNX, and check that the graph acts as the policy does.

    The graph is that of :class:`OnnxPolicy`. Its inputs are :data:`INPUTS`, with motion channels :data:`PREVIOUS_INPUTS` as
    well; its output is ``action``. Ranges, sampling period and units are in the file's metadata under ``sb3_flock``, as JSON.

    :param path: the file, which is written whole or not at all
    :param n_samples: number of random sample inputs on which the graph is compared with ``predict``
    :param seed: seed of the sample inputs
    :raises SettingsError: if a library is not installed or there is no such folder
    :raises RunError: if it differs from ``predict`` by more than :data:`TOLERANCE`
    :raises OSError: if it cannot be written
    """
    path = Path(path)
    if not path.absolute().parent.is_dir():
        raise SettingsError(f"{path}: there is no folder {path.parent}")
    try:
        import onnx
        import onnxruntime
        import onnxscript  # noqa: F401 - torch's exporter needs it
    except ImportError as error:
        raise SettingsError(f"export needs {error.name}: pip install 'sb3_flock[onnx]'") from None
    scenario = policy.scenario
    module = OnnxPolicy(policy.policy, scenario).eval()
    inputs = inputs_of(scenario)
    any_number = {0: th.export.Dim.DYNAMIC}
    shapes = {"waypoint": (2,), "previous_waypoint": (2,), "ego_motion": (3,)}
    with _quiet_exporter(), th.no_grad():
        program = th.onnx.export(
            module,
            tuple(th.zeros(*shapes.get(name, (2 + number, 2)), dtype=th.float64) for number, name in enumerate(inputs)),
            input_names=inputs,
            output_names=["action"],
            dynamic_shapes=tuple(None if name in shapes else any_number for name in inputs),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    model.doc_string = " ".join(str(OnnxPolicy.__doc__).split(":param", maxsplit=1)[0].replace("``", "").split())
    onnx.helper.set_model_props(model, {"sb3_flock": json.dumps(_metadata(policy))})
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    difference, latency = _compare(session, policy, n_samples, seed)
    if not difference <= TOLERANCE:
        raise RunError(
            f"export {path}: the graph differs from the policy by {difference:.2g} of the range, more than {TOLERANCE:g}"
        )
    with atomic_write(path) as aside:
        aside.write_bytes(model.SerializeToString())
    return ExportResult(path, n_samples, difference, latency)


def inputs_of(scenario: Scenario) -> tuple[str, ...]:
    """Names of a graph's inputs, in their order."""
    return (*INPUTS, *PREVIOUS_INPUTS) if scenario.motion_lag else INPUTS


def _metadata(policy: LoadedPolicy) -> dict[str, Any]:
    scenario = policy.scenario
    names = ("link_range", "detection_range", "neighbor_separation", "obstacle_separation", "time_step", "max_speed")
    inputs = "positions in the body frame [m], forward +x, left +y: neighbors (any, 2), obstacles (any, 2), waypoint (2,)"
    if scenario.motion_lag:
        inputs += "; previous_...: those of motion_lag [s] ago, in the frame of that time"
        inputs += "; ego_motion (3,): present position in that frame [m], turn since [rad]"
    return {
        **policy.describe(),
        "policy": policy.path.name,
        "inputs": inputs,
        "output": "action (2,): speed [m/s], turn rate [rad/s]",
        **{name: getattr(scenario, name) for name in (*names, "max_turn_rate", "motion_lag")},
        "exported_with": versions(),
    }


def _compare(session: Any, policy: LoadedPolicy, count: int, seed: int) -> tuple[float, float]:
    """Largest difference to ``predict``, and median time of one action."""
    space: Any = policy.policy.action_space
    samples = list(random_sample_inputs(policy.scenario, count, seed))
    actions, times = [], []
    for sample, _ in samples:
        start = time.perf_counter()
        (action,) = session.run(None, sample)
        times.append(time.perf_counter() - start)
        actions.append(action)
    expected = np.stack([policy.predict(tensor, deterministic=True)[0] for _, tensor in samples])
    difference = np.abs(np.stack(actions) - expected) / (space.high - space.low)
    return float(difference.max()), float(np.median(times))


def random_sample_inputs(scenario: Scenario, count: int, seed: int) -> Iterator[tuple[SampleInput, NDArray[np.float32]]]:
    """What one vehicle measures at the start of random episodes of all sizes, and its observation there.

    With motion channels, ``motion_lag`` after the start, with random actions.
    """
    for number in range(count):
        rng = episode_rng(seed, number)
        n_vehicles, n_obstacles = int(rng.integers(1, 13)), int(rng.integers(0, 6))
        bodies = {"n_vehicles": n_vehicles, "n_obstacles": n_obstacles, "obstacle_motion": "walk"}
        arena = max(scenario.link_range, scenario.detection_range) * rng.uniform(2, 5)
        free_space = {"arena": arena, "obstacle_arena": arena, "obstacle_starts": None, "sensors": SensorErrors()}
        world = World(scenario.replace(**bodies, **free_space, max_cycles=max(1, scenario.motion_lag_steps)))
        sensing = world.sensors.measure(world.reset([rng]))
        sample = _measured_by_first_vehicle(world, sensing)
        if scenario.motion_lag:
            before = {f"previous_{name}": positions for name, positions in sample.items()}
            (x, y), (cos, sin), heading = world.positions[0, 0], world.frames[0, 0], world.headings[0, 0]
            for _ in range(scenario.motion_lag_steps):
                actions = rng.uniform(world.action_low, world.action_high, (1, n_vehicles, 2))
                sensing = world.sensors.measure(world.step(actions)[0])
            dx, dy = world.positions[0, 0] - (x, y)
            ego_motion = np.array([cos * dx + sin * dy, cos * dy - sin * dx, world.headings[0, 0] - heading])
            sample = {**_measured_by_first_vehicle(world, sensing), **before, "ego_motion": ego_motion}
        yield sample, observe(sensing, scenario)[0, 0]


def _measured_by_first_vehicle(world: World, sensing: Sensing) -> SampleInput:
    """Positions of all bodies in the first vehicle's frame, in range or not."""
    neighbors, obstacles = (
        found.positions[found.observers == 0]
        for found in (
            find_contacts(world.positions, world.frames, world.positions, np.inf, exclude_self=True),
            find_contacts(world.positions, world.frames, world.obstacle_positions, np.inf),
        )
    )
    return {"neighbors": neighbors, "obstacles": obstacles, "waypoint": sensing.waypoint_positions[0, 0]}


@contextlib.contextmanager
def _quiet_exporter() -> Iterator[None]:
    """Silence torch's exporter, whose messages are not about the policy."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)
