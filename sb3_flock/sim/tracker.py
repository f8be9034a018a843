"""On-board estimation: each vehicle tracks the bodies that it senses, from noisy, late and incomplete detections.

A track is a Kalman filter with constant velocity in the vehicle's odometry frame, so that the vehicle's own motion is
compensated by the change of its pose. Detections carry no identities: gates and a one-to-one assignment of nearest neighbors
associate them with tracks (Bar-Shalom, Li and Kirubarajan: Estimation with Applications to Tracking and Navigation, 2001).
``docs/tracker.md`` has the equations and what the tracker gives.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import Field

from sb3_flock.settings import NotNegative, Positive, Settings
from sb3_flock.sim.sensing import Contacts, Sensing, to_body

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.randomization import FlockValues
    from sb3_flock.sim.sensing import SensingSettings
    from sb3_flock.sim.sensors import SensorSettings

_WAYPOINT_TIME = 1.0
"""Time in which the waypoint changes its velocity by about the vehicles' top speed [s]."""

_ROUNDING = 1e-6
"""Least standard deviation of a predicted position [sensing ranges]: a gate is never narrower than rounding errors."""

_TINY = 1e-300
"""Smallest variance that is divided by [m^2]."""


class TrackerSettings(Settings):
    """The estimation on board; off by default, as in the paper."""

    enabled: bool = Field(
        False, description="vehicles track what they sense, and act on the estimates instead of the measurements (paper: false)"
    )
    neighbor_acceleration: Positive | None = Field(
        None,
        description="standard deviation of a neighbor's change of velocity in a step, divided by time_step [m/s^2]; "
        "null: max_speed times max_turn_rate (paper: none)",
    )
    obstacle_acceleration: Positive | None = Field(
        None, description="the same of an obstacle [m/s^2]; null: obstacle_max_speed times obstacle_turn_std (paper: none)"
    )
    gate: Positive = Field(
        4.0, description="largest distance of a detection from the track that it updates [standard deviations] (paper: none)"
    )
    max_missed: int = Field(
        5, ge=0, le=1000, description="detections in succession that a track survives without [steps] (paper: none)"
    )
    assumed_noise: NotNegative | None = Field(
        None, description="standard deviation of each measured coordinate [m]; null: sensors.position_noise (paper: none)"
    )
    assumed_delay: NotNegative | None = Field(
        None,
        le=1e3,
        description="time between a detection and its use, rounded to whole steps [s]; null: sensors.delay (paper: none)",
    )
    shared_motion: bool = Field(
        False,
        description="neighbors share by communication their headings and how they moved in the last step by their odometry; "
        "tracks of neighbors then follow that motion instead of a constant velocity (paper: false)",
    )
    shared_motion_noise: NotNegative = Field(
        0.05, description="standard deviation of the relative error of a motion that a neighbor shares (paper: none)"
    )
    margin_stds: NotNegative = Field(
        2.0,
        description="what the safety filter keeps beyond safety_margin, for the uncertainty of an estimated position [standard "
        "deviations] (paper: none)",
    )


class Messages(NamedTuple):
    """What the vehicles of every flock share by communication, without delay."""

    frames: NDArray[np.float64]
    """Cosine and sine of their headings, ``(flocks, vehicles, 2)``."""
    ego_motion: NDArray[np.float64]
    """Their own motion since the last step by their odometry, :attr:`~sb3_flock.sim.Sensing.ego_motion`."""
    receivers: NDArray[np.int64]
    """``(messages,)``: the vehicles that receive one, numbered as in :class:`~sb3_flock.sim.Contacts`."""
    senders: NDArray[np.int64]
    """``(messages,)``: from whom, the vehicle's number within the flock."""


@dataclass(frozen=True)
class Tracks:
    """Tracked bodies of one kind: one row a track, in the order of the vehicles that track.

    The covariance of a track is the same along both axes, without correlation between them.
    """

    observers: NDArray[np.int64]
    """``(tracks,)``: the vehicle that tracks, numbered as in :class:`~sb3_flock.sim.Contacts`."""
    bodies: NDArray[np.int64]
    """``(tracks,)``: the number of the body whose detection the track took last. No estimate depends on it."""
    missed: NDArray[np.int64]
    """``(tracks,)``: detections in succession that the track has missed."""
    positions: NDArray[np.float64]
    """``(tracks, 2)`` [m], in the observer's odometry frame."""
    velocities: NDArray[np.float64]
    """``(tracks, 2)`` [m/s], over ground, in the same frame."""
    covariances: NDArray[np.float64]
    """``(tracks, 3)``: of a coordinate [m^2], of a coordinate and its velocity [m^2/s], of the velocity [m^2/s^2]."""

    def select(self, rows: NDArray[Any]) -> Tracks:
        """Some of the tracks."""
        return Tracks(*(getattr(self, field.name)[rows] for field in fields(self)))

    def predict(self, times: NDArray[np.float64], intensity: float) -> Tracks:
        """The tracks some time later: constant velocity, disturbed by white noise of the acceleration.

        :param times: ``(tracks,)`` [s]
        :param intensity: of the noise [m^2/s^3]
        """
        own, mixed, rate = self.covariances.T
        covariances = (
            own + times * (2 * mixed + times * (rate + intensity * times / 3)),
            mixed + times * (rate + intensity * times / 2),
            rate + intensity * times,
        )
        positions = self.positions + times[:, None] * self.velocities
        return replace(self, positions=positions, covariances=np.stack(covariances, axis=-1))

    def widen(self, variances: NDArray[np.float64]) -> Tracks:
        """The tracks with the variance of each coordinate raised, by ``(tracks,)`` [m^2]."""
        covariances = self.covariances.copy()
        covariances[:, 0] += variances
        return replace(self, covariances=covariances)

    def update(self, positions: NDArray[np.float64], variances: NDArray[np.float64], bodies: NDArray[np.int64]) -> Tracks:
        """The tracks after a detection of each.

        :param positions: detected, ``(tracks, 2)`` [m]
        :param variances: of each detected coordinate, ``(tracks,)`` [m^2]
        :param bodies: the detected ones, ``(tracks,)``
        """
        own, mixed, rate = self.covariances.T
        total = np.maximum(own + variances, _TINY)
        kept, innovations = variances / total, positions - self.positions
        return Tracks(
            self.observers,
            bodies,
            np.zeros_like(self.missed),
            positions - kept[:, None] * innovations,
            self.velocities + (mixed / total)[:, None] * innovations,
            np.stack((own * kept, mixed * kept, rate - mixed * mixed / total), axis=-1),
        )


_NONE = Tracks(*(np.empty(0, np.int64) for _ in range(3)), *(np.empty((0, size)) for size in (2, 2, 3)))


def associate(
    tracks: Tracks, observers: NDArray[np.int64], positions: NDArray[np.float64], variances: NDArray[np.float64], gate: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Which detection belongs to which track, without identities: one to one, the nearest pair of all first.

    The distance of a pair is in standard deviations of what is expected, that of the track and of the detection together.

    :param observers: the vehicle that detects, ascending, ``(detections,)``
    :param positions: detected, in the observers' odometry frames, ``(detections, 2)`` [m]
    :param variances: of each detected coordinate, ``(detections,)`` [m^2]
    :param gate: largest distance of a pair [standard deviations]
    :return: the associated rows of ``tracks`` and of the detections
    """
    first, last = (np.searchsorted(observers, tracks.observers, side=side) for side in ("left", "right"))
    counts = last - first
    track = np.repeat(np.arange(len(counts)), counts)
    detection = np.repeat(first - (np.cumsum(counts) - counts), counts) + np.arange(len(track))
    squares = np.square(positions[detection] - tracks.positions[track])
    expected = np.maximum(tracks.covariances[track, 0] + variances[detection], _TINY)
    distances = (squares[:, 0] + squares[:, 1]) / expected
    near = np.flatnonzero(distances <= gate * gate)
    near = near[np.argsort(distances[near], kind="stable")]
    track, detection = track[near], detection[near]
    chosen: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    while len(track):
        rank = np.arange(len(track))
        best_of_track, best_of_detection = np.full(len(counts), len(rank)), np.full(len(observers), len(rank))
        best_of_track[track[::-1]] = best_of_detection[detection[::-1]] = rank[::-1]
        is_best = (best_of_track[track] == rank) & (best_of_detection[detection] == rank)
        chosen.append((track[is_best], detection[is_best]))
        taken_tracks, taken_detections = np.zeros(len(counts), bool), np.zeros(len(observers), bool)
        taken_tracks[track[is_best]] = taken_detections[detection[is_best]] = True
        left = ~(taken_tracks[track] | taken_detections[detection])
        track, detection = track[left], detection[left]
    if not chosen:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    return tuple(np.concatenate(parts) for parts in zip(*chosen, strict=True))


class Tracker:
    """The tracks of every vehicle of every flock, and what they give: the bodies where they are now.

    Detections and waypoint are those of the sensors' delay ago; odometry and messages have no delay. A detection that no track
    takes starts a track. A track that takes none survives ``max_missed`` steps, or none where the sensors miss nothing that is in
    their field of view. The waypoint has one track, which takes every measurement.

    :param settings: the tracker's settings, the bounds of the bodies' motion, and the time step
    :param ranges: how far vehicles sense
    :param errors: what is known of the sensors' errors, of each flock where they are randomized

    :ivar tracks: by kind of body: ``neighbors``, ``obstacles``, ``waypoint``
    """

    def __init__(self, settings: SensorSettings, ranges: SensingSettings, errors: FlockValues) -> None:
        own, speed, obstacle_speed = settings.tracker, settings.max_speed, settings.obstacle_max_speed
        self.settings, self.time_step, self._errors = own, settings.time_step, errors
        neighbor, obstacle = own.neighbor_acceleration, own.obstacle_acceleration
        neighbor = speed * settings.max_turn_rate if neighbor is None else neighbor
        obstacle = obstacle_speed * settings.obstacle_turn_std if obstacle is None else obstacle
        self._kinds = {
            "neighbors": _Kind(ranges.link_range, speed, neighbor, own.gate, own.shared_motion),
            "obstacles": _Kind(ranges.known_obstacle_range, obstacle_speed, obstacle, own.gate),
            "waypoint": _Kind(math.inf, speed, speed / _WAYPOINT_TIME, math.inf),
        }
        delay = errors.delay if own.assumed_delay is None else np.full((1, 1), own.assumed_delay)
        self._delays = np.rint(delay[:, 0] / self.time_step).astype(np.int64)
        self._noise = errors.position_noise if own.assumed_noise is None else np.full((1, 1), own.assumed_noise)
        longest = int(self._delays.max())
        self._poses: deque[NDArray[np.float64]] = deque(maxlen=1 + longest)
        self._ways: deque[NDArray[np.float64]] = deque(maxlen=2 + longest)
        self.reset()

    def reset(self) -> None:
        """Drop all tracks."""
        self._steps = 0
        self._poses.clear()
        self._ways.clear()
        self.tracks = dict.fromkeys(self._kinds, _NONE)

    def update(self, measured: Sensing, ego_motion: NDArray[np.float64], messages: Messages | None = None) -> Sensing:
        """Take a measurement, once a step, and estimate where the bodies are now.

        :param measured: in the vehicles' frames of the sensors' delay ago; until the delay is over, the first measurement
        :param ego_motion: since the last step, measured without delay, :attr:`~sb3_flock.sim.Sensing.ego_motion`
        :param messages: needed for ``shared_motion`` alone
        :return: in the vehicles' present frames, the bodies that are in sensing range now
        """
        shape = measured.waypoint_distances.shape
        self._poses.append(_moved(self._poses[-1], ego_motion) if self._steps else np.zeros((*shape, 3)))
        turns = None
        if self.settings.shared_motion:
            if messages is None:
                raise ValueError("messages = None: shared_motion needs what the neighbors share")
            turns = self._take(messages)
        numbers = np.arange(shape[0] * shape[1])
        positions, distances = measured.waypoint_positions.reshape(-1, 2), measured.waypoint_distances.ravel()
        waypoints = Contacts(shape, numbers, np.zeros_like(numbers), positions, distances)
        detected = {"neighbors": measured.neighbors, "obstacles": measured.obstacles, "waypoint": waypoints}
        for name, contacts in detected.items():
            self.tracks[name] = self._after(contacts, self._kinds[name], self.tracks[name], ego_motion, turns)
        self._steps += 1
        neighbors, obstacles, waypoint = (self._now(kind, self.tracks[name], turns) for name, kind in self._kinds.items())
        return Sensing(
            neighbors,
            obstacles,
            waypoint.positions.reshape(*shape, 2),
            waypoint.distances.reshape(shape),
            ego_motion,
            unplaced=None if messages is None or turns is None else _unplaced(neighbors, messages),
        )

    def state_dict(self) -> dict[str, Any]:
        """The tracks and the odometry: plain values and arrays."""
        tracks = {name: dict(vars(tracks)) for name, tracks in self.tracks.items()}
        return {"steps": self._steps, "poses": list(self._poses), "ways": list(self._ways), "tracks": tracks}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.reset()
        self._steps = int(state["steps"])
        self._poses.extend(np.array(pose) for pose in state["poses"])
        self._ways.extend(np.array(way) for way in state["ways"])
        self.tracks = {name: Tracks(**state["tracks"][name]) for name in self._kinds}

    def _take(self, messages: Messages) -> NDArray[np.float64]:
        """Add up how the vehicles moved; the turns from the frame of their headings into their odometry frames, ``(vehicles,)``."""
        headings = np.arctan2(messages.frames[..., 1], messages.frames[..., 0])
        before = np.zeros((*headings.shape, 3))
        before[..., 2] = headings - messages.ego_motion[..., 1]
        way = _moved(before, messages.ego_motion)[..., :2]
        self._ways.append(self._ways[-1] + way if self._ways else np.zeros_like(way))
        return (self._poses[-1][..., 2] - headings).ravel()

    def _after(
        self,
        contacts: Contacts,
        kind: _Kind,
        tracks: Tracks,
        ego_motion: NDArray[np.float64],
        turns: NDArray[np.float64] | None,
    ) -> Tracks:
        """The tracks of one kind after the detections; until the delay is over, there are no new ones after the first."""
        n_flocks, vehicles = contacts.shape
        is_new = np.broadcast_to((self._steps == 0) | (self._steps > self._delays), (n_flocks,))
        waits, is_fresh = ~is_new[tracks.observers // vehicles], is_new[contacts.observers // vehicles]
        waiting, tracks = tracks.select(waits), tracks.select(~waits)
        observers, bodies = contacts.observers[is_fresh], contacts.bodies[is_fresh]
        poses = self._poses_of_detections(n_flocks)
        positions = _to_odometry(contacts.positions[is_fresh], poses[observers])
        variances = np.square(np.broadcast_to(self._noise[:, 0], (n_flocks,))[observers // vehicles])

        ages = self._ages(n_flocks)
        tracks = self._predicted(tracks, kind, ages + 1, ages, turns)
        tracks = tracks.widen(self._drift(tracks, poses, ego_motion) + kind.least_variance)
        track, detection = associate(tracks, observers, positions, variances, kind.gate)
        updated = tracks.select(track).update(positions[detection], variances[detection], bodies[detection])
        missed = tracks.select(np.delete(np.arange(len(tracks.observers)), track))
        missed = replace(missed, missed=missed.missed + 1)
        missed = missed.select((missed.missed <= self.settings.max_missed) & self._may_be_missed(missed, poses, n_flocks))
        first = np.delete(np.arange(len(observers)), detection)
        zeros = np.zeros(len(first), np.int64)
        covariances = np.stack((variances[first], zeros, np.full(len(first), kind.unknown_velocity)), axis=-1)
        born = Tracks(observers[first], bodies[first], zeros, positions[first], np.zeros((len(first), 2)), covariances)
        return _joined(waiting, updated, missed, born)

    def _now(self, kind: _Kind, tracks: Tracks, turns: NDArray[np.float64] | None) -> Contacts:
        """Where the tracked bodies of one kind are now."""
        pose = self._poses[-1]
        ages = self._ages(len(pose))
        tracks = self._predicted(tracks, kind, ages, np.zeros_like(ages), turns)
        positions = _to_body(tracks.positions, pose.reshape(-1, 3)[tracks.observers])
        distances = np.sqrt(np.square(positions).sum(-1))
        near = distances < kind.sensing_range
        stds = np.sqrt(tracks.covariances[near, 0])
        rows = tracks.observers[near], tracks.bodies[near], positions[near], distances[near], stds
        return Contacts((pose.shape[0], pose.shape[1]), *rows)

    def _predicted(
        self,
        tracks: Tracks,
        kind: _Kind,
        since: NDArray[np.int64],
        until: NDArray[np.int64],
        turns: NDArray[np.float64] | None,
    ) -> Tracks:
        """The tracks of some steps ago, ``since``, as they were or are fewer steps ago, ``until``; both ``(flocks,)``."""
        vehicles = self._poses[-1].shape[1]
        flocks = tracks.observers // vehicles
        if turns is None or not kind.shares_motion:
            return tracks.predict((since - until)[flocks] * self.time_step, kind.acceleration**2 * self.time_step)
        last, first = len(self._ways) - 1, np.minimum(since, len(self._ways) - 1)
        steps = enumerate(zip(first.tolist(), until.tolist(), strict=True))
        ways = np.concatenate([self._ways[last - end][f] - self._ways[last - start][f] for f, (start, end) in steps])
        own = ways[flocks * vehicles + tracks.bodies]
        angles = turns[tracks.observers]
        shared = to_body(own, np.stack((np.cos(angles), -np.sin(angles)), axis=-1))
        relative = self.settings.shared_motion_noise**2 + np.square(self._errors.of_flocks("odometry_noise", len(since)))
        moved = replace(tracks, positions=tracks.positions + shared)
        return moved.widen(relative[flocks] * np.square(own).sum(-1))

    def _ages(self, n_flocks: int) -> NDArray[np.int64]:
        """How many steps ago the last detections were made, ``(flocks,)``."""
        return np.broadcast_to(np.minimum(self._delays, len(self._poses) - 1), (n_flocks,))

    def _poses_of_detections(self, n_flocks: int) -> NDArray[np.float64]:
        """The vehicles' poses when the last detections were made, ``(vehicles of all flocks, 3)``."""
        last = len(self._poses) - 1
        return np.concatenate([self._poses[last - age][flock] for flock, age in enumerate(self._ages(n_flocks).tolist())])

    def _drift(
        self, tracks: Tracks, poses: NDArray[np.float64], ego_motion: NDArray[np.float64]
    ) -> NDArray[np.float64] | float:
        """Variance that errors of a vehicle's own odometry in a step give to its tracks, ``(tracks,)`` [m^2]."""
        if not self._errors.is_on("odometry_noise"):
            return 0.0
        errors = np.square(self._errors.odometry_noise[..., None] * ego_motion)
        forward, turn = (part.ravel()[tracks.observers] for part in (errors[..., ::2].sum(-1), errors[..., 1]))
        return forward + turn * np.square(tracks.positions - poses[tracks.observers, :2]).sum(-1)

    def _may_be_missed(self, tracks: Tracks, poses: NDArray[np.float64], n_flocks: int) -> NDArray[np.bool_]:
        """Whether a body whose track took no detection may be in range all the same, ``(tracks,)``."""
        dropout, occlusion, view = (
            self._errors.of_flocks(name, n_flocks) for name in ("dropout", "occlusion", "field_of_view")
        )
        flocks = tracks.observers // (len(poses) // n_flocks)
        positions = _to_body(tracks.positions, poses[tracks.observers])
        is_out_of_view = np.abs(np.arctan2(positions[:, 1], positions[:, 0])) > view[flocks] / 2
        return is_out_of_view | ((dropout > 0) | (occlusion > 0))[flocks]


class _Kind(NamedTuple):
    """What is known of the motion of one kind of body."""

    sensing_range: float
    max_speed: float
    acceleration: float
    gate: float
    shares_motion: bool = False

    @property
    def least_variance(self) -> float:
        """Of a predicted coordinate [m^2]."""
        return 0.0 if math.isinf(self.sensing_range) else (_ROUNDING * self.sensing_range) ** 2

    @property
    def unknown_velocity(self) -> float:
        """Variance of each coordinate of a velocity of which nothing is measured yet [m^2/s^2]."""
        return 0.0 if self.shares_motion else (self.max_speed / 2) ** 2


def _unplaced(neighbors: Contacts, messages: Messages) -> NDArray[np.bool_]:
    """Which vehicles receive a message of a neighbor that none of their tracks is of, ``(vehicles of all flocks,)``."""
    flocks, vehicles = neighbors.shape
    tracked = neighbors.observers * vehicles + neighbors.bodies
    is_unknown = ~np.isin(messages.receivers * vehicles + messages.senders, tracked)
    return np.bincount(messages.receivers[is_unknown], minlength=flocks * vehicles) > 0


def _joined(*parts: Tracks) -> Tracks:
    """Tracks together, in the order of the vehicles that track, then of the bodies."""
    joined = Tracks(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Tracks)))
    return joined.select(np.lexsort((joined.bodies, joined.observers)))


def _moved(poses: NDArray[np.float64], ego_motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses ``(..., 3)`` [m, m, rad] after an :attr:`~sb3_flock.sim.Sensing.ego_motion`."""
    left = ego_motion[..., 2] if ego_motion.shape[-1] > 2 else np.zeros(ego_motion.shape[:-1])
    places = _to_odometry(np.stack((ego_motion[..., 0], left), axis=-1), poses)
    return np.concatenate((places, (poses[..., 2] + ego_motion[..., 1])[..., None]), axis=-1)


def _to_odometry(positions: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions in body frames ``(..., 2)`` [m], in the odometry frame in which the bodies have the poses ``(..., 3)``."""
    back = np.stack((np.cos(poses[..., 2]), -np.sin(poses[..., 2])), axis=-1)
    return poses[..., :2] + to_body(positions, back)


def _to_body(positions: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse of :func:`_to_odometry`."""
    return to_body(positions - poses[..., :2], np.stack((np.cos(poses[..., 2]), np.sin(poses[..., 2])), axis=-1))
