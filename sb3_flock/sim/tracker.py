"""On-board estimation: each vehicle tracks the bodies that it senses, from noisy, late and incomplete detections.

A track is a Kalman filter with constant velocity in the vehicle's odometry frame, so that the vehicle's own motion is
compensated by the change of its pose. Detections carry no identities: gates and a one-to-one assignment of nearest neighbors
associate them with tracks (Bar-Shalom, Li and Kirubarajan: Estimation with Applications to Tracking and Navigation, 2001).
``docs/tracker.md`` has the equations and what the tracker gives.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from pydantic import Field

from sb3_flock.settings import NotNegative, Positive, Settings
from sb3_flock.sim.sensing import Contacts, Sensing, rotate, to_body

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.dynamics import DynamicsSettings
    from sb3_flock.sim.randomization import FlockValues
    from sb3_flock.sim.sensing import SensingSettings

_WAYPOINT_TIME = 1.0
"""Time in which the waypoint changes its velocity by about the vehicles' top speed [s]."""

_ROUNDING = 1e-6
"""Least standard deviation of a predicted position [sensing ranges]: a gate is never narrower than rounding errors."""

_TINY = 1e-300
"""Smallest variance that is divided by [m^2]."""


class TrackerSettings(Settings):
    """The estimation on board; off by default, as in the paper."""

    enabled: bool = Field(
        False,
        description="vehicles track what they sense, and act on the estimates instead of the measurements (paper: false)",
    )
    neighbor_acceleration: Positive | None = Field(
        None,
        description="standard deviation of a neighbor's change of velocity in a step, divided by time_step [m/s^2]; "
        "null: half of max_speed times max_turn_rate (paper: none)",
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
        description="margin for the uncertainty of an estimated position: the safety filter keeps that of a neighbor beyond "
        "safety_margin, and an obstacle is taken to be that much nearer [standard deviations] (paper: none)",
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
    """Tracked bodies: one row a track, in the order of their series.

    A series is one kind of bodies that one vehicle tracks. Series number k n + i is that of kind k and vehicle i, of n vehicles
    in all flocks. The covariance of a track is the same along both axes, without correlation between them.
    """

    labels: NDArray[np.int64]
    """``(tracks, 3)``: the series, the number of the body whose detection the track took last, on which no estimate depends, and
    the detections in succession that the track has missed."""
    means: NDArray[np.float64]
    """``(tracks, 4)``: position [m] and velocity over ground [m/s], in the vehicle's odometry frame."""
    covariances: NDArray[np.float64]
    """``(tracks, 3)``: of a coordinate [m^2], of a coordinate and its velocity [m^2/s], of the velocity [m^2/s^2]."""

    def select(self, rows: NDArray[Any]) -> Tracks:
        """Some of the tracks."""
        return Tracks(self.labels[rows], self.means[rows], self.covariances[rows])

    def predict(self, times: NDArray[np.floating] | float, intensities: NDArray[np.float64]) -> Tracks:
        """The tracks some time later: constant velocity, disturbed by white noise of the acceleration.

        :param times: ``(tracks,)`` [s], or one for all
        :param intensities: of the noise, ``(tracks,)`` [m^2/s^3]
        """
        own, mixed, rate = self.covariances.T
        means, covariances = self.means.copy(), np.empty_like(self.covariances)
        means[:, :2] += np.reshape(times, (-1, 1)) * means[:, 2:]
        covariances[:, 0] = own + times * (2 * mixed + times * (rate + intensities * times / 3))
        covariances[:, 1] = mixed + times * (rate + intensities * times / 2)
        covariances[:, 2] = rate + intensities * times
        return Tracks(self.labels, means, covariances)

    def update(self, positions: NDArray[np.float64], variances: NDArray[np.float64], bodies: NDArray[np.int64]) -> Tracks:
        """The tracks after a detection of each.

        :param positions: detected, ``(tracks, 2)`` [m]
        :param variances: of each detected coordinate, ``(tracks,)`` [m^2]
        :param bodies: the detected ones, ``(tracks,)``
        """
        own, mixed, rate = self.covariances.T
        total = np.maximum(own + variances, _TINY)
        kept, gain = variances / total, mixed / total
        labels, means, covariances = self.labels.copy(), self.means.copy(), np.empty_like(self.covariances)
        innovations = positions - means[:, :2]
        labels[:, 1], labels[:, 2] = bodies, 0
        means[:, :2] = positions - kept[:, None] * innovations  # exactly the position where there is no noise
        means[:, 2:] += gain[:, None] * innovations
        covariances[:, 0], covariances[:, 1], covariances[:, 2] = own * kept, mixed * kept, rate - mixed * gain
        return Tracks(labels, means, covariances)


_NONE = Tracks(np.empty((0, 3), np.int64), np.empty((0, 4)), np.empty((0, 3)))


def associate(
    tracks: Tracks,
    series: NDArray[np.int64],
    positions: NDArray[np.float64],
    variances: NDArray[np.float64],
    gates: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Which detection belongs to which track of its series, without identities: one to one, the nearest pair of all first.

    The distance of a pair is in standard deviations of what is expected, that of the track and of the detection together.

    :param series: of each detection, ascending, ``(detections,)``
    :param positions: detected, in the vehicles' odometry frames, ``(detections, 2)`` [m]
    :param variances: of each detected coordinate, ``(detections,)`` [m^2]
    :param gates: largest distance of each detection from its track, ``(detections,)`` [standard deviations]
    :return: the associated rows of ``tracks`` and of the detections
    """
    first = np.searchsorted(series, tracks.labels[:, 0])
    counts = np.searchsorted(series, tracks.labels[:, 0], side="right") - first
    track = np.repeat(np.arange(len(counts)), counts)
    detection = np.repeat(first - (np.cumsum(counts) - counts), counts) + np.arange(len(track))
    squares = np.square(positions[detection] - tracks.means[track, :2])
    expected = np.maximum(tracks.covariances[track, 0] + variances[detection], _TINY)
    distances = (squares[:, 0] + squares[:, 1]) / expected
    near = np.flatnonzero(distances <= np.square(gates)[detection])
    near = near[np.argsort(distances[near], kind="stable")]
    track, detection = track[near], detection[near]
    of_track, of_detection = np.full(len(counts), -1), np.empty(len(series), np.int64)
    while len(track):
        rank = np.arange(len(track))[::-1]  # of several values for one place the last one stays: the nearest pair
        best_of_track, best_of_detection = np.empty(len(counts), np.int64), np.empty(len(series), np.int64)
        best_of_track[track[::-1]] = best_of_detection[detection[::-1]] = rank
        is_best = best_of_track[track] == best_of_detection[detection]
        of_track[track[is_best]] = detection[is_best]
        of_detection[:] = -1
        of_detection[detection[is_best]] = 0
        left = (of_track[track] < 0) & (of_detection[detection] < 0)
        track, detection = track[left], detection[left]
    found = np.flatnonzero(of_track >= 0)
    return found, of_track[found]


class Tracker:
    """The tracks of every vehicle of every flock, and what they give: the bodies where they are now.

    An obstacle is given nearer to the vehicle than estimated by ``margin_stds`` standard deviations, so that policies, which keep
    to the distances that they see, keep that margin.

    Detections and waypoint are those of the sensors' delay ago; odometry and messages have no delay. A detection that no track
    takes starts a track. A track that takes none survives ``max_missed`` steps, or none where the sensors miss nothing that is in
    their field of view. The waypoint has one track, which takes every measurement. With ``shared_motion`` a track of a neighbor
    belongs to the messages of the vehicle whose detection it took last.

    :param settings: the tracker's settings
    :param dynamics: the bounds of the bodies' motion, and the time step
    :param ranges: how far vehicles sense
    :param errors: what is known of the sensors' errors, of each flock where they are randomized
    """

    def __init__(
        self, settings: TrackerSettings, dynamics: DynamicsSettings, ranges: SensingSettings, errors: FlockValues
    ) -> None:
        own, speed, obstacle_speed = settings, dynamics.max_speed, dynamics.obstacle_max_speed
        self.settings, self.time_step, self._errors = settings, dynamics.time_step, errors
        neighbor, obstacle = own.neighbor_acceleration, own.obstacle_acceleration
        neighbor = speed * dynamics.max_turn_rate / 2 if neighbor is None else neighbor
        obstacle = obstacle_speed * dynamics.obstacle_turn_std if obstacle is None else obstacle
        accelerations = np.array([neighbor, obstacle, speed / _WAYPOINT_TIME])
        speeds = np.array([speed, obstacle_speed, speed])
        if own.shared_motion:
            speeds[0] = accelerations[0] = 0.0  # no velocity of a neighbor is estimated
        self._ranges = np.array([ranges.link_range, ranges.known_obstacle_range, np.inf])
        self._gates = np.array([own.gate, own.gate, np.inf])
        self._unknown_velocity = np.square(speeds / 2)
        self._intensities = np.square(accelerations) * self.time_step
        self._least_variance = np.square(_ROUNDING * ranges.link_range)
        delay = errors.delay if own.assumed_delay is None else np.full((1, 1), own.assumed_delay)
        self._delays = np.rint(delay[:, 0] / self.time_step).astype(np.int64)
        noise = errors.position_noise if own.assumed_noise is None else np.full((1, 1), own.assumed_noise)
        self._variances = np.square(noise[:, 0])
        self._poses: deque[NDArray[np.float64]] = deque(maxlen=1 + self.delay_steps)
        self._ways: deque[NDArray[np.float64]] = deque(maxlen=2 + self.delay_steps)
        self._heard = np.empty((2, 0), np.int64)
        self.reset()

    @property
    def delay_steps(self) -> int:
        """The longest delay of any flock's detections [steps]."""
        return int(self._delays.max())

    def reset(self) -> None:
        """Drop all tracks."""
        self._steps, self.tracks, self._shape = 0, _NONE, (0, 0)
        self._poses.clear()
        self._ways.clear()
        self._heard = self._heard[:, :0]

    def update(self, measured: Sensing, ego_motion: NDArray[np.float64], messages: Messages | None = None) -> Sensing:
        """Take a measurement, once a step, and estimate where the bodies are now.

        :param measured: in the vehicles' frames of the sensors' delay ago; until the delay is over, the first measurement
        :param ego_motion: since the last step, measured without delay, :attr:`~sb3_flock.sim.Sensing.ego_motion`
        :param messages: needed for ``shared_motion`` alone
        :return: in the vehicles' present frames, the bodies that are in sensing range now
        :raises ValueError: without messages that are needed
        """
        n_flocks, vehicles = self._shape = measured.waypoint_distances.shape
        motion = ego_motion.reshape(n_flocks * vehicles, -1)
        start = np.tile((0.0, 0.0, 1.0, 0.0), (len(motion), 1))
        self._poses.append(_moved(self._poses[-1], motion) if self._steps else start)
        frames = None
        if self.settings.shared_motion:
            if messages is None:
                raise ValueError("messages = None: shared_motion needs what the neighbors share")
            frames = self._take(messages)
            self._end_unheard(messages)
        is_new = np.broadcast_to((self._steps == 0) | (self._steps > self._delays), (n_flocks,))
        ages = np.broadcast_to(np.minimum(self._delays, self._steps), (n_flocks,)).repeat(vehicles)
        if is_new.any():
            self._correct(measured, motion, frames, ages, is_new)
            if messages is not None and frames is not None:
                self._end_unheard(messages)
        self._steps += 1
        return self._now(ego_motion, frames, ages, messages)

    def state_dict(self) -> dict[str, Any]:
        """The tracks and the odometry: plain values and arrays."""
        return {
            "steps": self._steps,
            "poses": list(self._poses),
            "ways": list(self._ways),
            "heard": self._heard,
            "tracks": dict(vars(self.tracks)),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.reset()
        self._steps = int(state["steps"])
        self._poses.extend(np.array(pose) for pose in state["poses"])
        self._ways.extend(np.array(way) for way in state["ways"])
        self._heard = np.array(state["heard"])
        self.tracks = Tracks(**state["tracks"])

    def _take(self, messages: Messages) -> NDArray[np.float64]:
        """Add up how the vehicles moved.

        :return: cosine and sine of the turns from the odometry frames into that of the headings, ``(vehicles, 2)``
        """
        headings = messages.frames.reshape(-1, 2)
        motion = messages.ego_motion.reshape(len(headings), -1)
        before = np.zeros((len(headings), 4))
        before[:, 2:] = rotate(headings, -motion[:, 1])
        way = _moved(before, motion)[:, :2]
        self._ways.append(self._ways[-1] + way if self._ways else np.zeros_like(way))
        (cos, sin), (own_cos, own_sin) = headings.T, self._poses[-1][:, 2:].T
        return np.stack((cos * own_cos + sin * own_sin, sin * own_cos - cos * own_sin), axis=-1)

    def _end_unheard(self, messages: Messages) -> None:
        """End the tracks of neighbors whose messages are not received: they are out of link range."""
        series, senders = self.tracks.labels[:, 0], self.tracks.labels[:, 1]
        is_heard = np.isin(series * self._shape[1] + senders, messages.receivers * self._shape[1] + messages.senders)
        self.tracks = self.tracks.select(is_heard | (series >= len(self._poses[-1])))

    def _correct(
        self,
        measured: Sensing,
        motion: NDArray[np.float64],
        frames: NDArray[np.float64] | None,
        ages: NDArray[np.int64],
        is_new: NDArray[np.bool_],
    ) -> None:
        """Let the tracks take the detections; until the delay is over, there are no new ones after the first.

        :param ages: how many steps ago the detections were made, ``(vehicles of all flocks,)``
        :param is_new: which flocks have new ones, ``(flocks,)``
        """
        size, vehicles = len(ages), self._shape[1]
        found = measured.neighbors, measured.obstacles
        numbers = np.arange(size)
        observers = np.concatenate((*(contacts.observers for contacts in found), numbers))
        bodies = np.concatenate((*(contacts.bodies for contacts in found), np.zeros_like(numbers)))
        positions = np.concatenate((*(contacts.positions for contacts in found), measured.waypoint_positions.reshape(-1, 2)))
        kinds = np.repeat(np.arange(3), [*(len(contacts.observers) for contacts in found), size])
        waiting, tracks = _NONE, self.tracks
        if not is_new.all():
            fresh = is_new[observers // vehicles]
            observers, bodies, positions, kinds = observers[fresh], bodies[fresh], positions[fresh], kinds[fresh]
            fresh = is_new[tracks.labels[:, 0] % size // vehicles]
            waiting, tracks = tracks.select(~fresh), tracks.select(fresh)
        poses = _at(self._poses, ages)
        positions = _to_odometry(positions, poses[observers])
        variances = np.broadcast_to(self._variances, is_new.shape)[observers // vehicles]

        tracks = self._predicted(tracks, frames, ages + 1, ages)
        tracks.covariances[:, 0] += self._least_variance + self._drift(tracks, poses, motion)
        series = kinds * size + observers
        track, detection = associate(tracks, series, positions, variances, self._gates[kinds])
        updated = tracks.select(track).update(positions[detection], variances[detection], bodies[detection])
        is_left, is_unknown = np.ones(len(tracks.labels), bool), np.ones(len(series), bool)
        is_left[track] = is_unknown[detection] = False
        missed = self._surviving(tracks.select(is_left), poses)
        labels = np.stack((series, bodies, np.zeros_like(bodies)), axis=-1)[is_unknown]
        means = np.concatenate((positions, np.zeros_like(positions)), axis=-1)[is_unknown]
        covariances = np.stack((variances, np.zeros_like(variances), self._unknown_velocity[kinds]), axis=-1)[is_unknown]
        self.tracks = _joined(waiting, updated, missed, Tracks(labels, means, covariances))

    def _now(
        self,
        ego_motion: NDArray[np.float64],
        frames: NDArray[np.float64] | None,
        ages: NDArray[np.int64],
        messages: Messages | None,
    ) -> Sensing:
        """The tracked bodies where they are now, as far as they are in range; obstacles nearer by their margin."""
        shape, size = self._shape, len(ages)
        tracks = self._predicted(self.tracks, frames, ages, np.zeros_like(ages))
        kinds, observers = np.divmod(tracks.labels[:, 0], size)
        positions, stds = _to_body(tracks.means[:, :2], self._poses[-1][observers]), np.sqrt(tracks.covariances[:, 0])
        distances = np.sqrt(np.square(positions[:, 0]) + np.square(positions[:, 1]))
        near = distances < self._ranges[kinds]
        margins = np.where(kinds == 1, np.minimum(self.settings.margin_stds * stds, distances), 0.0)
        positions *= (1 - margins / np.maximum(distances, _TINY))[:, None]
        distances = distances - margins
        columns = observers, tracks.labels[:, 1], positions, distances, stds
        neighbors, obstacles = (
            Contacts(shape, *(column[near & (kinds == kind)] for column in columns)) for kind in range(2)
        )
        waypoint = slice(len(kinds) - size, None)
        unplaced = None if messages is None or frames is None else self._unplaced(neighbors, messages)
        places, ways = positions[waypoint].reshape(*shape, 2), distances[waypoint].reshape(shape)
        return Sensing(neighbors, obstacles, places, ways, ego_motion, unplaced=unplaced)

    def _predicted(
        self, tracks: Tracks, frames: NDArray[np.float64] | None, since: NDArray[np.int64], until: NDArray[np.int64]
    ) -> Tracks:
        """The tracks of some steps ago, ``since``, as they are fewer steps ago, ``until``; both ``(vehicles of all flocks,)``."""
        kinds, observers = np.divmod(tracks.labels[:, 0], len(since))
        steps = (since - until)[observers]
        tracks = tracks.predict(steps * self.time_step, self._intensities[kinds])
        if frames is not None:
            rows = np.searchsorted(tracks.labels[:, 0], len(since))  # the neighbors are first
            observers, vehicles = observers[:rows], self._shape[1]
            senders = observers // vehicles * vehicles + tracks.labels[:rows, 1]
            ways = (_at(self._ways, until) - _at(self._ways, since))[senders]
            odometry = self._errors.of_flocks("odometry_noise", len(since) // vehicles)[observers // vehicles]
            tracks.means[:rows, :2] += to_body(ways, frames[observers])
            relative = self.settings.shared_motion_noise**2 + np.square(odometry)
            tracks.covariances[:rows, 0] += relative * (np.square(ways[:, 0]) + np.square(ways[:, 1]))
        return tracks

    def _drift(self, tracks: Tracks, poses: NDArray[np.float64], motion: NDArray[np.float64]) -> NDArray[np.float64] | float:
        """Variance that errors of a vehicle's own odometry in a step give to its tracks, ``(tracks,)`` [m^2]."""
        if not self._errors.is_on("odometry_noise"):
            return 0.0
        noise = self._errors.of_flocks("odometry_noise", len(poses) // self._shape[1]).repeat(self._shape[1])
        errors = np.square(noise[:, None] * motion)
        observers = tracks.labels[:, 0] % len(poses)
        offsets = np.square(tracks.means[:, :2] - poses[observers, :2]).sum(-1)
        return errors[observers, ::2].sum(-1) + errors[observers, 1] * offsets

    def _surviving(self, tracks: Tracks, poses: NDArray[np.float64]) -> Tracks:
        """Those of the tracks that took no detection whose bodies may be in range all the same."""
        labels = tracks.labels + np.array([0, 0, 1])
        observers, n_flocks = labels[:, 0] % len(poses), len(poses) // self._shape[1]
        flocks = observers // self._shape[1]
        dropout, occlusion, view = (
            self._errors.of_flocks(name, n_flocks)[flocks] for name in ("dropout", "occlusion", "field_of_view")
        )
        x, y = _to_body(tracks.means[:, :2], poses[observers]).T
        may_be_missed = (dropout > 0) | (occlusion > 0) | (np.abs(np.arctan2(y, x)) > view / 2)
        survive = may_be_missed & (labels[:, 2] <= self.settings.max_missed)
        return Tracks(labels, tracks.means, tracks.covariances).select(survive)

    def _unplaced(self, neighbors: Contacts, messages: Messages) -> NDArray[np.bool_]:
        """Which vehicles receive messages of a neighbor that none of their tracks is of, ``(vehicles of all flocks,)``.

        A neighbor that is not detected in the time that the sensors need is out of view, and does not count any more.
        """
        n_flocks, vehicles = neighbors.shape
        pairs, steps = messages.receivers * vehicles + messages.senders, np.zeros(len(messages.receivers), np.int64)
        known, at = np.isin(pairs, self._heard[0]), np.searchsorted(self._heard[0], pairs)
        steps[known] = self._heard[1, at[known]] + 1
        self._heard = np.stack((pairs, steps))
        misses = np.where(self._errors.of_flocks("dropout", n_flocks) > 0, self.settings.max_missed, 0)
        patience = np.broadcast_to(self._delays, (n_flocks,)) + misses
        counts = steps < patience[messages.receivers // vehicles]
        counts &= ~np.isin(pairs, neighbors.observers * vehicles + neighbors.bodies)
        return np.bincount(messages.receivers[counts], minlength=n_flocks * vehicles) > 0


def _joined(*parts: Tracks) -> Tracks:
    """Tracks together, in the order of their series, then of the bodies."""
    columns = zip(*((part.labels, part.means, part.covariances) for part in parts), strict=True)
    joined = Tracks(*(np.concatenate(column) for column in columns))
    return joined.select(np.lexsort((joined.labels[:, 1], joined.labels[:, 0])))


def _at(history: Sequence[NDArray[np.float64]], ages: NDArray[np.int64]) -> NDArray[np.float64]:
    """The rows of some steps ago, or of the oldest: ``ages`` has the number of steps for each."""
    last = len(history) - 1
    ages = np.minimum(ages, last)
    if (ages == ages[0]).all():
        return history[last - int(ages[0])]
    return np.stack(list(history))[last - ages, np.arange(len(ages))]


def _moved(poses: NDArray[np.float64], motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses ``(vehicles, 4)``, position [m] and the heading's cosine and sine, after an ego-motion ``(vehicles, 2 or 3)``."""
    left = motion[:, 2] if motion.shape[1] > 2 else np.zeros(len(motion))
    places = _to_odometry(np.stack((motion[:, 0], left), axis=-1), poses)
    return np.concatenate((places, rotate(poses[:, 2:], motion[:, 1])), axis=-1)


def _to_odometry(positions: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions in body frames ``(any, 2)`` [m], in the odometry frame in which the bodies have the poses ``(any, 4)``."""
    (x, y), (at_x, at_y, cos, sin) = positions.T, poses.T
    return np.stack((at_x + cos * x - sin * y, at_y + sin * x + cos * y), axis=-1)


def _to_body(positions: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse of :func:`_to_odometry`."""
    return to_body(positions - poses[:, :2], poses[:, 2:])
