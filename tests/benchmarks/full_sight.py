"""How closely a flock could track if one saw everything: ``python tests/benchmarks/full_sight.py`` (extras fast, orca).

Those who fly the paper's tasks, and among obstacles that cross the flock:

- `orca` sees what our policies see;
- `foresight`, a teacher, plans the next twenty steps of all vehicles at once, as unicycles;
- `shared` is foresight by twice the rounds of descent, with closer packs, that gives no link up which is shorter than 1 m;
- `all` is the same that also knows of obstacles which no vehicle detects;
- `crossing` is the teacher of `configs/crossing_5v2o.yaml`, with the distances that practice asks for, among such obstacles.

There both teachers fly again, `disturbed`: by actions with errors as large as their pupils' are, that last as theirs do.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.config.training import TrainingConfig
from sb3_flock.controllers import MPC, Orca
from sb3_flock.controllers.base import Controller
from sb3_flock.controllers.mpc import MPCConfig
from sb3_flock.evaluation.rollout import rollout_batch
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.sim import Scenario, Sensing, World, episode_rng

CROSSING = Scenario(n_vehicles=5, n_obstacles=2, obstacle_motion="crossing")
SEED = 1
COLUMNS = ("tracking_error", "neighbor_violation_rate", "obstacle_violation_rate", "connectivity", "mean_separation")

SHARED = MPCConfig(separation=1.03, slack=6.0, rounds=400)
ALL = SHARED.replace(sight=1e6)


class Disturbed(MPC):
    """Whose controls err by 0.3 of their bounds (standard deviation), 0.8 of it from one step to the next."""

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Episodes begin without an error."""
        self._rng, self._errors = np.random.default_rng(0), np.zeros((*self.world.headings.shape, 2))

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.float64]:
        """What foresight would do, with the errors."""
        self._errors = 0.8 * self._errors + 0.6 * self._rng.normal(size=self._errors.shape)
        low, high = self.world.action_low, self.world.action_high
        return np.clip(super().act(sensing, scenario) + 0.3 * self._errors * high, low, high)


def print_flight(name: str, scenario: Scenario, pilot: Callable[[World], Controller], episodes: int) -> None:
    """Fly and print a line of metrics."""
    results = rollout_batch(pilot, scenario, [episode_rng(SEED, episode) for episode in range(episodes)])
    print(name, *(f"{np.nanmean(results[column]):.4f}" for column in COLUMNS), sep="; ", flush=True)


def crossing_teacher() -> MPCConfig:
    """What the teacher of ``configs/crossing_5v2o.yaml`` keeps, in separations of the task."""
    config = load_config(TrainingConfig, Path(__file__).parents[2] / "configs" / "crossing_5v2o.yaml")
    task, (flown,), gains = config.scenario, config.training_scenarios(), config.train_env.mpc
    return gains.replace(
        separation=gains.separation * flown.neighbor_separation / task.neighbor_separation,
        clearance=gains.clearance * flown.obstacle_separation / task.obstacle_separation,
    )


def main(episodes: int = 100) -> None:
    """Print a line a flight."""
    print("flight", *COLUMNS, sep="; ")
    tasks = {f"({n}, {m})": Scenario(n_vehicles=n, n_obstacles=m) for n, m in ((3, 1), (5, 1), (5, 2))}
    for task, scenario in {**tasks, "crossing": CROSSING}.items():
        print_flight(f"{task}, orca", scenario, lambda world: Orca(), episodes)
        print_flight(f"{task}, foresight", scenario, MPC, episodes)
        print_flight(f"{task}, shared", scenario, partial(MPC, gains=SHARED), episodes)
        print_flight(f"{task}, all", scenario, partial(MPC, gains=ALL), episodes)
    print_flight("crossing, crossing", CROSSING, partial(MPC, gains=crossing_teacher()), episodes)
    print_flight("crossing, foresight, disturbed", CROSSING, Disturbed, episodes)
    print_flight("crossing, crossing, disturbed", CROSSING, partial(Disturbed, gains=crossing_teacher()), episodes)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
