"""How closely a flock could track if one saw everything: ``python tests/benchmarks/full_sight.py`` (needs numba).

Three controllers on the paper's tasks, and among obstacles that cross the flock:

- `orca` sees what our policies see;
- `planner`, the teacher, gives each vehicle a place and lets ORCA fly there;
- `foresight` plans the next two seconds of all vehicles at once, as unicycles, by descent on what is wanted; it knows how fast
  obstacles walk. `shared foresight` does not know of an obstacle that no vehicle detects.

And a bound for crossing obstacles: at each settled moment by itself, five places of a hexagonal lattice, free of the obstacles
and connected, as near to the waypoint as possible.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numba import njit
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.evaluation.controllers import Orca, Planner
from sb3_flock.evaluation.controllers.planner import Packs
from sb3_flock.evaluation.episodes import Controller, fly_together
from sb3_flock.sim import Scenario, Sensing, World, episode_rng
from sb3_flock.sim.sensing import nearest

CROSSING = Scenario(n_vehicles=5, n_obstacles=2, obstacle_motion="crossing")
SEED = 1
COLUMNS = ("tracking_error", "neighbor_violation_rate", "obstacle_violation_rate", "connectivity", "mean_separation")

Array = NDArray[np.float64]

LOOKS, ROUNDS, PACE = 20, 100, 0.03
"""Steps planned ahead, rounds of descent in each step, and how far a control moves in a round at most [its bound]."""
SEPARATION, CLEARANCE, REACH = 1.03, 1.033, 0.93
"""Distances that plans keep, relative to the minimum separations to neighbors and obstacles and to the link range."""


class Foresight:
    """Plans the controls of all vehicles together, step by step anew, from the last plan on, and flies the first ones.

    :param sight: distance from a vehicle at which an obstacle is known of [m]
    """

    def __init__(self, world: World, sight: float = np.inf) -> None:
        self.world, self.sight = world, sight

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Begin with a plan to stand still."""
        self.plans = np.zeros((len(rngs), scenario.n_vehicles, LOOKS, 2))  # in units of the bounds

    def act(self, sensing: Sensing, scenario: Scenario) -> Array:
        """The first controls of the plans."""
        world, steps = self.world, np.arange(1, LOOKS + 1)
        waypoints = world.waypoints_after(np.broadcast_to(steps, (world.n_flocks, LOOKS)))
        headings = np.stack((np.cos(world.obstacle_headings), np.sin(world.obstacle_headings)), axis=-1)
        strides = world.obstacle_speeds.mean(0)[..., None] * headings * scenario.time_step
        obstacles = world.obstacle_positions[:, None] + strides[:, None] * steps[:, None, None]
        gaps = nearest(world.obstacle_positions, world.positions)
        bounds = np.array([scenario.max_speed, scenario.max_turn_rate])
        ranges = (
            SEPARATION * scenario.neighbor_separation,
            CLEARANCE * scenario.obstacle_separation,
            REACH * scenario.link_range,
        )
        self.plans = np.concatenate((self.plans[:, :, 1:], self.plans[:, :, -1:] * [1.0, 0.0]), axis=2)
        for flock, plan in enumerate(self.plans):
            known = obstacles[flock][:, gaps[flock] < self.sight]
            start = world.positions[flock], world.headings[flock]
            descend(plan, *start, waypoints[flock], known, *(bounds * scenario.time_step), *ranges)
        return self.plans[:, :, 0] * bounds


@njit(error_model="numpy", cache=True)
def descend(
    plan: Array,
    positions: Array,
    headings: Array,
    waypoints: Array,
    obstacles: Array,
    stride: float,
    turn: float,
    separation: float,
    clearance: float,
    reach: float,
) -> None:
    """Improve a plan ``(vehicles, LOOKS, 2)`` in place by rounds of Adam on its cost.

    That is, summed over the steps ahead, the mean distance to the waypoint and the squares of what is missing: of distances to
    neighbors and obstacles, and of links in the shortest tree that joins the flock.
    """
    n, looks, _ = plan.shape
    cos, sin, x, y = np.empty((n, looks)), np.empty((n, looks)), np.empty((n, looks)), np.empty((n, looks))
    down = np.empty((n, looks, 2))
    mean, square = np.zeros((n, looks, 2)), np.zeros((n, looks, 2))
    for k in range(ROUNDS):
        for i in range(n):
            heading, x_now, y_now = headings[i], positions[i, 0], positions[i, 1]
            for t in range(looks):
                cos[i, t], sin[i, t] = math.cos(heading), math.sin(heading)
                x_now += plan[i, t, 0] * stride * cos[i, t]
                y_now += plan[i, t, 0] * stride * sin[i, t]
                heading += plan[i, t, 1] * turn
                x[i, t], y[i, t] = x_now, y_now
        for t in range(looks):
            _slope(down[:, t], x[:, t], y[:, t], waypoints[t], obstacles[t], separation, clearance, reach)
        pace = PACE * (1.0 - 0.7 * (k + 1) / ROUNDS)
        for i in range(n):
            slope_x = slope_y = slope_heading = 0.0  # of all that comes after a step
            for t in range(looks - 1, -1, -1):
                slope_x += down[i, t, 0]
                slope_y += down[i, t, 1]
                along = (slope_x * cos[i, t] + slope_y * sin[i, t]) * stride
                across = (slope_y * cos[i, t] - slope_x * sin[i, t]) * stride
                for control, slope in enumerate((along, slope_heading * turn)):
                    mean[i, t, control] = 0.8 * mean[i, t, control] + 0.2 * slope
                    square[i, t, control] = 0.95 * square[i, t, control] + 0.05 * slope * slope
                    size = math.sqrt(square[i, t, control] / (1.0 - 0.95 ** (k + 1))) + 0.02
                    moved = plan[i, t, control] - pace * mean[i, t, control] / (1.0 - 0.8 ** (k + 1)) / size
                    plan[i, t, control] = min(max(moved, -float(control)), 1.0)
                # Who stands does not move by turning; as if it crept: else one that looks away would never turn round.
                slope_heading += across * max(plan[i, t, 0], 0.5)


@njit(error_model="numpy", cache=True)
def _slope(
    down: Array, x: Array, y: Array, waypoint: Array, obstacles: Array, separation: float, clearance: float, reach: float
) -> None:
    """The slope of one step's cost ``(vehicles, 2)`` by the positions."""
    n = len(x)
    for i in range(n):
        to_x, to_y = x[i] - waypoint[0], y[i] - waypoint[1]
        distance = math.sqrt(to_x * to_x + to_y * to_y + 0.02**2)  # smooth where a vehicle is on it
        down[i, 0], down[i, 1] = to_x / distance / n, to_y / distance / n
        for obstacle in obstacles:
            to_x, to_y = x[i] - obstacle[0], y[i] - obstacle[1]
            distance = math.sqrt(to_x * to_x + to_y * to_y) + 1e-9
            push = 2000.0 * max(0.0, clearance - distance) / distance
            down[i, 0] -= push * to_x
            down[i, 1] -= push * to_y
        for j in range(i):
            to_x, to_y = x[i] - x[j], y[i] - y[j]
            distance = math.sqrt(to_x * to_x + to_y * to_y) + 1e-9
            _pull(down, i, j, to_x, to_y, -1000.0 * max(0.0, separation - distance) / distance)
    nearest, at, joined = np.full(n, np.inf), np.zeros(n, np.int64), np.zeros(n, np.bool_)
    last = 0
    for _ in range(n - 1):  # Prim's algorithm
        joined[last] = True
        best = -1
        for j in range(n):
            if not joined[j]:
                distance = math.hypot(x[j] - x[last], y[j] - y[last])
                if distance < nearest[j]:
                    nearest[j], at[j] = distance, last
                if best < 0 or nearest[j] < nearest[best]:
                    best = j
        last, other = best, at[best]
        pull = 120.0 * min(max(0.0, nearest[last] - reach), 0.1) / max(nearest[last], 1e-9)
        _pull(down, last, other, x[last] - x[other], y[last] - y[other], pull)


@njit(error_model="numpy", cache=True)
def _pull(down: Array, i: int, j: int, to_x: float, to_y: float, pull: float) -> None:
    down[i, 0] += pull * to_x
    down[i, 1] += pull * to_y
    down[j, 0] -= pull * to_x
    down[j, 1] -= pull * to_y


def print_flight(name: str, scenario: Scenario, pilot: Callable[[World], Controller], episodes: int) -> None:
    """Fly and print a line of metrics."""
    results = fly_together(pilot, scenario, [episode_rng(SEED, episode) for episode in range(episodes)])
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


def main(episodes: int = 100) -> None:
    """Print a line a flight."""
    print("flight", *COLUMNS, sep="; ")
    tasks = {f"({n}, {m})": Scenario(n_vehicles=n, n_obstacles=m) for n, m in ((3, 1), (5, 1), (5, 2))}
    for task, scenario in {**tasks, "crossing": CROSSING}.items():
        print_flight(f"{task}, orca", scenario, lambda world: Orca(), episodes)
        print_flight(f"{task}, planner", scenario, Planner, episodes)
        print_flight(f"{task}, foresight", scenario, Foresight, episodes)
        shared = partial(Foresight, sight=scenario.detection_range)
        print_flight(f"{task}, shared foresight", scenario, shared, episodes)
    print(f"crossing, bound on the tracking error: {bound(episodes):.3f} m")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
