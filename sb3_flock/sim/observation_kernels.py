"""The observation by numba, whose numbers equal those of NumPy up to rounding.

The inner loops are written in LLVM's vectors, which LLVM splits where they are longer than the processor's. numba's own loops
over rows of 11 anchors take several times as long. All functions are in one file: numba's cache does not depend on other files.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

if TYPE_CHECKING:
    from numpy.typing import NDArray

_BLOCK = 128
"""Vehicles whose channels are all filled before the next vehicles'."""

_AHEAD = 1024
"""Single-precision numbers between what is written and the cache lines that are fetched for later writing."""

_LANES = 16
"""Numbers in a vector; rows of factors are padded with zeros to a multiple of it."""

_SERIES = tuple(1 / math.factorial(k) for k in range(9, -1, -1))
"""Coefficients of the exponential's series."""

_DOUBLES, _FLOATS = ir.VectorType(ir.DoubleType(), _LANES), ir.VectorType(ir.FloatType(), _LANES)


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
    ends = counts.copy()
    for channel in range(1, n_channels):
        ends[channel] += ends[channel - 1]
    following = ends - counts  # each channel's next body
    first = np.empty(n_channels, np.int64)  # the row of its factors
    of_vehicle = np.empty((_BLOCK, n_channels), np.int64)  # number of bodies
    factors = np.empty((2, 0, 0), np.float32)
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
        if rows + _LANES > factors.shape[1]:
            factors = np.empty((2, 2 * (rows + _LANES), -(-side // _LANES) * _LANES), np.float32)
        for channel in range(n_channels):
            start = following[channel]
            end = start + (first[channel + 1] if channel + 1 < n_channels else rows) - first[channel]
            _factors(factors[:, first[channel] :], positions[start:end], radii[channel], sigmas[channel], row)
            following[channel] = end
        for vehicle in range(block, block_end):
            for channel in range(n_channels):
                start, end = first[channel], first[channel] + of_vehicle[vehicle - block, channel]
                plane = (vehicle * n_channels + channel) * side * side
                _store_sum_of_products(flat, plane, factors, start, end, row)  # type: ignore[call-arg]
                first[channel] = end


@njit(error_model="numpy")
def _factors(
    factors: NDArray[np.float32], positions: NDArray[np.float64], radius: float, sigma: float, row: tuple[int, ...]
) -> None:
    """The factors of the bodies' Gaussians along x and y, ``factors[axis, body, anchor]``."""
    side = len(row)
    spacing = 2 * radius / (side - 1)
    step = spacing / sigma
    shrink = math.exp(-step * step)
    margin = 40.0 / step  # anchor spacings from the edge; a body farther out adds 0 everywhere
    x = np.zeros(len(positions) + _LANES)
    for axis in range(2):
        for i in range(len(positions)):
            x[i] = min(max((positions[i, axis] + radius) / spacing, -margin), side - 1 + margin)
        for i in range(0, len(positions), _LANES):
            _store_gaussians(factors[axis], i, x, step, shrink, row)  # type: ignore[call-arg]


def _padded(side: int) -> int:
    """The length of a row of ``side`` factors."""
    return -(-side // _LANES) * _LANES


@intrinsic
def _store_gaussians(_typing: Any, out: Any, body: Any, x: Any, step: Any, shrink: Any, row: Any) -> tuple[Any, Any]:
    """exp(-d^2 / 2) at every anchor for ``_LANES`` bodies, d the distance in units of sigma: ``out[body:, anchor]``.

    The ratio of neighboring anchors' values changes by the factor exp(-step^2) from anchor to anchor, so two exponentials a
    body do for all anchors. Lanes are bodies until the values are transposed.

    :param out: ``(bodies, padded)``, single precision
    :param x: positions in anchor spacings from the first anchor, ``(bodies,)``
    :param step: anchor spacing in units of sigma
    :param shrink: exp(-step^2)
    :param row: as many numbers as a row has anchors
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def data(number: int) -> Any:
            return context.make_array(signature.args[number])(context, builder, arguments[number]).data

        side, width, index = row.count, _padded(row.count), arguments[1].type
        here = builder.bitcast(builder.gep(data(2), [arguments[1]]), _DOUBLES.as_pointer())
        along, steps, shrinks = builder.load(here, align=8), *(_splat(builder, arguments[k], _DOUBLES) for k in (3, 4))
        distances = builder.fmul(along, steps)
        values = _exp(builder, builder.fmul(builder.fmul(distances, distances), _constant(-0.5)))
        ratios = _exp(builder, builder.fmul(builder.fmul(steps, steps), builder.fsub(along, _constant(0.5))))
        by_anchor = []
        for _ in range(side):
            by_anchor.append(builder.fptrunc(values, _FLOATS))
            values, ratios = builder.fmul(values, ratios), builder.fmul(ratios, shrinks)
        by_anchor += [ir.Constant(_FLOATS, [0.0] * _LANES)] * (width - side)
        base = builder.gep(data(0), [builder.mul(arguments[1], ir.Constant(index, width))])
        for first in range(0, width, _LANES):
            for lane, values in enumerate(_transposed(builder, by_anchor[first : first + _LANES])):
                there = builder.gep(base, [ir.Constant(index, lane * width + first)])
                builder.store(values, builder.bitcast(there, _FLOATS.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(out, types.intp, x, step, shrink, row), generate


@intrinsic
def _store_sum_of_products(
    _typing: Any, out: Any, at: Any, factors: Any, first: Any, last: Any, row: Any
) -> tuple[Any, Any]:
    """The l^2 numbers from ``out[at]`` on become the sums of ``factors[0, i, a] * factors[1, i, b]`` over first <= i < last.

    Each row of sums stays in a register over all bodies. A row is stored with its padding where the next rows overwrite that.

    :param out: flat, single precision
    :param factors: ``(2, bodies, padded)``, along x and along y
    :param row: as many numbers as a row has anchors
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def constant(value: int) -> Any:
            return ir.Constant(arguments[1].type, value)

        def pointer(base: Any, offset: Any, vector: Any) -> Any:
            return builder.bitcast(builder.gep(base, [offset]), vector.as_pointer())

        side, width = row.count, _padded(row.count)
        wide, narrow = (ir.VectorType(ir.FloatType(), length) for length in (width, side))
        base = context.make_array(out)(context, builder, arguments[0]).data
        array = context.make_array(factors)(context, builder, arguments[2])
        along_x = array.data
        along_y = builder.gep(along_x, [builder.mul(builder.extract_value(array.shape, 1), constant(width))])

        _prefetch(
            builder, [builder.gep(base, [builder.add(arguments[1], constant(_AHEAD + k))]) for k in range(0, side**2, 16)]
        )
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
        across = builder.load(pointer(along_y, place, wide), align=4)
        for a, total in enumerate(sums):
            factor = builder.load(builder.gep(along_x, [builder.add(place, constant(a))]))
            total.add_incoming(ir.Constant(wide, [0.0] * width), before)
            total.add_incoming(builder.fadd(total, builder.fmul(_splat(builder, factor, wide), across)), add)
        body.add_incoming(builder.add(body, constant(1)), add)
        builder.branch(test)

        builder.position_at_end(store)
        for a, total in enumerate(sums):
            offset = builder.add(arguments[1], constant(a * side))
            if a * side + width <= side * side:
                builder.store(total, pointer(base, offset, wide), align=4)
            else:
                exact = builder.shuffle_vector(total, total, _mask(range(side)))
                builder.store(exact, pointer(base, offset, narrow), align=4)
        return context.get_dummy_value()

    return types.void(out, types.intp, factors, types.intp, types.intp, row), generate


def _prefetch(builder: Any, pointers: list[Any]) -> None:
    """Fetch cache lines that will be written; beyond the end of an array this does nothing."""
    address, number = ir.IntType(8).as_pointer(), ir.IntType(32)
    signature = ir.FunctionType(ir.VoidType(), [address, number, number, number])
    prefetch = builder.module.declare_intrinsic("llvm.prefetch", [address], signature)
    to_write, to_second_level, data = (ir.Constant(number, value) for value in (1, 2, 1))
    for pointer in pointers:
        builder.call(prefetch, [builder.bitcast(pointer, address), to_write, to_second_level, data])


def _exp(builder: Any, t: Any) -> Any:
    """exp(t): that of t / 1024 by its series, squared ten times.

    Relative error: 3e-13 up to 100 either way, 2e-9 at 300, 4e-7 at -500, where the result is 0 in single precision.
    """
    u = builder.fmul(t, _constant(1 / 1024))
    power = _constant(0.0)
    for term in _SERIES:
        power = builder.fadd(builder.fmul(power, u), _constant(term))
    for _ in range(10):
        power = builder.fmul(power, power)
    return power


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """A square of ``_LANES`` vectors transposed: blocks of 1, 2, 4, ... change places across the diagonal."""
    block = 1
    while block < _LANES:
        upper = _mask(_LANES + k - block if k & block else k for k in range(_LANES))
        lower = _mask(_LANES + k if k & block else k + block for k in range(_LANES))
        for i in range(_LANES):
            if not i & block:
                pair = rows[i], rows[i + block]
                rows[i], rows[i + block] = builder.shuffle_vector(*pair, upper), builder.shuffle_vector(*pair, lower)
        block *= 2
    return rows


def _splat(builder: Any, value: Any, vector: Any) -> Any:
    """A vector with the value in every lane."""
    undefined = ir.Constant(vector, ir.Undefined)
    one = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(one, undefined, _mask([0] * vector.count))


def _mask(lanes: Any) -> Any:
    """Which lanes of two vectors a shuffle takes."""
    chosen = list(lanes)
    return ir.Constant(ir.VectorType(ir.IntType(32), len(chosen)), chosen)


def _constant(value: float) -> Any:
    return ir.Constant(_DOUBLES, [value] * _LANES)
