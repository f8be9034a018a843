"""How obstacles start and move, besides the paper's random walk: crossing obstacles, and the registry of further motions.

A further motion is a subclass of :class:`ObstacleMotion` registered with :func:`register_obstacle_motion`; the scenario's field
``obstacle_motion`` names it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from sb3_flock.settings import suggest

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

WALK = "walk"
"""The paper's random walk (section V), which the world has itself."""
_SLOWEST_CROSSING = 0.6
"""Lowest speed of a crossing obstacle [top speeds]: such an obstacle reaches the origin after 100 to 167 steps, when the
flock is there."""


class MotionSettings(Protocol):
    """The fields of a scenario that motions mostly need; a motion is given the whole scenario."""

    n_obstacles: int
    max_cycles: int
    time_step: float
    obstacle_max_speed: float
    arena: float
    link_range: float

    @property
    def obstacle_half_side(self) -> float:
        """Half side of the square of the obstacles [m]."""


class ObstacleMotion(ABC):
    """Where obstacles start, and their controls of a whole episode. They are unicycles that turn back at the arena's sides.

    An object serves one world. Random numbers come from the generator of the episode alone.

    :param settings: the task
    """

    def __init__(self, settings: MotionSettings) -> None:
        self.settings = settings

    @abstractmethod
    def start(self, rng: Generator, waypoint: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where an obstacle without a place in ``obstacle_starts`` starts; drawn again if a vehicle is too near.

        :param waypoint: its start, ``(2,)`` [m]
        :return: ``(2,)`` [m]
        """

    @abstractmethod
    def headings(self, rng: Generator, starts: NDArray[np.float64], waypoint: NDArray[np.float64]) -> NDArray[np.float64]:
        """The headings at the start.

        :param starts: of all obstacles, ``(obstacles, 2)`` [m]
        :return: ``(obstacles,)`` [rad]
        """

    @abstractmethod
    def controls(self, rng: Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The controls of every step.

        :return: speeds, from 0 to ``obstacle_max_speed`` [m/s], and turn rates [rad/s], each ``(max_cycles, obstacles)``
        """


OBSTACLE_MOTIONS: dict[str, type[ObstacleMotion]] = {}
"""Motions of obstacles by name, besides the random walk."""

_Motion = TypeVar("_Motion", bound=type[ObstacleMotion])


def register_obstacle_motion(name: str) -> Callable[[_Motion], _Motion]:
    """Register a motion of obstacles under a name, as a decorator of a subclass of :class:`ObstacleMotion`.

    :raises ValueError: if the name is taken, or for something else than a subclass
    """

    def register(motion: _Motion) -> _Motion:
        if not (isinstance(motion, type) and issubclass(motion, ObstacleMotion)):
            raise ValueError(f"obstacle motion {name!r}: a subclass of ObstacleMotion is needed")
        if name == WALK or OBSTACLE_MOTIONS.setdefault(name, motion) is not motion:
            raise ValueError(f"obstacle motion {name!r} is registered already")
        return motion

    return register


def check_obstacle_motion(name: str) -> str:
    """A name that is known, for the fields of settings.

    :raises ValueError: for any other
    """
    if name != WALK and name not in OBSTACLE_MOTIONS:
        known = (WALK, *OBSTACLE_MOTIONS)
        raise ValueError(
            f"obstacle_motion = {name}: the name of a motion registered with register_obstacle_motion is needed; registered are "
            f"{', '.join(known)}{suggest(name, known)}"
        )
    return name


@register_obstacle_motion("crossing")
class Crossing(ObstacleMotion):
    """Straight through the flock from its far side: opposite the waypoint, aimed at where the flock will be."""

    def start(self, rng: Generator, waypoint: NDArray[np.float64]) -> NDArray[np.float64]:
        """On a quarter of a circle behind the origin."""
        behind = math.atan2(-waypoint[1], -waypoint[0])
        angle = behind + rng.uniform(-np.pi / 4, np.pi / 4)
        return self.settings.obstacle_half_side * np.array([math.cos(angle), math.sin(angle)])

    def headings(self, rng: Generator, starts: NDArray[np.float64], waypoint: NDArray[np.float64]) -> NDArray[np.float64]:
        """At the origin, within a link range."""
        aims = rng.uniform(-self.settings.link_range, self.settings.link_range, starts.shape) - starts
        return np.arctan2(aims[:, 1], aims[:, 0])

    def controls(self, rng: Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """A constant speed each, and no turns."""
        shape, top = (self.settings.max_cycles, self.settings.n_obstacles), self.settings.obstacle_max_speed
        return np.broadcast_to(rng.uniform(_SLOWEST_CROSSING * top, top, shape[1]), shape), np.zeros(shape)
