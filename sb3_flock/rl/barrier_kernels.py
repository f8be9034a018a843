"""A barrier between two threads that run compiled code, on numbers in shared memory; POSIX alone, for its ``sched_yield``."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

ABORTED = 2**62
"""Arrivals of a thread that has ended early: the other waits no longer."""

_SPINS = 1000
"""Reads before a waiting thread yields its core."""


def new_barrier() -> NDArray[np.int64]:
    """Memory of a barrier of two threads: the arrivals of each, on cache lines of their own."""
    return np.zeros((2, 16), np.int64)


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    view = context.make_array(array_type)(context, builder, array)
    return cgutils.get_item_pointer(context, builder, array_type, view, [index, context.get_constant(types.intp, 0)])


@intrinsic
def _load(typing_context: Any, barrier: Any, thread: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        pointer = _pointer(context, builder, signature.args[0], *arguments)
        return builder.load_atomic(pointer, "acquire", 8)

    return types.int64(barrier, types.intp), generate


@intrinsic
def _store(typing_context: Any, barrier: Any, thread: Any, arrivals: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, index, value = arguments
        builder.store_atomic(value, _pointer(context, builder, signature.args[0], array, index), "release", 8)
        return context.get_dummy_value()

    return types.void(barrier, types.intp, types.int64), generate


@intrinsic
def _yield_core(typing_context: Any) -> Any:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        function = cgutils.get_or_insert_function(builder.module, ir.FunctionType(ir.IntType(32), ()), "sched_yield")
        builder.call(function, ())
        return context.get_dummy_value()

    return types.void(), generate


@njit(error_model="numpy", cache=True, nogil=True)
def wait_for_other(barrier: NDArray[np.int64], thread: int) -> bool:
    """Return once both threads have called this the same number of times.

    :param barrier: from :func:`new_barrier`; filled with :data:`ABORTED` by a thread that ends early
    :param thread: 0 or 1
    :return: whether both threads go on
    """
    arrivals = _load(barrier, thread) + 1  # type: ignore[call-arg]
    _store(barrier, thread, arrivals)
    spins, theirs = 0, _load(barrier, 1 - thread)
    while theirs < arrivals and theirs != ABORTED:
        spins += 1
        if spins > _SPINS:
            _yield_core()
        theirs = _load(barrier, 1 - thread)
    return theirs != ABORTED
