"""The environment's registration with PettingZoo as ``flock/flocking-v0``, as soon as PettingZoo is imported.

PettingZoo and gymnasium take most of the time that importing this package would take with them.
"""

from __future__ import annotations

import importlib.abc
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

_ID, _MODULE = "flock/flocking-v0", "sb3_flock.envs.flocking_v0"


class _Loader(importlib.abc.Loader):
    """Lets the loader that was found load PettingZoo, then registers the environment."""

    def __init__(self, found: importlib.abc.Loader) -> None:
        self.found = found

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self.found.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        module.__loader__ = self.found
        if module.__spec__ is not None:
            module.__spec__.loader = self.found
        self.found.exec_module(module)
        _register(module)


class _Finder(importlib.abc.MetaPathFinder):
    """Finds PettingZoo as the other finders do."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        if fullname != "pettingzoo":
            return None
        specs = (finder.find_spec(fullname, path, target) for finder in sys.meta_path if finder is not self)
        spec = next((spec for spec in specs if spec is not None), None)
        if spec is not None and spec.loader is not None:
            spec.loader = _Loader(spec.loader)
        return spec


def _register(pettingzoo: ModuleType) -> None:
    if _ID not in pettingzoo.parallel_registry:
        pettingzoo.register("parallel", _ID, entry_point=f"{_MODULE}:parallel_env")
        pettingzoo.register("aec", _ID, entry_point=f"{_MODULE}:env")


def install() -> None:
    """Register the environment now, if PettingZoo is imported already, else when it is."""
    if "pettingzoo" in sys.modules:
        _register(sys.modules["pettingzoo"])
    elif not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
