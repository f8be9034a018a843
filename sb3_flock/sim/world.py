"""World: many independent flocks of one scenario, simulated in lockstep as arrays (sections III-A and V)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field, model_validator

from sb3_flock.settings import ActionError, Coordinate, NotNegative, Positive, SettingsError, UserError
from sb3_flock.sim import dynamics, mujoco, navground  # noqa: F401 - the last two register simulators
from sb3_flock.sim.backend import compiled
from sb3_flock.sim.dynamics import DYNAMICS, VehicleDynamics, directions_of, wrap_angle
from sb3_flock.sim.obstacles import OBSTACLE_MOTIONS
from sb3_flock.sim.randomization import FlockValues, Ranges, check_ranges, draw
from sb3_flock.sim.safety import SafetySettings, filter_actions
from sb3_flock.sim.sensing import Bodies, Sensing, sense, to_body
from sb3_flock.sim.sensors import Sensors
from sb3_flock.sim.unicycle import Unicycle  # noqa: F401 - registers the default dynamics

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import ArrayLike, NDArray

_MAX_REDRAWS = 1000
"""Largest number of draws for one body's start before the arena counts as too crowded."""


Points = Annotated[tuple[tuple[Coordinate, Coordinate], ...], Field(min_length=1, max_length=10_000)]
"""Positions ``[[x, y], ...]`` [m]."""


class WorldSettings(SafetySettings):
    """The arena, the starts and the waypoint (section V)."""

    waypoint_speed: NotNegative = Field(0.1, description="speed of the waypoint towards the origin [m/s] (paper: 0.1)")
    waypoint_route: Points | None = Field(
        None,
        description="points [x, y] that the waypoint visits one after the other [m]; "
        "null: from a random start to the origin (paper: null)",
    )
    arena: Positive = Field(1.0, description="half side of the square in which all bodies start [m] (paper: 1)")
    obstacle_arena: Positive | None = Field(
        None, description="half side of the square in which obstacles start and walk [m]; null: arena (paper: null)"
    )
    obstacle_starts: Points | None = Field(
        None,
        description="points [x, y] where obstacles start [m]; with obstacle_max_speed 0 they stay there; "
        "null: random (paper: null)",
    )

    @model_validator(mode="after")
    def _starts_fit(self) -> WorldSettings:
        if len(self.obstacle_starts or ()) > self.n_obstacles:
            raise ValueError(
                f"obstacle_starts has {len(self.obstacle_starts or ())} points: n_obstacles = {self.n_obstacles}"
            )
        for point in self.obstacle_starts or ():
            if max(map(abs, point)) > self.obstacle_half_side:
                square = f"the obstacles' square of half side {self.obstacle_half_side}"
                raise ValueError(f"obstacle_starts: {point} is outside {square}")
        return self

    @property
    def obstacle_half_side(self) -> float:
        """Half side of the square in which obstacles start and walk [m]."""
        return self.arena if self.obstacle_arena is None else self.obstacle_arena


def check_randomization(ranges: Ranges, settings: WorldSettings) -> None:
    """Check the ranges of randomized fields for a scenario.

    :raises SettingsError: one line for the first that is not accepted
    """
    check_ranges(ranges, {"sensors": settings.sensors, "actuators": settings.actuators})
    _, fastest = ranges.get("actuators.min_speed", (0.0, 0.0))
    if fastest > settings.max_speed:
        raise SettingsError(
            f"randomization.actuators.min_speed = {list(ranges['actuators.min_speed'])}: input should be at most "
            f"max_speed = {settings.max_speed}"
        )


_EPISODE = (
    "positions",
    "headings",
    "obstacle_positions",
    "obstacle_headings",
    "waypoints",
    "obstacle_speeds",
    "obstacle_turn_rates",
)
"""The arrays of the current episode."""


class WorldError(UserError):
    """The scenario leaves no room to start."""


def check_actions(actions: NDArray[Any], shape: tuple[int, ...], *owners: str) -> None:
    """Check that actions have a shape and are finite: one that is NaN would violate no separation.

    :param owners: what the leading axes count, such as ``"flock", "vehicle"``
    :raises ActionError: if they have not, or are not
    """
    if actions.shape != shape:
        raise ActionError(f"actions have the shape {actions.shape}: {shape} is needed")
    if not np.isfinite(actions).all():
        place = np.argwhere(~np.isfinite(actions))[0].tolist()[: len(owners)]
        whose = " ".join(f"{owner} {index}" for owner, index in zip(owners, place, strict=True))
        raise ActionError(f"action{whose and f' of {whose}'} = {actions[tuple(place)].tolist()}: finite numbers are needed")


def episode_rng(seed: int, episode: int) -> Generator:
    """The random stream of one episode: it depends on the seed and the episode's number, never on the batch size."""
    return np.random.default_rng(np.random.SeedSequence([seed, episode]))


class World:
    """``n_flocks`` independent flocks of one scenario, advanced in lockstep.

    Every flock draws from its own generator, and the obstacles' random walk is drawn for the whole episode at the reset: a
    flock's trajectory depends on its generator and its actions alone.

    :param scenario: the task, a :class:`~sb3_flock.sim.Scenario`
    :param n_flocks: number of flocks, at least 1
    :param safety: the filters and their separations, if they are not the scenario's
    :param randomization: ranges from which fields of ``sensors`` and ``actuators`` are drawn for each flock and episode
    :raises SettingsError: for a range that is not accepted
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

    drawn: dict[str, NDArray[np.float64]]
    """The randomized fields' values in the current episode by name, ``(flocks,)`` each."""

    def __init__(
        self,
        scenario: WorldSettings,
        n_flocks: int = 1,
        safety: SafetySettings | None = None,
        randomization: Ranges | None = None,
    ) -> None:
        self.scenario, self._safety, self.randomization = scenario, safety, dict(randomization or {})
        check_randomization(self.randomization, scenario)
        self.n_flocks = n_flocks
        self.sensors = Sensors(scenario, scenario, lambda: Bodies(self.positions, self.frames, self.obstacle_positions))
        motion = OBSTACLE_MOTIONS.get(scenario.obstacle_motion)
        self._obstacle_motion = motion(scenario) if motion else None
        self.dynamics: VehicleDynamics = DYNAMICS[scenario.dynamics](scenario)
        self.drawn = {}
        self.steps = scenario.max_cycles  # no episode is running before the first reset
        self.action_low = np.array([0.0, -scenario.max_turn_rate])
        self.action_high = np.array([scenario.max_speed, scenario.max_turn_rate])
        # As large as the actions: NumPy broadcasts slowly along a last axis this short.
        shape = (n_flocks, scenario.n_vehicles, 2)
        self._one_step = np.ones((n_flocks, 1))
        self._bounds = [np.broadcast_to(bound, shape).copy() for bound in (self.action_low, self.action_high)]

    @property
    def safety(self) -> SafetySettings:
        """The settings of the safety filter."""
        return self._safety or self.scenario

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
            self._frames = directions_of(self._headings)
        return self._frames

    def sense(self, ego_motion: NDArray[np.float64] | None = None) -> Sensing:
        """Everything the vehicles sense in the present state, without sensor errors (section III-A).

        :param ego_motion: :attr:`Sensing.ego_motion`; ``None`` at the start
        """
        if ego_motion is None and not self.dynamics.is_plain:  # as wide as after a step
            ego_motion = np.zeros((*self.headings.shape, 3))
        return sense(self.positions, self.frames, self.obstacle_positions, self.waypoints, self.scenario, ego_motion)

    def reset(self, rngs: Sequence[Generator]) -> Sensing:
        """Start an episode in every flock (section V).

        Vehicles and obstacles are uniform in their squares with uniform headings, the waypoint is uniform in the arena. A
        body that starts closer to a vehicle than its minimum separation is drawn again. ``waypoint_route`` and
        ``obstacle_starts`` replace the random ones.

        :param rngs: one generator a flock
        :return: what the vehicles sense at the start
        :raises WorldError: if the arena is too crowded to place a body
        """
        if len(rngs) != self.n_flocks:
            raise ValueError(f"rngs has {len(rngs)} generators: one for each of the {self.n_flocks} flocks is needed")
        starts = [self._start(rng) for rng in rngs]
        self.positions, self.headings, self.obstacle_positions, self.obstacle_headings, self.waypoints = (
            np.stack(parts) for parts in zip(*starts, strict=True)
        )
        controls = [self._obstacle_controls(rng) for rng in rngs]
        self.obstacle_speeds, self.obstacle_turn_rates = (np.stack(parts, axis=1) for parts in zip(*controls, strict=True))
        if self.randomization:
            self._use(draw(self.randomization, rngs))
        self.sensors.reset(rngs)
        self.dynamics.reset(rngs)
        self.steps = 0
        return self.sense()

    def step(self, actions: ArrayLike) -> tuple[Sensing, NDArray[np.float64]]:
        """Move every body by one sampling period, vehicles, obstacles and waypoint together (section III-A).

        The actions are commands: how the vehicles follow them is a matter of their dynamics.

        :param actions: ``(flocks, vehicles, 2)``, speed v [m/s] and turn rate omega [rad/s], clipped to their bounds
        :return: what the vehicles sense afterwards, and the executed actions: clipped, and filtered where the scenario says so
        :raises ActionError: for actions of another shape, or that are not finite
        :raises RuntimeError: before a reset or after the episode's last step
        """
        if self.steps >= self.scenario.max_cycles:
            raise RuntimeError("no episode is running: call reset() first")
        low, high = self._bounds
        given = np.asarray(actions, dtype=np.float64)
        check_actions(given, low.shape, "flock", "vehicle")
        executed = np.minimum(np.maximum(given, low), high)
        safety = self.safety
        if safety.is_filtered:
            if self.dynamics.margin:
                safety = safety.model_copy(update={"safety_margin": safety.safety_margin + self.dynamics.margin})
            measured, stopping = self.sensors.latest or self.sense(), self.dynamics.stopping()
            executed = filter_actions(executed, measured, safety, self.frames, stopping=stopping)
        self.sensors.latest = None
        ego_motion = self._move(executed)
        self.steps += 1
        return self.sense(ego_motion), executed

    def state_dict(self) -> dict[str, Any]:
        """The current episode: everything its next steps depend on besides the actions."""
        return {
            **{name: getattr(self, name) for name in _EPISODE},
            "steps": self.steps,
            "sensors": self.sensors.state_dict(),
            "dynamics": self.dynamics.state_dict(),
            "drawn": self.drawn,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore the episode of :meth:`state_dict`.

        :raises ValueError: if its numbers of bodies or steps are others
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
        if type(state["steps"]) is not int or not 0 <= state["steps"] <= self.scenario.max_cycles:
            raise ValueError(f"steps = {state['steps']}: 0 to {self.scenario.max_cycles} are possible")
        self.steps = state["steps"]
        drawn = state.get("drawn", {})
        if drawn or self.drawn:
            self._use({name: np.array(values, dtype=np.float64) for name, values in drawn.items()})
        self.sensors.load_state_dict(state["sensors"])
        if "dynamics" in state:
            self.dynamics.load_state_dict(state["dynamics"])
        else:  # of an earlier version, whose vehicles had no state of their own
            self.dynamics.reset([np.random.default_rng(0) for _ in range(flocks)])

    def _use(self, drawn: dict[str, NDArray[np.float64]]) -> None:
        """Let the sensors and the dynamics have drawn values."""

        def of_group(group: str) -> dict[str, NDArray[np.float64]]:
            return {name.removeprefix(group): values for name, values in drawn.items() if name.startswith(group)}

        self.drawn = drawn
        self.sensors.errors = FlockValues(self.scenario.sensors, of_group("sensors."))
        self.dynamics.actuators = FlockValues(self.scenario.actuators, of_group("actuators."))

    def _move(self, controls: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vehicles by their controls ``(flocks, vehicles, 2)`` [m/s, rad/s], obstacles by drawn ones, and the waypoint.

        :return: the vehicles' own motion, :attr:`Sensing.ego_motion`
        """
        is_plain, dt = self.dynamics.is_plain, self.scenario.time_step
        ego_motion = controls * dt if is_plain else self._move_vehicles(controls)
        vehicles = self.positions, self.frames, self.headings, controls
        if not is_plain:  # the vehicles have moved
            positions, frames, headings, controls = vehicles
            vehicles = positions[:, :0], frames[:, :0], headings[:, :0], controls[:, :0]
        positions, headings, self.obstacle_positions, self.obstacle_headings = (compiled() or dynamics).move_bodies(
            *vehicles,
            self.obstacle_positions,
            directions_of(self.obstacle_headings),
            self.obstacle_headings,
            self.obstacle_speeds[self.steps],
            self.obstacle_turn_rates[self.steps],
            dt,
            self.scenario.obstacle_half_side,
        )
        if is_plain:
            self.positions, self.headings = positions, headings
        self.waypoints = waypoints_ahead(self.scenario, self.waypoints, self.steps, self._one_step)[:, 0]
        return ego_motion

    def _move_vehicles(self, controls: NDArray[np.float64]) -> NDArray[np.float64]:
        """Vehicles by their dynamics; their own motion forward, turn and to the left, ``(flocks, vehicles, 3)``."""
        before, frames, earlier = self.positions, self.frames, self.headings
        positions, headings = self.dynamics.step(before, earlier, controls, self.scenario.time_step)
        for name, now, then in (("positions", positions, before), ("headings", headings, earlier)):
            if np.shape(now) != then.shape or not np.isfinite(now).all():
                raise ValueError(
                    f"dynamics = {self.scenario.dynamics}: its step returns {name} of shape {np.shape(now)}: finite ones of "
                    f"shape {then.shape} are needed"
                )
        self.positions, self.headings = positions, wrap_angle(headings)
        forward, left = np.moveaxis(to_body(positions - before, frames), -1, 0)
        return np.stack((forward, wrap_angle(headings - earlier), left), axis=-1)

    def _start(self, rng: Generator) -> tuple[NDArray[np.float64], ...]:
        scenario = self.scenario
        given = scenario.obstacle_starts or ()
        placed, obstructed = _Placed(scenario.neighbor_separation), _Placed(scenario.obstacle_separation, given)
        positions = np.empty((scenario.n_vehicles, 2))
        for i in range(scenario.n_vehicles):
            positions[i] = placed.draw_apart(rng, scenario.arena, "n_vehicles", scenario.n_vehicles, obstructed)
            placed.add(*positions[i].tolist())
        placed, motion = _Placed(scenario.obstacle_separation, positions.tolist()), self._obstacle_motion
        obstacles = np.empty((scenario.n_obstacles, 2))
        obstacles[: len(given)] = given or np.empty((0, 2))
        others = range(len(given), scenario.n_obstacles)
        if motion is not None:
            start, where = motion.start, f"the starts of obstacle_motion = {scenario.obstacle_motion}"
            headings = rng.uniform(-np.pi, np.pi, scenario.n_vehicles)
            waypoint = self._first_waypoint(rng)
            for o in others:
                obstacles[o] = placed.draw(lambda: start(rng, waypoint), where, "n_obstacles", scenario.n_obstacles)
            return positions, headings, obstacles, motion.headings(rng, obstacles, waypoint), waypoint
        for o in others:
            obstacles[o] = placed.draw_apart(rng, scenario.obstacle_half_side, "n_obstacles", scenario.n_obstacles)
        headings = rng.uniform(-np.pi, np.pi, scenario.n_vehicles)
        obstacle_headings = rng.uniform(-np.pi, np.pi, scenario.n_obstacles)
        return positions, headings, obstacles, obstacle_headings, self._first_waypoint(rng)

    def _first_waypoint(self, rng: Generator) -> NDArray[np.float64]:
        drawn = rng.uniform(-self.scenario.arena, self.scenario.arena, 2)
        return drawn if self.scenario.waypoint_route is None else np.array(self.scenario.waypoint_route[0])

    def _obstacle_controls(self, rng: Generator) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The obstacles' speeds [m/s] and turn rates [rad/s] of a whole episode, each ``(steps, obstacles)``."""
        scenario, motion = self.scenario, self._obstacle_motion
        shape, top = (scenario.max_cycles, scenario.n_obstacles), scenario.obstacle_max_speed
        if motion is None:
            return rng.uniform(0.0, top, shape), rng.normal(0.0, 1.0, shape) * scenario.obstacle_turn_std
        speeds, turn_rates = motion.controls(rng)
        for name, values, bounds in (("speeds", speeds, (0.0, top)), ("turn rates", turn_rates, (-np.inf, np.inf))):
            if (
                np.shape(values) != shape
                or not np.isfinite(values).all()
                or (values < bounds[0]).any()
                or (values > bounds[1]).any()
            ):
                raise ValueError(
                    f"obstacle_motion = {scenario.obstacle_motion}: finite {name} of shape {shape} from {bounds[0]:g} to "
                    f"{bounds[1]:g} are needed"
                )
        return speeds, turn_rates


def waypoints_ahead(
    settings: WorldSettings, waypoints: NDArray[np.float64], steps: int, ahead: NDArray[np.floating]
) -> NDArray[np.float64]:
    """The waypoint's positions some steps ahead: straight towards the origin (section V), or along the route.

    :param settings: the waypoint's speed and route
    :param waypoints: present positions, ``(flocks, 2)`` [m]
    :param steps: steps since the reset
    :param ahead: steps from now, any number for each flock, ``(flocks, any)``
    :return: ``(flocks, any, 2)`` [m]
    """
    route, stride = settings.waypoint_route, settings.waypoint_speed * settings.time_step
    if route is not None:
        return along(np.array(route), stride * (steps + ahead))
    squares = np.square(waypoints)
    distances = np.sqrt(squares[:, :1] + squares[:, 1:])
    return waypoints[:, None] * (1.0 - np.minimum(stride * ahead / np.maximum(distances, 1e-12), 1.0))[..., None]


def along(route: NDArray[np.float64], distances: NDArray[np.floating]) -> NDArray[np.float64]:
    """The points at distances ``(...)`` along a route ``(points, 2)`` [m], ``(..., 2)``; beyond its end, the end."""
    lengths = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(route, axis=0).T))))
    return np.stack([np.interp(distances, lengths, coordinate) for coordinate in route.T], axis=-1)


class _Placed:
    """Vehicles placed so far, in square cells as wide as the minimum separation: a new point is checked against nine cells."""

    def __init__(self, separation: float, points: Iterable[Sequence[float]] = ()) -> None:
        self.separation = separation
        self._cells: dict[tuple[int, int], list[tuple[float, float]]] = {}
        for x, y in points:
            self.add(x, y)

    def add(self, x: float, y: float) -> None:
        if self.separation == 0:  # no point can violate it
            return
        self._cells.setdefault(self._cell(x, y), []).append((x, y))

    def draw_apart(
        self, rng: Generator, half_side: float, name: str, count: int, also: _Placed | None = None
    ) -> NDArray[np.float64]:
        """A point uniform in the square, drawn again while it is closer than the separation to one of these, or of ``also``."""
        where = f"a square of half side {half_side} m"
        return self.draw(lambda: rng.uniform(-half_side, half_side, 2), where, name, count, also)

    def draw(
        self,
        point_of: Callable[[], NDArray[np.float64]],
        where: str,
        name: str,
        count: int,
        also: _Placed | None = None,
    ) -> NDArray[np.float64]:
        """A point that a function draws, drawn again while it is closer than the separation to one of these, or of ``also``."""
        for _ in range(_MAX_REDRAWS):
            point = point_of()
            if self._is_free(*point.tolist()) and (also is None or also._is_free(*point.tolist())):
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
