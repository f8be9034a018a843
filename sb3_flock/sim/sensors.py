"""Sensor errors and sensor memory: noise, missed and hidden bodies, delay, odometry, and the earlier measurement for motion
channels."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field, model_validator

from sb3_flock.settings import NotNegative, Settings
from sb3_flock.sim.dynamics import DynamicsSettings
from sb3_flock.sim.randomization import FlockValues, own_rngs, rng_states, rngs_of
from sb3_flock.sim.sensing import Contacts, Sensing
from sb3_flock.sim.tracker import Messages, Tracker, TrackerSettings
from sb3_flock.sim.visibility import in_view, known_obstacles, occluded, select

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from sb3_flock.sim.sensing import Bodies, SensingSettings


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
    field_of_view: float = Field(
        2 * math.pi,
        gt=0,
        le=2 * math.pi,
        description="full angle around the heading in which vehicles detect neighbors and obstacles [rad] (paper: 2 pi)",
    )
    occlusion: NotNegative = Field(
        0.0,
        description="radius of the bodies that hide what is behind them on the line of sight [m]; 0: none does (paper: 0)",
    )
    odometry_noise: NotNegative = Field(
        0.0,
        description="standard deviation of the relative errors with which vehicles measure how far they moved and how far they "
        "turned in a step (paper: 0)",
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
    tracker: TrackerSettings = Field(
        default_factory=TrackerSettings, description="estimation on board from what vehicles measure (paper: none)"
    )

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

    Neighbors and obstacles are detected within the field of view and where no other body hides them. The waypoint is always
    known. With ``shared_detections`` a vehicle also knows the obstacles that a neighbor detects in the neighbor's own field of
    view; vehicles within ``link_range`` communicate whether they see each other or not. Then come missed detections and noise,
    also of what is shared. Where the settings have a tracker, vehicles act on its estimates.

    :param settings: the errors and the motion lag
    :param ranges: how far vehicles sense, and whether detections are shared
    :param bodies: where all bodies are in the state that is measured; needed for ``occlusion`` alone
    """

    def __init__(
        self, settings: SensorSettings, ranges: SensingSettings, bodies: Callable[[], Bodies] | None = None
    ) -> None:
        self.settings, self.ranges, self._bodies = settings, ranges, bodies
        self.latest: Sensing | None = None
        """What :meth:`measure` returned since the last step of the world."""
        self._rngs: list[Generator] = []
        self._history: deque[Sensing] = deque(maxlen=1 + settings.motion_lag_steps)
        self.errors = FlockValues(settings.sensors)

    @property
    def errors(self) -> FlockValues:
        """The numbers of ``settings.sensors``, of each flock where they are randomized; a change drops what was delayed."""
        return self._errors

    @errors.setter
    def errors(self, errors: FlockValues) -> None:
        self._errors = errors
        self.is_exact = self.settings.sensors == SensorErrors() and not errors.are_drawn
        self._delays = np.rint(errors.delay[:, 0] / self.settings.time_step).astype(np.int64)
        self._measured: deque[Sensing] = deque(maxlen=1 + int(self._delays.max()))
        own = self.settings.tracker
        self._tracker = Tracker(own, self.settings, self.ranges, errors) if own.enabled else None
        self._estimate: Sensing | None = None

    def reset(self, rngs: Sequence[Generator]) -> None:
        """Start an episode; exact sensors draw nothing from the flocks' generators."""
        self.forget()
        if not self.is_exact:
            self._rngs = own_rngs(rngs)

    def forget(self) -> None:
        """Drop everything measured so far, for a world whose bodies have changed."""
        self.latest = None
        self._history.clear()
        self._measured.clear()
        self._estimate = None
        if self._tracker is not None:
            self._tracker.reset()

    def measure(self, truth: Sensing) -> Sensing:
        """What the vehicles act on; call this once a step. Until the delay is over, that is the first measurement."""
        self.latest = self._measure(truth)
        return self.latest

    def _measure(self, truth: Sensing) -> Sensing:
        has_memory = self._history.maxlen != 1
        if self.is_exact and not has_memory and self._tracker is None:
            return truth
        measured = truth if self.is_exact else self._with_errors(truth)
        if self._tracker is not None:
            self._measured.append(measured)
            self._estimate = self._tracker.update(self.delayed(), measured.ego_motion, self._messages(truth, measured))
            return self._with_previous(self._estimate) if has_memory else self._estimate
        if has_memory:
            measured = self._with_previous(measured)
        self._measured.append(measured)
        return self.delayed()

    def _messages(self, truth: Sensing, measured: Sensing) -> Messages | None:
        """What neighbors share for the tracker: vehicles in link range communicate, whether they see each other or not."""
        if not self.settings.tracker.shared_motion:
            return None
        if self._bodies is None:
            raise ValueError("bodies = None: shared_motion needs to know the headings of all vehicles")
        return Messages(self._bodies().frames, measured.ego_motion, truth.neighbors.observers, truth.neighbors.bodies)

    def delayed(self) -> Sensing:
        """What is used now: what was measured before the delay, or first."""
        last = len(self._measured) - 1
        ages = np.minimum(self._delays, last)
        used, flocks = np.unique(ages, return_inverse=True)
        sources = [self._measured[last - age] for age in used.tolist()]
        return sources[0] if len(sources) == 1 else _by_flock(sources, flocks)

    def state_dict(self) -> dict[str, Any]:
        """The random streams, the memory and the delayed measurements: plain values and arrays."""
        tracker = {}
        if self._tracker is not None and self._estimate is not None:
            tracker = {"tracker": self._tracker.state_dict(), "estimate": asdict(self._estimate)}
        return {
            "rngs": rng_states(self._rngs),
            "history": [asdict(sensing) for sensing in self._history],
            "measured": [asdict(sensing) for sensing in self._measured],
            **tracker,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self._rngs = rngs_of(state["rngs"])
        for kept, saved in ((self._history, state["history"]), (self._measured, state["measured"])):
            kept.clear()
            kept.extend(_sensing(sensing) for sensing in saved)
        self.latest = self.delayed() if self._measured else None
        self._estimate = None
        if self._tracker is not None and "tracker" in state:
            self._tracker.load_state_dict(state["tracker"])
            self._estimate = _sensing(state["estimate"])
            self.latest = replace(self._estimate, previous=self._history[0] if self._history else None)

    def _with_previous(self, measured: Sensing) -> Sensing:
        """Adds what was measured ``motion_lag`` ago, or at the start, in the vehicles' present frames."""
        history = [sensing.compensate_ego_motion(measured.ego_motion) for sensing in self._history]
        self._history.clear()
        self._history.extend([*history, measured])
        return replace(measured, previous=self._history[0])

    def _with_errors(self, truth: Sensing) -> Sensing:
        neighbors, obstacles = (self._detected(contacts) for contacts in self._visible(truth))
        flocks, vehicles, _ = truth.waypoint_positions.shape
        noise = np.stack([rng.normal(size=(vehicles, 2)) for rng in self._rngs]).reshape(flocks, vehicles, 2)
        waypoints = truth.waypoint_positions + self.errors.position_noise[..., None] * noise
        ego_motion = truth.ego_motion
        if self.errors.is_on("odometry_noise"):
            factors = np.stack([rng.normal(size=(vehicles, 2)) for rng in self._rngs])
            factors = 1.0 + self.errors.odometry_noise[..., None] * factors
            ego_motion = ego_motion * factors[..., [0, 1, 0][: ego_motion.shape[-1]]]  # forward, turn, to the left
        return Sensing(neighbors, obstacles, waypoints, np.hypot(waypoints[..., 0], waypoints[..., 1]), ego_motion)

    def _visible(self, truth: Sensing) -> tuple[Contacts, Contacts]:
        """The neighbors and obstacles that no field of view or other body hides, and obstacles that a neighbor shares."""
        neighbors, obstacles = truth.neighbors, truth.obstacles
        if not (self.errors.is_on("field_of_view") or self.errors.is_on("occlusion")):
            return neighbors, obstacles
        detected = self._sees(obstacles, False) & (obstacles.distances < self.ranges.detection_range)
        known = known_obstacles(obstacles, detected, neighbors, self.ranges.shared_detections)
        return select(neighbors, self._sees(neighbors, True)), select(obstacles, known)

    def _sees(self, contacts: Contacts, are_vehicles: bool) -> NDArray[np.bool_]:
        flocks = contacts.shape[0]
        seen = in_view(contacts, self.errors.of_flocks("field_of_view", flocks))
        if self.errors.is_on("occlusion"):
            if self._bodies is None:
                raise ValueError("bodies = None: occlusion needs to know where all bodies are")
            seen &= ~occluded(contacts, are_vehicles, self._bodies(), self.errors.of_flocks("occlusion", flocks))
        return seen

    def _detected(self, contacts: Contacts) -> Contacts:
        """The contacts that are not missed, with noise."""
        n_flocks, vehicles = contacts.shape
        flocks = contacts.observers // vehicles
        by_flock = np.bincount(flocks, minlength=n_flocks)
        draws = [(rng.random(count), rng.normal(size=(count, 2))) for rng, count in zip(self._rngs, by_flock, strict=True)]
        luck, noise = (np.concatenate(parts) for parts in zip(*draws, strict=True))
        kept = luck >= self.errors.of_flocks("dropout", n_flocks)[flocks]
        positions = contacts.positions + self.errors.of_flocks("position_noise", n_flocks)[flocks, None] * noise
        found = select(replace(contacts, positions=positions), kept)
        return replace(found, distances=np.hypot(found.positions[:, 0], found.positions[:, 1]))


def _by_flock(sources: Sequence[Sensing], flocks: NDArray[np.int64]) -> Sensing:
    """One sensing whose flocks are those of several: ``flocks`` has the number of the source for each."""
    own = flocks[None, :] == np.arange(len(sources))[:, None]

    def contacts(name: str) -> Contacts:
        parts = [getattr(source, name) for source in sources]
        kept = [select(part, of[part.observers // part.shape[1]]) for part, of in zip(parts, own, strict=True)]
        order = np.argsort(np.concatenate([part.observers for part in kept]), kind="stable")
        columns = ("observers", "bodies", "positions", "distances")
        joined = [np.concatenate([getattr(part, column) for part in kept])[order] for column in columns]
        return Contacts(parts[0].shape, *joined)

    def values(name: str) -> NDArray[np.float64]:
        return np.stack([getattr(sources[number], name)[flock] for flock, number in enumerate(flocks.tolist())])

    previous = [source.previous for source in sources if source.previous is not None]
    return Sensing(
        contacts("neighbors"),
        contacts("obstacles"),
        values("waypoint_positions"),
        values("waypoint_distances"),
        values("ego_motion"),
        _by_flock(previous, flocks) if previous else None,
    )


def _sensing(saved: Mapping[str, Any]) -> Sensing:
    contacts = {name: _contacts(saved[name]) for name in ("neighbors", "obstacles")}
    previous = None if saved["previous"] is None else _sensing(saved["previous"])
    return Sensing(**{**saved, **contacts, "previous": previous})


def _contacts(saved: Mapping[str, Any]) -> Contacts:
    first, second = saved["shape"]
    return Contacts(**{**saved, "shape": (int(first), int(second))})
