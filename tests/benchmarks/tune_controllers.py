"""Search the gains of a baseline controller on the episodes by which trainings choose their best model.

The search evaluates random draws on (3, 1) and (5, 2), and prints every draw with a lower sum of scores than all before::

    python tests/benchmarks/tune_controllers.py orca --draws 200
"""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import numpy as np

from sb3_flock import Scenario
from sb3_flock.controllers.olfati_saber import OlfatiGains, OlfatiSaber
from sb3_flock.controllers.orca import Orca, OrcaGains
from sb3_flock.evaluation.metrics import score
from sb3_flock.evaluation.rollout import rollout
from sb3_flock.training.eval_callback import SELECTION_SEED

RANGES: dict[str, tuple[Any, Any, dict[str, tuple[float, float]]]] = {
    "orca": (
        Orca,
        OrcaGains,
        {"time_horizon": (0.2, 10.0), "margin": (0.001, 0.03), "approach": (0.2, 10.0)},
    ),
    "olfati-saber": (
        OlfatiSaber,
        OlfatiGains,
        {
            "spacing": (0.1, 0.15),
            "obstacle_distance": (0.18, 0.25),
            "alpha": (0.1, 100.0),
            "alpha_damping": (0.1, 10.0),
            "beta": (1.0, 1000.0),
            "beta_damping": (0.1, 10.0),
            "gamma": (0.3, 100.0),
            "gamma_damping": (0.1, 10.0),
        },
    ),
}
SCENARIOS = (Scenario(n_vehicles=3, n_obstacles=1), Scenario(n_vehicles=5, n_obstacles=2))


def evaluate(controller: Any, episodes: int) -> tuple[float, list[dict[str, float]]]:
    """The sum of the scores, and the mean metrics of each scenario."""
    means = []
    for scenario in SCENARIOS:
        values = rollout(controller, scenario, episodes, SELECTION_SEED)
        means.append({name: float(np.nanmean(value)) for name, value in values.items() if not np.isnan(value).all()})
    return sum(map(score, means)), means


def main() -> None:
    """Search with the options of the command line."""
    parser = argparse.ArgumentParser(description="Search the gains of a baseline controller.")
    parser.add_argument("controller", choices=RANGES)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    controller, gains_class, ranges = RANGES[args.controller]
    rng = np.random.default_rng(args.seed)
    best, best_gains = np.inf, gains_class()
    for draw in range(args.draws):
        gains = gains_class()
        if draw > args.draws // 2:  # half of the draws anywhere, half near the best
            near = {name: getattr(best_gains, name) * np.exp(rng.normal(0, 0.15)) for name in ranges}
            gains = gains_class(**{name: float(np.clip(near[name], *bounds)) for name, bounds in ranges.items()})
        elif draw:
            gains = gains_class(**{name: float(np.exp(rng.uniform(*np.log(bounds)))) for name, bounds in ranges.items()})
        total, means = evaluate(controller(gains), args.episodes)
        if total < best:
            best, best_gains = total, gains
            columns = ("tracking_error", "neighbor_violation_rate", "obstacle_violation_rate", "connectivity")
            shown = "; ".join(" ".join(f"{row[name]:.4f}" for name in columns) for row in means)
            print(f"draw {draw}: {total:.4f} ({shown}) {dataclasses.asdict(gains)}", flush=True)


if __name__ == "__main__":
    main()
