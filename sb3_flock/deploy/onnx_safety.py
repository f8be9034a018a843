"""The safety filter for a vehicle's computer: the twin of :func:`~sb3_flock.sim.safety.filter_actions` in torch, for ONNX."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch as th
from torch import nn

from sb3_flock.sim.safety import ROUNDING

if TYPE_CHECKING:
    from sb3_flock.sim.safety import SafetySettings

Shape = tuple[str | int, ...]
"""Shape of a graph's input: axes with a name have any size, the same wherever the name stands."""

_KNOWN: dict[str, tuple[str, ...]] = {
    "off": (),
    "voronoi": ("neighbors",),
    "motion": ("neighbors", "neighbor_motions"),
    "heading": ("neighbors", "neighbor_headings"),
    "announce": ("neighbors", "neighbor_headings", "neighbor_announced_speeds"),
}
"""What each ``safety_filter`` needs to know of the neighbors."""

_SHAPES: dict[str, Shape] = {
    "asked_action": (2,),
    "neighbors": ("neighbors", 2),
    "neighbor_motions": ("neighbors", 2),
    "neighbor_headings": ("neighbors",),
    "neighbor_announced_speeds": ("neighbors",),
    "neighbor_stds": ("neighbors",),
    "own_speed": (),
    "obstacles": ("obstacles", 2),
}

_UNIT = 2.0**40
"""Units of length in a meter. The power of 2 changes no digit. Optimizers of graphs, torch's for one, take a summand below 1e-8
for 0 and a factor of 1.000001 for 1: in meters they drop :data:`~sb3_flock.sim.safety.ROUNDING`."""

_TINY = 1e-300
"""Smallest length that is divided by."""


class OnnxSafetyFilter(nn.Module):
    """The actions of vehicles, clipped and with bounded speeds; each vehicle by what it measures itself.

    ``forward`` takes float64 tensors; further leading axes, the same for all of them, are vehicles:

    - ``asked_action`` ``(2,)``: speed [m/s] and turn rate [rad/s]
    - ``neighbors`` and ``obstacles`` ``(any, 2)``: positions in the body frame [m]; bodies out of sensing range are ignored
    - ``neighbor_motions`` ``(any, 2)``: by how much each neighbor has moved in the last ``motion_lag``, in the present body frame
      [m]; 0 or NaN if not known
    - ``neighbor_headings`` ``(any,)``: relative to the vehicle's own heading, to the left positive [rad]; NaN if not known
    - ``neighbor_announced_speeds`` ``(any,)``: [m/s]; 0 or NaN if not received
    - with a tracker ``neighbor_stds`` ``(any,)``: standard deviation of each coordinate of an estimated position [m]; the vehicle
      does not approach a neighbor with NaN
    - with actuators ``own_speed`` ``()``: the vehicle's present speed [m/s]; NaN counts as the top speed

    It returns the action ``(2,)``. With ``announce`` it also returns the speed ``()`` [m/s] that the vehicle has to announce,
    which does not depend on ``neighbor_announced_speeds``. A heading or an announcement that is missing lowers the speed as the
    level without it does, and the separation is kept.

    :param settings: the filters, the separations and the bounds of the actions
    """

    def __init__(self, settings: SafetySettings) -> None:
        super().__init__()
        self.settings = settings

    def forward(
        self,
        asked_action: th.Tensor,
        neighbors: th.Tensor | None = None,
        neighbor_motions: th.Tensor | None = None,
        neighbor_headings: th.Tensor | None = None,
        neighbor_announced_speeds: th.Tensor | None = None,
        neighbor_stds: th.Tensor | None = None,
        own_speed: th.Tensor | None = None,
        obstacles: th.Tensor | None = None,
    ) -> th.Tensor | tuple[th.Tensor, th.Tensor]:
        """The filtered action; with ``announce`` also the announced speed."""
        settings = self.settings
        dt, margin, max_speed = _length(settings.time_step), _length(settings.safety_margin), exact(settings.max_speed)
        asked = asked_action[..., 0].clamp(min=0).minimum(max_speed)
        turn_rate = asked_action[..., 1].clamp(exact(-settings.max_turn_rate), exact(settings.max_turn_rate))
        sensed, strides, budgets, raised = [], [], [], []  # one entry for neighbors and one for obstacles
        if settings.safety_filter != "off":
            assert neighbors is not None
            neighbors = neighbors * _UNIT
            distances, cosines = _distances_and_cosines(neighbors)
            free = distances - _length(settings.neighbor_separation) - margin
            if neighbor_stds is not None:
                uncertain = th.where(neighbor_stds >= 0, neighbor_stds, exact(np.inf)) * _length(
                    settings.tracker.margin_stds
                )
                free = free - uncertain
            gaps = free.clamp(min=0)
            receding = self._receding(neighbors, distances, neighbor_motions, neighbor_headings)
            sensed.append(distances < _length(settings.link_range))
            strides.append(cosines * dt)
            budgets.append(th.where(receding >= 0, gaps, gaps / 2))
            if settings.safety_filter == "announce":
                assert neighbor_announced_speeds is not None
                announced = _positive(neighbor_announced_speeds).minimum(max_speed)
                raised.append(budgets[-1] + _positive(receding) * announced * dt)
        if settings.obstacle_filter:  # the worst obstacle comes straight on at its top speed
            assert obstacles is not None
            distances, cosines = _distances_and_cosines(obstacles * _UNIT)
            kept = _length(settings.obstacle_separation) + margin + exact(settings.obstacle_max_speed) * dt
            sensed.append(distances < _length(settings.detection_range))
            strides.append(cosines * dt)
            budgets.append((distances - kept).clamp(min=0))
            raised.append(budgets[-1])
        if not sensed:
            return th.stack((asked, turn_rate), dim=-1)
        rounding = _length(
            ROUNDING * (settings.safety_margin + max(settings.neighbor_separation, settings.obstacle_separation))
        )
        contacts = th.cat(sensed, -1), th.cat(strides, -1)
        if own_speed is not None:
            own_speed = th.where(own_speed >= 0, own_speed, max_speed)

        def limit(floor: th.Tensor, within: list[th.Tensor]) -> th.Tensor:
            bounds = *contacts, th.cat(within, -1)
            if own_speed is not None:
                bounds = self._reserve_stopping(*bounds, own_speed)
            return _limit_speed(asked, floor, *bounds, rounding)

        speed = limit(th.zeros_like(asked), budgets)
        if settings.safety_filter != "announce":
            return th.stack((speed, turn_rate), dim=-1)
        announced = speed if own_speed is None else speed.minimum(own_speed)
        return th.stack((limit(speed, raised), turn_rate), dim=-1), announced

    def _reserve_stopping(
        self, sensed: th.Tensor, strides: th.Tensor, budgets: th.Tensor, own_speed: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """:func:`~sb3_flock.sim.safety.reserve_stopping` for bodies in rows of a vehicle's own."""
        settings, actuators = self.settings, self.settings.actuators
        ahead = strides.clamp(min=0) / exact(settings.time_step) * own_speed[..., None]  # m/s times _UNIT
        budgets = budgets - ahead * exact(actuators.speed_lag)
        if actuators.max_acceleration is None:
            return sensed, strides, budgets.clamp(min=0)
        bound = exact(actuators.max_acceleration)
        braking, steeper = ahead * own_speed[..., None] / (2 * bound), strides + ahead / bound
        both = th.cat((budgets - braking, budgets + braking), -1).clamp(min=0)
        return th.cat((sensed, sensed), -1), th.cat((strides, steeper), -1), both

    def _receding(
        self,
        neighbors: th.Tensor,
        distances: th.Tensor,
        motions: th.Tensor | None,
        headings: th.Tensor | None,
    ) -> th.Tensor:
        """The share of each neighbor's heading that points away from the vehicle, or less where that is not known."""
        settings = self.settings
        if settings.safety_filter in {"heading", "announce"}:
            assert headings is not None
            x, y = headings.cos(), headings.sin()
            return (x * neighbors[..., 0] + y * neighbors[..., 1]) / distances.maximum(exact(_TINY))
        turned = settings.motion_lag_steps * settings.max_turn_rate * settings.time_step
        if settings.safety_filter == "voronoi" or turned >= np.pi / 2:
            return th.full_like(distances, -1.0)
        assert motions is not None
        motions = motions * _UNIT
        away = (motions * neighbors).sum(-1) / distances.maximum(exact(_TINY))
        surely = away > exact(np.sin(turned)) * norm(motions) + _length(ROUNDING * settings.neighbor_separation)
        return surely.to(th.float64) - 1


def filter_shapes(settings: SafetySettings) -> dict[str, Shape]:
    """Names and shapes of the inputs that :class:`OnnxSafetyFilter` needs."""
    names = ["asked_action", *_KNOWN[settings.safety_filter]]
    if settings.tracker.enabled and settings.safety_filter != "off":
        names += ["neighbor_stds"]
    if settings.is_reserving:
        names += ["own_speed"]
    if settings.obstacle_filter:
        names += ["obstacles"]
    return {name: _SHAPES[name] for name in names}


def exact(value: float) -> th.Tensor:
    """A number in float64; torch's exporter rounds Python's floats to float32."""
    return th.tensor(value, dtype=th.float64)


def _length(meters: float) -> th.Tensor:
    """A length in the unit of the filter."""
    return exact(meters * _UNIT)


def norm(vectors: th.Tensor) -> th.Tensor:
    """Lengths of vectors ``(..., 2)``, ``(...)``."""
    return vectors.square().sum(-1).sqrt()


def _distances_and_cosines(positions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """Distances, and the share of the vehicle's heading that points to each body; 0 for a body at its own place."""
    distances = norm(positions)
    return distances, positions[..., 0] / distances.maximum(exact(_TINY))


def _positive(values: th.Tensor) -> th.Tensor:
    """Zero in the place of negative values and of NaN."""
    return th.where(values > 0, values, th.zeros_like(values))


def _limit_speed(
    asked: th.Tensor, floor: th.Tensor, sensed: th.Tensor, strides: th.Tensor, budgets: th.Tensor, rounding: th.Tensor
) -> th.Tensor:
    """:func:`~sb3_flock.sim.safety.limit_speeds` for bodies in rows of a vehicle's own ``(..., bodies)``.

    Minima are over the bodies and the speed itself, so that there may be no bodies.
    """
    asked, floor = asked[..., None], floor[..., None]
    allowed = budgets - 2 * rounding
    over = sensed & (strides > 0) & (strides * asked > allowed)
    speed = th.cat((asked, th.where(over, allowed.clamp(min=0) / strides, asked)), -1).amin(-1, keepdim=True)
    over = sensed & (strides * speed > budgets - rounding)
    return th.cat((speed, th.where(over, floor, speed)), -1).amin(-1)
