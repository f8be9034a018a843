"""Minutes until a training meets the paper's Table II: ``python tests/benchmarks/time_to_paper.py``.

Trains (3, 1) and (5, 2) with the default config, or with the settings of an expert (``--expert mpc``), one torch thread each. A
training stops as soon as its policy meets every column of Table II on the episodes of an evaluation and on 1000 further ones.
The time starts with the process and includes imports, compilation and evaluations. The final test is on the 1000 episodes of
the result tables, which no choice depends on. Prints a JSON object for each training, and the median of each task.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

START = time.monotonic()
CONFIRMATION_SEED = 2_000_000


def holds(means: dict[str, float], paper: dict[str, float]) -> bool:
    """Whether every column is at least as good: the minima not smaller, everything else not larger."""
    return all(means[name] >= bound if name.startswith("min_") else means[name] <= bound for name, bound in paper.items())


def train_until_it_holds(
    n_vehicles: int, n_obstacles: int, seed: int, expert: str | None, changes: list[str]
) -> dict[str, object]:
    """One training in this process.

    :param expert: as for `sb3-flock train`
    :param changes: ``key=value`` overrides of the config
    """
    import numpy as np
    from rich.console import Console
    from stable_baselines3.common.callbacks import BaseCallback

    from sb3_flock import TrainingConfig, evaluate, load_policy, train
    from sb3_flock.config.presets import EXPERT_PRESETS
    from sb3_flock.evaluation.report import PAPER
    from sb3_flock.serialization.yaml_io import load_config, parse_overrides

    paper = PAPER[n_vehicles, n_obstacles]["Table II"]

    class Stop(BaseCallback):
        """Ends the training when the last evaluation and 1000 further episodes meet Table II."""

        at: float | None = None
        seen = 0

        def _on_step(self) -> bool:
            written = list(Path(folder).glob("*/evaluations.npz"))
            if not written or written[0].stat().st_mtime_ns == self.seen:
                return True
            self.seen = written[0].stat().st_mtime_ns
            history = np.load(written[0])
            if holds({name: history[name][-1] for name in paper}, paper):
                metrics = evaluate(self.model, config.scenario, 1000, CONFIRMATION_SEED)
                if holds({name: metrics[name].mean for name in paper}, paper):
                    self.at = time.monotonic() - START
            return self.at is None

    with tempfile.TemporaryDirectory() as folder:
        overrides: dict[str, object] = {
            "n_vehicles": n_vehicles,
            "n_obstacles": n_obstacles,
            "seed": seed,
            "output_dir": folder,
        }
        if expert is not None:
            overrides["train_env.expert"] = expert
        overrides.update(parse_overrides(changes))
        config = load_config(TrainingConfig, overrides=overrides, defaults=EXPERT_PRESETS.get(expert or ""))
        stop = Stop()
        result = train(config, Console(quiet=True), callbacks=[stop])
        policy = result.model if stop.at is not None else load_policy(result.best_model)
        metrics = evaluate(policy, config.scenario, 1000, seed=0)
    means = {name: metrics[name].mean for name in paper}
    return {
        "n_vehicles": n_vehicles, "n_obstacles": n_obstacles, "seed": seed, "minutes": stop.at and stop.at / 60,
        "timesteps": result.model.num_timesteps, "test": means, "test_holds": holds(means, paper),
    }  # fmt: skip


def main() -> None:
    """Run every training in a process of its own, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--expert", help="as for `sb3-flock train`")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as for `sb3-flock train`")
    parser.add_argument("--one", type=int, nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(train_until_it_holds(*options.one, options.expert, options.set)))
        return
    rows = []
    for setup in ((3, 1), (5, 2)):
        for seed in options.seeds:
            changes = [f"--set={change}" for change in options.set]
            changes += [f"--expert={options.expert}"] if options.expert else []
            words = [sys.executable, __file__, *changes, "--one", *map(str, (*setup, seed))]
            with tempfile.TemporaryDirectory() as cache:  # every process compiles the kernels itself
                environment = {**os.environ, "NUMBA_CACHE_DIR": cache, "OMP_NUM_THREADS": "1"}
                done = subprocess.run(words, check=True, stdout=subprocess.PIPE, env=environment)
            rows.append(json.loads(done.stdout))
            print(json.dumps(rows[-1]), flush=True)
        minutes = [row["minutes"] or float("inf") for row in rows if (row["n_vehicles"], row["n_obstacles"]) == setup]
        print(f"{setup}: median {statistics.median(minutes):.1f} minutes of {len(minutes)} seeds", flush=True)


if __name__ == "__main__":
    main()
