"""How closely a flock can track with full information: ``python tests/benchmarks/full_sight.py`` (extras fast, orca).

The controllers, on the paper's tasks and where obstacles cross the flock:

- `orca` senses what the policies sense;
- `mpc`, the expert, plans the next twenty steps of all vehicles at once, as unicycles;
- `shared` is the MPC with twice the iterations and smaller separations that gives up no link shorter than 1 m;
- `all` is `shared` with every obstacle known, also those that no vehicle detects;
- `crossing` has softer weights and shorter links, and the separations of a training env, among crossing obstacles.

Among crossing obstacles both experts drive once more, `disturbed`: their actions have errors of the size and the duration of
a student's errors.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from sb3_flock.controllers.base import Controller
from sb3_flock.controllers.mpc import MPC, MPCConfig
from sb3_flock.controllers.orca import Orca
from sb3_flock.evaluation.rollout import rollout_batch
from sb3_flock.sim import Scenario, Sensing, World, episode_rng

CROSSING = Scenario(n_vehicles=5, n_obstacles=2, obstacle_motion="crossing")
SEED = 1
COLUMNS = ("tracking_error", "neighbor_violation_rate", "obstacle_violation_rate", "connectivity", "mean_separation")

SHARED = MPCConfig(separation=1.03, link_cutoff=6.0, n_iterations=400)
ALL = SHARED.replace(obstacle_visibility=1e6)


class Disturbed(MPC):
    """The MPC with noise of 0.3 of the controls' bounds (standard deviation), correlated by 0.8 from step to step."""

    def reset(self, rngs: Sequence[Generator], scenario: Scenario) -> None:
        """Start without errors."""
        self._rng, self._errors = np.random.default_rng(0), np.zeros((*self.world.headings.shape, 2))

    def act(self, sensing: Sensing, scenario: Scenario) -> NDArray[np.float64]:
        """The controls of the MPC, with errors."""
        self._errors = 0.8 * self._errors + 0.6 * self._rng.normal(size=self._errors.shape)
        low, high = self.world.action_low, self.world.action_high
        return np.clip(super().act(sensing, scenario) + 0.3 * self._errors * high, low, high)


def print_row(name: str, scenario: Scenario, controller: Callable[[World], Controller], episodes: int) -> None:
    """Simulate the episodes and print a line of metrics."""
    results = rollout_batch(controller, scenario, [episode_rng(SEED, episode) for episode in range(episodes)])
    print(name, *(f"{np.nanmean(results[column]):.4f}" for column in COLUMNS), sep="; ", flush=True)


def crossing_expert() -> MPCConfig:
    """An expert for crossing obstacles, with separations 1.06 and 1.1 times the task's."""
    mpc = MPCConfig(max_link_length=0.85, link_cutoff=1.0, separation_weight=100, clearance_weight=200, link_weight=120)
    return mpc.replace(separation=1.06 * mpc.separation, clearance=1.1 * mpc.clearance)


def main(episodes: int = 100) -> None:
    """Print a line for each task and controller."""
    print("task, controller", *COLUMNS, sep="; ")
    tasks = {f"({n}, {m})": Scenario(n_vehicles=n, n_obstacles=m) for n, m in ((3, 1), (5, 1), (5, 2))}
    for task, scenario in {**tasks, "crossing": CROSSING}.items():
        print_row(f"{task}, orca", scenario, lambda world: Orca(), episodes)
        print_row(f"{task}, mpc", scenario, MPC, episodes)
        print_row(f"{task}, shared", scenario, partial(MPC, config=SHARED), episodes)
        print_row(f"{task}, all", scenario, partial(MPC, config=ALL), episodes)
    print_row("crossing, crossing", CROSSING, partial(MPC, config=crossing_expert()), episodes)
    print_row("crossing, mpc, disturbed", CROSSING, Disturbed, episodes)
    print_row("crossing, crossing, disturbed", CROSSING, partial(Disturbed, config=crossing_expert()), episodes)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
