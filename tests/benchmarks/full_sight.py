"""How closely a flock could track if one saw everything: ``python tests/benchmarks/full_sight.py`` (extras fast, orca).

Four who fly the paper's tasks, and among obstacles that cross the flock:

- `orca` sees what our policies see;
- `foresight`, a teacher, plans the next twenty steps of all vehicles at once, as unicycles;
- `shared` is foresight by twice the rounds of descent, with closer packs, that gives no link up which is shorter than 1 m;
- `all` is the same that also knows of obstacles which no vehicle detects.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial

import numpy as np

from sb3_flock.evaluation.controllers import Foresight, Orca
from sb3_flock.evaluation.controllers.foresight import ForesightGains
from sb3_flock.evaluation.episodes import Controller, fly_together
from sb3_flock.sim import Scenario, World, episode_rng

CROSSING = Scenario(n_vehicles=5, n_obstacles=2, obstacle_motion="crossing")
SEED = 1
COLUMNS = ("tracking_error", "neighbor_violation_rate", "obstacle_violation_rate", "connectivity", "mean_separation")

SHARED = ForesightGains(separation=1.03, slack=6.0, rounds=400)
ALL = SHARED.replace(sight=1e6)


def print_flight(name: str, scenario: Scenario, pilot: Callable[[World], Controller], episodes: int) -> None:
    """Fly and print a line of metrics."""
    results = fly_together(pilot, scenario, [episode_rng(SEED, episode) for episode in range(episodes)])
    print(name, *(f"{np.nanmean(results[column]):.4f}" for column in COLUMNS), sep="; ", flush=True)


def main(episodes: int = 100) -> None:
    """Print a line a flight."""
    print("flight", *COLUMNS, sep="; ")
    tasks = {f"({n}, {m})": Scenario(n_vehicles=n, n_obstacles=m) for n, m in ((3, 1), (5, 1), (5, 2))}
    for task, scenario in {**tasks, "crossing": CROSSING}.items():
        print_flight(f"{task}, orca", scenario, lambda world: Orca(), episodes)
        print_flight(f"{task}, foresight", scenario, Foresight, episodes)
        print_flight(f"{task}, shared", scenario, partial(Foresight, gains=SHARED), episodes)
        print_flight(f"{task}, all", scenario, partial(Foresight, gains=ALL), episodes)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
