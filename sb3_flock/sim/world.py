"""World: many flocks flown side by side as arrays (section III-A and V)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_flock.settings import UserError
from sb3_flock.sim.sensing import Sensing, sense
from sb3_flock.sim.sensors import Sensors

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import ArrayLike, NDArray

    from sb3_flock.sim.scenario import Scenario

_MAX_REDRAWS = 1000
"""Draws allowed for one body's start before the arena counts as too crowded."""

_SLOWEST_CROSSING = 0.6
"""Slowest crossing obstacle [top speeds]: from the arena's edge to the origin in 100 to 167 steps, when the flock is there."""


_EPISODE = (
    "positions",
    "headings",
    "obstacle_positions",
    "obstacle_headings",
    "waypoints",
    "obstacle_speeds",
    "obstacle_turn_rates",
)
"""The arrays of an episode under way."""


class WorldError(UserError):
    """The scenario leaves no room to start."""


def episode_rng(seed: int, episode: int) -> Generator:
    """The random stream of one episode: it depends on the seed and the episode's number, never on how many fly at once."""
    return np.random.default_rng(np.random.SeedSequence([seed, episode]))


class World:
    """``n_flocks`` independent flocks of one scenario, advanced in lockstep.

    Every flock draws from its own generator, and a whole episode's obstacle walk is drawn at the reset: a flock's course
    depends on its generator and its actions alone.

    :param scenario: every number of the task
    :param n_flocks: number of flocks, at least 1
    """

    positions: NDArray[np.float64]
    """``(flocks, vehicles, 2)`` [m]."""
    obstacle_positions: NDArray[np.float64]
    """``(flocks, obstacles, 2)`` [m]."""
    obstacle_headings: NDArray[np.float64]
    """``(flocks, obstacles)`` [rad], in [-pi, pi)."""
    waypoints: NDArray[np.float64]
    """``(flocks, 2)`` [m]."""
    obstacle_speeds: NDArray[np.float64]
    """``(max_cycles, flocks, obstacles)`` [m/s], drawn at the reset."""
    obstacle_turn_rates: NDArray[np.float64]
    """``(max_cycles, flocks, obstacles)`` [rad/s], drawn at the reset."""
    steps: int
    """Steps taken since the reset, k."""

    def __init__(self, scenario: Scenario, n_flocks: int = 1) -> None:
        self.scenario = scenario
        self.n_flocks = n_flocks
        self.sensors = Sensors(scenario)
        self.action_low = np.array([0.0, -scenario.max_turn_rate])
        self.action_high = np.array([scenario.max_speed, scenario.max_turn_rate])
        # As large as the actions: NumPy is slow where it repeats a bound along a last axis this short.
        shape = (n_flocks, scenario.n_vehicles, 2)
        self._bounds = [np.broadcast_to(bound, shape).copy() for bound in (self.action_low, self.action_high)]

    @property
    def headings(self) -> NDArray[np.float64]:
        """``(flocks, vehicles)`` [rad], in [-pi, pi). Read-only: assign another array to change them."""
        return self._headings

    @headings.setter
    def headings(self, headings: NDArray[np.float64]) -> None:
        self._headings = headings.view()
        self._headings.flags.writeable = False
        self._frames: NDArray[np.float64] | None = None

    @property
    def frames(self) -> NDArray[np.float64]:
        """Cosine and sine of the headings, ``(flocks, vehicles, 2)``."""
        if self._frames is None:
            self._frames = _directions(self._headings)
        return self._frames

    def waypoints_after(self, steps: NDArray[np.floating]) -> NDArray[np.float64]:
        """Where the waypoint will be: straight towards the origin (section V), or along the route.

        :param steps: from now on, any number for each flock, ``(flocks, any)``
        :return: ``(flocks, any, 2)`` [m]
        """
        route, stride = self.scenario.waypoint_route, self.scenario.waypoint_speed * self.scenario.time_step
        if route is not None:
            return along(np.array(route), stride * (self.steps + steps))
        distances = np.sqrt(np.square(self.waypoints).sum(-1, keepdims=True))
        return self.waypoints[:, None] * (1.0 - np.minimum(stride * steps / np.maximum(distances, 1e-12), 1.0))[..., None]

    def obstacles_after(self, steps: NDArray[np.integer]) -> NDArray[np.float64]:
        """Where obstacles are to be expected: straight ahead, at their mean speed of the episode.

        :param steps: from now on, ``(any,)``
        :return: ``(flocks, any, obstacles, 2)`` [m]
        """
        strides = self.obstacle_speeds.mean(0)[..., None] * _directions(self.obstacle_headings) * self.scenario.time_step
        return self.obstacle_positions[:, None] + strides[:, None] * steps[:, None, None]

    def reset(self, rngs: Sequence[Generator]) -> Sensing:
        """Start an episode in every flock (section V).

        Vehicles and obstacles are uniform in their squares with uniform headings, the waypoint is uniform in the arena. A
        body that starts closer to a vehicle than its minimum separation is drawn again. A route and given starts (ours) stand
        in for what is drawn otherwise.

        :param rngs: one generator a flock
        :return: what the vehicles sense at the start
        :raises WorldError: if the arena is too crowded to place a body
        """
        if len(rngs) != self.n_flocks:
            raise ValueError(f"rngs has {len(rngs)} generators: one for each of the {self.n_flocks} flocks is needed")
        scenario = self.scenario
        starts = [self._start(rng) for rng in rngs]
        self.positions, self.headings, self.obstacle_positions, self.obstacle_headings, self.waypoints = (
            np.stack(parts) for parts in zip(*starts, strict=True)
        )
        courses = [self._course(rng) for rng in rngs]
        self.obstacle_speeds = np.stack([speeds for speeds, _ in courses], axis=1)
        self.obstacle_turn_rates = np.stack([turns for _, turns in courses], axis=1) * scenario.obstacle_turn_std
        self.sensors.reset(rngs)
        self.steps = 0
        return sense(self)

    def step(self, actions: ArrayLike) -> tuple[Sensing, NDArray[np.float64]]:
        """Move every body by one sampling period, vehicles, obstacles and waypoint together (section III-A).

        :param actions: ``(flocks, vehicles, 2)``, speed v [m/s] and turn rate omega [rad/s], clipped to their bounds
        :return: what the vehicles sense afterwards, and the clipped actions
        :raises RuntimeError: before a reset or after the episode's last step
        """
        scenario = self.scenario
        if not hasattr(self, "steps") or self.steps >= scenario.max_cycles:
            raise RuntimeError("the episode is over or not begun: call reset() first")
        clipped = np.clip(np.asarray(actions, dtype=np.float64), *self._bounds)
        dt = scenario.time_step
        self.positions = _moved(self.positions, self.frames, clipped[..., 0], dt)
        self.headings = wrap_angle(self.headings + clipped[..., 1] * dt)
        self._move_obstacles(dt)
        self.waypoints = self.waypoints_after(np.ones((self.n_flocks, 1)))[:, 0]
        self.steps += 1
        return sense(self, clipped * dt), clipped

    def state_dict(self) -> dict[str, Any]:
        """The episode under way: all that its next steps depend on besides the actions."""
        return {
            **{name: getattr(self, name) for name in _EPISODE},
            "steps": self.steps,
            "sensors": self.sensors.state_dict(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with the episode of :meth:`state_dict`.

        :raises ValueError: if it is one of other numbers of bodies or steps
        """
        flocks, vehicles, obstacles = self.n_flocks, self.scenario.n_vehicles, self.scenario.n_obstacles
        walk = (self.scenario.max_cycles, flocks, obstacles)
        shapes = (
            (flocks, vehicles, 2),
            (flocks, vehicles),
            (flocks, obstacles, 2),
            (flocks, obstacles),
            (flocks, 2),
            walk,
            walk,
        )
        for name, shape in zip(_EPISODE, shapes, strict=True):
            if state[name].shape != shape:
                raise ValueError(f"{name} has the shape {state[name].shape}: {shape} is needed")
            setattr(self, name, np.array(state[name], dtype=np.float64))
        self.steps = int(state["steps"])
        self.sensors.load_state_dict(state["sensors"])

    def _move_obstacles(self, dt: float) -> None:
        """Unicycles with drawn speeds and turn rates, turned back at the edge of their square."""
        bound = self.scenario.obstacle_half_side
        speeds, turn_rates = self.obstacle_speeds[self.steps], self.obstacle_turn_rates[self.steps]
        positions = _moved(self.obstacle_positions, _directions(self.obstacle_headings), speeds, dt)
        outside = np.maximum(np.abs(positions[..., 0]), np.abs(positions[..., 1])) > bound
        self.obstacle_positions = np.clip(positions, -bound, bound)
        self.obstacle_headings = wrap_angle(self.obstacle_headings + turn_rates * dt + np.pi * outside)

    def _start(self, rng: Generator) -> tuple[NDArray[np.float64], ...]:
        scenario = self.scenario
        given = scenario.obstacle_starts or ()
        placed, obstructed = _Placed(scenario.neighbor_separation), _Placed(scenario.obstacle_separation, given)
        positions = np.empty((scenario.n_vehicles, 2))
        for i in range(scenario.n_vehicles):
            positions[i] = placed.draw_apart(rng, scenario.arena, "n_vehicles", scenario.n_vehicles, obstructed)
            placed.add(*positions[i].tolist())
        placed = _Placed(scenario.obstacle_separation, positions.tolist())
        if scenario.obstacle_motion == "crossing":
            headings = rng.uniform(-np.pi, np.pi, scenario.n_vehicles)
            waypoint = self._first_waypoint(rng)
            return positions, headings, *self._far_side(rng, placed, waypoint), waypoint
        obstacles = np.empty((scenario.n_obstacles, 2))
        obstacles[: len(given)] = given or np.empty((0, 2))
        for o in range(len(given), scenario.n_obstacles):
            obstacles[o] = placed.draw_apart(rng, scenario.obstacle_half_side, "n_obstacles", scenario.n_obstacles)
        headings = rng.uniform(-np.pi, np.pi, scenario.n_vehicles)
        obstacle_headings = rng.uniform(-np.pi, np.pi, scenario.n_obstacles)
        return positions, headings, obstacles, obstacle_headings, self._first_waypoint(rng)

    def _first_waypoint(self, rng: Generator) -> NDArray[np.float64]:
        drawn = rng.uniform(-self.scenario.arena, self.scenario.arena, 2)
        return drawn if self.scenario.waypoint_route is None else np.array(self.scenario.waypoint_route[0])

    def _far_side(
        self, rng: Generator, placed: _Placed, waypoint: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Starts and headings of crossing obstacles: opposite the waypoint, aimed at where the flock will be."""
        scenario, count = self.scenario, self.scenario.n_obstacles
        radius, behind = scenario.obstacle_half_side, math.atan2(-waypoint[1], -waypoint[0])

        def point() -> NDArray[np.float64]:
            angle = behind + rng.uniform(-np.pi / 4, np.pi / 4)
            return radius * np.array([math.cos(angle), math.sin(angle)])

        given = scenario.obstacle_starts or ()
        starts = np.empty((count, 2))
        starts[: len(given)] = given or np.empty((0, 2))
        for o in range(len(given), count):
            starts[o] = placed.draw(point, f"a quarter of a circle of radius {radius} m", "n_obstacles", count)
        aims = rng.uniform(-scenario.link_range, scenario.link_range, (count, 2)) - starts
        return starts, np.arctan2(aims[:, 1], aims[:, 0])

    def _course(self, rng: Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """An episode's speeds [m/s] and turn rates [standard deviations] of the obstacles, each ``(steps, obstacles)``."""
        shape = (self.scenario.max_cycles, self.scenario.n_obstacles)
        top = self.scenario.obstacle_max_speed
        if self.scenario.obstacle_motion == "crossing":
            return np.broadcast_to(rng.uniform(_SLOWEST_CROSSING * top, top, shape[1]), shape), np.zeros(shape)
        return rng.uniform(0.0, top, shape), rng.normal(0.0, 1.0, shape)


def _moved(
    positions: NDArray[np.float64], directions: NDArray[np.float64], speeds: NDArray[np.float64], dt: float
) -> NDArray[np.float64]:
    """The discrete unicycle's position, which moves with the old heading (section III-A); the heading turns afterwards."""
    return positions + (speeds * dt)[..., None] * directions


def _directions(headings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Cosine and sine, ``(..., 2)``."""
    return np.stack((np.cos(headings), np.sin(headings)), axis=-1)


def along(route: NDArray[np.float64], distances: NDArray[np.floating]) -> NDArray[np.float64]:
    """The points so far ``(...)`` along a route ``(points, 2)`` [m], ``(..., 2)``; at its end beyond."""
    lengths = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))))
    return np.stack([np.interp(distances, lengths, coordinate) for coordinate in route.T], axis=-1)


def wrap_angle(angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Angles in [-pi, pi) [rad]."""
    return angles - 2 * np.pi * np.floor((angles + np.pi) / (2 * np.pi))


class _Placed:
    """Vehicles placed so far, in square cells of the separation to keep from them: only nine cells need a look."""

    def __init__(self, separation: float, points: Iterable[Sequence[float]] = ()) -> None:
        self.separation = separation
        self._cells: dict[tuple[int, int], list[tuple[float, float]]] = {}
        for x, y in points:
            self.add(x, y)

    def add(self, x: float, y: float) -> None:
        if self.separation == 0:  # nothing is ever too close
            return
        self._cells.setdefault(self._cell(x, y), []).append((x, y))

    def draw_apart(
        self, rng: Generator, half_side: float, name: str, count: int, others: _Placed | None = None
    ) -> NDArray[np.float64]:
        """A point uniform in the square, drawn again while it is closer than the separation to one of these or of others."""
        where = f"a square of half side {half_side} m"
        return self.draw(lambda: rng.uniform(-half_side, half_side, 2), where, name, count, others)

    def draw(
        self,
        point_of: Callable[[], NDArray[np.float64]],
        where: str,
        name: str,
        count: int,
        others: _Placed | None = None,
    ) -> NDArray[np.float64]:
        """A point that a function draws, drawn again while it is closer than the separation to one of these or of others."""
        for _ in range(_MAX_REDRAWS):
            point = point_of()
            if self._is_free(*point.tolist()) and (others is None or others._is_free(*point.tolist())):
                return point
        raise WorldError(
            f"{name} = {count}: no start at least {self.separation} m from the others found in {_MAX_REDRAWS} draws "
            f"from {where}; fewer bodies or a larger arena are needed"
        )

    def _is_free(self, x: float, y: float) -> bool:
        if not self._cells:
            return True
        column, row = self._cell(x, y)
        near = self.separation**2
        for cell in itertools.product((column - 1, column, column + 1), (row - 1, row, row + 1)):
            for there_x, there_y in self._cells.get(cell, ()):
                dx, dy = there_x - x, there_y - y
                if dx * dx + dy * dy < near:
                    return False
        return True

    def _cell(self, x: float, y: float) -> tuple[int, int]:
        return math.floor(x / self.separation), math.floor(y / self.separation)
