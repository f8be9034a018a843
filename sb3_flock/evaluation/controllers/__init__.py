"""Hand-written controllers behind the interface of a policy, ``evaluate(make_controller("orca"), scenario)``, and teachers."""

from __future__ import annotations

from collections.abc import Callable

from sb3_flock.envs.demonstrations import Teacher
from sb3_flock.evaluation.controllers.foresight import Foresight
from sb3_flock.evaluation.controllers.olfati_saber import OlfatiSaber
from sb3_flock.evaluation.controllers.orca import Orca
from sb3_flock.evaluation.controllers.simple import GoToWaypoint, RandomController
from sb3_flock.evaluation.episodes import Controller
from sb3_flock.settings import SettingsError
from sb3_flock.sim import World

CONTROLLERS: dict[str, type[Controller]] = {
    "random": RandomController,
    "go-to-waypoint": GoToWaypoint,
    "olfati-saber": OlfatiSaber,
    "orca": Orca,
}
"""The controllers by name."""

TEACHERS: dict[str, Callable[[World], Teacher]] = {
    "olfati-saber": lambda world: OlfatiSaber(),
    "orca": lambda world: Orca(),
    "foresight": Foresight,
}
"""Who can fly and advise for a policy to learn from, by name. A teacher may see the whole world, a controller may not."""

__all__ = [
    "CONTROLLERS",
    "TEACHERS",
    "Foresight",
    "GoToWaypoint",
    "OlfatiSaber",
    "Orca",
    "RandomController",
    "make_controller",
]


def make_controller(name: str) -> Controller:
    """A controller by its name.

    :raises SettingsError: for an unknown name, or if its library is not installed
    """
    if name not in CONTROLLERS:
        raise SettingsError(f"controller = {name!r}: one of {', '.join(CONTROLLERS)} is needed")
    return CONTROLLERS[name]()
