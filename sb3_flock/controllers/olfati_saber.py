"""Olfati-Saber's flocking with obstacles (*Flocking for multi-agent dynamic systems*, IEEE TAC 51(3), 2006, Algorithm 3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.controllers.base import Controller, register_controller, register_expert
from sb3_flock.controllers.motion import Velocities, limit, steer
from sb3_flock.sim import Contacts, Scenario, Sensing
from sb3_flock.sim.sensing import compensate_ego_motion, rotate


@dataclass(frozen=True)
class OlfatiGains:
    """Gains of the controller; lengths in meters."""

    spacing: float = 0.14
    """Desired distance between neighbors d."""
    obstacle_distance: float = 0.18
    """Distance at which obstacles start to repel d'."""
    alpha: float = 31.0
    """Weight of the neighbors' potential c1."""
    alpha_damping: float = 0.91
    """Weight of the neighbors' velocities c2."""
    beta: float = 93.0
    """Weight of the obstacles' potential."""
    beta_damping: float = 0.56
    """Weight of the obstacles' velocities."""
    gamma: float = 75.0
    """Weight of the distance to the waypoint."""
    gamma_damping: float = 0.54
    """Weight of the velocity relative to the waypoint's."""


@register_controller("olfati-saber")
class OlfatiSaber(Controller):
    """u_i = u_i^alpha + u_i^beta + u_i^gamma, an acceleration, applied to a unicycle.

    The lattice is scaled so that its d of 7 is ``spacing`` (as in the article's experiments: epsilon 0.1, a = b = 5,
    h 0.2 for neighbors and 0.9 for obstacles). An obstacle is a point (R_k = 0): its beta-agent stands at it and moves with
    it. The waypoint is the gamma-agent. Accelerations integrate to a desired velocity, which :func:`steer` turns into speed
    and turn rate. Velocities of other bodies come from :class:`Velocities`.

    :param gains: the weights; the default is the best of a search on separate episodes (``tests/benchmarks/tune_controllers.py``)
    """

    def __init__(self, gains: OlfatiGains | None = None) -> None:
        self.gains = gains or OlfatiGains()

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Clear the memory of the last episode."""
        self._neighbors, self._obstacles = Velocities(), Velocities()
        self._velocities = np.zeros((len(rngs), scenario.n_vehicles, 2))
        self._waypoints: NDArray[np.float64] | None = None

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.float64]:
        """The actions ``(flocks, vehicles, 2)`` [m/s, rad/s]."""
        gains, dt = self.gains, scenario.time_step
        unit = gains.spacing / _D  # meters a unit of the lattice
        own = rotate(self._velocities, -sensing.ego_motion[..., 1])  # its velocity in its present frame
        acceleration = np.zeros_like(own)

        contacts = sensing.neighbors
        velocities = self._neighbors.update(contacts, scenario.n_vehicles, sensing.ego_motion, dt)
        offsets = contacts.positions / unit
        sigma, reach = _sigma_norm(offsets), _sigma_norm(np.array([scenario.link_range / unit, 0.0]))
        pull = _bump(sigma / reach, 0.2) * _uneven_sigmoid(sigma - _sigma_norm(np.array([_D, 0.0])))
        agreement = _bump(sigma / reach, 0.2)[:, None] * (velocities - own.reshape(-1, 2)[contacts.observers]) / unit
        force = gains.alpha * pull[:, None] * _direction(offsets) + gains.alpha_damping * agreement
        acceleration += _by_observer(contacts, force)

        contacts = sensing.obstacles
        velocities = self._obstacles.update(contacts, scenario.n_obstacles, sensing.ego_motion, dt)
        offsets = contacts.positions / unit
        sigma, reach = _sigma_norm(offsets), _sigma_norm(np.array([gains.obstacle_distance / unit, 0.0]))
        push = _bump(sigma / reach, 0.9) * (_sigmoid(sigma - reach) - 1.0)
        agreement = _bump(sigma / reach, 0.9)[:, None] * (velocities - own.reshape(-1, 2)[contacts.observers]) / unit
        force = gains.beta * push[:, None] * _direction(offsets) + gains.beta_damping * agreement
        acceleration += _by_observer(contacts, force)

        offsets = sensing.waypoint_positions / unit
        acceleration += gains.gamma * offsets / np.sqrt(1 + np.square(offsets).sum(-1, keepdims=True))
        acceleration += gains.gamma_damping * (self._waypoint_velocities(sensing, dt) - own) / unit

        self._velocities = limit(own + acceleration * unit * dt, scenario.max_speed)
        return steer(self._velocities, scenario)

    def state_dict(self) -> dict[str, Any]:
        """The memory of the current episodes: plain values and arrays."""
        return {
            "neighbors": self._neighbors.state_dict(),
            "obstacles": self._obstacles.state_dict(),
            "velocities": self._velocities,
            "waypoints": self._waypoints,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self._neighbors, self._obstacles = Velocities(**state["neighbors"]), Velocities(**state["obstacles"])
        self._velocities, self._waypoints = state["velocities"], state["waypoints"]

    def _waypoint_velocities(self, sensing: Sensing, dt: float) -> NDArray[np.float64]:
        """The waypoint's velocity over ground in each vehicle's frame, ``(flocks, vehicles, 2)`` [m/s]; 0 at the first step."""
        before, self._waypoints = self._waypoints, sensing.waypoint_positions
        if before is None:
            return np.zeros_like(sensing.waypoint_positions)
        return (self._waypoints - compensate_ego_motion(before, sensing.ego_motion)) / dt


_D = 7.0
"""The lattice's scale d in the article's experiments."""

_EPSILON = 0.1
"""Parameter of the sigma-norm."""

_A, _B = 5.0, 5.0
"""Parameters of the uneven sigmoid, 0 < a <= b."""


def _by_observer(contacts: Contacts, force: NDArray[np.float64]) -> NDArray[np.float64]:
    """The forces ``(contacts, 2)``, added up by observer."""
    return np.stack([contacts.sum(force[:, axis]) for axis in (0, 1)], axis=-1)


def _sigma_norm(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """(sqrt(1 + epsilon |z|^2) - 1) / epsilon, Eq. 8 of the article."""
    return (np.sqrt(1 + _EPSILON * np.square(z).sum(-1)) - 1) / _EPSILON


def _direction(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """The sigma-norm's gradient, n_ij."""
    return z / np.sqrt(1 + _EPSILON * np.square(z).sum(-1, keepdims=True))


def _bump(z: NDArray[np.float64], h: float) -> NDArray[np.float64]:
    """rho_h: 1 below h, falling smoothly to 0 at 1."""
    return np.where(z < h, 1.0, np.where(z < 1, 0.5 * (1 + np.cos(np.pi * (z - h) / (1 - h))), 0.0))


def _sigmoid(z: NDArray[np.float64]) -> NDArray[np.float64]:
    return z / np.sqrt(1 + np.square(z))


def _uneven_sigmoid(z: NDArray[np.float64]) -> NDArray[np.float64]:
    """phi: attraction up to a, repulsion up to b, zero at z = 0."""
    c = abs(_A - _B) / np.sqrt(4 * _A * _B)
    return 0.5 * ((_A + _B) * _sigmoid(z + c) + (_A - _B))


register_expert("olfati-saber", lambda world, mpc: OlfatiSaber())
