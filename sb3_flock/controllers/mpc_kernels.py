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


class FilterParams(NamedTuple):
    """The safety filter of the world that a plan is made for (:mod:`sb3_flock.sim.safety`)."""

    separation: float
    """Distance that the filter keeps between vehicles."""
    rounds: int
    """0: no filter; 1: bounds from positions or headings; 2: also from announced speeds."""
    knows_headings: bool
    """Whether a vehicle that follows another has the whole gap, rather than its half."""


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
    safety: FilterParams,
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
    :param safety: the filter, whose bounds every step of a plan obeys
    :param n_iterations: iterations of Adam
    :param step_size: Adam's step size at the first iteration, relative to the bounds; a tenth of it at the last
    """
    n, horizon, _ = plan.shape
    cos, sin, strides = np.empty((horizon, n)), np.empty((horizon, n)), np.empty((horizon, n))
    trajectory, gradient = np.empty((horizon + 1, n, 2)), np.empty((horizon, n, 2))
    held_by, slack = np.empty((horizon, n), np.int64), np.empty((horizon, n, 2))
    turned, plan_gradient = np.empty(n), np.empty((n, horizon, 2))
    later, to_heading = np.empty((n, 2)), np.empty(n)
    flat, flat_gradient = plan.reshape(-1), plan_gradient.reshape(-1)
    mean, square = np.zeros(plan.size), np.zeros(plan.size)
    low = np.zeros(plan.size)
    low[1::2] = -1.0
    beta1_power, beta2_power = 1.0, 1.0
    trajectory[0] = positions
    for k in range(n_iterations):
        turned[:] = headings
        for t in range(horizon):
            for i in range(n):
                cos[t, i], sin[t, i] = math.cos(turned[i]), math.sin(turned[i])
                turned[i] += plan[i, t, 1] * max_turn
                strides[t, i] = plan[i, t, 0] * max_step
            limit_strides(strides[t], held_by[t], slack[t], trajectory[t], cos[t], sin[t], max_step, safety)
            for i in range(n):
                trajectory[t + 1, i, 0] = trajectory[t, i, 0] + strides[t, i] * cos[t, i]
                trajectory[t + 1, i, 1] = trajectory[t, i, 1] + strides[t, i] * sin[t, i]
            cost_gradient(gradient[t], trajectory[t + 1], waypoints[t], obstacles[t], cost)
        later[:], to_heading[:] = 0.0, 0.0  # gradients of all later steps' cost
        for t in range(horizon - 1, -1, -1):
            later += gradient[t]
            for i in range(n):
                plan_gradient[i, t, 0] = (later[i, 0] * cos[t, i] + later[i, 1] * sin[t, i]) * max_step
                plan_gradient[i, t, 1] = to_heading[i] * max_turn
                # Turning does not move a standing vehicle. Its speed counts as at least 0.5 here, or it would never turn around.
                sideways = later[i, 1] * cos[t, i] - later[i, 0] * sin[t, i]
                speed = plan[i, t, 0] if held_by[t, i] < 0 else strides[t, i] / max_step
                to_heading[i] += sideways * max_step * max(speed, 0.5)
            if safety.rounds:
                _make_way(later, plan_gradient[:, t, 0], held_by[t], slack[t], trajectory[t], max_step)
        # Adam with beta1 = 0.8 and beta2 = 0.9.
        beta1_power *= 0.8
        beta2_power *= 0.9
        rate, correction = step_size * (1.0 - 0.9 * (k + 1) / n_iterations) / (1.0 - beta1_power), 1.0 / (1.0 - beta2_power)
        for i in range(plan.size):
            mean[i] = 0.8 * mean[i] + 0.2 * flat_gradient[i]
            square[i] = 0.9 * square[i] + 0.1 * flat_gradient[i] * flat_gradient[i]
            flat[i] = min(max(flat[i] - rate * mean[i] / (math.sqrt(square[i] * correction) + 0.005), low[i]), 1.0)


@njit(error_model="numpy", cache=True)
def limit_strides(
    strides: Array,
    held_by: NDArray[np.int64],
    slack: Array,
    positions: Array,
    cos: Array,
    sin: Array,
    max_step: float,
    safety: FilterParams,
) -> None:
    """Lower the strides of one step ``(vehicles,)`` as the safety filter does, in place.

    :param held_by: set to the neighbor whose bound counts for each vehicle, -1 for none, ``(vehicles,)``
    :param slack: set to how much longer a held vehicle's stride gets, if that neighbor is further away by 1, and if its
        announced stride is longer by 1, ``(vehicles, 2)``
    :param positions: positions at the start of the step, ``(vehicles, 2)``
    :param cos: cosines of the headings, ``(vehicles,)``; ``sin`` their sines
    :param max_step: longest stride
    :param safety: the filter
    """
    n = len(strides)
    held_by[:] = -1
    if safety.rounds == 0:
        return
    asked, announced = strides.copy(), np.zeros(n)
    for number in range(safety.rounds):
        for i in range(n):
            best, strides[i], held_by[i] = asked[i], asked[i], -1
            for j in range(n):
                if j == i:
                    continue
                x, y = positions[j, 0] - positions[i, 0], positions[j, 1] - positions[i, 1]
                gap = math.sqrt(x * x + y * y) - safety.separation
                if gap > 2.0 * max_step:
                    continue
                distance = gap + safety.separation + 1e-9
                approach = (cos[i] * x + sin[i] * y) / distance
                if approach <= 0.0:
                    continue
                recedes = (cos[j] * x + sin[j] * y) / distance
                share, ahead = 0.5, 0.0
                if safety.knows_headings and recedes >= 0.0:
                    share = 1.0
                    if number == 1:
                        ahead = recedes
                bound = (share * max(gap, 0.0) + ahead * announced[j]) / approach
                if bound < best:
                    best, held_by[i] = bound, j
                    slack[i, 0], slack[i, 1] = share / approach, ahead / approach
            strides[i] = best
        announced[:] = strides


@njit(error_model="numpy", cache=True)
def _make_way(
    later: Array, speed_gradient: Array, held_by: NDArray[np.int64], slack: Array, positions: Array, max_step: float
) -> None:
    """What vehicles that are held cost, as gradients of those who hold them: in their positions, and in their speeds."""
    for i in range(len(held_by)):
        j = held_by[i]
        if j < 0:
            continue
        x, y = positions[j, 0] - positions[i, 0], positions[j, 1] - positions[i, 1]
        distance = math.sqrt(x * x + y * y) + 1e-9
        gain = speed_gradient[i] / max_step
        later[j, 0] += gain * slack[i, 0] * x / distance
        later[j, 1] += gain * slack[i, 0] * y / distance
        later[i, 0] -= gain * slack[i, 0] * x / distance
        later[i, 1] -= gain * slack[i, 0] * y / distance
        speed_gradient[j] += gain * slack[i, 1] * max_step


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
