"""The inner loops of the world, compiled by numba: twins of the functions named in their docstrings, tested against them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from sb3_flock.sim.observation_kernels import rasterize  # noqa: F401 - one of these kernels, in a file of its own

if TYPE_CHECKING:
    from numpy.typing import NDArray


@njit(error_model="numpy", cache=True)
def move_bodies(
    positions: NDArray[np.float64],
    directions: NDArray[np.float64],
    headings: NDArray[np.float64],
    controls: NDArray[np.float64],
    obstacle_positions: NDArray[np.float64],
    obstacle_directions: NDArray[np.float64],
    obstacle_headings: NDArray[np.float64],
    obstacle_speeds: NDArray[np.float64],
    obstacle_turn_rates: NDArray[np.float64],
    dt: float,
    half_side: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """:func:`sb3_flock.sim.dynamics.move_bodies` in one pass."""
    next_positions, next_headings = np.empty(positions.shape), np.empty(headings.shape)
    for flock in range(positions.shape[0]):
        for i in range(positions.shape[1]):
            stride = controls[flock, i, 0] * dt
            next_positions[flock, i, 0] = positions[flock, i, 0] + stride * directions[flock, i, 0]
            next_positions[flock, i, 1] = positions[flock, i, 1] + stride * directions[flock, i, 1]
            next_headings[flock, i] = _wrap_angle(headings[flock, i] + controls[flock, i, 1] * dt)
    next_obstacles, next_obstacle_headings = np.empty(obstacle_positions.shape), np.empty(obstacle_headings.shape)
    for flock in range(obstacle_positions.shape[0]):
        for o in range(obstacle_positions.shape[1]):
            stride = obstacle_speeds[flock, o] * dt
            x = obstacle_positions[flock, o, 0] + stride * obstacle_directions[flock, o, 0]
            y = obstacle_positions[flock, o, 1] + stride * obstacle_directions[flock, o, 1]
            heading = obstacle_headings[flock, o] + obstacle_turn_rates[flock, o] * dt
            if max(abs(x), abs(y)) > half_side:
                heading += np.pi
            next_obstacles[flock, o, 0] = min(max(x, -half_side), half_side)
            next_obstacles[flock, o, 1] = min(max(y, -half_side), half_side)
            next_obstacle_headings[flock, o] = _wrap_angle(heading)
    return next_positions, next_headings, next_obstacles, next_obstacle_headings


@njit(error_model="numpy", inline="always")
def _wrap_angle(angle: float) -> float:
    """:func:`sb3_flock.sim.dynamics.wrap_angle` of one angle."""
    return angle - 2 * np.pi * math.floor((angle + np.pi) / (2 * np.pi))


@njit(error_model="numpy", inline="always")
def _follow(rate: float, command: float, lag: float, bound: float, dt: float) -> tuple[float, float]:
    """:func:`sb3_flock.sim.actuators.follow` of one rate."""
    gap, sign = abs(command - rate), np.sign(command - rate)
    at_bound = min(max(gap / bound - lag, 0.0), dt)
    left = max(gap - bound * at_bound, 0.0)
    decay = math.expm1(-(dt - at_bound) / max(lag, 1e-300))
    missed = (gap + left) / 2 * at_bound - left * lag * decay
    return command - sign * (left + left * decay), command * dt - sign * missed


@njit(error_model="numpy", cache=True)
def step_unicycles(
    positions: NDArray[np.float64],
    directions: NDArray[np.float64],
    headings: NDArray[np.float64],
    rates: NDArray[np.float64],
    commands: NDArray[np.float64],
    noise: NDArray[np.float64],
    values: NDArray[np.float64],
    dt: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """:func:`sb3_flock.sim.unicycle.step_unicycles` in one pass; equal up to the rounding of the exponential."""
    next_positions, next_headings = np.empty(positions.shape), np.empty(headings.shape)
    next_rates = np.empty(rates.shape)
    for flock in range(positions.shape[0]):
        speed_lag, turn_lag, acceleration, turn_acceleration, min_speed, slip, disturbance = (
            values[0, flock], values[1, flock], values[2, flock], values[3, flock], values[4, flock], values[5, flock],
            values[6, flock],
        )  # fmt: skip
        drift = disturbance * np.sqrt(dt)
        for i in range(positions.shape[1]):
            asked = max(commands[flock, i, 0], min_speed)
            speed, stride = _follow(rates[flock, i, 0], asked, speed_lag, acceleration, dt)
            turn_rate, turn = _follow(rates[flock, i, 1], commands[flock, i, 1], turn_lag, turn_acceleration, dt)
            stride *= max(1.0 + slip * noise[flock, i, 0], 0.0)
            for axis in range(2):
                moved = positions[flock, i, axis] + stride * directions[flock, i, axis]
                next_positions[flock, i, axis] = moved + drift * noise[flock, i, 1 + axis]
            next_headings[flock, i] = _wrap_angle(headings[flock, i] + turn)
            next_rates[flock, i, 0], next_rates[flock, i, 1] = speed, turn_rate
    return next_positions, next_headings, next_rates


Found = tuple["NDArray[np.int64]", "NDArray[np.int64]", "NDArray[np.float64]", "NDArray[np.float64]"]
"""Observers, bodies, positions in the observers' frames and distances: the arrays of a ``Contacts``."""


@njit(error_model="numpy", cache=True)
def sense(
    positions: NDArray[np.float64],
    frames: NDArray[np.float64],
    obstacle_positions: NDArray[np.float64],
    waypoints: NDArray[np.float64],
    link_range: float,
    detection_range: float,
) -> tuple[Found, Found, NDArray[np.float64], NDArray[np.float64]]:
    """:func:`sb3_flock.sim.sensing.sense` of few bodies: neighbors, obstacles, the waypoint's positions and distances."""
    waypoint_positions, waypoint_distances = np.empty(positions.shape), np.empty(positions.shape[:2])
    for flock in range(positions.shape[0]):
        for i in range(positions.shape[1]):
            cos, sin = frames[flock, i, 0], frames[flock, i, 1]
            x, y = waypoints[flock, 0] - positions[flock, i, 0], waypoints[flock, 1] - positions[flock, i, 1]
            waypoint_positions[flock, i, 0] = cos * x + sin * y
            waypoint_positions[flock, i, 1] = cos * y - sin * x
            waypoint_distances[flock, i] = math.sqrt(x * x + y * y)
    neighbors = find_contacts(positions, frames, positions, link_range, True)
    obstacles = find_contacts(positions, frames, obstacle_positions, detection_range, False)
    return neighbors, obstacles, waypoint_positions, waypoint_distances


@njit(error_model="numpy", cache=True)
def find_contacts(
    positions: NDArray[np.float64],
    frames: NDArray[np.float64],
    bodies: NDArray[np.float64],
    sensing_range: float,
    exclude_self: bool,
) -> Found:
    """:func:`sb3_flock.sim.sensing.find_contacts` by comparing all pairs of a flock."""
    n_flocks, n_vehicles, _ = positions.shape
    n_bodies = bodies.shape[1]
    capacity = n_flocks * n_vehicles * n_bodies
    observers, found = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    relative, distances = np.empty((capacity, 2)), np.empty(capacity)
    bound = 1.001 * sensing_range * sensing_range  # the root is taken of squares below this one alone
    n = 0
    for flock in range(n_flocks):
        for i in range(n_vehicles):
            cos, sin = frames[flock, i, 0], frames[flock, i, 1]
            for j in range(n_bodies):
                x = bodies[flock, j, 0] - positions[flock, i, 0]
                y = bodies[flock, j, 1] - positions[flock, i, 1]
                square = x * x + y * y
                if square > bound or (exclude_self and i == j):
                    continue
                distance = math.sqrt(square)
                if distance < sensing_range:
                    observers[n], found[n], distances[n] = flock * n_vehicles + i, j, distance
                    relative[n, 0], relative[n, 1] = cos * x + sin * y, cos * y - sin * x
                    n += 1
    return observers[:n], found[:n], relative[:n], distances[:n]


@njit(error_model="numpy", cache=True)
def find_contacts_by_cell(
    positions: NDArray[np.float64],
    frames: NDArray[np.float64],
    bodies: NDArray[np.float64],
    sensing_range: float,
    exclude_self: bool,
) -> Found:
    """:func:`sb3_flock.sim.sensing.find_contacts` by a list of the vehicles in each square cell of side ``sensing_range``.

    The cells are numbered by a hash, so that memory does not grow with the area. Each body looks for vehicles in the nine
    cells around it. The pairs found are then sorted by vehicle, which keeps the bodies of a vehicle in their order.
    """
    n_flocks, n_vehicles, _ = positions.shape
    size = 1
    while size < 2 * n_vehicles:
        size *= 2
    firsts, vehicles = np.empty(size + 1, np.int64), np.empty(n_vehicles, np.int64)
    columns, rows = np.empty(n_vehicles, np.int64), np.empty(n_vehicles, np.int64)
    counts = np.zeros(n_flocks * n_vehicles + 1, np.int64)
    capacity, n = 16 * n_vehicles, 0
    near, near_bodies = np.empty(capacity, np.int64), np.empty(capacity, np.int64)
    for flock in range(n_flocks):
        firsts[:] = 0
        for i in range(n_vehicles):
            columns[i] = math.floor(positions[flock, i, 0] / sensing_range)
            rows[i] = math.floor(positions[flock, i, 1] / sensing_range)
            firsts[_cell(columns[i], rows[i], size)] += 1
        firsts[:] = np.cumsum(firsts)
        for i in range(n_vehicles - 1, -1, -1):
            cell = _cell(columns[i], rows[i], size)
            firsts[cell] -= 1
            vehicles[firsts[cell]] = i
        for j in range(bodies.shape[1]):
            x, y = bodies[flock, j, 0], bodies[flock, j, 1]
            column, row = math.floor(x / sensing_range), math.floor(y / sensing_range)
            if n + n_vehicles > capacity:  # a body has at most as many observers
                capacity = 2 * capacity + n_vehicles
                near, near_bodies = _longer(near, capacity), _longer(near_bodies, capacity)
            for around_column in range(column - 1, column + 2):
                for around_row in range(row - 1, row + 2):
                    cell = _cell(around_column, around_row, size)
                    for i in vehicles[firsts[cell] : firsts[cell + 1]]:
                        if columns[i] != around_column or rows[i] != around_row or (exclude_self and i == j):
                            continue
                        dx, dy = x - positions[flock, i, 0], y - positions[flock, i, 1]
                        if math.sqrt(dx * dx + dy * dy) < sensing_range:
                            near[n], near_bodies[n] = flock * n_vehicles + i, j
                            counts[near[n] + 1] += 1
                            n += 1
    following = np.cumsum(counts)
    observers, found = np.empty(n, np.int64), np.empty(n, np.int64)
    relative, distances = np.empty((n, 2)), np.empty(n)
    for pair in range(n):
        observer, j = near[pair], near_bodies[pair]
        flock, i = observer // n_vehicles, observer % n_vehicles
        k = following[observer]
        following[observer] += 1
        cos, sin = frames[flock, i, 0], frames[flock, i, 1]
        x, y = bodies[flock, j, 0] - positions[flock, i, 0], bodies[flock, j, 1] - positions[flock, i, 1]
        observers[k], found[k], distances[k] = observer, j, math.sqrt(x * x + y * y)
        relative[k, 0], relative[k, 1] = cos * x + sin * y, cos * y - sin * x
    return observers, found, relative, distances


@njit(error_model="numpy", cache=True)
def find_occluded(
    observers: NDArray[np.int64],
    bodies: NDArray[np.int64],
    positions: NDArray[np.float64],
    radii: NDArray[np.float64],
    ends: NDArray[np.int64],
    near_bodies: NDArray[np.int64],
    near_positions: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """:func:`sb3_flock.sim.visibility.find_occluded`, one contact after the other."""
    hidden = np.zeros(len(observers), np.bool_)
    for contact in range(len(observers)):
        observer, x, y = observers[contact], positions[contact, 0], positions[contact, 1]
        square = x * x + y * y
        width = radii[contact] * math.sqrt(square)
        for near in range(ends[observer - 1] if observer else 0, ends[observer]):
            near_x, near_y = near_positions[near, 0], near_positions[near, 1]
            along, across = x * near_x + y * near_y, abs(x * near_y - y * near_x)
            if near_bodies[near] != bodies[contact] and 0 < along < square and across < width:
                hidden[contact] = True
                break
    return hidden


@njit(error_model="numpy", inline="always")
def _cell(column: int, row: int, size: int) -> int:
    """The number below ``size``, a power of two, of a cell."""
    return (column * 73856093 ^ row * 19349663) & (size - 1)


@njit(error_model="numpy")
def _longer(values: NDArray[np.int64], length: int) -> NDArray[np.int64]:
    longer = np.empty(length, np.int64)
    longer[: len(values)] = values
    return longer


@njit(error_model="numpy", cache=True)
def count_closer(
    observers: NDArray[np.int64], distances: NDArray[np.float64], closer_than: float, n_observers: int
) -> NDArray[np.int64]:
    """:meth:`sb3_flock.sim.sensing.Contacts.count`, flat."""
    counts = np.zeros(n_observers, np.int64)
    for k in range(len(observers)):
        counts[observers[k]] += distances[k] < closer_than
    return counts


@njit(error_model="numpy", cache=True)
def own_terms(
    neighbor_observers: NDArray[np.int64],
    neighbor_distances: NDArray[np.float64],
    obstacle_observers: NDArray[np.int64],
    obstacle_distances: NDArray[np.float64],
    waypoint_distances: NDArray[np.float64],
    actions: NDArray[np.float64],
    separations: tuple[float, float],
    weights: tuple[float, float, float, float, float],
    max_distance: float,
    scale: float,
) -> NDArray[np.float64]:
    """:func:`sb3_flock.sim.reward.own_terms` in one pass."""
    link_bonus, separation_penalty, obstacle_penalty, epsilon, beta = weights
    n_vehicles = waypoint_distances.shape[1]
    counts = count_closer(neighbor_observers, neighbor_distances, np.inf, waypoint_distances.size)
    violations = count_closer(neighbor_observers, neighbor_distances, separations[0], waypoint_distances.size)
    near_obstacles = count_closer(obstacle_observers, obstacle_distances, separations[1], waypoint_distances.size)
    terms = np.empty((4, *waypoint_distances.shape))
    for flock in range(len(waypoint_distances)):
        for i in range(n_vehicles):
            k = flock * n_vehicles + i
            linked = counts[k] - violations[k]
            speed, turn_rate = actions[flock, i, 0], actions[flock, i, 1]
            terms[0, flock, i] = scale * (link_bonus * linked - separation_penalty * violations[k])
            terms[1, flock, i] = scale * (-obstacle_penalty * near_obstacles[k])
            terms[2, flock, i] = scale * (-epsilon * min(waypoint_distances[flock, i], max_distance))
            terms[3, flock, i] = scale * (beta * (speed * speed + turn_rate * turn_rate))
    return terms


@njit(error_model="numpy", cache=True)
def mix_rewards(
    own: NDArray[np.float64], observers: NDArray[np.int64], neighbors: NDArray[np.int64], lambda_: float
) -> NDArray[np.float64]:
    """:func:`sb3_flock.sim.reward.mix_rewards`, flat."""
    counts, mixed = np.zeros(len(own), np.int64), np.zeros(len(own))
    for k in range(len(observers)):
        if not (0 <= observers[k] < len(own) and 0 <= neighbors[k] < len(own)):
            raise IndexError("observers and neighbors are numbers of vehicles, from 0")
        counts[observers[k]] += 1
        mixed[observers[k]] += own[neighbors[k]]
    for i in range(len(own)):
        mixed[i] = lambda_ * own[i] + (1 - lambda_) * (mixed[i] / counts[i]) if counts[i] else own[i]
    return mixed
