"""Export of a policy as one ONNX graph for a vehicle's computer: from measured positions to speed and turn rate."""

from __future__ import annotations

import contextlib
import copy
import io
import json
import logging
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch as th
from stable_baselines3.sac.policies import SACPolicy
from stable_baselines3.td3.policies import TD3Policy
from torch import nn

from sb3_flock.deploy.onnx_check import compare
from sb3_flock.deploy.onnx_safety import OnnxSafetyFilter, Shape, exact, filter_shapes, norm
from sb3_flock.serialization.load import LoadedPolicy
from sb3_flock.serialization.save import atomic_write, versions
from sb3_flock.settings import RunError, SettingsError
from sb3_flock.sim import Scenario

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

INPUTS = ("neighbors", "obstacles", "waypoint")
PREVIOUS_INPUTS = ("previous_neighbors", "previous_obstacles", "previous_waypoint", "ego_motion")
"""Further inputs of a policy with motion channels."""
TOLERANCE = 1e-5
"""Largest difference to ``predict`` that an exported policy may have, as a share of the action's range; it is float32's."""


@dataclass(frozen=True)
class ExportResult:
    """The written file, and its comparison with the policy."""

    path: Path
    n_samples: int
    difference: float
    """Largest difference to ``predict`` over the sample inputs, as a share of the action's range."""
    latency: float
    """Median time of a decision on one core [s]; with ``announce`` the graph runs twice for one."""


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
        self.actor = copy.deepcopy(actor_of(policy)).double()
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
            to_present = _to_present(ego_motion)
            previous = {
                "neighbors": previous_neighbors,
                "obstacles": previous_obstacles,
                "waypoint": previous_waypoint[None],
            }
            observation = th.cat((present, present - self._channels(previous, to_present)))
        action = self.actor(observation[None])[0]
        return self.low + (action + 1) / 2 * (self.high - self.low)

    def _channels(
        self, bodies: dict[str, th.Tensor], to_present: Callable[[th.Tensor], th.Tensor] = lambda positions: positions
    ) -> th.Tensor:
        """The channels ``(channels, l, l)`` of one measurement, all at once for speed: bodies carry their channel's number,
        lengths are in units of its sigma."""
        scenario, side = self.scenario, self.scenario.n_anchors
        ranges = {"neighbors": scenario.link_range, "obstacles": scenario.known_obstacle_range}
        marked, shown = [], []
        for number, (channel, radius) in enumerate(zip(scenario.channels, scenario.channel_radii, strict=True)):
            measured = bodies[channel.source]
            positions = to_present(measured)
            in_range = norm(measured) < ranges.get(channel.source, float("inf"))
            if channel.source == "waypoint":
                positions = positions / (norm(positions) / radius).clamp(min=1.0)[:, None]
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


def actor_of(policy: Any) -> nn.Sequential:
    """The parts of an actor: features extractor, dense layers and bound, from observations to actions in [-1, 1].

    :raises SettingsError: for a policy of another kind than those of DDPG, TD3 and SAC
    """
    actor: Any = getattr(policy, "actor", None)
    if isinstance(policy, TD3Policy):
        return nn.Sequential(actor.features_extractor, actor.mu)
    if isinstance(policy, SACPolicy):
        return nn.Sequential(actor.features_extractor, actor.latent_pi, actor.mu, nn.Tanh())
    raise SettingsError(f"export: a policy of DDPG, TD3 or SAC is needed, not {type(policy).__name__}")


def _to_present(ego_motion: th.Tensor) -> Callable[[th.Tensor], th.Tensor]:
    """The transformation of positions ``(any, 2)`` [m] from the vehicle's previous frame into its present one."""
    cos, sin = ego_motion[2].cos(), ego_motion[2].sin()
    frame = th.stack((th.stack((cos, -sin)), th.stack((sin, cos))))  # the present frame, in the previous one
    return lambda positions: (positions - ego_motion[:2]) @ frame


class FilteredOnnxPolicy(OnnxPolicy):
    """The on-board part of a policy with the safety filter: the action is the one that the vehicle executes.

    Positions are in the body frame [m] (forward is +x, left is +y); bodies out of sensing range are ignored. All numbers are
    float64. Inputs: ``neighbors`` and ``obstacles`` ``(any number, 2)``, and ``waypoint`` ``(2,)``. With motion channels
    ``previous_neighbors``, ``previous_obstacles`` and ``previous_waypoint`` are what was measured ``motion_lag`` ago in the body
    frame of that time, and ``ego_motion`` ``(3,)`` is the vehicle's present position in that frame [m, m] and its turn since
    [rad]. The output ``action`` ``(2,)`` is the speed [m/s] and the turn rate [rad/s].

    With ``motion`` a row of ``previous_neighbors`` is the neighbor of the same row of ``neighbors``. A neighbor that is not
    sensed now, or was not then, has a position out of sensing range there.

    With ``heading`` and ``announce`` the graph also takes ``neighbor_headings`` ``(any number,)``, in the order of ``neighbors``:
    relative to the vehicle's own heading, to the left positive [rad], NaN if not known.

    With a tracker, whose estimates the positions then are, it also takes ``neighbor_stds`` ``(any number,)``: their standard
    deviations [m]. With actuators it takes ``own_speed`` ``()``, the vehicle's present speed [m/s].

    With ``announce`` a step has two runs. The first one, with zeros as ``neighbor_announced_speeds`` ``(any number,)``, gives the
    output ``announced_speed`` ``()`` [m/s], which the vehicle sends to its neighbors. The second one, with the speeds received
    from them, 0 or NaN where none was, gives ``action``.

    :param policy: a policy of DDPG, TD3 or SAC for the flock's observation
    :param scenario: the task with its sensing ranges, its filters, and the bounds to which actions are clipped
    :raises SettingsError: for another kind of policy
    """

    def __init__(self, policy: Any, scenario: Scenario) -> None:
        super().__init__(policy, scenario)
        self.filter = OnnxSafetyFilter(scenario)

    def forward(  # type: ignore[override]
        self,
        neighbors: th.Tensor,
        obstacles: th.Tensor,
        waypoint: th.Tensor,
        previous_neighbors: th.Tensor = _NOTHING,
        previous_obstacles: th.Tensor = _NOTHING,
        previous_waypoint: th.Tensor = _NOTHING,
        ego_motion: th.Tensor | None = None,
        neighbor_headings: th.Tensor | None = None,
        neighbor_announced_speeds: th.Tensor | None = None,
        neighbor_stds: th.Tensor | None = None,
        own_speed: th.Tensor | None = None,
    ) -> th.Tensor | tuple[th.Tensor, th.Tensor]:
        """The executed action, ``(2,)``; with ``announce`` also the speed to announce, ``()``."""
        asked = super().forward(
            neighbors, obstacles, waypoint, previous_neighbors, previous_obstacles, previous_waypoint, ego_motion
        )
        motions = None
        if self.scenario.safety_filter == "motion" and ego_motion is not None:
            was_sensed = norm(previous_neighbors) < exact(self.scenario.link_range)
            motions = was_sensed[:, None] * (neighbors - _to_present(ego_motion)(previous_neighbors))
        known = motions, neighbor_headings, neighbor_announced_speeds, neighbor_stds, own_speed
        return self.filter(asked, neighbors, *known, obstacles)


def export(
    policy: LoadedPolicy, path: str | Path, n_samples: int = 1000, seed: int = 0, scenario: Scenario | None = None
) -> ExportResult:
    """Write a policy as ONNX, and check that the graph acts as the policy does.

    The graph is that of :class:`OnnxPolicy`, with a safety filter that of :class:`FilteredOnnxPolicy`. :func:`inputs_of` and
    :func:`outputs_of` list its inputs and outputs. Ranges, sampling period and units are in the file's metadata under
    ``sb3_flock``, as JSON.

    :param path: the file, which is written whole or not at all
    :param n_samples: number of random sample inputs on which the graph is compared with ``predict``
    :param seed: seed of the sample inputs
    :param scenario: the task with its filters; ``None``: the one that the policy was trained for
    :raises PolicyError: if the scenario's observations do not fit the policy
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
    scenario = policy.scenario if scenario is None else scenario
    policy.check(scenario)
    bounds = [(task.max_speed, task.max_turn_rate) for task in (scenario, policy.scenario)]
    kind = FilteredOnnxPolicy if scenario.is_filtered or bounds[0] != bounds[1] else OnnxPolicy
    model = graph_of(kind(policy.policy, scenario), inputs_of(scenario), outputs_of(scenario))
    onnx.helper.set_model_props(model, {"sb3_flock": json.dumps(_metadata(policy, scenario))})
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
    difference, latency = compare(session, policy, scenario, n_samples, seed)
    if not difference <= TOLERANCE:
        raise RunError(
            f"export {path}: the graph differs from the policy by {difference:.2g} of the range, more than {TOLERANCE:g}"
        )
    with atomic_write(path) as aside:
        aside.write_bytes(model.SerializeToString())
    return ExportResult(path, n_samples, difference, latency)


def graph_of(module: nn.Module, shapes: Mapping[str, Shape], outputs: Sequence[str]) -> Any:
    """The ONNX model of a module, whose docstring the model gets.

    :param shapes: shape of each input; axes with a name have any size, the same for all axes of that name
    :param outputs: names of the outputs
    """
    axes = dict.fromkeys(axis for shape in shapes.values() for axis in shape)
    sizes = {axis: 2 + number if isinstance(axis, str) else axis for number, axis in enumerate(axes)}
    with _quiet_exporter(), th.no_grad():
        program = th.onnx.export(
            module.eval(),
            kwargs={name: th.zeros([sizes[axis] for axis in shape], dtype=th.float64) for name, shape in shapes.items()},
            input_names=list(shapes),
            output_names=outputs,
            dynamic_shapes={
                name: {number: th.export.Dim.DYNAMIC for number, axis in enumerate(shape) if isinstance(axis, str)} or None
                for name, shape in shapes.items()
            },
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    model.doc_string = " ".join(str(module.__doc__).split(":param", maxsplit=1)[0].replace("``", "").split())
    return model


def inputs_of(scenario: Scenario) -> dict[str, Shape]:
    """Names and shapes of a graph's inputs, in their order."""
    shapes: dict[str, Shape] = dict(zip(INPUTS, (("neighbors", 2), ("obstacles", 2), (2,)), strict=True))
    if scenario.motion_lag:
        before = "neighbors" if scenario.safety_filter == "motion" else "previous_neighbors"
        shapes |= zip(PREVIOUS_INPUTS, ((before, 2), ("previous_obstacles", 2), (2,), (3,)), strict=True)
    names = ("neighbor_headings", "neighbor_announced_speeds", "neighbor_stds", "own_speed")
    return shapes | {name: shape for name, shape in filter_shapes(scenario).items() if name in names}


def outputs_of(scenario: Scenario) -> tuple[str, ...]:
    """Names of a graph's outputs, in their order."""
    return ("action", "announced_speed") if scenario.safety_filter == "announce" else ("action",)


_HEADINGS = (
    "; neighbor_headings (any,): in the order of neighbors, relative to the own heading, left + [rad], NaN: not known"
)
_INPUTS_OF_LEVELS = {
    "motion": "; rows of previous_neighbors and neighbors are the same neighbors, out of range where not sensed",
    "heading": _HEADINGS,
    "announce": f"{_HEADINGS}; neighbor_announced_speeds (any,): received from them [m/s], 0 or NaN: not received; 0 in the run "
    "that gives announced_speed",
}
"""What the metadata says about the inputs of the safety filter."""


_ESTIMATES = (
    "positions are those that a tracker in front of this file estimates for now, as sb3_flock.sim.tracker does, obstacles nearer "
    "by margin_stds standard deviations"
)
"""What the metadata says where the scenario has a tracker."""

_INPUTS_OF_FILTERS = {
    "neighbor_stds": "; neighbor_stds (any,): standard deviation of each coordinate of their estimates [m], NaN: not approached",
    "own_speed": "; own_speed (): of the vehicle now [m/s], NaN: its top speed",
}
"""What the metadata says about further inputs of the filter."""


def _metadata(policy: LoadedPolicy, scenario: Scenario) -> dict[str, Any]:
    inputs = "positions in the body frame [m], forward +x, left +y: neighbors (any, 2), obstacles (any, 2), waypoint (2,)"
    if scenario.shared_detections:
        inputs += "; obstacles are those that the vehicle or one of its neighbors detects"
    if scenario.motion_lag:
        inputs += "; previous_...: those of motion_lag [s] ago, in the frame of that time"
        inputs += "; ego_motion (3,): present position in that frame [m], turn since [rad]"
    outputs = "action (2,): speed [m/s], turn rate [rad/s]"
    if scenario.is_filtered:
        inputs += _INPUTS_OF_LEVELS.get(scenario.safety_filter, "")
        inputs += "".join(text for name, text in _INPUTS_OF_FILTERS.items() if name in filter_shapes(scenario))
    if scenario.safety_filter == "announce":
        outputs += "; announced_speed (): to send to the neighbors [m/s]"
    return {**metadata_of(policy, scenario), "inputs": inputs, "output": outputs, "exported_with": versions()}


def metadata_of(policy: LoadedPolicy, scenario: Scenario) -> dict[str, Any]:
    """What every exported file says about its policy and its task, as plain values."""
    names = ["link_range", "detection_range", "shared_detections", "neighbor_separation", "obstacle_separation"]
    names += ["time_step", "max_speed", "max_turn_rate", "motion_lag"]
    if scenario.is_filtered:
        names += ["safety_filter", "obstacle_filter", "safety_margin", "obstacle_max_speed"]
    more: dict[str, Any] = {}
    if scenario.tracker.enabled:
        more |= {"estimates": _ESTIMATES, "margin_stds": scenario.tracker.margin_stds}
    if scenario.is_reserving:
        more |= {name: getattr(scenario.actuators, name) for name in ("speed_lag", "max_acceleration")}
    return {**policy.describe(), "policy": policy.path.name, **{name: getattr(scenario, name) for name in names}, **more}


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
