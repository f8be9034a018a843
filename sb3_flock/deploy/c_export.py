"""Export of a policy as one file of C99 for a microcontroller: observation, network and safety filter in float32."""

from __future__ import annotations

import json
import re
import warnings
from importlib.metadata import version
from pathlib import Path
from string import Template
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import nn

from sb3_flock.deploy.c_check import compiler, library_of
from sb3_flock.deploy.onnx_check import compare, random_sample_inputs
from sb3_flock.deploy.onnx_export import ExportResult, actor_of, metadata_of
from sb3_flock.deploy.onnx_safety import filter_shapes
from sb3_flock.rl.policies import InvertingBound
from sb3_flock.rl.torch_layers import FlockCNN
from sb3_flock.serialization.save import atomic_write
from sb3_flock.settings import RunError, SettingsError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from sb3_flock.serialization.load import LoadedPolicy
    from sb3_flock.sim import Scenario

TOLERANCE = 1e-4
"""Largest difference to ``predict`` that a file may have, as a share of the action's range."""

RESERVE = 2.0**-20
"""What the filter keeps beyond a separation for float32's errors [sensing ranges], instead of
:data:`~sb3_flock.sim.safety.ROUNDING`. It is 16 times float32's unit roundoff of 2^-24. A vehicle's own errors add up to at most
13 of these: 4 of the gap, 5 of the approach, 4 of what an announcement adds."""

_DIRECTION_RESERVE = 2.0**-19
"""By how much a neighbor's heading has to recede; relative headings of up to 2 pi, their cosines and sines are off by 8e-7."""

_TEMPLATE = Path(__file__).with_name("policy_template.c")
_FLOAT32 = np.finfo(np.float32)


def export_c(
    policy: LoadedPolicy, path: str | Path, n_samples: int = 1000, seed: int = 0, scenario: Scenario | None = None
) -> ExportResult:
    """Write a policy as C99, and check that the compiled file acts as the policy does.

    The same policy and scenario give the same bytes. Without a C compiler the file is written unchecked, with a warning; the
    result's ``n_samples`` is then 0.

    :param path: the file, which is written whole or not at all
    :param n_samples: number of random sample inputs on which the compiled file is compared with ``predict`` and the filter
    :param seed: seed of the sample inputs
    :param scenario: the task with its filters; ``None``: the one that the policy was trained for
    :raises PolicyError: if the scenario's observations do not fit the policy
    :raises SettingsError: for networks or channels that have no C, or if there is no such folder
    :raises RunError: if it differs from ``predict`` by more than :data:`TOLERANCE`
    :raises OSError: if it cannot be written
    """
    path = Path(path)
    if not path.absolute().parent.is_dir():
        raise SettingsError(f"{path}: there is no folder {path.parent}")
    scenario = policy.scenario if scenario is None else scenario
    policy.check(scenario)
    source = source_of(policy, scenario)
    result = ExportResult(path, 0, float("nan"), float("nan"))
    if compiler() is None:
        warnings.warn(f"{path}: not compared with the policy, because there is no C compiler (cc)", stacklevel=2)
    else:
        with library_of(source, scenario) as library:
            difference, _ = compare(library, policy, scenario, n_samples, seed, reserve=reserved_margin(scenario))
            latency = library.latency(inputs for inputs, _ in random_sample_inputs(scenario, min(n_samples, 200), seed))
        if not difference <= TOLERANCE:
            raise RunError(
                f"export {path}: the file differs from the policy by {difference:.2g} of the range, more than {TOLERANCE:g}"
            )
        result = ExportResult(path, n_samples, difference, latency)
    with atomic_write(path) as aside:
        aside.write_bytes(source.encode("ascii"))
    return result


def reserved_margin(scenario: Scenario) -> float:
    """The ``safety_margin`` that slows a vehicle down at least as much as float32's reserve does [m]."""
    return 8 * _reserve(scenario)


def source_of(policy: LoadedPolicy, scenario: Scenario) -> str:
    """The text of the file.

    :raises SettingsError: for networks or channels that have no C
    """
    for channel in scenario.channels:
        if channel.select is not None:
            raise SettingsError(f"export: channel {channel.name!r} selects bodies by a function of Python, which has no C")
    weights, network, sizes, kinds = _network(actor_of(policy.policy), scenario)
    space: Any = policy.policy.action_space
    speed, turn_rate = (
        f"{_float(low)} + 0.5f * (action[{number}] + 1.0f) * {_float(float(high) - float(low))}"
        for number, (low, high) in enumerate(zip(space.low, space.high, strict=True))
    )
    level, infers = scenario.safety_filter, bool(_infers_motion(scenario))
    conditions = {
        *kinds,
        *(["lag"] if scenario.motion_lag else []),
        "filtered" if scenario.is_filtered else "unfiltered",
        *(["neighbor_filter"] if level != "off" else []),
        *(["obstacle_filter"] if scenario.obstacle_filter else []),
        *([level] if level in {"motion", "announce"} else []),
        "headings" if level in {"heading", "announce"} else "infers_motion" if infers else "no_receding",
    }
    conditions |= _further_conditions(scenario)
    if level == "off":
        conditions -= {"headings", "infers_motion", "no_receding"}
    shared = "that the vehicle or one of its neighbors detects" if scenario.shared_detections else "that the vehicle detects"
    return Template(_select(_TEMPLATE.read_text("ascii"), conditions)).substitute(
        header=_header(policy, scenario),
        time_step=_float(scenario.time_step, up=True),
        motion_lag_steps=scenario.motion_lag_steps,
        obstacles_comment=f"/* {shared} */",
        constants="\n".join(_constants(scenario)),
        weights="\n\n".join(weights),
        even_size=sizes[0],
        odd_size=sizes[1],
        show_channels="\n".join(_shown_channels(scenario)),
        network="\n".join(network),
        speed=speed,
        turn_rate=turn_rate,
    )


def _further_conditions(scenario: Scenario) -> set[str]:
    """What the filter needs for estimates, and for vehicles that do not stop at once."""
    further = filter_shapes(scenario)
    conditions = {"estimates" if "neighbor_stds" in further else "measured"}
    if "own_speed" not in further:
        return conditions | {"plain"}
    conditions |= {"reserves", "lags" if scenario.actuators.max_acceleration is None else "brakes"}
    return conditions | ({"announces_less"} if scenario.safety_filter == "announce" else set())


def _select(template: str, conditions: set[str]) -> str:
    """The lines of a template without markers: those between ``//: if NAME`` and ``//: end`` only where the name is given."""
    lines, shown = [], [True]
    for line in template.splitlines():
        if line.startswith("//: if "):
            shown.append(shown[-1] and line[7:] in conditions)
        elif line == "//: end":
            shown.pop()
        elif shown[-1]:
            lines.append(line.rstrip())
    return "\n".join(lines) + "\n"


def _float(value: float, up: bool | None = None) -> str:
    """A literal of float32: the nearest number, or the nearest that is not lower (``up``) or not higher (``up=False``)."""
    nearest = np.float32(value)
    if up is True and float(nearest) < value:
        nearest = np.nextafter(nearest, np.float32(np.inf))
    if up is False and float(nearest) > value:
        nearest = np.nextafter(nearest, np.float32(-np.inf))
    text = f"{float(nearest):.9g}"
    return f"{text}f" if re.search(r"[.e]", text) else f"{text}.0f"


def _reserve(scenario: Scenario) -> float:
    reach = scenario.link_range if scenario.safety_filter != "off" else 0.0
    return RESERVE * max(reach, scenario.detection_range if scenario.obstacle_filter else 0.0)


def _infers_motion(scenario: Scenario) -> float:
    """By how much a neighbor can turn within ``motion_lag``, if its motion then says something on its heading [rad], or 0."""
    turned = scenario.motion_lag_steps * scenario.max_turn_rate * scenario.time_step
    return turned if scenario.safety_filter == "motion" and turned < np.pi / 2 else 0.0


def _constants(scenario: Scenario) -> Iterator[str]:
    margin, reach = scenario.safety_margin, 1 + RESERVE
    obstacle_kept = scenario.obstacle_separation + margin + scenario.obstacle_max_speed * scenario.time_step
    motion_reach = scenario.link_range + scenario.max_speed * scenario.motion_lag
    numbers = [
        ("LINK_RANGE", _float(scenario.link_range), "[m]"),
        ("OBSTACLE_RANGE", _float(scenario.known_obstacle_range), "in which obstacles are known [m]"),
        ("MAX_SPEED", _float(scenario.max_speed, up=False), "[m/s]"),
        ("MAX_TURN_RATE", _float(scenario.max_turn_rate, up=False), "[rad/s]"),
        ("SIDE", str(scenario.n_anchors), "anchors"),
        ("CHANNELS", str(scenario.observation_shape[0]), ""),
        ("SIGMAS_PER_ANCHOR", _float(1 / scenario.anchor_width), ""),
    ]
    if scenario.is_filtered:
        numbers += [
            ("RESERVE", _float(_reserve(scenario), up=True), "of every budget, for errors of float32: 2^-20 ranges [m]"),
            ("DOWN", _float(1 - 2**-22), "rounds speeds down"),
            ("BOUNDS_PER_BODY", "1" if scenario.actuators.max_acceleration is None else "2", ""),
        ]
    further = filter_shapes(scenario)
    if "neighbor_stds" in further:
        numbers += [("MARGIN_STDS", _float(scenario.tracker.margin_stds, up=True), "margin for uncertainty")]
    if "own_speed" in further:
        numbers += [("SPEED_LAG", _float(scenario.actuators.speed_lag, up=True), "[s]")]
        if scenario.actuators.max_acceleration is not None:
            numbers += [("MAX_ACCELERATION", _float(scenario.actuators.max_acceleration, up=False), "[m/s^2]")]
    if scenario.safety_filter != "off":
        numbers += [
            ("NEIGHBOR_KEPT", _float(scenario.neighbor_separation + margin, up=True), "separation and margin [m]"),
            ("NEIGHBOR_REACH", _float(scenario.link_range * reach, up=True), "range of the filter [m]"),
        ]
    turned = _infers_motion(scenario)
    if turned or scenario.safety_filter in {"heading", "announce"}:
        numbers += [("FULL_TURN", _float(2 * np.pi, up=True), "largest angle that is precise enough in float32 [rad]")]
    if scenario.safety_filter in {"heading", "announce"}:
        numbers += [("DIRECTION_RESERVE", _float(_DIRECTION_RESERVE), "for errors of directions in float32")]
    if turned:
        numbers += [
            ("SIN_TURNED", _float(np.sin(turned), up=True), "of how far a neighbor turns within motion_lag"),
            ("MOTION_RESERVE", _float(2 * RESERVE * motion_reach, up=True), "for errors of motions in float32 [m]"),
        ]
    if scenario.obstacle_filter:
        numbers += [
            ("OBSTACLE_KEPT", _float(obstacle_kept, up=True), "separation, margin and the obstacle's own stride [m]"),
            ("OBSTACLE_REACH", _float(scenario.detection_range * reach, up=True), "range of the filter [m]"),
        ]
    for name, value, meaning in numbers:
        yield f"#define FLOCK_{name} {value}" + (f" /* {meaning} */" if meaning else "")


def _shown_channels(scenario: Scenario) -> Iterator[str]:
    """The statements that draw the channels of a measurement."""
    ranges = {"neighbors": "FLOCK_LINK_RANGE", "obstacles": "FLOCK_OBSTACLE_RANGE"}
    for number, (channel, radius) in enumerate(zip(scenario.channels, scenario.channel_radii, strict=True)):
        per_sigma = _float((scenario.n_anchors - 1) / (2 * radius * scenario.anchor_width))
        if channel.source == "waypoint":
            call = f"flock_show_waypoint(measured->waypoint, {_float(radius)}, frame, {per_sigma}, first + {number});"
        else:
            bodies = f"measured->{channel.source}, measured->n_{channel.source}, {ranges[channel.source]}"
            call = f"flock_show_bodies({bodies}, frame, {per_sigma}, first + {number});"
        yield f"    {call}"


def _network(actor: nn.Sequential, scenario: Scenario) -> tuple[list[str], list[str], tuple[int, int], set[str]]:
    """Arrays of weights, statements that compute the action, sizes of the two work arrays, and which functions are needed.

    The input of a layer is in one work array, its output in the other one.

    :raises SettingsError: for a layer that has no C
    """
    channels, side, _ = scenario.observation_shape
    size, sizes, kinds = channels * side * side, [channels * side * side, 1], set()
    weights: list[str] = []
    lines: list[str] = []
    names, at = ("flock_even", "flock_odd"), 0
    for number, layer in enumerate(_layers(actor)):
        arrays = f"flock_weights_{number}, flock_biases_{number}"
        if isinstance(layer, nn.Conv2d):
            kernel, stride, out = layer.kernel_size[0], layer.stride[0], layer.out_channels
            weights += _arrays(number, layer.weight.permute(0, 2, 3, 1), layer.bias)
            shape = f"{names[at]}, {side}, {channels}, {kernel}, {stride}"
            lines.append(f"flock_convolve({shape}, {arrays}, {names[1 - at]}, {out});")
            channels, side = out, (side - kernel) // stride + 1
            size, at = channels * side * side, 1 - at
            kinds.add("convolutions")
        elif isinstance(layer, nn.Linear):
            weights += _arrays(number, layer.weight, layer.bias)
            lines.append(f"flock_dense({names[at]}, {size}, {arrays}, {names[1 - at]}, {layer.out_features});")
            size, at = layer.out_features, 1 - at
        elif isinstance(layer, nn.LayerNorm):
            weights += _arrays(number, layer.weight, layer.bias)
            lines.append(f"flock_layer_norm({names[at]}, {size}, {arrays}, {_float(layer.eps)});")
            kinds.add("layer_norm")
        elif isinstance(layer, nn.ReLU):
            lines.append(f"flock_relu({names[at]}, {size});")
        else:
            kinds.add("tanh" if isinstance(layer, nn.Tanh) else "clamp")
            lines += [f"{names[at]}[{i}] = flock_bound({names[at]}[{i}]);" for i in range(size)]
        sizes[at] = max(sizes[at], size)
    lines.append(f"return {names[at]};")
    return weights, [f"    {line}" for line in lines], (sizes[0], sizes[1]), kinds


def _layers(actor: nn.Sequential) -> list[nn.Module]:
    """The layers of an actor, the last one of which bounds the action.

    :raises SettingsError: for other ones than :class:`FlockCNN`'s, dense layers, ReLU, layer norm and one bound at the end
    """
    extractor, *rest = actor
    parts: list[nn.Module] = [*extractor.cnn[:-1], *extractor.dense] if type(extractor) is FlockCNN else [extractor]
    for part in rest:
        parts += part if isinstance(part, nn.Sequential) else [part]
    inner, bounds = (nn.Conv2d, nn.Linear, nn.LayerNorm, nn.ReLU), (InvertingBound, nn.Tanh)
    wrong = [part for part in parts[:-1] if type(part) not in inner]
    wrong += [part for part in parts[-1:] if type(part) not in bounds]
    if wrong:
        raise SettingsError(
            f"export: C is written for FlockCNN with ReLU, layer norm, dense layers and an inverting or tanh bound, "
            f"not for {type(wrong[0]).__name__}"
        )
    return parts


def _arrays(number: int, weights: Any, biases: Any) -> Iterator[str]:
    for name, tensor in (("weights", weights), ("biases", biases)):
        values = [_float(value) for value in tensor.detach().cpu().float().flatten().tolist()]
        rows = (f"    {', '.join(values[start : start + 8])}," for start in range(0, len(values), 8))
        body = "\n".join(rows)
        yield f"static const float flock_{name}_{number}[{len(values)}] = {{\n{body}\n}};"


_USE = """A policy of sb3_flock in C99: from measured positions to speed and turn rate. All numbers are float, in m, s and rad.

Positions are in the vehicle's body frame: x is forward, y is to the left. Bodies out of range are ignored. Any number that is
NaN, infinite or beyond FLOCK_NOT_SENSED, and any count that is negative or too large, stops the vehicle: the speed is 0, and
flock_decide returns FLOCK_STOPPED.

    FlockInput input;   every sampling period: fill it, then
    FlockOutput output;
    flock_decide(&input, &output);   drive with output.speed and output.turn_rate
"""
_ANNOUNCE = """    send output.announced_speed to the neighbors, receive theirs, then, before driving,
    flock_raise_speed(&input, announced_speeds, &output);
"""
_REST = """
Another file of the program sees the declarations with
    #define FLOCK_DECLARATIONS_ONLY
    #include "policy.c"
There is no allocation, and no function of libm but expf, sqrtf, cosf and sinf.
"""


def _header(policy: LoadedPolicy, scenario: Scenario) -> str:
    """The comment at the top, which no name in a policy's file can end."""
    metadata = {**metadata_of(policy, scenario), "exported_with": {"sb3_flock": version("sb3_flock")}}
    written = json.dumps(metadata, indent=1).replace("*", "\\u002a").replace("?", "\\u003f")
    use = _USE + (_ANNOUNCE if scenario.safety_filter == "announce" else "") + _REST
    lines = [*use.splitlines(), "", "The policy and its task, as JSON:", *written.splitlines()]
    return "/*\n" + "\n".join(f" * {line}".rstrip() for line in lines) + "\n */"
