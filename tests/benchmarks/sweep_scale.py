"""The cost of a sweep beside its trainings: ``python tests/benchmarks/sweep_scale.py``.

The first measurement is the same four trainings with one worker and with two, each a Ray cluster of that many cores on this
machine: the wall time, the seconds in trials, and the rest for each trial (start of the process, imports). The second is many
trials that only report, which measures the driver alone. The third, with ``--run``, is a copy of a whole run folder into the
sweep's folder. Prints one line for each measurement.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

TRAINING = {
    "total_timesteps": 10_000, "eval_freq": 0, "save_freq": 5_000, "keep_checkpoints": 1, "n_test_episodes": 1,
}  # fmt: skip


def timed_sweep(workers: int, trials: int, folder: Path) -> tuple[float, list[dict[str, str]]]:
    """Wall seconds of a sweep by the command line, on a cluster of ``workers`` cores, and its results."""
    from ray.cluster_utils import Cluster

    file, out = folder / "sweep.yaml", folder / f"out{workers}"
    file.write_text(f"base: {TRAINING}\ngrid: {{seed: {list(range(trials))}}}\n")
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": workers, "include_dashboard": False})
    try:
        words = [
            sys.executable,
            "-m",
            "sb3_flock.cli",
            "sweep",
            str(file),
            "--output",
            str(out),
            "--address",
            cluster.address,
        ]
        started = time.monotonic()
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        seconds = time.monotonic() - started
    finally:
        cluster.shutdown()
    with open(out / "results.csv", newline="") as file_:
        return seconds, list(csv.DictReader(file_))


def report_only(point: dict[str, Any]) -> None:
    """A trial without work."""
    from ray import tune

    tune.report({"status": "done", "score": 0.0})


def driver_alone(trials: int, folder: Path) -> float:
    """Seconds of the driver for each trial, with two workers that stay from trial to trial."""
    os.environ.update(TUNE_DISABLE_AUTO_CALLBACK_LOGGERS="1", RAY_AIR_NEW_OUTPUT="0")
    import ray
    from ray import tune

    from sb3_flock.sweep.run import trial_name
    from sb3_flock.sweep.table import TrialsTable

    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR")
    started = time.monotonic()
    tune.Tuner(
        report_only,
        param_space={"seed": tune.grid_search(list(range(trials)))},
        tune_config=tune.TuneConfig(trial_name_creator=trial_name, trial_dirname_creator=trial_name, reuse_actors=True),
        run_config=tune.RunConfig(name="empty", storage_path=str(folder), callbacks=[TrialsTable()], verbose=0),
    ).fit()
    ray.shutdown()
    return (time.monotonic() - started) / trials


def checkpoint_cost(run: Path, folder: Path) -> tuple[float, float]:
    """Megabytes of a whole run folder, and the seconds of Ray's copy."""
    import pyarrow.fs

    (folder / "copy").mkdir()
    size = sum(path.stat().st_size for path in run.rglob("*")) / 1e6
    started = time.monotonic()
    pyarrow.fs.copy_files(str(run), str(folder / "copy"))
    return size, time.monotonic() - started


def main() -> None:
    """Measure everything."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=4, help="trainings of a sweep")
    parser.add_argument("--empty", type=int, default=300, help="trials that only report")
    parser.add_argument("--run", type=Path, help="a run folder, to measure the time of its copy")
    options = parser.parse_args()
    walls = {}
    for workers in (1, 2):
        with tempfile.TemporaryDirectory() as folder:
            walls[workers], rows = timed_sweep(workers, options.trials, Path(folder))
        inside = 60 * sum(float(row["minutes"]) for row in rows)
        left = (workers * walls[workers] - inside) / options.trials
        print(
            f"{workers} workers: {walls[workers]:.1f} s, {inside:.1f} s in trials, {left:.1f} s more for each trial",
            flush=True,
        )
    print(f"speed-up {walls[1] / walls[2]:.2f}", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        print(f"driver alone: {1000 * driver_alone(options.empty, Path(folder)):.0f} ms a trial", flush=True)
        if options.run is not None:
            size, seconds = checkpoint_cost(options.run, Path(folder))
            print(f"a run folder of {size:.0f} MB is copied in {seconds:.2f} s", flush=True)


if __name__ == "__main__":
    main()
