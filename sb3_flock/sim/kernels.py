"""The inner loops of the world, compiled by numba: twins of the functions named in their docstrings, tested against them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

if TYPE_CHECKING:
    from numpy.typing import NDArray

_CHUNK = 64
"""Bodies whose factors are computed together."""

_BLOCK = 256
"""Vehicles whose channels are all filled before the next vehicles'."""

_LANES = 16
"""Single-precision numbers in the longest vector of today's processors; LLVM splits it where they are shorter."""

_SERIES = tuple(1 / math.factorial(k) for k in range(9, -1, -1))
"""Coefficients of the exponential's series."""


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
def mix_rewards(
    own: NDArray[np.float64], observers: NDArray[np.int64], neighbors: NDArray[np.int64], lambda_: float
) -> NDArray[np.float64]:
    """:func:`sb3_flock.sim.reward.mix_rewards`, flat."""
    counts, mixed = np.zeros(len(own), np.int64), np.zeros(len(own))
    for k in range(len(observers)):
        counts[observers[k]] += 1
        mixed[observers[k]] += own[neighbors[k]]
    for i in range(len(own)):
        mixed[i] = lambda_ * own[i] + (1 - lambda_) * (mixed[i] / counts[i]) if counts[i] else own[i]
    return mixed


@njit(error_model="numpy", cache=True)
def rasterize(
    channels: NDArray[np.float32],
    counts: NDArray[np.int64],
    observers: NDArray[np.int64],
    positions: NDArray[np.float64],
    radii: NDArray[np.float64],
    sigmas: NDArray[np.float64],
    row: tuple[int, ...],
) -> None:
    """:func:`sb3_flock.sim.observation.rasterize` for all channels, some vehicles at a time, which stay in the cache meanwhile.

    :param channels: ``(vehicles, channels, l, l)``, C-contiguous
    :param counts: number of bodies in each channel; ``observers`` and ``positions`` hold them channel after channel
    :param radii: half width of each channel [m]
    :param sigmas: standard deviation of each channel [m]
    :param row: as many numbers as a row has anchors: numba knows a tuple's length at compile time and unrolls the loops
    """
    n_channels, side, flat = len(counts), len(row), channels.reshape(-1)
    ends = np.cumsum(counts)
    following = ends - counts  # each channel's next body
    first = np.empty(n_channels, np.int64)  # the row of its factors
    of_vehicle = np.empty((_BLOCK, n_channels), np.int64)  # number of bodies
    factors = np.empty((2, 0, 0), np.float32)
    scratch = np.zeros((2, _CHUNK)), np.empty((side, _CHUNK), np.float32)
    for block in range(0, len(channels), _BLOCK):
        block_end = min(block + _BLOCK, len(channels))
        of_vehicle[:] = 0
        rows = 0
        for channel in range(n_channels):
            body = following[channel]
            first[channel] = rows
            while body < ends[channel] and observers[body] < block_end:
                of_vehicle[observers[body] - block, channel] += 1
                body += 1
                rows += 1
        if rows > factors.shape[1]:
            factors = np.zeros((2, 2 * rows, -(-side // _LANES) * _LANES), np.float32)
        for channel in range(n_channels):
            start = following[channel]
            end = start + (first[channel + 1] if channel + 1 < n_channels else rows) - first[channel]
            _factors(factors[:, first[channel] :], positions[start:end], radii[channel], sigmas[channel], scratch, row)
            following[channel] = end
        for vehicle in range(block, block_end):
            for channel in range(n_channels):
                start, end = first[channel], first[channel] + of_vehicle[vehicle - block, channel]
                plane = (vehicle * n_channels + channel) * side * side
                _store_sum_of_products(flat, plane, factors, start, end, row)  # type: ignore[call-arg]
                first[channel] = end


@njit(error_model="numpy")
def _factors(
    factors: NDArray[np.float32],
    positions: NDArray[np.float64],
    radius: float,
    sigma: float,
    scratch: tuple[NDArray[np.float64], NDArray[np.float32]],
    row: tuple[int, ...],
) -> None:
    """The factors of the bodies' Gaussians along x and y, ``factors[axis, body, anchor]``."""
    side = len(row)
    spacing = 2 * radius / (side - 1)
    step = spacing / sigma
    margin = 40.0 / step  # anchor spacings from the edge; a body farther out adds 0 everywhere
    x, ratios, along = scratch[0][0], scratch[0][1], scratch[1]
    for start in range(0, len(positions), _CHUNK):
        count = min(_CHUNK, len(positions) - start)
        for axis in range(2):
            for i in range(count):
                x[i] = min(max((positions[start + i, axis] + radius) / spacing, -margin), side - 1 + margin)
            _gaussians(along, x, ratios, step, row)
            for i in range(count):
                for anchor in range(side):
                    factors[axis, start + i, anchor] = along[anchor, i]


@njit(error_model="numpy")
def _gaussians(
    out: NDArray[np.float32], x: NDArray[np.float64], ratios: NDArray[np.float64], step: float, row: tuple[int, ...]
) -> None:
    """exp(-d^2 / 2) at every anchor (rows) for every body (columns), d the distance in units of sigma.

    The ratio of neighboring anchors' values changes by the factor exp(-step^2) from anchor to anchor, so two exponentials a
    body do for all anchors. The anchors are ``step`` sigma apart; x counts them from the first one. x and ``ratios`` are
    overwritten.
    """
    shrink = math.exp(-step * step)
    for i in range(_CHUNK):
        ratios[i] = _exp(step * step * (x[i] - 0.5))
    for i in range(_CHUNK):
        x[i] = _exp(-0.5 * (x[i] * step) ** 2)
    for anchor in range(len(row)):
        for i in range(_CHUNK):
            out[anchor, i] = x[i]
        for i in range(_CHUNK):
            x[i] *= ratios[i]
        for i in range(_CHUNK):
            ratios[i] *= shrink


@intrinsic
def _store_sum_of_products(
    _context: Any, out: Any, at: Any, factors: Any, first: Any, last: Any, row: Any
) -> tuple[Any, Any]:
    """The l^2 numbers from ``out[at]`` on become the sums of ``factors[0, i, a] * factors[1, i, b]`` over first <= i < last.

    Written in LLVM's vectors: each row of sums is one vector of ``_LANES`` numbers (a multiple of them in a long row), held in
    a register over all bodies. numba's own loops over rows of 11 take four times as long. A row is stored with the lanes
    beyond its end where the next rows overwrite these.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def array(number: int) -> Any:
            return context.make_array(signature.args[number])(context, builder, arguments[number])

        def constant(value: int) -> Any:
            return ir.Constant(arguments[1].type, value)

        def pointer(base: Any, offset: Any, lanes: int) -> Any:
            return builder.bitcast(builder.gep(base, [offset]), ir.VectorType(number, lanes).as_pointer())

        def lanes_of(vector: Any, lanes: list[int]) -> Any:
            return builder.shuffle_vector(vector, undefined, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes))

        side = row.count
        width = -(-side // _LANES) * _LANES
        number = ir.FloatType()
        wide = ir.VectorType(number, width)
        undefined = ir.Constant(wide, ir.Undefined)
        base, x = array(0).data, array(2).data
        y = builder.gep(x, [builder.mul(builder.extract_value(array(2).shape, 1), constant(width))])

        before = builder.block
        test, add, store = (builder.append_basic_block(name) for name in ("test", "add", "store"))
        builder.branch(test)
        builder.position_at_end(test)
        body = builder.phi(arguments[3].type)
        body.add_incoming(arguments[3], before)
        sums = [builder.phi(wide) for _ in range(side)]
        builder.cbranch(builder.icmp_signed("<", body, arguments[4]), add, store)

        builder.position_at_end(add)
        place = builder.mul(body, constant(width))
        along_y = builder.load(pointer(y, place, width), align=4)
        for a, total in enumerate(sums):
            factor = builder.load(builder.gep(x, [builder.add(place, constant(a))]))
            same = lanes_of(builder.insert_element(undefined, factor, ir.Constant(ir.IntType(32), 0)), [0] * width)
            total.add_incoming(ir.Constant(wide, [0.0] * width), before)
            total.add_incoming(builder.fadd(total, builder.fmul(same, along_y)), add)
        body.add_incoming(builder.add(body, constant(1)), add)
        builder.branch(test)

        builder.position_at_end(store)
        for a, total in enumerate(sums):
            fits = a * side + width <= side * side
            values = total if fits else lanes_of(total, list(range(side)))
            offset = builder.add(arguments[1], constant(a * side))
            builder.store(values, pointer(base, offset, width if fits else side), align=4)
        return context.get_dummy_value()

    return types.void(out, at, factors, types.intp, types.intp, row), generate


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
