"""The optimizer of :mod:`~sb3_flock.controllers.mpc`, compiled by numba."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


UNIT_LINK = 0.15
"""The link range in the unit of all lengths here: the paper's meter. The same weights then serve tasks of any size."""


class CostParams(NamedTuple):
    """The constraints of a plan, and their weights beside the mean distance to the waypoint."""

    separation: float
    """Distance to keep between vehicles."""
    clearance: float
    """Distance to keep to obstacles."""
    max_link_length: float
    """Longest link without cost."""
    link_cutoff: float
    """Excess over ``max_link_length`` from which a link no longer counts."""
    separation_weight: float
    clearance_weight: float
    link_weight: float


@njit(error_model="numpy", cache=True)
def optimize(
    plan: Array,
    positions: Array,
    headings: Array,
    waypoints: Array,
    obstacles: Array,
    max_step: float,
    max_turn: float,
    cost: CostParams,
    n_iterations: int,
    step_size: float,
) -> None:
    """Optimize the plan of one flock in place: Adam on :func:`cost_gradient`, summed over the horizon.

    :param plan: controls of every vehicle at every step of the horizon, ``(vehicles, horizon, 2)``, relative to their bounds
    :param positions: present positions of the vehicles, ``(vehicles, 2)``
    :param headings: their present headings, ``(vehicles,)`` [rad]
    :param waypoints: predicted waypoint after each step, ``(horizon, 2)``
    :param obstacles: predicted obstacles after each step, ``(horizon, obstacles, 2)``
    :param max_step: longest distance of one step
    :param max_turn: largest turn of one step [rad]
    :param cost: constraints and weights
    :param n_iterations: iterations of Adam
    :param step_size: Adam's step size at the first iteration, relative to the bounds; a tenth of it at the last
    """
    n, horizon, _ = plan.shape
    cos, sin, trajectory = np.empty((n, horizon)), np.empty((n, horizon)), np.empty((horizon, n, 2))
    gradient, plan_gradient = np.empty((horizon, n, 2)), np.empty((n, horizon, 2))
    flat, flat_gradient = plan.reshape(-1), plan_gradient.reshape(-1)
    mean, square = np.zeros(plan.size), np.zeros(plan.size)
    low = np.zeros(plan.size)
    low[1::2] = -1.0
    beta1_power, beta2_power = 1.0, 1.0
    for k in range(n_iterations):
        for i in range(n):
            heading, x, y = headings[i], positions[i, 0], positions[i, 1]
            for t in range(horizon):
                cos[i, t], sin[i, t] = math.cos(heading), math.sin(heading)
                x += plan[i, t, 0] * max_step * cos[i, t]
                y += plan[i, t, 0] * max_step * sin[i, t]
                heading += plan[i, t, 1] * max_turn
                trajectory[t, i, 0], trajectory[t, i, 1] = x, y
        for t in range(horizon):
            cost_gradient(gradient[t], trajectory[t], waypoints[t], obstacles[t], cost)
        for i in range(n):
            to_x = to_y = to_heading = 0.0  # gradient of all later steps' cost
            for t in range(horizon - 1, -1, -1):
                to_x += gradient[t, i, 0]
                to_y += gradient[t, i, 1]
                plan_gradient[i, t, 0] = (to_x * cos[i, t] + to_y * sin[i, t]) * max_step
                plan_gradient[i, t, 1] = to_heading * max_turn
                # Turning does not move a standing vehicle. Its speed counts as at least 0.5 here, or it would never turn around.
                to_heading += (to_y * cos[i, t] - to_x * sin[i, t]) * max_step * max(plan[i, t, 0], 0.5)
        # Adam with beta1 = 0.8 and beta2 = 0.9.
        beta1_power *= 0.8
        beta2_power *= 0.9
        rate, correction = step_size * (1.0 - 0.9 * (k + 1) / n_iterations) / (1.0 - beta1_power), 1.0 / (1.0 - beta2_power)
        for i in range(plan.size):
            mean[i] = 0.8 * mean[i] + 0.2 * flat_gradient[i]
            square[i] = 0.9 * square[i] + 0.1 * flat_gradient[i] * flat_gradient[i]
            flat[i] = min(max(flat[i] - rate * mean[i] / (math.sqrt(square[i] * correction) + 0.005), low[i]), 1.0)


@njit(error_model="numpy", cache=True)
def cost_gradient(gradient: Array, positions: Array, waypoint: Array, obstacles: Array, cost: CostParams) -> None:
    """The gradient ``(vehicles, 2)`` of one step's cost in the positions ``(vehicles, 2)``, written to ``gradient``.

    The cost is the mean distance to the waypoint plus weighted half squares of the violations: of separations to neighbors and
    obstacles, and of the link length in the flock's minimum spanning tree. The weight of a long link falls with its excess and
    is 0 from ``link_cutoff`` on.
    """
    n = len(positions)
    for i in range(n):
        x, y = positions[i, 0] - waypoint[0], positions[i, 1] - waypoint[1]
        distance = math.sqrt(x * x + y * y + 0.02**2)  # smooth where a vehicle is on it
        gradient[i, 0], gradient[i, 1] = x / distance / n, y / distance / n
        for obstacle in obstacles:
            x, y = positions[i, 0] - obstacle[0], positions[i, 1] - obstacle[1]
            distance = math.sqrt(x * x + y * y) + 1e-9
            push = cost.clearance_weight * max(0.0, cost.clearance - distance) / distance
            gradient[i, 0] -= push * x
            gradient[i, 1] -= push * y
        for j in range(i):
            distance = _distance(positions, i, j)
            _pull(gradient, positions, i, j, -cost.separation_weight * max(0.0, cost.separation - distance) / distance)
    gaps, at, joined = np.full(n, np.inf), np.zeros(n, np.int64), np.zeros(n, np.bool_)
    last = 0
    for _ in range(n - 1):  # Prim's algorithm
        joined[last] = True
        best = -1
        for j in range(n):
            if not joined[j]:
                distance = _distance(positions, j, last)
                if distance < gaps[j]:
                    gaps[j], at[j] = distance, last
                if best < 0 or gaps[j] < gaps[best]:
                    best = j
        last = best
        missing = max(0.0, gaps[last] - cost.max_link_length)
        pull = cost.link_weight * missing * max(0.0, 1.0 - missing / cost.link_cutoff) ** 2
        _pull(gradient, positions, last, at[last], pull / gaps[last])


@njit(error_model="numpy", cache=True)
def _distance(positions: Array, i: int, j: int) -> float:
    x, y = positions[i, 0] - positions[j, 0], positions[i, 1] - positions[j, 1]
    return math.sqrt(x * x + y * y) + 1e-9


@njit(error_model="numpy", cache=True)
def _pull(gradient: Array, positions: Array, i: int, j: int, pull: float) -> None:
    for axis in range(2):
        difference = pull * (positions[i, axis] - positions[j, axis])
        gradient[i, axis] += difference
        gradient[j, axis] -= difference
