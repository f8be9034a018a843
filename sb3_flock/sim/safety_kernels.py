"""The inner loop of the safety filter, compiled by numba: the twin of the function named in its docstring."""

from __future__ import annotations

from typing import TYPE_CHECKING

from numba import njit

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


@njit(cache=True)
def limit_speeds(
    speeds: NDArray[np.float64],
    floors: NDArray[np.float64],
    observers: NDArray[np.int64],
    strides: NDArray[np.float64],
    budgets: NDArray[np.float64],
    rounding: float,
) -> NDArray[np.float64]:
    """:func:`sb3_flock.sim.safety.limit_speeds`, one contact after the other."""
    limited = speeds.copy()
    for contact, i in enumerate(observers):
        allowed = budgets[contact] - 2 * rounding
        if strides[contact] > 0 and strides[contact] * speeds[i] > allowed:
            limited[i] = min(limited[i], max(allowed, 0.0) / strides[contact])
    result = limited.copy()
    for contact, i in enumerate(observers):
        if strides[contact] * limited[i] > budgets[contact] - rounding:
            result[i] = floors[i]
    return result
