"""What the baseline controllers share: driving a unicycle by a planar velocity, and velocities of sensed bodies."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_flock.sim import Contacts, Scenario
from sb3_flock.sim.sensing import compensate_ego_motion, rotate  # noqa: F401 - rotate was here in the previous release


def steer(velocities: NDArray[np.float64], scenario: Scenario) -> NDArray[np.float64]:
    """A unicycle's actions for desired velocities: it turns towards the velocity and drives the part that points ahead.

    :param velocities: ``(..., 2)`` [m/s], in the body frame: forward is +x
    :return: ``(..., 2)``: speed [m/s] and turn rate [rad/s], within their bounds
    """
    forward, left = velocities[..., 0], velocities[..., 1]
    moving = np.hypot(forward, left) > 1e-3 * scenario.max_speed  # a smaller velocity has no reliable direction
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


class Velocities:
    """Velocities of sensed bodies by finite differences between this measurement and the last one.

    A vehicle uses its own measurements and its own odometry alone. A body without an earlier measurement counts as standing.
    """

    def __init__(self, keys: NDArray[np.int64] | None = None, positions: NDArray[np.float64] | None = None) -> None:
        self._keys = np.empty(0, np.int64) if keys is None else keys
        self._positions = np.empty((0, 2)) if positions is None else positions

    def update(self, contacts: Contacts, n_bodies: int, ego_motion: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """The velocity of each sensed body.

        :param contacts: who senses whom, now
        :param n_bodies: bodies in a flock
        :param ego_motion: the vehicles' own motion since the last measurement, :attr:`~sb3_flock.sim.Sensing.ego_motion`
        :param dt: time since the last measurement [s]
        :return: ``(contacts, 2)`` [m/s], over ground, in the observers' present frames
        """
        keys = contacts.observers * n_bodies + contacts.bodies  # ascending, as the contacts are
        at = np.searchsorted(self._keys, keys)
        known = np.zeros(len(keys), bool)
        within = at < len(self._keys)
        known[within] = self._keys[at[within]] == keys[within]
        velocities = np.zeros((len(keys), 2))
        own_motion = ego_motion.reshape(-1, ego_motion.shape[-1])[contacts.observers[known]]
        before = compensate_ego_motion(self._positions[at[known]], own_motion)
        velocities[known] = (contacts.positions[known] - before) / dt
        self._keys, self._positions = keys, contacts.positions
        return velocities

    def state_dict(self) -> dict[str, NDArray[Any]]:
        """The last measurement, as arguments of a copy that continues from it."""
        return {"keys": self._keys, "positions": self._positions}
