"""Access to the numba kernels where numba is installed."""

from __future__ import annotations

import functools
import importlib
from types import ModuleType


@functools.cache
def compiled(module: str = "kernels") -> ModuleType | None:
    """A module of ``sb3_flock.sim`` with kernels, or ``None`` where numba (the ``fast`` extra) is not installed."""
    try:
        return importlib.import_module(f"sb3_flock.sim.{module}")
    except (ImportError, RuntimeError):  # RuntimeError: there is no folder where numba may keep its cache
        return None
