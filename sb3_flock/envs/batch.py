"""Some of the flocks of a batch: for an expert that acts for them alone, and to look at one flock."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_flock.sim import Contacts, Sensing, World

_BY_STEP = ("obstacle_speeds", "obstacle_turn_rates")
"""Arrays of the world's state whose second axis is the flocks'; of all others it is the first."""


def copy_flocks(world: World, flocks: NDArray[np.int64] | slice, into: World) -> None:
    """Copy the present state of some flocks into a world of the same scenario, to read it there: the sensors' memory is empty.

    :param world: the world of all flocks
    :param flocks: their numbers
    :param into: afterwards a world of those flocks alone, in their order
    """
    state: dict[str, Any] = {**world.state_dict(), "sensors": {"rngs": [], "history": [], "measured": []}}
    for name, value in state.items():
        if isinstance(value, np.ndarray):
            state[name] = value[:, flocks] if name in _BY_STEP else value[flocks]
    rngs = state["dynamics"]["rngs"]
    state["dynamics"] = {
        **{name: value[flocks] for name, value in state["dynamics"].items() if name != "rngs"},
        "rngs": [rngs[flock] for flock in np.arange(world.n_flocks)[flocks]] if rngs else [],
    }
    state["drawn"] = {name: values[flocks] for name, values in state["drawn"].items()}
    into.n_flocks = len(state["positions"])
    into.load_state_dict(state)


def select_flocks(sensing: Sensing, flocks: NDArray[np.int64]) -> Sensing:
    """What the vehicles of some flocks sense.

    :param flocks: their numbers, ascending
    """
    return Sensing(
        _select_contacts(sensing.neighbors, flocks),
        _select_contacts(sensing.obstacles, flocks),
        sensing.waypoint_positions[flocks],
        sensing.waypoint_distances[flocks],
        sensing.ego_motion[flocks],
        None if sensing.previous is None else select_flocks(sensing.previous, flocks),
        None if sensing.unplaced is None else sensing.unplaced.reshape(sensing.ego_motion.shape[:2])[flocks].ravel(),
    )


def _select_contacts(contacts: Contacts, flocks: NDArray[np.int64]) -> Contacts:
    vehicles = contacts.shape[1]
    numbers = np.full(contacts.shape[0], -1)
    numbers[flocks] = np.arange(len(flocks))
    new = numbers[contacts.observers // vehicles]
    kept = new >= 0
    return replace(
        contacts,
        shape=(len(flocks), vehicles),
        observers=new[kept] * vehicles + contacts.observers[kept] % vehicles,
        bodies=contacts.bodies[kept],
        positions=contacts.positions[kept],
        distances=contacts.distances[kept],
        stds=None if contacts.stds is None else contacts.stds[kept],
    )
