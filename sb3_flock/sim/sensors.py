"""Sensor errors and sensor memory: noise, missed detections, delay, and the earlier measurement for motion channels."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field, model_validator

from sb3_flock.settings import NotNegative, Settings
from sb3_flock.sim.dynamics import DynamicsSettings
from sb3_flock.sim.sensing import Contacts, Sensing

if TYPE_CHECKING:
    from numpy.random import Generator


class SensorErrors(Settings):
    """Errors of what vehicles measure; none by default, as in the paper."""

    position_noise: NotNegative = Field(
        0.0, description="standard deviation of each measured coordinate of neighbors, obstacles and waypoint [m] (paper: 0)"
    )
    dropout: float = Field(
        0.0, ge=0, le=1, description="share of the neighbors and obstacles in range that a measurement misses (paper: 0)"
    )
    delay: NotNegative = Field(
        0.0, le=1e3, description="time between a measurement and its use, rounded to whole steps [s] (paper: 0)"
    )


class SensorSettings(DynamicsSettings):
    """The sensors' errors, and how far back the motion channels reach."""

    motion_lag: NotNegative = Field(
        0.0,
        le=100,
        description="time over which the motion channels take differences, a multiple of time_step [s]; "
        "0: no motion channels (paper: 0)",
    )
    sensors: SensorErrors = Field(default_factory=SensorErrors, description="errors of what vehicles measure (paper: none)")

    @model_validator(mode="after")
    def _lag_is_whole_steps(self) -> SensorSettings:
        if not math.isclose(self.motion_lag, self.motion_lag_steps * self.time_step, rel_tol=1e-6):
            raise ValueError(f"motion_lag = {self.motion_lag}: input should be a multiple of time_step = {self.time_step}")
        return self

    @property
    def motion_lag_steps(self) -> int:
        """``motion_lag`` in steps; 0 without motion channels."""
        return round(self.motion_lag / self.time_step)


class Sensors:
    """The sensors of every flock, with their memory. Each flock's errors depend on its own generator alone.

    Odometry is exact: a vehicle knows its own motion since the earlier measurement.

    :param settings: the errors and the motion lag
    """

    def __init__(self, settings: SensorSettings) -> None:
        self.errors = settings.sensors
        self.is_exact = self.errors == SensorErrors()
        self.latest: Sensing | None = None
        """What :meth:`measure` returned since the last step of the world."""
        self._rngs: list[Generator] = []
        self._history: deque[Sensing] = deque(maxlen=1 + settings.motion_lag_steps)
        self._measured: deque[Sensing] = deque(maxlen=1 + round(self.errors.delay / settings.time_step))

    def reset(self, rngs: Sequence[Generator]) -> None:
        """Start an episode; exact sensors draw nothing from the flocks' generators."""
        self.forget()
        if not self.is_exact:
            self._rngs = [np.random.default_rng(rng.integers(2**63, size=2)) for rng in rngs]

    def forget(self) -> None:
        """Drop everything measured so far, for a world whose bodies have changed."""
        self.latest = None
        self._history.clear()
        self._measured.clear()

    def measure(self, truth: Sensing) -> Sensing:
        """What the vehicles act on; call this once a step. Until the delay is over, that is the first measurement."""
        self.latest = self._measure(truth)
        return self.latest

    def _measure(self, truth: Sensing) -> Sensing:
        has_memory = self._history.maxlen != 1
        if self.is_exact and not has_memory:
            return truth
        measured = truth if self.is_exact else self._with_errors(truth)
        if has_memory:
            measured = self._with_previous(measured)
        self._measured.append(measured)
        return self._measured[0]

    def state_dict(self) -> dict[str, Any]:
        """The random streams, the memory and the delayed measurements: plain values and arrays."""
        return {
            "rngs": [rng.bit_generator.state for rng in self._rngs],
            "history": [asdict(sensing) for sensing in self._history],
            "measured": [asdict(sensing) for sensing in self._measured],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self._rngs = [np.random.default_rng() for _ in state["rngs"]]
        for rng, saved in zip(self._rngs, state["rngs"], strict=True):
            rng.bit_generator.state = saved
        for kept, saved in ((self._history, state["history"]), (self._measured, state["measured"])):
            kept.clear()
            kept.extend(_sensing(sensing) for sensing in saved)
        self.latest = self._measured[0] if self._measured else None

    def _with_previous(self, measured: Sensing) -> Sensing:
        """Adds what was measured ``motion_lag`` ago, or at the start, in the vehicles' present frames."""
        history = [sensing.compensate_ego_motion(measured.ego_motion) for sensing in self._history]
        self._history.clear()
        self._history.extend([*history, measured])
        return replace(measured, previous=self._history[0])

    def _with_errors(self, truth: Sensing) -> Sensing:
        neighbors, obstacles = (self._detected(contacts) for contacts in (truth.neighbors, truth.obstacles))
        flocks, vehicles, _ = truth.waypoint_positions.shape
        noise = np.stack([rng.normal(size=(vehicles, 2)) for rng in self._rngs]).reshape(flocks, vehicles, 2)
        waypoints = truth.waypoint_positions + self.errors.position_noise * noise
        return Sensing(neighbors, obstacles, waypoints, np.hypot(waypoints[..., 0], waypoints[..., 1]), truth.ego_motion)

    def _detected(self, contacts: Contacts) -> Contacts:
        """The contacts that are detected, with noise."""
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
    previous = None if saved["previous"] is None else _sensing(saved["previous"])
    return Sensing(**{**saved, **contacts, "previous": previous})


def _contacts(saved: Mapping[str, Any]) -> Contacts:
    first, second = saved["shape"]
    return Contacts(**{**saved, "shape": (int(first), int(second))})
