"""Metrics of a flight: what each number means, gathered step by step, one value an episode, then a mean with its interval.

All thresholds are strict. The settled window is the second half of the episode, k = T/2 + 1 ... T. A metric that an episode
does not define (pairs of a lone vehicle, obstacles where there are none) is NaN there and left out of the mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sb3_flock.sim import Scenario, Sensing, World
from sb3_flock.sim.sensing import distance_blocks, is_connected, nearest

METRICS = {
    "tracking_error": "mean distance vehicle to waypoint over vehicles and settled steps [m]",
    "tracking_error_episode": "the same over the whole episode [m]",
    "min_separation_obstacles": "the episode's smallest distance vehicle to obstacle [m]",
    "encounter_min_separation_obstacles": "the same, over episodes in which an obstacle came within detection range [m]",
    "min_separation_neighbors": "the episode's smallest distance between two vehicles [m]",
    "mean_separation": "mean distance over all pairs and settled steps [m]",
    "mean_separation_linked": "mean distance over linked pairs and settled steps [m]",
    "obstacle_violation_rate": "share of vehicle-steps with an obstacle closer than its minimum separation",
    "neighbor_violation_rate": "share of vehicle-steps with a vehicle closer than its minimum separation",
    "connectivity": "share of settled steps whose proximity graph is connected",
    "success_rate": "share of episodes without violation that end connected, each vehicle within link range of the waypoint",
    "return": "undiscounted sum of a vehicle's own reward, mean over vehicles",
}
"""Every metric by name, in the order of the tables."""

MINIMA = ("min_separation_obstacles", "encounter_min_separation_obstacles", "min_separation_neighbors")
"""Metrics whose worst episode is reported too."""

LARGER_IS_BETTER = (*MINIMA, "connectivity", "success_rate", "return")
"""Metrics of which more is better; of all others, and of :func:`score`, less."""

_RESAMPLES = 10_000
_CONFIDENCE = 0.95


class EpisodeMetrics:
    """Gathers the metrics of one batch of episodes flown in lockstep, in bounded memory.

    :param scenario: the task flown
    :param n_flocks: episodes in the batch
    """

    def __init__(self, scenario: Scenario, n_flocks: int) -> None:
        self.scenario = scenario
        self.steps = 0
        self.settled_steps = 0
        self._sums = {
            name: np.zeros(n_flocks)
            for name in (
                "distance", "settled_distance", "pair", "linked", "n_linked", "obstacle_hits", "neighbor_hits",
                "connected", "return",
            )
        }  # fmt: skip
        self._min_neighbors = np.full(n_flocks, np.inf)
        self._min_obstacles = np.full(n_flocks, np.inf)
        self._arrived = np.zeros(n_flocks, dtype=bool)

    def update(self, world: World, sensing: Sensing, rewards: NDArray[np.float64]) -> None:
        """Take in the state after one step, what was sensed there and its rewards ``(flocks, vehicles)``."""
        scenario, sums, positions = self.scenario, self._sums, world.positions
        self.steps += 1
        settled = 2 * self.steps > scenario.max_cycles
        distances = sensing.waypoint_distances
        for _, to_neighbors in distance_blocks(positions, positions, others=True):
            by_flock = to_neighbors.reshape(len(positions), -1)
            np.minimum(self._min_neighbors, by_flock.min(-1), out=self._min_neighbors)
            if settled:  # each pair is seen from both sides
                sums["pair"] += np.where(np.isfinite(by_flock), by_flock, 0.0).sum(-1) / 2
        to_obstacle = nearest(positions, world.obstacle_positions).min(-1)
        np.minimum(self._min_obstacles, to_obstacle, out=self._min_obstacles)
        sums["distance"] += distances.sum(-1)
        sums["neighbor_hits"] += (sensing.neighbors.count(scenario.neighbor_separation) > 0).sum(-1)
        sums["obstacle_hits"] += (sensing.obstacles.count(scenario.obstacle_separation) > 0).sum(-1)
        sums["return"] += rewards.sum(-1)
        if not settled:
            return
        self.settled_steps += 1
        sums["settled_distance"] += distances.sum(-1)
        sums["linked"] += sensing.neighbors.sum(sensing.neighbors.distances).sum(-1) / 2
        sums["n_linked"] += sensing.neighbors.count().sum(-1) / 2
        connected = is_connected(sensing.neighbors)
        sums["connected"] += connected
        self._arrived = connected & (distances < scenario.link_range).all(-1)

    def result(self) -> dict[str, NDArray[np.float64]]:
        """Every metric's value for each episode, ``(flocks,)`` each, NaN where it is not defined."""
        n, sums = self.scenario.n_vehicles, self._sums
        n_pairs = n * (n - 1) // 2
        vehicle_steps = n * self.steps
        undefined = np.full(len(self._arrived), np.nan)
        has_pairs, has_obstacles = n_pairs > 0, self.scenario.n_obstacles > 0
        min_obstacles = self._min_obstacles if has_obstacles else undefined
        encounter = min_obstacles < self.scenario.detection_range
        violated = (sums["neighbor_hits"] > 0) | (sums["obstacle_hits"] > 0)
        with np.errstate(invalid="ignore"):
            mean_linked = sums["linked"] / sums["n_linked"]  # 0 / 0 where no pair was ever linked
        return {
            "tracking_error": sums["settled_distance"] / (n * self.settled_steps),
            "tracking_error_episode": sums["distance"] / vehicle_steps,
            "min_separation_obstacles": min_obstacles,
            "encounter_min_separation_obstacles": np.where(encounter, min_obstacles, np.nan),
            "min_separation_neighbors": self._min_neighbors if has_pairs else undefined,
            "mean_separation": sums["pair"] / (n_pairs * self.settled_steps) if has_pairs else undefined,
            "mean_separation_linked": mean_linked,
            "obstacle_violation_rate": sums["obstacle_hits"] / vehicle_steps if has_obstacles else undefined,
            "neighbor_violation_rate": sums["neighbor_hits"] / vehicle_steps if has_pairs else undefined,
            "connectivity": sums["connected"] / self.settled_steps,
            "success_rate": (self._arrived & ~violated).astype(np.float64),
            "return": sums["return"] / n,
        }


@dataclass(frozen=True)
class Metric:
    """One metric over episodes: the mean with its 95 % interval; all ``None`` if no episode defines it."""

    mean: float | None
    low: float | None
    high: float | None
    n: int
    """Episodes that define it."""
    worst: float | None = None
    """The worst episode, for the minima alone."""


def summarize(values: dict[str, NDArray[np.float64]]) -> dict[str, Metric]:
    """Unweighted means over episodes, with 95 % percentile bootstrap intervals over episodes (10 000 resamples).

    :param values: a value per episode for each metric, NaN where undefined
    """
    return {name: _metric(name, per_episode[~np.isnan(per_episode)]) for name, per_episode in values.items()}


def _metric(name: str, defined: NDArray[np.float64]) -> Metric:
    if len(defined) == 0:
        return Metric(None, None, None, 0)
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
    worst = float(defined.min()) if name in MINIMA else None
    return Metric(float(defined.mean()), float(low), float(high), len(defined), worst)


def score(means: dict[str, float]) -> float:
    """One number to choose the best of several policies by; lower is better.

    ``tracking_error + 2 neighbor_violation_rate + 4 obstacle_violation_rate + 0.2 (1 - connectivity)``: a neighbor too
    close in 1 % of the vehicle-steps weighs as much as 2 cm of tracking error. Undefined metrics count as kept.
    """
    kept = {"neighbor_violation_rate": 0.0, "obstacle_violation_rate": 0.0, "connectivity": 1.0}
    kept.update({name: value for name, value in means.items() if name in kept and np.isfinite(value)})
    return float(
        means["tracking_error"]
        + 2 * kept["neighbor_violation_rate"]
        + 4 * kept["obstacle_violation_rate"]
        + 0.2 * (1 - kept["connectivity"])
    )
