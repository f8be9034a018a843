"""What the laws share: planar velocities for a unicycle, and velocities from two looks at the same bodies."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_flock.sim import Contacts, Scenario
from sb3_flock.sim.sensing import after


def steer(velocities: NDArray[np.float64], scenario: Scenario) -> NDArray[np.float64]:
    """A unicycle's actions for wanted velocities: turn towards it, drive as much of it as points ahead.

    :param velocities: ``(..., 2)`` [m/s], in the body frame: forward is +x
    :return: ``(..., 2)``: speed [m/s] and turn rate [rad/s], within their bounds
    """
    forward, left = velocities[..., 0], velocities[..., 1]
    moving = np.hypot(forward, left) > 1e-3 * scenario.max_speed  # a wish too small to tell its direction
    turn_rates = np.where(moving, np.arctan2(left, forward) / scenario.time_step, 0.0)
    return np.stack(
        (
            np.clip(forward, 0.0, scenario.max_speed),
            np.clip(turn_rates, -scenario.max_turn_rate, scenario.max_turn_rate),
        ),
        axis=-1,
    )


def limit(vectors: NDArray[np.float64], length: float) -> NDArray[np.float64]:
    """The vectors ``(..., 2)``, shortened to a length where they exceed it."""
    return vectors * np.minimum(1.0, length / np.maximum(np.hypot(vectors[..., 0], vectors[..., 1]), 1e-12))[..., None]


def rotate(vectors: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors ``(..., 2)`` turned by angles ``(...)`` [rad]."""
    cos, sin = np.cos(angles), np.sin(angles)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack((cos * x - sin * y, sin * x + cos * y), axis=-1)


class Velocities:
    """Velocities of sensed bodies, from where they are and where they were one step ago.

    A vehicle remembers one look and knows its own way since, nothing that others tell it. A body seen for the first time
    counts as standing.
    """

    def __init__(self, keys: NDArray[np.int64] | None = None, positions: NDArray[np.float64] | None = None) -> None:
        self._keys = np.empty(0, np.int64) if keys is None else keys
        self._positions = np.empty((0, 2)) if positions is None else positions

    def update(self, contacts: Contacts, n_bodies: int, moved: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """The velocity of each sensed body.

        :param contacts: who senses whom, now
        :param n_bodies: bodies in a flock
        :param moved: own way since the last look, :attr:`~sb3_flock.sim.Sensing.moved`
        :param dt: time since the last look [s]
        :return: ``(contacts, 2)`` [m/s], over ground, in the observers' frames of now
        """
        keys = contacts.observers * n_bodies + contacts.bodies  # ascending, as the contacts are
        at = np.searchsorted(self._keys, keys)
        known = np.zeros(len(keys), bool)
        within = at < len(self._keys)
        known[within] = self._keys[at[within]] == keys[within]
        velocities = np.zeros((len(keys), 2))
        before = after(self._positions[at[known]], moved.reshape(-1, 2)[contacts.observers[known]])
        velocities[known] = (contacts.positions[known] - before) / dt
        self._keys, self._positions = keys, contacts.positions
        return velocities

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """The look that is remembered, as arguments for another one that goes on from it."""
        return {"keys": self._keys, "positions": self._positions}
