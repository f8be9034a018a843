"""What vehicles sense: body frames, the proximity graph and detections (section III-A)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.world import World


@dataclass(frozen=True)
class Sensing:
    """Positions relative to every vehicle, in its body frame: forward is +x, left is +y. Distances in meters.

    The distance of a vehicle to itself is infinite, so that no threshold counts it.
    """

    neighbor_positions: NDArray[np.float64]
    """``(flocks, vehicles, vehicles, 2)``, of vehicle j seen from vehicle i."""
    neighbor_distances: NDArray[np.float64]
    """``(flocks, vehicles, vehicles)``."""
    neighbors: NDArray[np.bool_]
    """``(flocks, vehicles, vehicles)``, the proximity graph: d_ij < r_n."""
    obstacle_positions: NDArray[np.float64]
    """``(flocks, vehicles, obstacles, 2)``."""
    obstacle_distances: NDArray[np.float64]
    """``(flocks, vehicles, obstacles)``."""
    detections: NDArray[np.bool_]
    """``(flocks, vehicles, obstacles)``: d_io < r_o."""
    waypoint_positions: NDArray[np.float64]
    """``(flocks, vehicles, 2)``."""
    waypoint_distances: NDArray[np.float64]
    """``(flocks, vehicles)``."""

    @property
    def nearest_neighbor(self) -> NDArray[np.float64]:
        """Distance of each vehicle to the nearest other one, in range or not; ``(flocks, vehicles)``, inf if alone."""
        return self.neighbor_distances.min(-1, initial=np.inf)

    @property
    def nearest_obstacle(self) -> NDArray[np.float64]:
        """Distance of each vehicle to the nearest obstacle; ``(flocks, vehicles)``, inf where there is none."""
        return self.obstacle_distances.min(-1, initial=np.inf)


def sense(world: World) -> Sensing:
    """Everything the vehicles of every flock sense in the world's present state (section III-A)."""
    scenario, positions = world.scenario, world.positions
    neighbor_offsets = positions[:, None, :, :] - positions[:, :, None, :]
    obstacle_offsets = world.obstacle_positions[:, None, :, :] - positions[:, :, None, :]
    waypoint_offsets = world.waypoints[:, None, :] - positions

    neighbor_distances = _norm(neighbor_offsets)
    diagonal = np.arange(scenario.n_vehicles)
    neighbor_distances[:, diagonal, diagonal] = np.inf
    obstacle_distances = _norm(obstacle_offsets)

    cos, sin = np.cos(world.headings), np.sin(world.headings)
    return Sensing(
        neighbor_positions=_to_body(neighbor_offsets, cos[..., None], sin[..., None]),
        neighbor_distances=neighbor_distances,
        neighbors=neighbor_distances < scenario.link_range,
        obstacle_positions=_to_body(obstacle_offsets, cos[..., None], sin[..., None]),
        obstacle_distances=obstacle_distances,
        detections=obstacle_distances < scenario.detection_range,
        waypoint_positions=_to_body(waypoint_offsets, cos, sin),
        waypoint_distances=_norm(waypoint_offsets),
    )


def _norm(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sqrt(np.square(vectors[..., 0]) + np.square(vectors[..., 1]))


def _to_body(offsets: NDArray[np.float64], cos: NDArray[np.float64], sin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotate world offsets into the body frame: x_ij = R(theta_i) (x_j - x_i), R the rotation into the frame."""
    x, y = offsets[..., 0], offsets[..., 1]
    return np.stack((cos * x + sin * y, cos * y - sin * x), axis=-1)


def is_connected(neighbors: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether each proximity graph is connected; one vehicle alone is.

    :param neighbors: ``(..., vehicles, vehicles)``, symmetric
    :return: ``(...,)``
    """
    reached = neighbors | np.eye(neighbors.shape[-1], dtype=bool)
    length = 1  # `reached` holds the pairs joined by a path of at most this many links; squaring doubles it
    while length < neighbors.shape[-1] - 1:
        reached = np.matmul(reached, reached)
        length *= 2
    return np.asarray(reached[..., 0, :].all(-1))
