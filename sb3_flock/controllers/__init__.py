"""Everything that drives vehicles without learning, behind one base class: baseline controllers and the privileged expert.

``evaluate(make_controller("orca"), scenario)`` evaluates a baseline controller like a policy. Every module of this package
is imported here, so that a new controller is one new file that registers itself.
"""

from __future__ import annotations

import importlib
import pkgutil

from sb3_flock.controllers.base import (
    CONTROLLERS,
    EXPERTS,
    Controller,
    make_controller,
    register_controller,
    register_expert,
)

for _module in pkgutil.iter_modules(__path__):
    if not _module.name.endswith("_kernels"):  # compiled code is imported when it is needed
        importlib.import_module(f"{__name__}.{_module.name}")

__all__ = [
    "CONTROLLERS",
    "EXPERTS",
    "Controller",
    "make_controller",
    "register_controller",
    "register_expert",
]
