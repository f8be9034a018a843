"""The base class of everything that drives vehicles, and the registry of controllers by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.settings import SettingsError, suggest
from sb3_flock.sim import Scenario, Sensing


class Controller(ABC):
    """Drives every vehicle of every flock: a learned policy, a baseline controller or a privileged expert.

    One instance drives one batch of flocks at a time. The defaults are those of a controller without memory.
    """

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:  # noqa: B027 - a no-op by default
        """Start episodes.

        :param rngs: one generator a flock, which a controller that draws random numbers uses
        :param scenario: the task
        """

    @abstractmethod
    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.floating]:
        """The actions ``(flocks, vehicles, 2)``: speed [m/s] and turn rate [rad/s].

        :param sensing: what every vehicle measures; a vehicle's action may depend on its own part alone
        :param scenario: the task
        """

    def state_dict(self) -> dict[str, Any]:
        """The memory of the current episodes: plain values and arrays."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:  # noqa: B027 - a no-op by default
        """Restore :meth:`state_dict`."""


CONTROLLERS: dict[str, type[Controller]] = {}
"""Baseline controllers by name."""

EXPERTS: dict[str, Callable[..., Controller]] = {}
"""Experts by name: functions of the world, which an expert may see whole, and of the config's ``mpc`` settings."""


def register_controller(name: str) -> Callable[[type[Controller]], type[Controller]]:
    """Register a class of baseline controllers under a name, as a decorator; the class is made without arguments.

    :raises ValueError: if the name is taken
    """

    def register(controller: type[Controller]) -> type[Controller]:
        if CONTROLLERS.setdefault(name, controller) is not controller:
            raise ValueError(f"controller {name!r} is registered already")
        return controller

    return register


def register_expert(name: str, make: Callable[..., Controller]) -> None:
    """Register an expert under a name, for ``train_env.expert``.

    :param make: called with a :class:`~sb3_flock.sim.World` of the flocks that it acts for, one or several, and the settings
        of the MPC expert
    :raises ValueError: if the name is taken
    """
    if EXPERTS.setdefault(name, make) is not make:
        raise ValueError(f"expert {name!r} is registered already")


def make_controller(name: str) -> Controller:
    """A baseline controller by its name.

    :raises SettingsError: for an unknown name, or if its library is not installed
    """
    if name not in CONTROLLERS:
        raise SettingsError(f"controller = {name!r}: one of {', '.join(CONTROLLERS)} is needed{suggest(name, CONTROLLERS)}")
    return CONTROLLERS[name]()
