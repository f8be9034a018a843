"""The safety filter: bounds on the vehicles' speeds under which no two vehicles end a step nearer than their separation.

A unicycle moves along its present heading, never backwards, and may stop within a step. The share of vehicle i's heading
towards neighbor j at distance d is cos_i. Each pair has a budget d - r_n', which i and j divide among them, and each bounds
its own approach v_i cos_i dt by its part. The new offset, projected on the old line, is then at least r_n'. ``docs/safety.md``
has the proof, what each level needs to know, and what can be guaranteed about obstacles.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from sb3_flock.settings import NotNegative
from sb3_flock.sim.actuators import Actuators
from sb3_flock.sim.backend import compiled
from sb3_flock.sim.sensing import Contacts, Sensing, SensingSettings
from sb3_flock.sim.sensors import SensorSettings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from sb3_flock.sim.dynamics import Stopping

ROUNDING = 1e-9
"""What the filter keeps beyond a separation for floating-point errors [separations]: enough while coordinates stay below
10 000 separations. A vehicle that touches its bound stands still unless it recedes by more than that."""

_TINY = 1e-300
"""Smallest length that is divided by [m]."""


class SafetySettings(SensingSettings, SensorSettings):
    """Which bounds on the vehicles' speeds the world enforces; none by default, as in the paper."""

    safety_filter: Literal["off", "voronoi", "motion", "heading", "announce"] = Field(
        "off",
        description="bound on speeds that prevents neighbor violations; off: none; voronoi: headings of neighbors are "
        "unknown (buffered Voronoi cells); motion: inferred over motion_lag; heading: sensed; announce: sensed, and each "
        "vehicle announces to its neighbors the speed that it will reach at least (paper: off)",
    )
    obstacle_filter: bool = Field(
        False,
        description="also bound speeds towards obstacles, so that no vehicle's own motion causes a violation (paper: false)",
    )
    safety_margin: NotNegative = Field(
        0.0, description="distance that the filters keep beyond the minimum separations, for sensor errors [m] (paper: 0)"
    )

    @field_validator("safety_filter", mode="before")
    @classmethod
    def _off_is_a_word(cls, value: Any) -> Any:
        """PyYAML reads ``off`` as false."""
        return "off" if value is False else value

    @model_validator(mode="after")
    def _filter_senses_enough(self) -> SafetySettings:
        if self.safety_filter == "motion" and not self.motion_lag:
            raise ValueError("safety_filter = motion: motion_lag > 0 is needed")
        if self.safety_filter != "off":
            self._check_reach("safety_filter", "link_range", "neighbor_separation", 2 * self.max_speed)
        if self.obstacle_filter:
            self._check_reach(
                "obstacle_filter", "detection_range", "obstacle_separation", self.max_speed + self.obstacle_max_speed
            )
        return self

    def _check_reach(self, which: str, sensing_range: str, separation: str, speed: float) -> None:
        """A body out of range must not come nearer than the separation in one step, at the highest speed of approach."""
        kept, approach = getattr(self, separation) + self.safety_margin, speed * self.time_step
        if getattr(self, sensing_range) < (1 + 2 * ROUNDING) * kept + approach:
            raise ValueError(
                f"{sensing_range} = {getattr(self, sensing_range)}: {which} needs more than {separation} + safety_margin + "
                f"the approach of two bodies in one time_step = {kept:g} + {approach:g}; it can be off"
            )

    @property
    def is_filtered(self) -> bool:
        """Whether a filter is on."""
        return self.safety_filter != "off" or self.obstacle_filter

    @property
    def is_reserving(self) -> bool:
        """Whether a filter keeps the way free that the vehicles need in order to stop, for which it needs their actual speeds."""
        return self.is_filtered and self.dynamics == "unicycle" and self.actuators != Actuators()

    @property
    def guarantee_limits(self) -> tuple[str, ...]:
        """Which parameters end the guarantee of the filter that is on, as ``name = value``; empty if it holds.

        The last one is the range itself, where two vehicles that come into range at top speed cannot stop apart any more. A
        tracker lifts no limit: its margin is a number of standard deviations. The guarantee also needs starts that keep the
        separation, and vehicles that are all filtered: ``docs/safety.md``.
        """
        if not self.is_filtered:
            return ()
        limits = [f"dynamics = {self.dynamics}"] if self.dynamics != "unicycle" else []
        harmless = {"turn_lag", "max_turn_acceleration"}  # a filtered vehicle may turn as it likes
        if self.safety_filter != "motion":
            harmless.add("odometry_noise")
        if self.sensors.field_of_view >= math.pi:  # no vehicle approaches what is behind it
            harmless.add("field_of_view")
        for name, group in (("actuators", self.actuators), ("sensors", self.sensors)):
            exact = type(group)()
            limits += [
                f"{name}.{field} = {getattr(group, field):g}"
                for field in type(group).model_fields
                if field not in harmless and getattr(group, field) != getattr(exact, field)
            ]
        if self.safety_filter != "off" and self.stopping_range > self.link_range:
            limits.append(f"link_range = {self.link_range:g}, of which two vehicles need {self.stopping_range:.3g} to stop")
        return tuple(limits)

    @property
    def stopping_range(self) -> float:
        """How far two vehicles have to sense each other in order to stop apart if they meet head-on at top speed [m].

        Each goes on for one step until the other is in range, for the sensors' delay, and for the way of its stop. Messages
        (``tracker.shared_motion``) have no delay.
        """
        speed, actuators, bound = self.max_speed, self.actuators, self.actuators.max_acceleration
        is_heard = self.tracker.enabled and self.tracker.shared_motion
        late = self.time_step + (0.0 if is_heard else self.sensors.delay) + actuators.speed_lag
        way = speed * late + (0.0 if bound is None else speed * speed / (2 * bound))
        return self.neighbor_separation + self.safety_margin + 2 * way


def filter_actions(
    actions: NDArray[np.float64],
    sensing: Sensing,
    settings: SafetySettings,
    frames: NDArray[np.float64] | None = None,
    use_numba: bool = True,
    stopping: Stopping | None = None,
) -> NDArray[np.float64]:
    """The actions with their speeds bounded; each vehicle uses what it senses, and with ``announce`` what neighbors announce.

    Of a neighbor whose position is estimated it keeps ``tracker.margin_stds`` standard deviations more; for obstacles the tracker
    does that. A neighbor that it knows by messages alone came into range in the last step: it is at least ``link_range`` less a
    step's approach away, straight ahead at the worst.

    Vehicles that cannot stop at once keep the way free that they need in order to stop, straight on. That lowers the number of
    violations; the guarantee is for vehicles that stop at once.

    :param actions: ``(flocks, vehicles, 2)``, speed [m/s], not negative, and turn rate [rad/s]
    :param sensing: what every vehicle senses before it acts
    :param settings: the filters and the separations
    :param frames: cosine and sine of the vehicles' headings, ``(flocks, vehicles, 2)``, for ``heading`` and ``announce``
    :param use_numba: use numba where it is installed; the numbers are the same
    :param stopping: what the vehicles need in order to stop; ``None``: they stop at once
    :return: ``(flocks, vehicles, 2)``; only speeds differ, none is higher
    """
    dt, margin = settings.time_step, settings.safety_margin
    observers, strides, budgets = np.empty(0, np.int64), np.empty(0), np.empty(0)
    neighbors, obstacles = sensing.neighbors, sensing.obstacles
    if settings.safety_filter != "off":
        free = neighbors.distances - settings.neighbor_separation - margin
        uncertainty = 0.0 if neighbors.stds is None else settings.tracker.margin_stds * neighbors.stds
        gaps = np.maximum(free - uncertainty, 0.0)
        receding = _receding(sensing, settings, frames)
        observers, strides = neighbors.observers, _cosines(neighbors) * dt
        budgets = np.where(receding >= 0, gaps, gaps / 2)
    if settings.obstacle_filter:  # the worst obstacle comes straight on at its top speed
        kept = settings.obstacle_separation + margin + settings.obstacle_max_speed * dt
        observers = np.concatenate((observers, obstacles.observers))
        strides = np.concatenate((strides, _cosines(obstacles) * dt))
        gaps_to_obstacles = obstacles.distances - kept
        budgets = np.concatenate((budgets, np.maximum(gaps_to_obstacles, 0.0)))
    if sensing.unplaced is not None and settings.safety_filter != "off":
        rows, step = np.flatnonzero(sensing.unplaced), 2 * settings.max_speed * dt
        gap = max(settings.link_range - step - settings.neighbor_separation - margin, 0.0)
        observers = np.concatenate((observers, rows))
        strides = np.concatenate((strides, np.full(len(rows), dt)))
        budgets = np.concatenate((budgets, np.full(len(rows), gap / 2)))
    rounding = ROUNDING * (margin + max(settings.neighbor_separation, settings.obstacle_separation))
    asked = actions[..., 0].ravel()

    def limit(floors: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = observers, strides, budgets
        if stopping is not None:
            rows = reserve_stopping(*rows, stopping, dt)
        return limit_speeds(asked, floors, *rows, rounding, use_numba)

    speeds = limit(np.zeros_like(asked))
    if settings.safety_filter == "announce":
        surely = speeds if stopping is None else np.minimum(speeds, stopping.speeds.ravel())
        budgets[: len(gaps)] += np.maximum(receding, 0.0) * surely[neighbors.vehicles] * dt
        speeds = limit(speeds)
    return np.stack((speeds.reshape(actions.shape[:-1]), actions[..., 1]), axis=-1)


def reserve_stopping(
    observers: NDArray[np.int64],
    strides: NDArray[np.float64],
    budgets: NDArray[np.float64],
    stopping: Stopping,
    dt: float,
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """The rows of :func:`limit_speeds` for vehicles that need a way to stop: two bounds for each contact.

    A vehicle at the speed v that is commanded u for a step and 0 from then on travels, straight on, at most the larger of
    u dt + v lag + v^2 / (2 a) and u (dt + v / a) + v lag - v^2 / (2 a), where a bounds the acceleration. The share of that way
    that points to a body has to fit the budget for it.

    :param stopping: what the vehicles need in order to stop
    :return: ``observers``, ``strides`` and ``budgets`` of twice as many rows; no budget is negative
    """
    shape = stopping.speeds.shape
    speeds, lag, bound = (np.broadcast_to(values, shape).ravel()[observers] for values in stopping)
    ahead = np.maximum(strides / dt, 0.0)
    by_lag, by_bound = ahead * speeds * lag, ahead * speeds * speeds / (2 * bound)
    first = np.maximum(budgets - by_lag - by_bound, 0.0)
    second = np.maximum(budgets - by_lag + by_bound, 0.0)
    steeper = strides + ahead * speeds / bound
    return np.tile(observers, 2), np.concatenate((strides, steeper)), np.concatenate((first, second))


def limit_speeds(
    speeds: NDArray[np.float64],
    floors: NDArray[np.float64],
    observers: NDArray[np.int64],
    strides: NDArray[np.float64],
    budgets: NDArray[np.float64],
    rounding: float,
    use_numba: bool = True,
) -> NDArray[np.float64]:
    """The highest speeds with which no vehicle approaches a sensed body by more than its budget for that body.

    ``rounding`` of every budget stays unused. Where that leaves nothing, a vehicle has to recede from the body by as much as
    is missing. A vehicle whose speed does not do so, or has been lowered too far for that, gets its floor instead.

    :param speeds: ``(vehicles of all flocks,)`` [m/s]
    :param floors: speeds that every budget admits, not negative, such as 0, ``(vehicles of all flocks,)`` [m/s]
    :param observers: the vehicle that senses, ``(contacts,)``
    :param strides: cos dt, by how much a speed of 1 m/s approaches the sensed body in a step, ``(contacts,)`` [s]
    :param budgets: by how much the vehicle may approach the body in this step, ``(contacts,)`` [m], not negative
    :param rounding: length that covers floating-point errors [m]
    :param use_numba: use numba where it is installed; the numbers are the same
    :return: ``(vehicles of all flocks,)`` [m/s], none higher than ``speeds`` or lower than ``floors``
    """
    kernels = compiled("safety_kernels") if use_numba else None
    if kernels is not None:
        return kernels.limit_speeds(speeds, floors, observers, strides, budgets, rounding)
    limited = speeds.copy()
    over = np.flatnonzero(strides * speeds[observers] > budgets - 2 * rounding)
    over = over[strides[over] > 0]
    np.minimum.at(limited, observers[over], np.maximum(budgets[over] - 2 * rounding, 0.0) / strides[over])
    over = np.flatnonzero(strides * limited[observers] > budgets - rounding)
    limited[observers[over]] = floors[observers[over]]
    return limited


def _cosines(contacts: Contacts) -> NDArray[np.float64]:
    """The share of each observer's heading that points to the sensed body, ``(contacts,)``; 0 for a body at its own place."""
    return contacts.positions[:, 0] / np.maximum(contacts.distances, _TINY)


def _receding(sensing: Sensing, settings: SafetySettings, frames: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """The share of each neighbor's heading that points away from the observer, or less where that is not known."""
    neighbors = sensing.neighbors
    if settings.safety_filter == "voronoi":
        return np.full(len(neighbors.observers), -1.0)
    if settings.safety_filter == "motion":
        return np.where(_surely_recede(sensing, settings), 0.0, -1.0)
    if frames is None:
        raise ValueError(f"frames = None: safety_filter = {settings.safety_filter} needs the vehicles' headings")
    (cos, sin), (x, y) = (frames.reshape(-1, 2)[numbers].T for numbers in (neighbors.observers, neighbors.vehicles))
    along = (cos * x + sin * y) * neighbors.positions[:, 0] + (cos * y - sin * x) * neighbors.positions[:, 1]
    return along / np.maximum(neighbors.distances, _TINY)


def _surely_recede(sensing: Sensing, settings: SafetySettings) -> NDArray[np.bool_]:
    """Which neighbors head away whatever they did, by their motion over ``motion_lag``, ``(contacts,)``.

    A heading differs from the motion of the last steps by at most what the neighbor can turn in them. A neighbor that was
    not sensed before, or that stood still, counts as unknown.
    """
    neighbors = sensing.neighbors
    turned = settings.motion_lag_steps * settings.max_turn_rate * settings.time_step
    if sensing.previous is None or turned >= np.pi / 2:
        return np.zeros(len(neighbors.observers), bool)
    previous = sensing.previous.neighbors
    size = neighbors.shape[1]
    keys, keys_before = (seen.observers * size + seen.bodies for seen in (neighbors, previous))  # ascending
    at = np.minimum(np.searchsorted(keys_before, keys), max(len(keys_before) - 1, 0))
    known = keys_before[at] == keys if len(keys_before) else np.zeros(len(keys), bool)
    motion = np.zeros_like(neighbors.positions)
    motion[known] = neighbors.positions[known] - previous.positions[at[known]]
    away = (motion * neighbors.positions).sum(-1) / np.maximum(neighbors.distances, _TINY)
    rounding = ROUNDING * settings.neighbor_separation
    return away > np.sin(turned) * np.hypot(motion[:, 0], motion[:, 1]) + rounding
