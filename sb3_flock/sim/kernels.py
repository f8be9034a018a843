"""The inner loops of the world, compiled by numba: twins of the functions named in their docstrings, tested against them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

_CHUNK = 64
"""Bodies whose factors are computed together."""

_SERIES = tuple(1 / math.factorial(k) for k in range(9, -1, -1))
"""Coefficients of the exponential's series."""


@njit(cache=True)
def find_contacts(
    positions: NDArray[np.float64],
    frames: NDArray[np.float64],
    bodies: NDArray[np.float64],
    sensing_range: float,
    exclude_self: bool,
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
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
                if exclude_self and i == j:
                    continue
                x = bodies[flock, j, 0] - positions[flock, i, 0]
                y = bodies[flock, j, 1] - positions[flock, i, 1]
                distance = math.sqrt(x * x + y * y)
                if distance < sensing_range:
                    observers[n], found[n], distances[n] = flock * n_vehicles + i, j, distance
                    relative[n, 0], relative[n, 1] = cos * x + sin * y, cos * y - sin * x
                    n += 1
    return observers[:n], found[:n], relative[:n], distances[:n]


@njit(error_model="numpy", cache=True)
def rasterize(
    channels: NDArray[np.float32],
    channel: int,
    observers: NDArray[np.int64],
    positions: NDArray[np.float64],
    radius: float,
    sigma: float,
    row: tuple[int, ...],
) -> None:
    """:func:`sb3_flock.sim.observation.rasterize`, some bodies at a time.

    :param row: as many numbers as a row has anchors: numba knows a tuple's length at compile time and unrolls the loops
    """
    side = len(row)
    spacing = 2 * radius / (side - 1)
    step = spacing / sigma
    along_x, along_y = np.empty((side, _CHUNK), np.float32), np.empty((side, _CHUNK), np.float32)
    x, y = np.zeros(_CHUNK), np.zeros(_CHUNK)
    factors = np.empty(side, np.float32)
    margin = 40.0 / step  # anchor spacings from the edge; a body farther out adds 0 everywhere
    last = -1
    for start in range(0, len(observers), _CHUNK):
        count = min(_CHUNK, len(observers) - start)
        for i in range(count):
            x[i] = min(max((positions[start + i, 0] + radius) / spacing, -margin), side - 1 + margin)
            y[i] = min(max((positions[start + i, 1] + radius) / spacing, -margin), side - 1 + margin)
        _gaussians(along_x, x, step, row)
        _gaussians(along_y, y, step, row)
        for i in range(count):
            observer = observers[start + i]
            plane = channels[observer, channel]
            for b in range(side):
                factors[b] = along_y[b, i]
            if observer == last:
                for a in range(side):
                    factor = along_x[a, i]
                    for b in range(side):
                        plane[a, b] += factor * factors[b]
            else:
                for blank in range(last + 1, observer):
                    channels[blank, channel] = 0
                for a in range(side):
                    factor = along_x[a, i]
                    for b in range(side):
                        plane[a, b] = factor * factors[b]
                last = observer
    for blank in range(last + 1, len(channels)):
        channels[blank, channel] = 0


@njit(error_model="numpy", cache=True)
def _gaussians(out: NDArray[np.float32], x: NDArray[np.float64], step: float, row: tuple[int, ...]) -> None:
    """exp(-d^2 / 2) at every anchor (rows) for every body (columns), d the distance in units of sigma.

    The ratio of neighboring anchors' values changes by the factor exp(-step^2) from anchor to anchor, so two exponentials a
    body do for all anchors. The anchors are ``step`` sigma apart; x counts them from the first one.
    """
    shrink = math.exp(-step * step)
    values, ratios = np.empty(_CHUNK), np.empty(_CHUNK)
    for i in range(_CHUNK):
        values[i] = _exp(-0.5 * (x[i] * step) ** 2)
    for i in range(_CHUNK):
        ratios[i] = _exp(step * step * (x[i] - 0.5))
    for anchor in range(len(row)):
        for i in range(_CHUNK):
            out[anchor, i] = values[i]
        for i in range(_CHUNK):
            values[i] *= ratios[i]
        for i in range(_CHUNK):
            ratios[i] *= shrink


@njit(error_model="numpy", inline="always")
def _exp(t: float) -> float:
    """exp(t): that of t / 1024 by its series, squared ten times. Unlike the library's, this one is vectorized by the compiler.

    Relative error: 3e-13 up to 100 either way, 2e-9 at 300, 4e-7 at -500, where the result is 0 in single precision.
    """
    u = t / 1024
    power = 0.0
    for term in _SERIES:
        power = power * u + term
    for _ in range(10):
        power *= power
    return power
