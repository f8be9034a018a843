"""A planner that sees everything, to teach a policy that sees little."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.evaluation.controllers.motion import limit, rotate, steer
from sb3_flock.evaluation.controllers.orca import Orca, OrcaGains
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, Sensing, World

Array = NDArray[np.float64]


@dataclass(frozen=True)
class PlannerGains:
    """What is free in the planner."""

    spacing: float = 1.04
    """Distance between neighboring places, relative to the minimum separation to neighbors."""
    clearance: float = 1.03
    """Distance of places from obstacles, relative to the minimum separation to them."""
    way: float = 0.8
    """Weight of the vehicles' mean way to their places, beside the places' mean distance to the waypoint."""
    apart: float = 0.3
    """Weight of the share of looks ahead in which the flock has come apart on its way, beside the same [m]."""
    hold: float = 0.9
    """Distance at which vehicles hold together on their way, relative to the link range."""
    approach: float = 1.0
    """Preferred velocity for each meter to the place [1/s]."""
    tolerance: float = 0.005
    """Distance that a vehicle keeps from its place, at rest and behind a moving one [m]."""
    calm: float = 0.015
    """Speed below which vehicles turn in proportion to it [m/s]: at rest a wish is too small for its direction to matter."""


class Planner:
    """Gives each vehicle a place of its own around the waypoint, and lets :class:`Orca` fly them there.

    The places are a connected part of a hexagonal lattice, free of obstacles: of many lattices, turned and shifted, the one
    where the vehicles stand nearest to the waypoint, have the shortest ways and hold together on them. Vehicles fly to where the
    waypoint will be when they meet it. Places are given by where everything is, so it is no peer of a policy that flies by what
    one vehicle senses; on its way a vehicle minds what it senses itself.

    :param world: the world that it sees, whatever is sensed in it
    :param gains: found by a few trials
    :raises SettingsError: if ``pyrvo`` or ``scipy`` is not installed
    """

    def __init__(self, world: World, gains: PlannerGains | None = None) -> None:
        self.world, self.gains = world, gains or PlannerGains()
        self.orca = Orca(OrcaGains(margin=0.002, approach=self.gains.approach))
        self.packs = Packs(world.scenario.n_vehicles, self.gains.spacing * world.scenario.neighbor_separation)

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Forget the last episode."""
        self.orca.reset(rngs, scenario)

    def act(self, sensing: Sensing, scenario: Scenario) -> Array:
        """The actions that fly ORCA's velocities towards the places, as fast as these move besides."""
        world, gains = self.world, self.gains
        places = np.stack([self._places(flock) for flock in range(world.n_flocks)])
        offsets = places + self._meetings(places) - world.positions
        distances = np.hypot(offsets[..., 0], offsets[..., 1])[..., None]
        offsets = offsets * np.maximum(0.0, 1.0 - gains.tolerance / np.maximum(distances, 1e-9))
        goals = rotate(offsets, -world.headings)
        velocities = self.orca.velocities(replace(sensing, waypoint_positions=goals), scenario)
        actions = steer(velocities, scenario)
        actions[..., 1] *= np.minimum(1.0, np.hypot(velocities[..., 0], velocities[..., 1]) / gains.calm)
        return actions

    def state_dict(self) -> dict[str, Any]:
        """What is remembered of the episodes under way: plain values and arrays."""
        return self.orca.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from :meth:`state_dict`."""
        self.orca.load_state_dict(state)

    def _places(self, flock: int) -> Array:
        """A place for each vehicle ``(vehicles, 2)``, seen from the waypoint."""
        world, scenario, gains = self.world, self.world.scenario, self.gains
        vehicles, obstacles = (
            bodies[flock] - world.waypoints[flock] for bodies in (world.positions, world.obstacle_positions)
        )
        clearance = gains.clearance * scenario.obstacle_separation
        packs, distances = self.packs.free(obstacles, clearance)
        places, ways = self.packs.given(packs, vehicles, obstacles, clearance)
        flown = limit(places - vehicles, scenario.max_speed * _LOOKS[:, None, None])
        apart = 1.0 - _connected(vehicles + flown, gains.hold * scenario.link_range).mean(0)
        return places[np.argmin(distances + gains.way * ways + gains.apart * apart)]

    def _meetings(self, places: Array) -> Array:
        """Where the waypoint ``(flocks, vehicles, 2)`` will be when a vehicle can be at its place beside it.

        It is never nearer than the time that a vehicle takes to slow down at its place.
        """
        world, scenario = self.world, self.world.scenario
        times = np.zeros(places.shape[:2])
        for _ in range(10):
            times = np.maximum(times, 1.0 / self.gains.approach)
            waypoints = world.waypoints_after(times / scenario.time_step)
            times = np.linalg.norm(waypoints + places - world.positions, axis=-1) / scenario.max_speed
        return waypoints


_LOOKS = np.array([0.25, 0.5, 0.75, 1.0])
"""Times ahead at which a flock on its way should be in one piece [s]."""


class Packs:
    """Packs of vehicles around the origin, cut from lattices of many angles and offsets, some leaning to one side.

    :param n_vehicles: vehicles in a pack
    :param spacing: between neighbors of the lattice [m]
    :param lattices: number of lattices
    :raises SettingsError: if ``scipy`` is not installed
    """

    def __init__(self, n_vehicles: int, spacing: float, lattices: int = 24) -> None:
        try:
            from scipy.optimize import linear_sum_assignment
        except ImportError:
            raise SettingsError("teacher = 'planner': needs scipy, pip install 'sb3_flock[orca]'") from None
        self._assign = linear_sum_assignment
        rng = np.random.default_rng(0)
        reach = int(np.ceil(np.sqrt(n_vehicles))) + 3
        side = np.arange(-reach, reach + 1)
        grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2) @ np.array([[1.0, 0.0], [0.5, np.sqrt(0.75)]])
        grid = grid[np.argsort(np.linalg.norm(grid, axis=-1), kind="stable")][: 3 * n_vehicles + 25]
        angles, offsets = rng.uniform(0, np.pi / 3, (lattices, 1)), rng.uniform(-0.5, 0.5, (lattices, 1, 2))
        self.n_vehicles, self.spacing = n_vehicles, spacing
        self.places = spacing * rotate(grid + offsets, np.broadcast_to(angles, (lattices, len(grid))))
        self.distances = np.linalg.norm(self.places, axis=-1)
        leanings = [lean * np.array([np.cos(a), np.sin(a)]) for lean in (0.3, 0.8) for a in np.arange(8) * np.pi / 4]
        self._orders = np.stack([self.distances - self.places @ lean for lean in [np.zeros(2), *leanings]], axis=1)

    def free(self, obstacles: Array, clearance: float, most: int = 20) -> tuple[Array, Array]:
        """The packs nearest to the origin with no place within ``clearance`` of an obstacle; connected ones if any of them are.

        Where obstacles leave no room for a pack, they are not minded.

        :param obstacles: ``(any, 2)`` [m]
        :param clearance: distance to keep from obstacles [m]
        :param most: number of packs at most
        :return: the packs ``(packs, vehicles, 2)`` and their mean distances ``(packs,)``, both in meters
        """
        n = self.n_vehicles
        away = np.linalg.norm(self.places[..., None, :] - obstacles, axis=-1).min(-1, initial=np.inf)
        # Only what an obstacle cuts into needs packs that lean away from it.
        orders = self._orders if away.min() < clearance else self._orders[:, :1]
        free = (away >= clearance)[:, None]
        if (free.sum(-1) >= n).any():
            orders = np.where(free, orders, np.inf)
        chosen = np.argpartition(orders, n - 1, axis=-1)[..., :n]
        is_free = np.isfinite(np.take_along_axis(orders, chosen, axis=-1)).all(-1)
        chosen, lattice = chosen[is_free], np.nonzero(is_free)[0][:, None]
        packs, distances = self.places[lattice, chosen], self.distances[lattice, chosen].mean(1)
        nearest = np.argsort(distances, kind="stable")[: 3 * most]
        packs, distances = packs[nearest], distances[nearest]
        whole = _connected(packs, 1.01 * self.spacing)
        if whole.any():
            packs, distances = packs[whole], distances[whole]
        return packs[:most], distances[:most]

    def given(self, packs: Array, vehicles: Array, obstacles: Array, clearance: float) -> tuple[Array, Array]:
        """The packs with the place of each vehicle, and the vehicles' mean ways there, the shortest, around obstacles.

        :param packs: ``(packs, vehicles, 2)`` [m], in any order
        :param vehicles: where they are, ``(vehicles, 2)`` [m]

        The other parameters are those of :meth:`free`.

        :return: the packs in the vehicles' order ``(packs, vehicles, 2)`` and the mean ways ``(packs,)``, both in meters
        """
        ways = way_lengths(vehicles[:, None], packs[:, None], obstacles, clearance)
        chosen = np.array([self._assign(lengths)[1] for lengths in ways])[..., None]
        return np.take_along_axis(packs, chosen, axis=1), np.take_along_axis(ways, chosen, axis=2).mean((1, 2))


def _connected(positions: Array, reach: float) -> NDArray[np.bool_]:
    """Whether all vehicles ``(..., vehicles, 2)`` hold together over distances below ``reach`` [m], ``(...)``."""
    reached = (np.linalg.norm(positions[..., :, None, :] - positions[..., None, :, :], axis=-1) < reach).astype(np.float32)
    for _ in range(positions.shape[-2].bit_length()):
        reached = np.minimum(reached @ reached, 1.0)
    return reached.all(axis=(-2, -1))


def way_lengths(starts: Array, ends: Array, obstacles: Array, clearance: float) -> Array:
    """The shortest ways ``(...)`` [m] around whichever obstacle makes them longest.

    :param starts: ``(..., 2)`` [m], and so are ``ends``; both broadcast
    :param obstacles: ``(any, 2)`` [m]
    :param clearance: radius of the circles to go around; one that holds a start or an end shrinks to it [m]
    """
    lengths = np.linalg.norm(ends - starts, axis=-1)
    for obstacle in obstacles:
        a, b = starts - obstacle, ends - obstacle
        to_start, to_end = np.maximum(np.linalg.norm(a, axis=-1), 1e-9), np.maximum(np.linalg.norm(b, axis=-1), 1e-9)
        radius = np.minimum(clearance, np.minimum(to_start, to_end))
        between = np.arccos(np.clip((a * b).sum(-1) / (to_start * to_end), -1.0, 1.0))
        arc = between - np.arccos(radius / to_start) - np.arccos(radius / to_end)  # what the two tangents leave
        around = np.sqrt(to_start**2 - radius**2) + np.sqrt(to_end**2 - radius**2) + radius * arc
        lengths = np.maximum(lengths, np.where(arc > 0, around, 0.0))
    return lengths
