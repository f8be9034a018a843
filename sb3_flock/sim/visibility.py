"""Which of the bodies in range a vehicle detects: its field of view, and bodies that hide others behind them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sb3_flock.sim.backend import compiled
from sb3_flock.sim.sensing import Contacts, find_contacts, shared_keys

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.sensing import Bodies


def in_view(contacts: Contacts, field_of_view: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which of the sensed bodies are within the field of view around the observer's heading, ``(contacts,)``.

    :param field_of_view: full angle of each flock, ``(flocks,)`` [rad]; a body on its edge is within
    """
    bearings = np.abs(np.arctan2(contacts.positions[:, 1], contacts.positions[:, 0]))
    return bearings <= field_of_view[contacts.observers // contacts.shape[1]] / 2


def occluded(
    contacts: Contacts, are_vehicles: bool, bodies: Bodies, radii: NDArray[np.float64], use_numba: bool = True
) -> NDArray[np.bool_]:
    """Which of the sensed bodies are hidden behind another body, ``(contacts,)``.

    A body is hidden if the line from the observer to its center crosses the disc of another body that is nearer, measured along
    that line. The discs of vehicles and obstacles have the same radius.

    :param contacts: sensed bodies
    :param are_vehicles: whether those are vehicles; else obstacles
    :param bodies: where all bodies are
    :param radii: of the discs of each flock, ``(flocks,)`` [m]; 0: nothing is hidden
    :param use_numba: use numba where it is installed; the result is the same
    """
    vehicles, reach = bodies.positions.shape[1], float(contacts.distances.max(initial=0.0) + radii.max())
    around = [
        find_contacts(bodies.positions, bodies.frames, places, reach, exclude_self, use_numba)
        for places, exclude_self in ((bodies.positions, True), (bodies.obstacle_positions, False))
    ]
    observers = np.concatenate([found.observers for found in around])
    order = np.argsort(observers, kind="stable")
    numbers = np.concatenate((around[0].bodies, around[1].bodies + vehicles))[order]
    positions = np.concatenate([found.positions for found in around])[order]
    ends = np.cumsum(np.bincount(observers, minlength=contacts.shape[0] * vehicles))
    kernels = compiled() if use_numba else None
    find = find_occluded if kernels is None else kernels.find_occluded
    own = contacts.bodies + (0 if are_vehicles else vehicles)
    return find(contacts.observers, own, contacts.positions, radii[contacts.observers // vehicles], ends, numbers, positions)


def find_occluded(
    observers: NDArray[np.int64],
    bodies: NDArray[np.int64],
    positions: NDArray[np.float64],
    radii: NDArray[np.float64],
    ends: NDArray[np.int64],
    near_bodies: NDArray[np.int64],
    near_positions: NDArray[np.float64],
) -> NDArray[np.bool_]:
    """Which bodies are hidden behind one of the bodies near their observer, ``(contacts,)``.

    :param observers: the vehicle that senses, ``(contacts,)``
    :param bodies: number of the sensed body, ``(contacts,)``
    :param positions: of the sensed body in the observer's frame, ``(contacts, 2)`` [m]
    :param radii: of the discs, ``(contacts,)`` [m]
    :param ends: of each vehicle's rows of ``near_bodies``, ``(vehicles of all flocks,)``
    :param near_bodies: number of each body near a vehicle, ``(pairs,)``
    :param near_positions: its position in that vehicle's frame, ``(pairs, 2)`` [m]
    """
    starts = np.concatenate(([0], ends[:-1]))
    counts = (ends - starts)[observers]
    contact = np.repeat(np.arange(len(observers)), counts)
    first = np.repeat(starts[observers] - (np.cumsum(counts) - counts), counts)
    near = first + np.arange(len(contact))
    (x, y), (near_x, near_y) = positions[contact].T, near_positions[near].T
    square, along, across = x * x + y * y, x * near_x + y * near_y, np.abs(x * near_y - y * near_x)
    hides = (near_bodies[near] != bodies[contact]) & (along > 0) & (along < square)
    hides &= across < radii[contact] * np.sqrt(square)
    hidden = np.zeros(len(observers), bool)
    hidden[contact[hides]] = True
    return hidden


def select(contacts: Contacts, kept: NDArray[np.bool_]) -> Contacts:
    """Some of the contacts."""
    return Contacts(
        contacts.shape, contacts.observers[kept], contacts.bodies[kept], contacts.positions[kept], contacts.distances[kept]
    )


def known_obstacles(
    obstacles: Contacts, detected: NDArray[np.bool_], neighbors: Contacts, is_shared: bool
) -> NDArray[np.bool_]:
    """Which obstacles a vehicle knows: those that it detects and, if detections are shared, those that a neighbor detects.

    :param obstacles: every obstacle that the vehicle would know if nothing were hidden
    :param detected: which of them it detects itself, ``(contacts,)``
    :param neighbors: with whom the vehicle communicates, seen or not
    :param is_shared: whether detections are shared
    """
    if not is_shared or not len(obstacles.bodies):
        return detected
    n_obstacles = int(obstacles.bodies.max()) + 1
    keys = shared_keys(neighbors, select(obstacles, detected), n_obstacles)
    return np.isin(obstacles.observers * n_obstacles + obstacles.bodies, keys)
