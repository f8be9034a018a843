"""Metrics: each is one class with its name, unit, direction, description and table column, computed step by step.

A metric has one value per episode; results are means over episodes with intervals. All thresholds are strict. The steady
state is the second half of an episode, k = T/2 + 1 ... T. A metric that an episode does not define (pairs of a single vehicle,
obstacles where there are none) is NaN there and left out of the mean.

A further metric is a subclass of :class:`EpisodeMetric` passed to :func:`register_metric`: it then appears in every table,
JSON file and log.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count
from statistics import NormalDist
from typing import ClassVar, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from sb3_flock.settings import SettingsError, suggest
from sb3_flock.sim import Scenario, Sensing, World
from sb3_flock.sim.sensing import distance_blocks, is_connected, nearest

Values = NDArray[np.float64]

_RESAMPLES = 10_000
_CONFIDENCE = 0.95


class Step:
    """The state after one step of a batch of episodes, with what several metrics need computed once.

    :param world: the world after the step
    :param sensing: what was sensed there, without sensor errors
    :param rewards: r_i of the step, ``(flocks, vehicles)``
    :param number: number k of the step, from 1
    """

    def __init__(self, world: World, sensing: Sensing, rewards: Values, number: int) -> None:
        self.world, self.sensing, self.rewards, self.number = world, sensing, rewards, number

    @property
    def is_steady_state(self) -> bool:
        """Whether the step is in the second half of the episode."""
        return 2 * self.number > self.world.scenario.max_cycles

    @cached_property
    def _pairs(self) -> tuple[Values, Values]:
        """Smallest distance and sum of distances over all pairs of vehicles, ``(flocks,)`` each [m]."""
        positions = self.world.positions
        smallest, total = np.full(len(positions), np.inf), np.zeros(len(positions))
        for _, distances in distance_blocks(positions, positions, exclude_self=True):
            by_flock = distances.reshape(len(positions), -1)
            np.minimum(smallest, by_flock.min(-1), out=smallest)
            if self.is_steady_state:  # each pair counts from both sides
                total += np.where(np.isfinite(by_flock), by_flock, 0.0).sum(-1) / 2
        return smallest, total

    @property
    def smallest_pair_distance(self) -> Values:
        """Smallest distance between two vehicles, ``(flocks,)`` [m]; inf for a single vehicle."""
        return self._pairs[0]

    @property
    def sum_of_pair_distances(self) -> Values:
        """Sum of the distances of all pairs, ``(flocks,)`` [m]; in the steady state alone."""
        return self._pairs[1]

    @cached_property
    def smallest_obstacle_distance(self) -> Values:
        """Smallest distance of a vehicle to an obstacle, ``(flocks,)`` [m]; inf without obstacles."""
        return nearest(self.world.positions, self.world.obstacle_positions).min(-1)

    @cached_property
    def neighbor_violations(self) -> Values:
        """Number of vehicles with a neighbor closer than the minimum separation, ``(flocks,)``."""
        return (self.sensing.neighbors.count(self.world.scenario.neighbor_separation) > 0).sum(-1).astype(np.float64)

    @cached_property
    def obstacle_violations(self) -> Values:
        """Number of vehicles with an obstacle closer than the minimum separation, ``(flocks,)``."""
        return (self.sensing.obstacles.count(self.world.scenario.obstacle_separation) > 0).sum(-1).astype(np.float64)

    @cached_property
    def connected(self) -> NDArray[np.bool_]:
        """Whether the proximity graph is connected, ``(flocks,)``."""
        return is_connected(self.sensing.neighbors)


class EpisodeMetric(ABC):
    """One metric over a batch of episodes that are simulated in lockstep.

    :param scenario: the task
    :param n_flocks: number of episodes in the batch
    """

    name: ClassVar[str]
    unit: ClassVar[str] = ""
    """``"m"``, or ``""`` for a number without unit."""
    better: ClassVar[Literal["lower", "higher"]]
    description: ClassVar[str]
    is_rate: ClassVar[bool] = False
    """Whether it is a fraction, which tables show in percent."""
    is_binary: ClassVar[bool] = False
    """Whether it is 0 or 1 in each episode, so that its mean is a share of the episodes."""
    is_minimum: ClassVar[bool] = False
    """Whether it is a smallest distance; its worst episode is reported too."""
    column: ClassVar[str | None] = None
    """Heading in narrow tables; ``None`` leaves it out of them."""

    @classmethod
    def format(cls, value: float) -> str:
        """A value as tables show it."""
        return f"{value:.2%}" if cls.is_rate else f"{value:.3f}"

    def __init__(self, scenario: Scenario, n_flocks: int) -> None:
        self.scenario, self.n_flocks = scenario, n_flocks

    @abstractmethod
    def update(self, step: Step) -> None:
        """Take in the state after one step."""

    @abstractmethod
    def result(self) -> Values:
        """The metric's value in each episode, ``(flocks,)``, NaN where it is not defined."""

    def _undefined(self) -> Values:
        return np.full(self.n_flocks, np.nan)

    @property
    def _n_pairs(self) -> int:
        return self.scenario.n_vehicles * (self.scenario.n_vehicles - 1) // 2


METRICS: dict[str, type[EpisodeMetric]] = {}
"""Every metric by name, in the order of the tables."""

_Metric = TypeVar("_Metric", bound=type[EpisodeMetric])


def register_metric(metric: _Metric) -> _Metric:
    """Add a metric to every table, as a decorator.

    :raises ValueError: if another metric has the name already
    """
    if METRICS.setdefault(metric.name, metric) is not metric:
        raise ValueError(f"metric {metric.name!r} is registered already")
    return metric


class _Mean(EpisodeMetric):
    """Sum of a value per step over the sum of its weights; NaN where they are 0."""

    steady_state_only: ClassVar[bool] = True

    def __init__(self, scenario: Scenario, n_flocks: int) -> None:
        super().__init__(scenario, n_flocks)
        self._total, self._weight = np.zeros(n_flocks), np.zeros(n_flocks)

    def update(self, step: Step) -> None:
        if step.is_steady_state or not self.steady_state_only:
            self._total += self.value(step)
            self._weight += self.weight(step)

    @abstractmethod
    def value(self, step: Step) -> Values:
        """The step's contribution, ``(flocks,)``."""

    def weight(self, step: Step) -> Values | float:
        """The step's weight."""
        return float(self.scenario.n_vehicles)

    def result(self) -> Values:
        with np.errstate(invalid="ignore"):
            return self._total / self._weight


class _Minimum(EpisodeMetric):
    """Smallest value over all steps."""

    unit, better, is_minimum = "m", "higher", True

    def __init__(self, scenario: Scenario, n_flocks: int) -> None:
        super().__init__(scenario, n_flocks)
        self._smallest = np.full(n_flocks, np.inf)

    def update(self, step: Step) -> None:
        np.minimum(self._smallest, self.value(step), out=self._smallest)

    @abstractmethod
    def value(self, step: Step) -> Values:
        """The step's value, ``(flocks,)`` [m]."""


@register_metric
class TrackingError(_Mean):
    """Mean distance to the waypoint in the steady state."""

    name, unit, better = "tracking_error", "m", "lower"
    column: ClassVar[str | None] = "tracking"
    description = "mean distance vehicle to waypoint over vehicles and steady-state steps [m]"

    def value(self, step: Step) -> Values:
        return step.sensing.waypoint_distances.sum(-1)


@register_metric
class TrackingErrorEpisode(TrackingError):  # noqa: N818 - a metric, not an exception
    """Mean distance to the waypoint in the whole episode."""

    name = "tracking_error_episode"
    column: ClassVar[str | None] = None
    description = "the same over the whole episode [m]"
    steady_state_only = False


@register_metric
class MinSeparationObstacles(_Minimum):
    """Smallest distance to an obstacle."""

    name = "min_separation_obstacles"
    description = "smallest distance vehicle to obstacle in the episode [m]"

    def value(self, step: Step) -> Values:
        return step.smallest_obstacle_distance

    def result(self) -> Values:
        return self._smallest if self.scenario.n_obstacles else self._undefined()


@register_metric
class EncounterMinSeparationObstacles(MinSeparationObstacles):
    """Smallest distance to an obstacle, in episodes with an encounter."""

    name = "encounter_min_separation_obstacles"
    description = "the same, over episodes in which an obstacle came within detection range [m]"

    def result(self) -> Values:
        return np.where(self._smallest < self.scenario.detection_range, super().result(), np.nan)


@register_metric
class MinSeparationNeighbors(_Minimum):
    """Smallest distance between two vehicles."""

    name = "min_separation_neighbors"
    description = "smallest distance between two vehicles in the episode [m]"

    def value(self, step: Step) -> Values:
        return step.smallest_pair_distance

    def result(self) -> Values:
        return self._smallest if self._n_pairs else self._undefined()


@register_metric
class MeanSeparation(_Mean):
    """Mean distance over all pairs of vehicles."""

    name, unit, better = "mean_separation", "m", "lower"
    description = "mean distance over all pairs and steady-state steps [m]"

    def value(self, step: Step) -> Values:
        return step.sum_of_pair_distances

    def weight(self, step: Step) -> float:
        return float(self._n_pairs)


@register_metric
class MeanSeparationLinked(_Mean):
    """Mean distance over linked pairs of vehicles."""

    name, unit, better = "mean_separation_linked", "m", "lower"
    description = "mean distance over linked pairs and steady-state steps [m]"

    def value(self, step: Step) -> Values:
        return step.sensing.neighbors.sum(step.sensing.neighbors.distances).sum(-1) / 2

    def weight(self, step: Step) -> Values:
        return step.sensing.neighbors.count().sum(-1) / 2


@register_metric
class ObstacleViolationRate(_Mean):
    """Share of vehicle-steps that violate the separation to obstacles."""

    name, better, is_rate, column = "obstacle_violation_rate", "lower", True, "obst. viol."
    description = "share of vehicle-steps with an obstacle closer than its minimum separation"
    steady_state_only = False

    def value(self, step: Step) -> Values:
        return step.obstacle_violations

    def result(self) -> Values:
        return super().result() if self.scenario.n_obstacles else self._undefined()


@register_metric
class NeighborViolationRate(_Mean):
    """Share of vehicle-steps that violate the separation to neighbors."""

    name, better, is_rate, column = "neighbor_violation_rate", "lower", True, "neigh. viol."
    description = "share of vehicle-steps with a vehicle closer than its minimum separation"
    steady_state_only = False

    def value(self, step: Step) -> Values:
        return step.neighbor_violations

    def result(self) -> Values:
        return super().result() if self._n_pairs else self._undefined()


@register_metric
class Connectivity(_Mean):
    """Share of steps with a connected proximity graph."""

    name, better, is_rate, column = "connectivity", "higher", True, "connected"
    description = "share of steady-state steps whose proximity graph is connected"

    def value(self, step: Step) -> Values:
        return step.connected.astype(np.float64)

    def weight(self, step: Step) -> float:
        return 1.0


@register_metric
class ViolationFreeRate(EpisodeMetric):
    """Share of episodes without any violation."""

    name, better, is_rate, is_binary = "violation_free_rate", "higher", True, True
    column: ClassVar[str | None] = "free"
    description = "share of episodes in which no vehicle violates any separation in any step"

    def __init__(self, scenario: Scenario, n_flocks: int) -> None:
        super().__init__(scenario, n_flocks)
        self._violated = np.zeros(n_flocks, dtype=bool)

    def update(self, step: Step) -> None:
        self._violated |= (step.neighbor_violations > 0) | (step.obstacle_violations > 0)

    def result(self) -> Values:
        return (~self._violated).astype(np.float64)


def lattice_rings(n_vehicles: int) -> int:
    """Number of rings of a hexagonal lattice around the waypoint that holds all n vehicles.

    It is the least k from 1 on with 1 + 3k(k + 1) >= n: 1 for up to 7 vehicles, 2 for 19, 3 for 37. With links as long as the
    lattice's edges, no vehicle has to be farther than k link ranges from the waypoint.
    """
    return next(k for k in count(1) if 1 + 3 * k * (k + 1) >= n_vehicles)


@register_metric
class SuccessRate(ViolationFreeRate):
    """Share of episodes without any violation that end connected, within :func:`lattice_rings` link ranges of the waypoint."""

    name, column = "success_rate", "success"
    description = (
        "share of episodes without violation that end connected, each vehicle within k link ranges of the waypoint "
        "(k: rings of a hexagonal lattice that holds all vehicles, 1 for up to 7)"
    )

    def __init__(self, scenario: Scenario, n_flocks: int) -> None:
        super().__init__(scenario, n_flocks)
        self._arrived = np.zeros(n_flocks, dtype=bool)
        self._radius = lattice_rings(scenario.n_vehicles) * scenario.link_range

    def update(self, step: Step) -> None:
        super().update(step)
        if step.is_steady_state:
            self._arrived = step.connected & (step.sensing.waypoint_distances < self._radius).all(-1)

    def result(self) -> Values:
        return self._arrived * super().result()


@register_metric
class Return(EpisodeMetric):
    """Undiscounted return of the own reward r_i."""

    name, better = "return", "higher"
    description = "undiscounted sum of a vehicle's own reward, mean over vehicles"

    @classmethod
    def format(cls, value: float) -> str:
        """A value as tables show it."""
        return f"{value:.1f}"

    def __init__(self, scenario: Scenario, n_flocks: int) -> None:
        super().__init__(scenario, n_flocks)
        self._total = np.zeros(n_flocks)

    def update(self, step: Step) -> None:
        self._total += step.rewards.sum(-1)

    def result(self) -> Values:
        return self._total / self.scenario.n_vehicles


def is_higher_better(name: str) -> bool:
    """Whether more is better of a metric; of :func:`score` less is."""
    return name in METRICS and METRICS[name].better == "higher"


class EpisodeMetrics:
    """Metrics of one batch of episodes, in bounded memory.

    :param scenario: the task
    :param n_flocks: number of episodes in the batch
    :param metrics: the metrics; every registered one by default
    """

    def __init__(self, scenario: Scenario, n_flocks: int, metrics: Sequence[type[EpisodeMetric]] | None = None) -> None:
        self._metrics = [metric(scenario, n_flocks) for metric in (METRICS.values() if metrics is None else metrics)]
        self._steps = 0

    def update(self, world: World, sensing: Sensing, rewards: Values) -> None:
        """Take in the state after one step, what was sensed there and the rewards r_i, ``(flocks, vehicles)``."""
        self._steps += 1
        step = Step(world, sensing, rewards, self._steps)
        for metric in self._metrics:
            metric.update(step)

    def result(self) -> dict[str, Values]:
        """Every metric's value in each episode, ``(flocks,)`` each, NaN where it is not defined."""
        return {metric.name: metric.result() for metric in self._metrics}


@dataclass(frozen=True)
class Metric:
    """One metric over episodes: the mean with its 95 % interval; all ``None`` if no episode defines it."""

    mean: float | None
    low: float | None
    high: float | None
    n: int
    """Number of episodes that define it."""
    worst: float | None = None
    """The worst episode, for smallest distances alone."""


def find_metrics(metrics: Sequence[str | type[EpisodeMetric]] | None) -> list[type[EpisodeMetric]]:
    """Metrics by their names or classes; ``None`` stands for every registered one.

    :raises SettingsError: for a name that is not registered, something else than a class, or two of one name
    """
    found = []
    for each in METRICS if metrics is None else metrics:
        metric = METRICS.get(each) if isinstance(each, str) else each
        if metric is None:
            raise SettingsError(f"metrics = {each!r}: one of {', '.join(METRICS)} is needed{suggest(str(each), METRICS)}")
        if not (isinstance(metric, type) and issubclass(metric, EpisodeMetric)):
            raise SettingsError(f"metrics: {each!r} is neither a name nor a subclass of EpisodeMetric")
        found.append(metric)
    names = [each.name for each in found]
    twice = [name for name in names if names.count(name) > 1]
    if twice:
        raise SettingsError(f"metrics: {twice[0]} is named twice")
    return found


def summarize(values: Mapping[str, Values], metrics: Mapping[str, type[EpisodeMetric]] = METRICS) -> dict[str, Metric]:
    """Unweighted means over episodes, with 95 % intervals.

    Metrics that are 0 or 1 in each episode (:attr:`EpisodeMetric.is_binary`) have Wilson's score interval, the others the
    percentile bootstrap over episodes (10 000 resamples), which would have no width where all episodes are alike.

    :param values: one value per episode for each metric, NaN where undefined
    :param metrics: the metrics' classes by name
    """
    return {name: _summarize(metrics[name], per_episode[~np.isnan(per_episode)]) for name, per_episode in values.items()}


def _summarize(metric: type[EpisodeMetric], defined: Values) -> Metric:
    if len(defined) == 0:
        return Metric(None, None, None, 0)
    mean = float(defined.mean())
    low, high = wilson_interval(mean, len(defined)) if metric.is_binary else _bootstrap_interval(defined)
    worst = float(defined.min()) if metric.is_minimum else None
    return Metric(mean, low, high, len(defined), worst)


def wilson_interval(share: float, n: int) -> tuple[float, float]:
    """The 95 % score interval of a share of ``n`` episodes: every p from which the share is at most z standard errors away.

    E. B. Wilson: *Probable inference, the law of succession, and statistical inference*, JASA 22 (1927), 209-212.
    """
    z = NormalDist().inv_cdf((1 + _CONFIDENCE) / 2)
    center = share + z**2 / (2 * n)
    half_width = z * (share * (1 - share) / n + (z / (2 * n)) ** 2) ** 0.5
    scale = 1 + z**2 / n
    low, high = (center - half_width) / scale, (center + half_width) / scale
    return max(0.0, min(share, low)), min(1.0, max(share, high))  # exactly 0 and 1, where rounding leaves nearly that


def _bootstrap_interval(defined: Values) -> tuple[float, float]:
    rng = np.random.default_rng(0)
    rows = max(1, 1_000_000 // len(defined))  # resamples drawn at once, to bound memory
    means = np.concatenate(
        [
            defined[rng.integers(len(defined), size=(min(rows, _RESAMPLES - start), len(defined)))].mean(-1)
            for start in range(0, _RESAMPLES, rows)
        ]
    )
    tail = 50 * (1 - _CONFIDENCE)
    low, high = np.percentile(means, [tail, 100 - tail])
    return float(low), float(high)


def columns() -> dict[str, str]:
    """Headings of narrow tables by metric: the metrics with a ``column``."""
    return {name: metric.column for name, metric in METRICS.items() if metric.column is not None}


def score(means: Mapping[str, float]) -> float:
    """One number to choose the best of several policies by; lower is better.

    ``tracking_error + 2 neighbor_violation_rate + 4 obstacle_violation_rate + 0.2 (1 - connectivity)``: neighbor violations in
    1 % of the vehicle-steps weigh as much as 2 cm of tracking error. Undefined metrics count as perfect.
    """
    perfect = {"neighbor_violation_rate": 0.0, "obstacle_violation_rate": 0.0, "connectivity": 1.0}
    perfect.update({name: value for name, value in means.items() if name in perfect and np.isfinite(value)})
    return float(
        means["tracking_error"]
        + 2 * perfect["neighbor_violation_rate"]
        + 4 * perfect["obstacle_violation_rate"]
        + 0.2 * (1 - perfect["connectivity"])
    )
