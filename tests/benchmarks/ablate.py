r"""Does one parameter matter? Trains with each of its values and several seeds and prints a table of means and spreads.

    python tests/benchmarks/ablate.py reward.lambda_ 0 0.3 0.5 0.7 1 \
        --set n_vehicles=5 --set n_obstacles=2 --set total_timesteps=60000

Each training has a process and one torch thread. Its last policy (not the best one of its evaluations, which would choose by
luck) flies 1000 episodes that nothing was chosen by.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import tempfile
from concurrent.futures import ProcessPoolExecutor

METRICS = (
    "tracking_error",
    "mean_separation",
    "neighbor_violation_rate",
    "obstacle_violation_rate",
    "connectivity",
    "success_rate",
)


def train_once(key: str, value: str, seed: int, changes: list[str]) -> dict[str, float]:
    """One training; ``changes`` of the config as on the command line."""
    from rich.console import Console

    from sb3_flock import TrainingConfig, evaluate, train
    from sb3_flock.rl.config_io import load_config, parse_overrides

    with tempfile.TemporaryDirectory() as folder:
        settings = parse_overrides([*changes, f"{key}={value}"])
        overrides = {**settings, "seed": seed, "output_dir": folder, "eval_freq": 0, "save_freq": 0, "torch_threads": 1}
        config = load_config(TrainingConfig, overrides=overrides)
        model = train(config, Console(quiet=True)).model
    metrics = evaluate(model, config.scenario, 1000, seed=0)
    return {name: float(metrics[name].mean or 0.0) for name in METRICS}


def main() -> None:
    """Train as the command line says."""
    import numpy as np

    parser = argparse.ArgumentParser(description="Train with several values of one parameter.")
    parser.add_argument("key")
    parser.add_argument("values", nargs="+")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=2, help="trainings at once")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    args = parser.parse_args()

    with ProcessPoolExecutor(args.jobs, multiprocessing.get_context("spawn")) as pool:
        runs = {
            (value, seed): pool.submit(train_once, args.key, value, seed, args.set)
            for seed, value in itertools.product(args.seeds, args.values)
        }
        results = {run: future.result() for run, future in runs.items()}
    print("| " + " | ".join((args.key, *METRICS)) + " |")
    print("|---" * (len(METRICS) + 1) + "|")
    for value in args.values:
        rows = {name: np.array([results[value, seed][name] for seed in args.seeds]) for name in METRICS}
        cells = [f"{values.mean():.4f} ± {values.std(ddof=1):.4f}" for values in rows.values()]
        print("| " + " | ".join((value, *cells)) + " |")
    print(json.dumps([{"value": value, "seed": seed, **metrics} for (value, seed), metrics in results.items()]))


if __name__ == "__main__":
    main()
