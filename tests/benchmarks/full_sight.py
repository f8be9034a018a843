"""How closely a flock could track if one saw everything: ``python tests/benchmarks/full_sight.py``.

First the paper's tasks: :class:`~sb3_flock.evaluation.controllers.Planner`, who gives each vehicle a place, beside ORCA, whose
vehicles see what ours see.

Then obstacles that cross the flock. A bound: at each settled moment by itself, five places of a hexagonal lattice, free of the
obstacles and connected, as near to the waypoint as possible. And flights of two planners that see what comes, too, and let
ORCA fly their goals:

- `aside` moves the goal of the whole flock out of the obstacles' way;
- `places` gives each vehicle its own place in such a pack, the one with the shortest ways.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.envs.demonstrations import Teacher
from sb3_flock.evaluation.controllers import TEACHERS, Orca
from sb3_flock.evaluation.controllers.motion import rotate
from sb3_flock.evaluation.controllers.orca import OrcaGains
from sb3_flock.evaluation.controllers.planner import Packs
from sb3_flock.evaluation.metrics import EpisodeMetrics
from sb3_flock.sim import Scenario, Sensing, World, episode_rng, own_reward, reward_terms

CROSSING = Scenario(n_vehicles=5, n_obstacles=2, obstacle_motion="crossing")
SEED = 1
COLUMNS = ("tracking_error", "neighbor_violation_rate", "obstacle_violation_rate", "connectivity", "mean_separation")

Array = NDArray[np.float64]


Goals = Callable[[World, Array, Array], Array]
"""From the world and the obstacles' positions and velocities ``(flocks, obstacles, 2)``, seen from the waypoint, to goals
``(flocks, vehicles, 2)``, seen from there, too."""


def aside(weight: float, ahead: float, keep: float = 0.25) -> Goals:
    """One goal for all, ``keep`` [m] away from where obstacles will be within ``ahead`` [s]: the nearest, and near the last."""
    axis = np.linspace(-0.35, 0.35, 29)
    goals = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    times = np.arange(0, ahead + 0.01, 0.25)
    last = np.zeros((1, 2))

    def plan(world: World, positions: Array, velocities: Array) -> Array:
        nonlocal last
        courses = positions[:, :, None] + velocities[:, :, None] * times[:, None]
        gaps = np.linalg.norm(goals[:, None, None] - courses[:, None], axis=-1)
        costs = np.linalg.norm(goals, axis=-1) + 6 * np.maximum(0, keep - gaps).max(-1).sum(-1)
        last = goals[np.argmin(costs + weight * np.linalg.norm(goals - last[:, None], axis=-1), axis=1)]
        return np.broadcast_to(last[:, None], world.positions.shape)

    return plan


def places(weight: float, ahead: tuple[float, ...]) -> Goals:
    """A place for each, in a pack free of the obstacles ``ahead`` [s]: near the waypoint, and with short ways."""
    packs = Packs(5, 0.112, lattices=40)

    def plan(world: World, positions: Array, velocities: Array) -> Array:
        goals = np.empty_like(world.positions)
        for flock, vehicles in enumerate(world.positions - world.waypoints[:, None]):
            courses = np.concatenate([positions[flock] + velocities[flock] * time for time in ahead])
            goals[flock] = packs.given(vehicles, courses, 0.165, weight, most=40)
        return goals

    return plan


class Guided:
    """ORCA towards a planner's goals; without one, towards the waypoint."""

    def __init__(self, world: World, planner: Goals | None, gains: OrcaGains | None = None) -> None:
        self.world, self.planner, self.orca = world, planner, Orca(gains)

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        self.orca.reset(rngs, scenario)

    def act(self, sensing: Sensing, scenario: Scenario) -> Array:
        world = self.world
        if self.planner is not None:
            wanted = self.planner(world, world.obstacle_positions - world.waypoints[:, None], _velocities(world))
            offsets = wanted + world.waypoints[:, None] - world.positions
            sensing = replace(sensing, waypoint_positions=rotate(offsets, -world.headings))
        return self.orca.act(sensing, scenario)


def print_flight(name: str, scenario: Scenario, pilot: Callable[[World], Guided | Teacher], episodes: int) -> None:
    """Fly and print a line of metrics."""
    world, metrics = World(scenario, episodes), EpisodeMetrics(scenario, episodes)
    rngs = [episode_rng(SEED, episode) for episode in range(episodes)]
    flies, sensing = pilot(world), world.reset(rngs)
    flies.reset(rngs, scenario)
    for _ in range(scenario.max_cycles):
        sensing, clipped = world.step(flies.act(sensing, scenario))
        metrics.update(world, sensing, own_reward(reward_terms(sensing, clipped, scenario)))
    results = metrics.result()
    print(name, *(f"{np.nanmean(results[column]):.4f}" for column in COLUMNS), sep="; ", flush=True)


def bound(episodes: int) -> float:
    """The least mean distance of connected packs 0.1 m apart, 0.15 m from obstacles, over the settled moments."""
    packs, world = Packs(5, CROSSING.neighbor_separation, lattices=200), World(CROSSING, episodes)
    world.reset([episode_rng(SEED, episode) for episode in range(episodes)])
    least = []
    for step in range(1, CROSSING.max_cycles + 1):
        world.step(np.zeros((episodes, 5, 2)))
        if 2 * step > CROSSING.max_cycles and step % 10 == 0:
            for obstacles in world.obstacle_positions - world.waypoints[:, None]:
                least.append(packs.free(obstacles, CROSSING.obstacle_separation, most=10_000)[1].min())
    return float(np.mean(least))


def _velocities(world: World) -> Array:
    headings = np.stack((np.cos(world.obstacle_headings), np.sin(world.obstacle_headings)), axis=-1)
    return world.obstacle_speeds[world.steps][..., None] * headings


def main(episodes: int = 100) -> None:
    """Print a line a planner."""
    print("flight", *COLUMNS, sep="; ")
    for vehicles, obstacles in ((3, 1), (5, 1), (5, 2)):
        task = Scenario(n_vehicles=vehicles, n_obstacles=obstacles)
        for name in ("orca", "planner"):
            print_flight(f"({vehicles}, {obstacles}), {name}", task, TEACHERS[name], episodes)
    print(f"crossing, bound on the tracking error: {bound(episodes):.3f} m")
    planners = {
        "orca by itself": (None, None),
        **{f"aside, {ahead} s ahead": (aside(0.3, ahead), None) for ahead in (1.5, 2.5, 3.5)},
        "aside, 2.5 s ahead, staying": (aside(1.0, 2.5), None),
        **{
            f"places, {ahead[-1]} s ahead": (places(weight, ahead), OrcaGains(approach=2.0))
            for weight, ahead in ((0.2, (0.5, 1.0, 1.5)), (1.0, (1.0, 2.0)))
        },
    }
    for name, (planner, gains) in planners.items():
        print_flight(f"crossing, {name}", CROSSING, lambda world: Guided(world, planner, gains), episodes)  # noqa: B023


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
