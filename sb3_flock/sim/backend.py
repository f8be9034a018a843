"""Access to the numba kernels where numba is installed."""

from __future__ import annotations

import functools
import importlib
from types import ModuleType


@functools.cache
def compiled() -> ModuleType | None:
    """:mod:`sb3_flock.sim.kernels`, or ``None`` where numba (the ``fast`` extra) is not installed."""
    try:
        return importlib.import_module("sb3_flock.sim.kernels")
    except (ImportError, RuntimeError):  # RuntimeError: there is no folder where numba may keep its cache
        return None
