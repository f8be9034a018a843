"""What vehicles sense: body frames, the proximity graph and detections (section III-A)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from pydantic import Field, model_validator

from sb3_flock.settings import NotNegative, Positive, Settings
from sb3_flock.sim.backend import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray

_FEW = 128
"""Largest number of bodies for which all pairs are compared; for more, a cell list is faster."""

_BLOCK = 1_000_000
"""Largest number of distances in memory at once in :func:`distance_blocks`."""


class SensingSettings(Settings):
    """How far vehicles sense, and the minimum separations they have to keep."""

    link_range: Positive = Field(0.15, description="proximity network threshold r_n [m] (paper: 0.15)")
    neighbor_separation: NotNegative = Field(0.1, description="minimum separation to neighbors r_n' [m] (paper: 0.1)")
    detection_range: Positive = Field(0.25, description="obstacle detection range r_o [m] (paper: 0.25)")
    obstacle_separation: NotNegative = Field(0.15, description="minimum separation to obstacles r_o' [m] (paper: 0.15)")
    shared_detections: bool = Field(
        False,
        description="neighbors share by communication where the obstacles are that they detect (paper: false)",
    )

    @model_validator(mode="after")
    def _ranges_fit(self) -> SensingSettings:
        for near, far in (("neighbor_separation", "link_range"), ("obstacle_separation", "detection_range")):
            if getattr(self, near) > getattr(self, far):
                raise ValueError(f"{near} = {getattr(self, near)}: input should be at most {far} = {getattr(self, far)}")
        return self

    @property
    def known_obstacle_range(self) -> float:
        """Distance within which every obstacle lies that a vehicle or one of its neighbors detects [m]."""
        return self.detection_range + (self.link_range if self.shared_detections else 0.0)


@dataclass(frozen=True)
class Contacts:
    """Who senses whom: one row a pair, in the order of the sensing vehicles, then of the sensed bodies.

    Memory and time grow with the pairs in range, not with the square of the bodies.
    """

    shape: tuple[int, int]
    """``(flocks, vehicles)``."""
    observers: NDArray[np.int64]
    """``(contacts,)``: the vehicle that senses; vehicle i of flock f has the number f * vehicles + i."""
    bodies: NDArray[np.int64]
    """``(contacts,)``: the number of the sensed body within the flock."""
    positions: NDArray[np.float64]
    """``(contacts, 2)`` [m], of the body in the observer's frame: forward is +x, left is +y."""
    distances: NDArray[np.float64]
    """``(contacts,)`` [m]."""
    stds: NDArray[np.float64] | None = None
    """Standard deviation of each coordinate of an estimated position, ``(contacts,)`` [m]; ``None`` for measured ones."""

    def count(self, closer_than: float = np.inf) -> NDArray[np.int64]:
        """How many bodies each vehicle senses nearer than a distance [m] (strictly); ``(flocks, vehicles)``."""
        kernels = compiled()
        if kernels is not None:
            return kernels.count_closer(self.observers, self.distances, closer_than, self._size).reshape(self.shape)
        near = self.observers if closer_than == np.inf else self.observers[self.distances < closer_than]
        counts: NDArray[np.int64] = np.bincount(near, minlength=self._size)
        return counts.reshape(self.shape)

    def sum(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """A value a contact, ``(contacts,)``, added up by observer: ``(flocks, vehicles)``."""
        return np.bincount(self.observers, values, minlength=self._size).astype(np.float64, copy=False).reshape(self.shape)

    def by_observer(self) -> list[NDArray[np.int64]]:
        """The bodies that each vehicle senses, ascending; one array a vehicle."""
        ends = np.cumsum(self.count()).tolist()
        return [self.bodies[start:end] for start, end in zip([0, *ends], ends, strict=False)]

    def compensate_ego_motion(self, ego_motion: NDArray[np.float64]) -> Contacts:
        """The same bodies, where they were, in the observers' frames after a further ego-motion ``(contacts, 2 or 3)``."""
        positions = compensate_ego_motion(self.positions, ego_motion)
        return replace(self, positions=positions, distances=_norm(positions))

    @property
    def vehicles(self) -> NDArray[np.int64]:
        """``bodies`` numbered like ``observers``, where they are vehicles."""
        n = self.shape[1]
        return self.observers // n * n + self.bodies

    @property
    def _size(self) -> int:
        return self.shape[0] * self.shape[1]


class Bodies(NamedTuple):
    """Where the bodies of every flock are."""

    positions: NDArray[np.float64]
    """Of the vehicles, ``(flocks, vehicles, 2)`` [m]."""
    frames: NDArray[np.float64]
    """Cosine and sine of their headings, ``(flocks, vehicles, 2)``."""
    obstacle_positions: NDArray[np.float64]
    """``(flocks, obstacles, 2)`` [m]."""


@dataclass(frozen=True)
class Sensing:
    """What every vehicle senses, in its own body frame: forward is +x, left is +y. Distances in meters."""

    neighbors: Contacts
    """The proximity graph: d_ij < r_n."""
    obstacles: Contacts
    """Detected obstacles, d_io < r_o, and with ``shared_detections`` those that a neighbor detects."""
    waypoint_positions: NDArray[np.float64]
    """``(flocks, vehicles, 2)``."""
    waypoint_distances: NDArray[np.float64]
    """``(flocks, vehicles)``."""
    ego_motion: NDArray[np.float64]
    """The vehicle's own motion since the last step, forward [m], then turn [rad], ``(flocks, vehicles, 2)``; 0 at the start.
    Where vehicles also move to the side, ``(flocks, vehicles, 3)``: the third is to the left [m], before the turn."""
    previous: Sensing | None = None
    """What was sensed ``motion_lag`` ago, in the vehicles' present frames; ``None`` without motion channels."""
    unplaced: NDArray[np.bool_] | None = None
    """Whether a vehicle receives messages of a neighbor whose place it does not know yet, ``(vehicles of all flocks,)``; ``None``
    without a tracker and ``shared_motion``."""

    def compensate_ego_motion(self, ego_motion: NDArray[np.float64]) -> Sensing:
        """The same bodies, where they were, in the vehicles' frames after a further :attr:`ego_motion`."""
        neighbors, obstacles = (
            contacts.compensate_ego_motion(ego_motion.reshape(-1, ego_motion.shape[-1])[contacts.observers])
            for contacts in (self.neighbors, self.obstacles)
        )
        waypoints = compensate_ego_motion(self.waypoint_positions, ego_motion)
        return replace(
            self,
            neighbors=neighbors,
            obstacles=obstacles,
            waypoint_positions=waypoints,
            waypoint_distances=_norm(waypoints),
        )


def sense(
    positions: NDArray[np.float64],
    frames: NDArray[np.float64],
    obstacle_positions: NDArray[np.float64],
    waypoints: NDArray[np.float64],
    ranges: SensingSettings,
    ego_motion: NDArray[np.float64] | None = None,
) -> Sensing:
    """Everything the vehicles of every flock sense: the graphs G_c and G_o and the waypoint (section III-A).

    :param positions: of the vehicles, ``(flocks, vehicles, 2)`` [m]
    :param frames: cosine and sine of their headings, ``(flocks, vehicles, 2)``
    :param obstacle_positions: ``(flocks, obstacles, 2)`` [m]
    :param waypoints: ``(flocks, 2)`` [m]
    :param ranges: how far vehicles sense
    :param ego_motion: :attr:`Sensing.ego_motion`; ``None`` at the start
    """
    link_range, detection_range, shape = ranges.link_range, ranges.detection_range, positions.shape[:2]
    if ego_motion is None:
        ego_motion = np.zeros_like(positions)
    kernels = compiled() if max(positions.shape[1], obstacle_positions.shape[1]) <= _FEW else None
    if kernels is not None:
        sensed = kernels.sense(positions, frames, obstacle_positions, waypoints, link_range, detection_range)
        sensing = Sensing(Contacts(shape, *sensed[0]), Contacts(shape, *sensed[1]), sensed[2], sensed[3], ego_motion)
    else:
        offsets = waypoints[:, None, :] - positions
        sensing = Sensing(
            neighbors=find_contacts(positions, frames, positions, link_range, exclude_self=True),
            obstacles=find_contacts(positions, frames, obstacle_positions, detection_range),
            waypoint_positions=to_body(offsets, frames),
            waypoint_distances=_norm(offsets),
            ego_motion=ego_motion,
        )
    if not ranges.shared_detections:
        return sensing
    shared = share_detections(sensing.neighbors, sensing.obstacles, positions, frames, obstacle_positions)
    return replace(sensing, obstacles=shared)


def share_detections(
    neighbors: Contacts,
    detected: Contacts,
    positions: NDArray[np.float64],
    frames: NDArray[np.float64],
    obstacle_positions: NDArray[np.float64],
) -> Contacts:
    """The obstacles that each vehicle or one of its neighbors detects.

    :param neighbors: the proximity graph
    :param detected: the obstacles that the vehicles detect themselves
    :param positions: of the vehicles, ``(flocks, vehicles, 2)`` [m]
    :param frames: cosine and sine of their headings, ``(flocks, vehicles, 2)``
    :param obstacle_positions: ``(flocks, obstacles, 2)`` [m]
    """
    n_obstacles = obstacle_positions.shape[1]
    observers, bodies = np.divmod(shared_keys(neighbors, detected, n_obstacles), n_obstacles)
    flocks = observers // positions.shape[1]
    offsets = obstacle_positions[flocks, bodies] - positions.reshape(-1, 2)[observers]
    return Contacts(detected.shape, observers, bodies, to_body(offsets, frames.reshape(-1, 2)[observers]), _norm(offsets))


def shared_keys(neighbors: Contacts, detected: Contacts, n_obstacles: int) -> NDArray[np.int64]:
    """Which obstacles each vehicle or one of its neighbors detects: ascending numbers observer * n_obstacles + obstacle."""
    counts = detected.count().ravel()
    shared = counts[neighbors.vehicles]  # how many obstacles each neighbor detects
    first = np.repeat((np.cumsum(counts) - counts)[neighbors.vehicles] - (np.cumsum(shared) - shared), shared)
    bodies = detected.bodies[first + np.arange(len(first))]
    observers = np.concatenate((detected.observers, np.repeat(neighbors.observers, shared)))
    return np.unique(observers * n_obstacles + np.concatenate((detected.bodies, bodies)))


def compensate_ego_motion(positions: NDArray[np.float64], ego_motion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions in a body's frame, transformed into its frame after the body has moved.

    :param positions: ``(..., 2)`` [m], in the frame before the motion
    :param ego_motion: ``(..., 2)``: forward [m], then turn [rad], or ``(..., 3)`` with a third, to the left [m], as
        :attr:`Sensing.ego_motion`
    :return: ``(..., 2)`` [m], in the frame after it
    """
    forward, turn = ego_motion[..., 0], ego_motion[..., 1]
    across = positions[..., 1] - ego_motion[..., 2] if ego_motion.shape[-1] > 2 else positions[..., 1]
    ahead = np.stack((positions[..., 0] - forward, across), axis=-1)
    return to_body(ahead, np.stack((np.cos(turn), np.sin(turn)), axis=-1))


def find_contacts(
    positions: NDArray[np.float64],
    frames: NDArray[np.float64],
    bodies: NDArray[np.float64],
    sensing_range: float,
    exclude_self: bool = False,
    use_numba: bool = True,
) -> Contacts:
    """The bodies strictly nearer than ``sensing_range`` to each vehicle of the same flock (section III-A).

    :param positions: of the vehicles, ``(flocks, vehicles, 2)`` [m]
    :param frames: cosine and sine of their headings, ``(flocks, vehicles, 2)``
    :param bodies: positions of the bodies, ``(flocks, bodies, 2)`` [m]
    :param sensing_range: range [m]
    :param exclude_self: the bodies are the vehicles themselves, and no vehicle senses itself
    :param use_numba: use numba where it is installed; the numbers are the same
    """
    shape = positions.shape[:2]
    is_few = bodies.shape[1] <= _FEW
    kernels = compiled() if use_numba else None
    if kernels is not None:
        find = kernels.find_contacts if is_few else kernels.find_contacts_by_cell
        return Contacts(shape, *find(positions, frames, bodies, sensing_range, exclude_self))
    pairs = _all_pairs if is_few else _pairs_by_cell
    observers, found, offsets, distances = pairs(positions, bodies, sensing_range)
    if exclude_self:
        apart = observers % shape[1] != found
        observers, found, offsets, distances = observers[apart], found[apart], offsets[apart], distances[apart]
    return Contacts(shape, observers, found, to_body(offsets, frames.reshape(-1, 2)[observers]), distances)


Pairs = tuple["NDArray[np.int64]", "NDArray[np.int64]", "NDArray[np.float64]", "NDArray[np.float64]"]
"""Observers, bodies, offsets in the world's frame and distances of the pairs in range."""


def _all_pairs(positions: NDArray[np.float64], bodies: NDArray[np.float64], sensing_range: float) -> Pairs:
    offsets = bodies[:, None, :, :] - positions[:, :, None, :]
    distances = _norm(offsets)
    flocks, vehicles, found = np.nonzero(distances < sensing_range)
    return (
        flocks * positions.shape[1] + vehicles,
        found,
        offsets[flocks, vehicles, found],
        distances[flocks, vehicles, found],
    )


def _pairs_by_cell(positions: NDArray[np.float64], bodies: NDArray[np.float64], sensing_range: float) -> Pairs:
    """Square cells of side ``sensing_range``, numbered flock by flock and column by column: a body in range of a vehicle lies
    in one of three columns, in three cells of consecutive numbers each, so sorted bodies are found by bisection."""
    n_flocks, n_bodies, _ = bodies.shape
    corner = np.minimum(positions.min((0, 1)), bodies.min((0, 1), initial=np.inf))
    span = np.maximum(positions.max((0, 1)), bodies.max((0, 1), initial=-np.inf)) - corner
    columns, rows = (span // sensing_range).astype(np.int64) + 3  # an empty one on either side

    def cells(points: NDArray[np.float64]) -> NDArray[np.int64]:
        column, row = np.moveaxis(((points - corner) // sensing_range).astype(np.int64) + 1, -1, 0)
        return ((np.arange(n_flocks)[:, None] * columns + column) * rows + row).ravel()

    body_cells = cells(bodies)
    order = np.argsort(body_cells, kind="stable")
    middle = cells(positions)[:, None] + np.array([-rows, 0, rows])
    first = np.searchsorted(body_cells[order], middle - 1, side="left").ravel()
    counts = np.searchsorted(body_cells[order], middle + 1, side="right").ravel() - first
    observers = np.repeat(np.arange(len(middle)), counts.reshape(-1, 3).sum(-1))
    candidates = order[np.repeat(first - (np.cumsum(counts) - counts), counts) + np.arange(len(observers))]

    offsets = bodies.reshape(-1, 2)[candidates] - positions.reshape(-1, 2)[observers]
    distances = _norm(offsets)
    near = np.flatnonzero(distances < sensing_range)
    near = near[np.lexsort((candidates[near], observers[near]))]
    return observers[near], candidates[near] % n_bodies, offsets[near], distances[near]


def distance_blocks(
    positions: NDArray[np.float64], bodies: NDArray[np.float64], exclude_self: bool = False
) -> Iterator[tuple[slice, NDArray[np.float64]]]:
    """Distances between all vehicles and bodies of a flock, in range or not, some vehicles at a time to bound the memory.

    :param exclude_self: the bodies are the vehicles themselves; the distance of a vehicle to itself is then infinite
    :return: a slice of the vehicles and ``(flocks, those vehicles, bodies)`` [m]
    """
    flocks, vehicles, _ = positions.shape
    step = max(1, _BLOCK // max(1, flocks * bodies.shape[1]))
    for start in range(0, vehicles, step):
        rows = slice(start, min(start + step, vehicles))
        distances = _norm(bodies[:, None, :, :] - positions[:, rows, None, :])
        if exclude_self:
            own = np.arange(rows.start, rows.stop)
            distances[:, own - start, own] = np.inf
        yield rows, distances


def nearest(positions: NDArray[np.float64], bodies: NDArray[np.float64], exclude_self: bool = False) -> NDArray[np.float64]:
    """Each vehicle's distance to the nearest body, in range or not: ``(flocks, vehicles)`` [m], inf where there is none."""
    found = np.empty(positions.shape[:2])
    for rows, distances in distance_blocks(positions, bodies, exclude_self):
        found[:, rows] = distances.min(-1, initial=np.inf)
    return found


def is_connected(neighbors: Contacts) -> NDArray[np.bool_]:
    """Whether each flock's proximity graph is connected, ``(flocks,)``; the graph of a single vehicle is."""
    flocks, vehicles = neighbors.shape
    linked = neighbors.vehicles
    # Each vehicle takes the smallest label among its neighbors'; following the label's own label halves the rounds.
    labels = np.arange(flocks * vehicles)
    while True:
        lower = labels.copy()
        np.minimum.at(lower, neighbors.observers, labels[linked])
        lower = lower[lower]
        if np.array_equal(lower, labels):
            return (labels.reshape(flocks, vehicles) == vehicles * np.arange(flocks)[:, None]).all(-1)
        labels = lower


def _norm(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(np.square(vectors[..., 0]) + np.square(vectors[..., 1]))


def rotate(vectors: NDArray[np.float64], angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Vectors ``(..., 2)`` turned by angles ``(...)`` [rad]."""
    cos, sin = np.cos(angles), np.sin(angles)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack((cos * x - sin * y, sin * x + cos * y), axis=-1)


def to_body(offsets: NDArray[np.float64], frames: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate world offsets into the body frame: x_ij = R(theta_i) (x_j - x_i), R the rotation into the frame."""
    (x, y), (cos, sin) = np.moveaxis(offsets, -1, 0), np.moveaxis(frames, -1, 0)
    return np.stack((cos * x + sin * y, cos * y - sin * x), axis=-1)
