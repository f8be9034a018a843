"""Sensors that err: noise, missed detections and delay between the truth and what a vehicle acts on."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from sb3_flock.settings import NotNegative, Settings
from sb3_flock.sim.sensing import Contacts, Sensing

if TYPE_CHECKING:
    from numpy.random import Generator

    from sb3_flock.sim.scenario import Scenario


class SensorErrors(Settings):
    """What is between the truth and the vehicles' measurements; nothing by default, as in the paper."""

    position_noise: NotNegative = Field(
        0.0, description="standard deviation of each coordinate measured, of neighbors, obstacles and waypoint [m] (ours)"
    )
    dropout: float = Field(
        0.0, ge=0, le=1, description="share of the neighbors and obstacles in range that a measurement misses (ours)"
    )
    delay: NotNegative = Field(
        0.0, le=1e3, description="time between a measurement and its use, to the nearest step [s] (ours)"
    )


class Sensors:
    """The sensors of every flock, and what it remembers. Each flock's errors depend on its own generator alone.

    :param scenario: how they err, and how long vehicles look back; of their own way vehicles know all
    """

    def __init__(self, scenario: Scenario) -> None:
        self.errors = scenario.sensors
        self.is_exact = self.errors == SensorErrors()
        self._rngs: list[Generator] = []
        self._looks: deque[Sensing] = deque(maxlen=1 + scenario.look_back_steps)
        self._measured: deque[Sensing] = deque(maxlen=1 + round(self.errors.delay / scenario.time_step))

    def reset(self, rngs: Sequence[Generator]) -> None:
        """Begin an episode; exact sensors draw nothing from the flocks' generators."""
        self.forget()
        if not self.is_exact:
            self._rngs = [np.random.default_rng(rng.integers(2**63, size=2)) for rng in rngs]

    def forget(self) -> None:
        """Go on without what was measured so far, as where the bodies are others now."""
        self._looks.clear()
        self._measured.clear()

    def measure(self, truth: Sensing) -> Sensing:
        """What the vehicles act on, to be asked for once a step. Until the delay is over that is the first measurement."""
        remembers = self._looks.maxlen != 1
        if self.is_exact and not remembers:
            return truth
        measured = truth if self.is_exact else self._with_errors(truth)
        if remembers:
            measured = self._beside_earlier(measured)
        self._measured.append(measured)
        return self._measured[0]

    def state_dict(self) -> dict[str, Any]:
        """The random streams, the memory and the measurements on their way: plain values and arrays."""
        return {
            "rngs": [rng.bit_generator.state for rng in self._rngs],
            "looks": [asdict(sensing) for sensing in self._looks],
            "measured": [asdict(sensing) for sensing in self._measured],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from :meth:`state_dict`."""
        self._rngs = [np.random.default_rng() for _ in state["rngs"]]
        for rng, saved in zip(self._rngs, state["rngs"], strict=True):
            rng.bit_generator.state = saved
        for kept, saved in ((self._looks, state.get("looks", ())), (self._measured, state["measured"])):
            kept.clear()
            kept.extend(_sensing(sensing) for sensing in saved)

    def _beside_earlier(self, measured: Sensing) -> Sensing:
        """With what was measured a look back ago, or at the start; the way since then is known."""
        moved = [look.after(measured.moved) for look in self._looks]
        self._looks.clear()
        self._looks.extend([*moved, measured])
        return replace(measured, earlier=self._looks[0])

    def _with_errors(self, truth: Sensing) -> Sensing:
        neighbors, obstacles = (self._detected(contacts) for contacts in (truth.neighbors, truth.obstacles))
        flocks, vehicles, _ = truth.waypoint_positions.shape
        noise = np.stack([rng.normal(size=(vehicles, 2)) for rng in self._rngs]).reshape(flocks, vehicles, 2)
        waypoints = truth.waypoint_positions + self.errors.position_noise * noise
        return Sensing(neighbors, obstacles, waypoints, np.hypot(waypoints[..., 0], waypoints[..., 1]), truth.moved)

    def _detected(self, contacts: Contacts) -> Contacts:
        """The contacts that are not missed, with noise."""
        by_flock = np.bincount(contacts.observers // contacts.shape[1], minlength=contacts.shape[0])
        draws = [(rng.random(count), rng.normal(size=(count, 2))) for rng, count in zip(self._rngs, by_flock, strict=True)]
        luck, noise = (np.concatenate(parts) for parts in zip(*draws, strict=True))
        kept = luck >= self.errors.dropout
        positions = (contacts.positions + self.errors.position_noise * noise)[kept]
        return replace(
            contacts,
            observers=contacts.observers[kept],
            bodies=contacts.bodies[kept],
            positions=positions,
            distances=np.hypot(positions[:, 0], positions[:, 1]),
        )


def _sensing(saved: Mapping[str, Any]) -> Sensing:
    contacts = {name: _contacts(saved[name]) for name in ("neighbors", "obstacles")}
    earlier = None if saved["earlier"] is None else _sensing(saved["earlier"])
    return Sensing(**{**saved, **contacts, "earlier": earlier})


def _contacts(saved: Mapping[str, Any]) -> Contacts:
    first, second = saved["shape"]
    return Contacts(**{**saved, "shape": (int(first), int(second))})
