"""The image-like tensor each vehicle sees: three channels (section IV-A), and three more with a second look (ours)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from sb3_flock.sim.backend import compiled

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.scenario import Scenario
    from sb3_flock.sim.sensing import Sensing


def observe(sensing: Sensing, scenario: Scenario, compile_it: bool = True) -> NDArray[np.float32]:
    """The observation I_N, I_O, I_W of every vehicle (section IV-A).

    ``obs[..., c, a, b]`` is channel c (0 neighbors, 1 obstacles, 2 waypoint) at the anchor number a along the body's x axis
    (forward) and b along its y axis (left), both from -r to +r, ends included. Each anchor adds up
    exp(-|d|^2 / (2 sigma^2)) over the bodies within sensing range; sigma is ``anchor_width`` anchor spacings. A waypoint
    beyond ``goal_radius`` shows on the circle of that radius, so that its bearing is always visible.

    With ``look_back`` three more channels tell how the first three have changed: from what was sensed that long ago, in the
    body's frame of now, to the present. What stands still over ground is 0 there, whatever the vehicle does; what came into
    range since shows whole, what left it with a minus sign. All is 0 for a sensing that was not measured by
    :class:`~sb3_flock.sim.sensors.Sensors`, which remember.

    :param compile_it: use numba where it is installed; the numbers are the same to rounding
    :return: ``(flocks, vehicles, 3 or 6, l, l)``, a fresh array
    """
    shape = sensing.waypoint_distances.shape
    tensor = np.empty((shape[0] * shape[1], *scenario.observation_shape), dtype=np.float32)
    _paint_look(tensor, 0, sensing, scenario, compile_it)
    if scenario.look_back:
        _paint_look(tensor, 3, sensing if sensing.earlier is None else sensing.earlier, scenario, compile_it)
        np.subtract(tensor[:, :3], tensor[:, 3:], out=tensor[:, 3:])
    return tensor.reshape(*shape, *scenario.observation_shape)


def _paint_look(tensor: NDArray[np.float32], first: int, sensing: Sensing, scenario: Scenario, compile_it: bool) -> None:
    """Fill three channels with what is sensed."""
    reach = np.maximum(sensing.waypoint_distances / scenario.goal_radius, 1.0)
    waypoints = (sensing.waypoint_positions / reach[..., None]).reshape(-1, 2)
    bodies = (
        (sensing.neighbors.observers, sensing.neighbors.positions),
        (sensing.obstacles.observers, sensing.obstacles.positions),
        (np.arange(len(waypoints)), waypoints),
    )
    # From the first anchor to the last, the compiled Gaussians must not underflow on their way.
    kernels = compiled() if compile_it and scenario.n_anchors - 1 <= 30 * scenario.anchor_width else None
    for channel, ((observers, positions), radius) in enumerate(zip(bodies, scenario.channel_radii, strict=True), first):
        sigma = scenario.anchor_width * 2 * radius / (scenario.n_anchors - 1)
        if kernels is None:
            paint(tensor, channel, observers, positions, radius, sigma)
        else:
            kernels.paint(tensor, channel, observers, positions, radius, sigma, (0,) * scenario.n_anchors)


def paint(
    tensor: NDArray[np.float32],
    channel: int,
    observers: NDArray[np.int64],
    positions: NDArray[np.float64],
    radius: float,
    sigma: float,
) -> None:
    """Fill one channel with the sums of its bodies' Gaussians.

    The Gaussian of a diagonal Sigma is a product of one factor along x and one along y, so the exponential is taken 2 l times
    a body, not l^2 times.

    :param tensor: ``(vehicles, channels, l, l)``, changed in place
    :param observers: row of the tensor for each body, ascending; ``(bodies,)``
    :param positions: ``(bodies, 2)`` [m]
    :param radius: half width of the channel [m]
    :param sigma: standard deviation [m]
    """
    anchors = np.linspace(-radius, radius, tensor.shape[-1])
    tensor[:, channel] = 0
    factors = np.exp(-0.5 * np.square((positions[..., None] - anchors) / sigma)).astype(np.float32)
    counts = np.bincount(observers)
    rank = np.arange(len(observers)) - (np.cumsum(counts) - counts)[observers]  # first, second, ... of its observer
    for turn in range(counts.max(initial=0)):
        rows = np.flatnonzero(rank == turn)
        tensor[observers[rows], channel] += factors[rows, 0, :, None] * factors[rows, 1, None, :]
