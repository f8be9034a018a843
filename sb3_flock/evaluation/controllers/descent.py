"""The descent of :mod:`~sb3_flock.evaluation.controllers.foresight`, compiled by numba."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


LINK = 0.15
"""The link range in the unit of all lengths here, so that the weights are the same for tasks of any size: the paper's meter."""


class Wants(NamedTuple):
    """What plans should keep, and what it weighs beside the mean distance to the waypoint."""

    separation: float
    """Distance between vehicles."""
    clearance: float
    """Distance to obstacles."""
    reach: float
    """Length of the links that join the flock."""
    slack: float
    """Length beyond that at which a link no longer counts."""
    separation_weight: float
    clearance_weight: float
    reach_weight: float


@njit(error_model="numpy", cache=True)
def descend(
    plan: Array,
    positions: Array,
    headings: Array,
    waypoints: Array,
    obstacles: Array,
    stride: float,
    turn: float,
    wants: Wants,
    rounds: int,
    pace: float,
) -> None:
    """Improve the plan of one flock in place by rounds of Adam on :func:`slope`, summed over the steps ahead.

    :param plan: controls of every vehicle in every step ahead, ``(vehicles, steps, 2)``, relative to their bounds
    :param positions: where vehicles are, ``(vehicles, 2)``
    :param headings: where they look, ``(vehicles,)`` [rad]
    :param waypoints: where the waypoint will be after each step, ``(steps, 2)``
    :param obstacles: where obstacles will be then, ``(steps, obstacles, 2)``
    :param stride: longest way of a step
    :param turn: largest turn of a step [rad]
    :param wants: what is to be kept besides
    :param rounds: rounds of descent
    :param pace: how far a control moves in the first round at most, relative to its bound; in the last one a tenth of it
    """
    n, looks, _ = plan.shape
    cos, sin, ways = np.empty((n, looks)), np.empty((n, looks)), np.empty((looks, n, 2))
    down, slopes = np.empty((looks, n, 2)), np.empty((n, looks, 2))
    flat, flat_slopes = plan.reshape(-1), slopes.reshape(-1)
    mean, square = np.zeros(plan.size), np.zeros(plan.size)
    low = np.zeros(plan.size)
    low[1::2] = -1.0
    fade, fade_square = 1.0, 1.0
    for k in range(rounds):
        for i in range(n):
            heading, x, y = headings[i], positions[i, 0], positions[i, 1]
            for t in range(looks):
                cos[i, t], sin[i, t] = math.cos(heading), math.sin(heading)
                x += plan[i, t, 0] * stride * cos[i, t]
                y += plan[i, t, 0] * stride * sin[i, t]
                heading += plan[i, t, 1] * turn
                ways[t, i, 0], ways[t, i, 1] = x, y
        for t in range(looks):
            slope(down[t], ways[t], waypoints[t], obstacles[t], wants)
        for i in range(n):
            to_x = to_y = to_heading = 0.0  # slopes of all that comes after a step
            for t in range(looks - 1, -1, -1):
                to_x += down[t, i, 0]
                to_y += down[t, i, 1]
                slopes[i, t, 0] = (to_x * cos[i, t] + to_y * sin[i, t]) * stride
                slopes[i, t, 1] = to_heading * turn
                # Who stands does not move by turning; as if it crept: else one that looks away would never turn round.
                to_heading += (to_y * cos[i, t] - to_x * sin[i, t]) * stride * max(plan[i, t, 0], 0.5)
        # Adam, its means remembering 0.8 and 0.9 of what they were.
        fade *= 0.8
        fade_square *= 0.9
        step, share = pace * (1.0 - 0.9 * (k + 1) / rounds) / (1.0 - fade), 1.0 / (1.0 - fade_square)
        for i in range(plan.size):
            mean[i] = 0.8 * mean[i] + 0.2 * flat_slopes[i]
            square[i] = 0.9 * square[i] + 0.1 * flat_slopes[i] * flat_slopes[i]
            flat[i] = min(max(flat[i] - step * mean[i] / (math.sqrt(square[i] * share) + 0.005), low[i]), 1.0)


@njit(error_model="numpy", cache=True)
def slope(down: Array, ways: Array, waypoint: Array, obstacles: Array, wants: Wants) -> None:
    """The slope ``down`` ``(vehicles, 2)`` of a step's cost by the positions ``ways`` ``(vehicles, 2)``.

    The cost is the mean distance to the waypoint and half the weighed squares of what is missing: of distances to neighbors and
    obstacles, and of the links in the shortest tree that joins the flock. What a link lacks weighs less the more it is, and
    nothing more beyond the slack.
    """
    n = len(ways)
    for i in range(n):
        x, y = ways[i, 0] - waypoint[0], ways[i, 1] - waypoint[1]
        distance = math.sqrt(x * x + y * y + 0.02**2)  # smooth where a vehicle is on it
        down[i, 0], down[i, 1] = x / distance / n, y / distance / n
        for obstacle in obstacles:
            x, y = ways[i, 0] - obstacle[0], ways[i, 1] - obstacle[1]
            distance = math.sqrt(x * x + y * y) + 1e-9
            push = wants.clearance_weight * max(0.0, wants.clearance - distance) / distance
            down[i, 0] -= push * x
            down[i, 1] -= push * y
        for j in range(i):
            distance = _distance(ways, i, j)
            _pull(down, ways, i, j, -wants.separation_weight * max(0.0, wants.separation - distance) / distance)
    gaps, at, joined = np.full(n, np.inf), np.zeros(n, np.int64), np.zeros(n, np.bool_)
    last = 0
    for _ in range(n - 1):  # Prim's algorithm
        joined[last] = True
        best = -1
        for j in range(n):
            if not joined[j]:
                distance = _distance(ways, j, last)
                if distance < gaps[j]:
                    gaps[j], at[j] = distance, last
                if best < 0 or gaps[j] < gaps[best]:
                    best = j
        last = best
        missing = max(0.0, gaps[last] - wants.reach)
        pull = wants.reach_weight * missing * max(0.0, 1.0 - missing / wants.slack) ** 2
        _pull(down, ways, last, at[last], pull / gaps[last])


@njit(error_model="numpy", cache=True)
def _distance(ways: Array, i: int, j: int) -> float:
    x, y = ways[i, 0] - ways[j, 0], ways[i, 1] - ways[j, 1]
    return math.sqrt(x * x + y * y) + 1e-9


@njit(error_model="numpy", cache=True)
def _pull(down: Array, ways: Array, i: int, j: int, pull: float) -> None:
    for axis in range(2):
        difference = pull * (ways[i, axis] - ways[j, axis])
        down[i, axis] += difference
        down[j, axis] -= difference
