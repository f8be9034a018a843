"""How closely a flock could track if one saw everything: ``python tests/benchmarks/full_sight.py`` (needs numba).

Five on the paper's tasks, and among obstacles that cross the flock:

- `orca` sees what our policies see;
- `planner`, the teacher, gives each vehicle a place and lets ORCA fly there;
- `foresight`, the other teacher, plans the next two seconds of all vehicles at once, as unicycles, anew in every step;
- `central` goes on from its last plan, with nothing but the waypoint as everyone's goal; it knows all obstacles, `shared` only
  those that some vehicle detects.

And a bound for crossing obstacles: at each settled moment by itself, five places of a hexagonal lattice, free of the obstacles
and connected, as near to the waypoint as possible.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.evaluation.controllers import Foresight, Orca, Planner
from sb3_flock.evaluation.controllers.foresight import ForesightGains
from sb3_flock.evaluation.controllers.planner import Packs
from sb3_flock.evaluation.episodes import Controller, fly_together
from sb3_flock.sim import Scenario, Sensing, World, episode_rng

CROSSING = Scenario(n_vehicles=5, n_obstacles=2, obstacle_motion="crossing")
SEED = 1
COLUMNS = ("tracking_error", "neighbor_violation_rate", "obstacle_violation_rate", "connectivity", "mean_separation")

Array = NDArray[np.float64]


class Central(Foresight):
    """Flies by foresight as well as it can: step by step from its last plan on, with the waypoint as everyone's goal.

    :param sight: distance from a vehicle at which an obstacle is known of [m]
    """

    def __init__(self, world: World, sight: float = np.inf) -> None:
        super().__init__(world, ForesightGains(separation=1.03, rounds=100))
        self.sight = sight

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Begin with plans to stand still."""
        self.plans = np.zeros((len(rngs), scenario.n_vehicles, self.gains.steps, 2))

    def act(self, sensing: Sensing, scenario: Scenario) -> Array:
        """The first controls of the plans."""
        self.plans = np.concatenate((self.plans[:, :, 1:], self.plans[:, :, -1:] * [1.0, 0.0]), axis=2)
        goals = np.repeat(self.courses()[:, :, None], scenario.n_vehicles, axis=2)
        self.improve(self.plans, goals, self.known(self.sight))
        return self.plans[:, :, 0] * self.world.action_high


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
        print_flight(f"{task}, central", scenario, Central, episodes)
        print_flight(f"{task}, shared", scenario, partial(Central, sight=scenario.detection_range), episodes)
    print(f"crossing, bound on the tracking error: {bound(episodes):.3f} m")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
