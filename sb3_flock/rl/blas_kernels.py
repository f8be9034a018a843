"""Matrix products by the BLAS that torch brings with it (MKL on x86), for compiled code.

numba's own ``np.dot`` goes to SciPy's OpenBLAS, which takes 1.2 to 1.6 times as long for the products of an update. Matrices are
float32 and contiguous. MKL's rounding depends on how memory is aligned: matrices are parts of memory that torch allocated.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from llvmlite import binding, ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

Array = NDArray[np.float32]

_SYMBOL = "sb3_flock_sgemm"
_NO, _YES = ord("N"), ord("T")


def _find_sgemm() -> int:
    """The address of torch's ``sgemm_``.

    :raises ImportError: if torch's library has none
    """
    for path in sorted((Path(th.__file__).parent / "lib").glob("libtorch_cpu.*")):
        function = getattr(ctypes.CDLL(str(path)), "sgemm_", None)
        if function is not None:
            return ctypes.cast(function, ctypes.c_void_p).value or 0
    raise ImportError("torch's library has no sgemm_")


binding.add_symbol(_SYMBOL, _find_sgemm())


@intrinsic
def _sgemm(
    typing_context: Any,
    transpose_a: Any,
    transpose_b: Any,
    m: Any,
    n: Any,
    k: Any,
    a: Any,
    row_a: Any,
    b: Any,
    row_b: Any,
    out: Any,
    row_out: Any,
) -> Any:
    """BLAS's ``sgemm`` on columns: out = op(a) op(b), ``(m, n)``."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        def letter(value: Any) -> Any:
            return cgutils.alloca_once_value(builder, builder.trunc(value, ir.IntType(8)))

        def integer(value: Any) -> Any:
            return cgutils.alloca_once_value(builder, builder.trunc(value, ir.IntType(32)))

        def data(position: int) -> Any:
            return context.make_array(signature.args[position])(context, builder, arguments[position]).data

        one, zero = (cgutils.alloca_once_value(builder, ir.Constant(ir.FloatType(), value)) for value in (1.0, 0.0))
        m, n, k, row_a, row_b, row_out = (integer(arguments[position]) for position in (2, 3, 4, 6, 8, 10))
        pointers = [
            letter(arguments[0]), letter(arguments[1]), m, n, k, one, data(5), row_a, data(7), row_b, zero, data(9), row_out,
        ]  # fmt: skip
        of_bytes = cgutils.voidptr_t
        function_type = ir.FunctionType(ir.VoidType(), [of_bytes] * len(pointers))
        function = cgutils.get_or_insert_function(builder.module, function_type, _SYMBOL)
        builder.call(function, [builder.bitcast(pointer, of_bytes) for pointer in pointers])
        return context.get_dummy_value()

    integers = (types.int64,) * 5
    signature = types.void(*integers, a, types.int64, b, types.int64, out, types.int64)
    return signature, generate


@njit(error_model="numpy", cache=True)
def product(a: Array, b: Array, out: Array) -> None:
    """The product a b."""
    (m, k), n = a.shape, b.shape[1]  # BLAS's columns are NumPy's rows: it computes the transposed product of swapped factors
    _sgemm(_NO, _NO, n, m, k, b, n, a, k, out, n)  # type: ignore[call-arg]


@njit(error_model="numpy", cache=True)
def product_transposed(a: Array, b: Array, out: Array) -> None:
    """The product a b^T."""
    (m, k), n = a.shape, b.shape[0]
    _sgemm(_YES, _NO, n, m, k, b, k, a, k, out, n)  # type: ignore[call-arg]


@njit(error_model="numpy", cache=True)
def transposed_product(a: Array, b: Array, out: Array) -> None:
    """The product a^T b."""
    (k, m), n = a.shape, b.shape[1]
    _sgemm(_NO, _YES, n, m, k, b, n, a, m, out, n)  # type: ignore[call-arg]
