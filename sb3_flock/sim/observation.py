"""The three-channel, image-like tensor each vehicle sees (section IV-A)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.scenario import Scenario
    from sb3_flock.sim.sensing import Sensing


def observe(sensing: Sensing, scenario: Scenario) -> NDArray[np.float32]:
    """The observation I_N, I_O, I_W of every vehicle (section IV-A).

    ``obs[..., c, a, b]`` is channel c (0 neighbors, 1 obstacles, 2 waypoint) at the anchor number a along the body's x axis
    (forward) and b along its y axis (left), both from -r to +r, ends included. Each anchor adds up
    exp(-|d|^2 / (2 sigma^2)) over the bodies within sensing range; sigma is ``anchor_width`` anchor spacings. A waypoint
    beyond ``goal_radius`` shows on the circle of that radius, so that its bearing is always visible.

    :return: ``(flocks, vehicles, 3, l, l)``, a fresh array
    """
    neighbor_radius, obstacle_radius, goal_radius = scenario.channel_radii
    reach = np.maximum(sensing.waypoint_distances / goal_radius, 1.0)
    waypoint = (sensing.waypoint_positions / reach[..., None])[..., None, :]

    flocks, vehicles = sensing.waypoint_distances.shape
    tensor = np.empty((flocks, vehicles, *scenario.observation_shape), dtype=np.float32)
    tensor[:, :, 0] = _intensity(sensing.neighbor_positions, sensing.neighbors, neighbor_radius, scenario)
    tensor[:, :, 1] = _intensity(sensing.obstacle_positions, sensing.detections, obstacle_radius, scenario)
    tensor[:, :, 2] = _intensity(waypoint, None, goal_radius, scenario)
    return tensor


def _intensity(
    positions: NDArray[np.float64], visible: NDArray[np.bool_] | None, radius: float, scenario: Scenario
) -> NDArray[np.float64]:
    """Sum of the visible bodies' Gaussians at every anchor: ``(..., bodies, 2)`` to ``(..., l, l)``.

    The Gaussian of a diagonal Sigma is a product of one factor along x and one along y, so the sum over bodies of their
    outer products is one small matrix product, and the exponential is taken 2 l times a body, not l^2 times.
    """
    anchors = np.linspace(-radius, radius, scenario.n_anchors)
    sigma = scenario.anchor_width * (anchors[1] - anchors[0])
    factors = np.exp(-0.5 * np.square((positions[..., None] - anchors) / sigma))  # (..., bodies, 2, l)
    along_x, along_y = factors[..., 0, :], factors[..., 1, :]
    if visible is not None:
        along_x = along_x * visible[..., None]
    return np.matmul(np.swapaxes(along_x, -1, -2), along_y)
