"""The observation of section IV-A: channels of Gaussian sums over sensed bodies, as large for any number of vehicles.

A further channel is a :class:`Channel` registered with :func:`register_channel`; ``extra_channels: [name]`` switches it on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field, field_validator

from sb3_flock.settings import Positive, suggest
from sb3_flock.sim.backend import compiled
from sb3_flock.sim.sensing import SensingSettings
from sb3_flock.sim.sensors import SensorSettings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.sensing import Sensing

_MOST_COMPILED = 64
"""Largest number of anchors per side for which numba is used; its unrolled loops take long to compile for more."""


@dataclass(frozen=True)
class Channel:
    """One channel of the observation; its twin in an exported ONNX graph follows from it."""

    name: str
    source: Literal["neighbors", "obstacles", "waypoint"]
    """Which sensed bodies the channel shows. A waypoint beyond the radius is shown on the circle of that radius."""
    radius: Callable[[ObservationSettings], float]
    """Half width of the channel [m], from the settings."""
    select: Callable[[Any], Any] | None = None
    """Which of those bodies: positions ``(bodies, 2)`` [m] in the body frame to a mask ``(bodies,)``, written with operators
    that NumPy arrays and torch tensors share; ``None`` selects all."""


def _neighbor_radius(settings: ObservationSettings) -> float:
    return settings.link_range if settings.neighbor_radius is None else settings.neighbor_radius


def _obstacle_radius(settings: ObservationSettings) -> float:
    return settings.known_obstacle_range if settings.obstacle_radius is None else settings.obstacle_radius


CHANNELS = {
    "neighbors": Channel("neighbors", "neighbors", _neighbor_radius),
    "obstacles": Channel("obstacles", "obstacles", _obstacle_radius),
    "waypoint": Channel("waypoint", "waypoint", lambda settings: settings.goal_radius),
}
"""Channels by name: the paper's three (I_N, I_O, I_W of section IV-A), then the registered ones."""

_PAPER_CHANNELS = tuple(CHANNELS)


def register_channel(channel: Channel) -> Channel:
    """Make a channel available as one of ``extra_channels``.

    :raises ValueError: if another channel has the name already
    """
    if CHANNELS.setdefault(channel.name, channel) is not channel:
        raise ValueError(f"channel {channel.name!r} is registered already")
    return channel


class ObservationSettings(SensingSettings, SensorSettings):
    """The grid of anchors and the channels of the observation (section IV-A)."""

    n_anchors: int = Field(11, ge=2, le=101, description="anchors per side l of each channel (paper: 11)")
    neighbor_radius: Positive | None = Field(
        None, description="half width of the neighbor channel r_c [m]; null: link_range (paper: not stated)"
    )
    obstacle_radius: Positive | None = Field(
        None,
        description="half width of the obstacle channel [m]; null: detection_range, plus link_range with shared_detections "
        "(paper: null)",
    )
    goal_radius: Positive = Field(
        0.3,
        description="half width r_g of the goal channel [m]; a farther waypoint shows on its circle (paper: not stated)",
    )
    anchor_width: float = Field(
        1.0,
        ge=0.1,
        le=1e6,
        description="standard deviation sigma of the anchors' Gaussian [anchor spacings] (paper: not stated)",
    )
    extra_channels: tuple[str, ...] = Field(
        (), max_length=16, description="names of further registered channels (paper: none)"
    )

    @field_validator("extra_channels")
    @classmethod
    def _are_registered(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        known = [name for name in CHANNELS if name not in _PAPER_CHANNELS]
        for number, name in enumerate(names):
            if name not in known or name in names[:number]:
                has = f"registered are {', '.join(known)}" if known else "none is registered"
                raise ValueError(
                    f"extra_channels = {name}: different channels registered with register_channel are needed; "
                    f"{has}{suggest(name, known)}"
                )
        return names

    @property
    def channels(self) -> tuple[Channel, ...]:
        """The channels of the present, in their order."""
        return tuple(CHANNELS[name] for name in (*_PAPER_CHANNELS, *self.extra_channels))

    @property
    def channel_radii(self) -> tuple[float, ...]:
        """Half width of each of :attr:`channels` [m]."""
        return tuple(channel.radius(self) for channel in self.channels)

    @property
    def observation_shape(self) -> tuple[int, int, int]:
        """Shape of one vehicle's observation: ``(channels, l, l)``, twice as many channels with motion channels."""
        return (len(self.channels) * (2 if self.motion_lag else 1), self.n_anchors, self.n_anchors)


def observe(sensing: Sensing, settings: ObservationSettings, use_numba: bool = True) -> NDArray[np.float32]:
    """The observation I_N, I_O, I_W of every vehicle (section IV-A).

    ``obs[..., c, a, b]`` is channel c (0 neighbors, 1 obstacles, 2 waypoint, then the extra channels) at the anchor number a
    along the body's x axis (forward) and b along its y axis (left), both from -r to +r, ends included. Each anchor adds up
    exp(-|d|^2 / (2 sigma^2)) over the bodies within sensing range; sigma is ``anchor_width`` anchor spacings. A waypoint
    beyond ``goal_radius`` shows on the circle of that radius, so that its bearing is always visible.

    With ``motion_lag`` as many motion channels follow: the difference between the present channels and those of
    ``motion_lag`` ago, both in the body's present frame. A body at rest over ground is 0 there whatever the vehicle does, a
    body that came into range since shows whole, one that left it with a minus sign. The motion channels are 0 for a sensing
    that did not pass through :class:`~sb3_flock.sim.sensors.Sensors`, which hold the memory.

    :param use_numba: use numba where it is installed; the results are equal up to rounding
    :return: ``(flocks, vehicles, channels, l, l)``, a fresh array
    """
    shape, n_channels = sensing.waypoint_distances.shape, len(settings.channels)
    channels = np.empty((shape[0] * shape[1], *settings.observation_shape), dtype=np.float32)
    sensings = [sensing]
    if settings.motion_lag:
        sensings.append(sensing if sensing.previous is None else sensing.previous)
    radii = settings.channel_radii
    shown = [
        _bodies(channel, source, radius)
        for source in sensings
        for channel, radius in zip(settings.channels, radii, strict=True)
    ]
    sigmas = [settings.anchor_width * 2 * radius / (settings.n_anchors - 1) for radius in radii]
    # From the first anchor to the last, the compiled Gaussians must not underflow on their way.
    is_compiled = use_numba and settings.n_anchors <= min(_MOST_COMPILED, 1 + 30 * settings.anchor_width)
    kernels = compiled() if is_compiled else None
    if kernels is None:
        for number, (observers, positions) in enumerate(shown):
            rasterize(channels, number, observers, positions, radii[number % n_channels], sigmas[number % n_channels])
    else:
        all_observers, all_positions = (np.concatenate(parts) for parts in zip(*shown, strict=True))
        counts, repeats = np.array([len(observers) for observers, _ in shown]), len(sensings)
        kernels.rasterize(
            channels, counts, all_observers, all_positions, np.array(radii * repeats), np.array(sigmas * repeats),
            (0,) * settings.n_anchors,
        )  # fmt: skip
    if settings.motion_lag:
        np.subtract(channels[:, :n_channels], channels[:, n_channels:], out=channels[:, n_channels:])
    return channels.reshape(*shape, *settings.observation_shape)


def _bodies(channel: Channel, sensing: Sensing, radius: float) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Observer and position of each body that a channel shows."""
    if channel.source == "waypoint":
        excess = np.maximum(sensing.waypoint_distances / radius, 1.0)
        positions = (sensing.waypoint_positions / excess[..., None]).reshape(-1, 2)
        observers = np.arange(len(positions))
    else:
        contacts = getattr(sensing, channel.source)
        observers, positions = contacts.observers, contacts.positions
    if channel.select is not None:
        selected = channel.select(positions)
        observers, positions = observers[selected], positions[selected]
    return observers, positions


def rasterize(
    channels: NDArray[np.float32],
    channel: int,
    observers: NDArray[np.int64],
    positions: NDArray[np.float64],
    radius: float,
    sigma: float,
) -> None:
    """Fill one channel with the sums of its bodies' Gaussians (section IV-A).

    The Gaussian of a diagonal Sigma is a product of one factor along x and one along y, so the exponential is taken 2 l times
    a body, not l^2 times.

    :param channels: ``(vehicles, channels, l, l)``, changed in place
    :param channel: number of the channel to fill
    :param observers: row of ``channels`` for each body, ascending; ``(bodies,)``
    :param positions: ``(bodies, 2)`` [m]
    :param radius: half width of the channel [m]
    :param sigma: standard deviation [m]
    """
    anchors = np.linspace(-radius, radius, channels.shape[-1])
    channels[:, channel] = 0
    factors = np.exp(-0.5 * np.square((positions[..., None] - anchors) / sigma)).astype(np.float32)
    counts = np.bincount(observers)
    rank = np.arange(len(observers)) - (np.cumsum(counts) - counts)[observers]  # first, second, ... of its observer
    for turn in range(counts.max(initial=0)):
        rows = np.flatnonzero(rank == turn)
        channels[observers[rows], channel] += factors[rows, 0, :, None] * factors[rows, 1, None, :]
