"""The inner loops of the world compiled by numba. What they compute is told and tested where they are called."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.sensing import Pairs


@njit(cache=True)
def find_contacts(
    positions: NDArray[np.float64], frames: NDArray[np.float64], bodies: NDArray[np.float64], reach: float, others: bool
) -> Pairs:
    """:func:`sb3_flock.sim.sensing.find_contacts` by comparing all pairs of a flock."""
    n_flocks, n_vehicles, _ = positions.shape
    n_bodies = bodies.shape[1]
    capacity = n_flocks * n_vehicles * n_bodies
    observers, found = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    relative, distances = np.empty((capacity, 2)), np.empty(capacity)
    n = 0
    for flock in range(n_flocks):
        for i in range(n_vehicles):
            cos, sin = frames[flock, i, 0], frames[flock, i, 1]
            for j in range(n_bodies):
                if others and i == j:
                    continue
                x = bodies[flock, j, 0] - positions[flock, i, 0]
                y = bodies[flock, j, 1] - positions[flock, i, 1]
                distance = math.sqrt(x * x + y * y)
                if distance < reach:
                    observers[n], found[n], distances[n] = flock * n_vehicles + i, j, distance
                    relative[n, 0], relative[n, 1] = cos * x + sin * y, cos * y - sin * x
                    n += 1
    return observers[:n], found[:n], relative[:n], distances[:n]


@njit(error_model="numpy", cache=True)
def add_gaussians(
    tensor: NDArray[np.float32],
    channel: int,
    observers: NDArray[np.int64],
    positions: NDArray[np.float64],
    radius: float,
    sigma: float,
) -> None:
    """:func:`sb3_flock.sim.observation.add_gaussians`."""
    side = tensor.shape[-1]
    along_x, along_y = np.empty(side, np.float32), np.empty(side, np.float32)
    spacing = 2 * radius / (side - 1)
    step = spacing / sigma
    half, shrink = math.exp(-0.5 * step * step), math.exp(-step * step)
    for contact in range(len(observers)):
        _gaussian(along_x, positions[contact, 0] + radius, spacing, step, half, shrink)
        _gaussian(along_y, positions[contact, 1] + radius, spacing, step, half, shrink)
        plane = tensor[observers[contact], channel]
        for a in range(side):
            factor = along_x[a]
            for b in range(side):
                plane[a, b] += factor * along_y[b]


@njit(error_model="numpy", cache=True)
def _gaussian(out: NDArray[np.float32], x: float, spacing: float, step: float, half: float, shrink: float) -> None:
    """exp(-d^2 / 2) at every anchor, d the distance in units of sigma, from the nearest anchor outwards.

    The ratio of neighboring anchors' values changes by the factor ``shrink`` = exp(-step^2) from anchor to anchor, so two
    exponentials do for all of them. The anchors are ``step`` sigma or ``spacing`` apart, x is counted from the first one.
    """
    middle = min(max(int(x / spacing + 0.5), 0), len(out) - 1)
    distance = (x / spacing - middle) * step
    peak, lean = math.exp(-0.5 * distance * distance), math.exp(step * distance)
    out[middle] = peak
    value, ratio = peak, half * lean
    for anchor in range(middle + 1, len(out)):
        value *= ratio
        ratio *= shrink
        out[anchor] = value
    value, ratio = peak, half / lean
    for anchor in range(middle - 1, -1, -1):
        value *= ratio
        ratio *= shrink
        out[anchor] = value
