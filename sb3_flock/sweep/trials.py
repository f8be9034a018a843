"""One trial of a sweep, in a process of its own on any machine of the cluster."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from ray import tune
from stable_baselines3.common.callbacks import BaseCallback

from sb3_flock.config.training import TrainingConfig
from sb3_flock.console import PlainConsole
from sb3_flock.evaluation import evaluate
from sb3_flock.evaluation.metrics import Metric, columns, score
from sb3_flock.rl.callbacks import DivergedError
from sb3_flock.serialization.archive import read_curves
from sb3_flock.serialization.load import LoadedPolicy, checkpoint_paths, load_policy
from sb3_flock.settings import UserError
from sb3_flock.sweep.config import SweepConfig
from sb3_flock.training.train import resume, train

TEST_SEED = 0
"""Seed of the test episodes, those of the final table of a training; no policy is chosen by them."""

DONE, DIVERGED, REFUSED = "done", "diverged", "refused"


def train_trial(point: dict[str, Any], sweep: Mapping[str, Any]) -> None:
    """Train at one point of a sweep, or resume from its last checkpoint, then test the policy.

    An error that would repeat is reported as the trial's status. Any other error is raised, and Ray tries the trial again,
    there or on another machine.

    :param point: the trial's own fields of the training config
    :param sweep: the :class:`~sb3_flock.sweep.config.SweepConfig`, as a mapping
    """
    config = SweepConfig(**sweep).training(point)
    started = time.monotonic()
    reports = Reports(config.total_timesteps)
    try:
        folder = _train_or_resume(config, reports)
        reports.read(folder)
        th.set_num_threads(1)
        metrics = evaluate(load_policy(folder), config.scenario, config.n_test_episodes, TEST_SEED)
        minutes = reports.row.get("minutes", (time.monotonic() - started) / 60)
        ended = {"status": DONE, "timesteps": config.total_timesteps, "minutes": minutes}
        tune.report({**reports.row, **ended, **_tested(metrics)}, checkpoint=tune.Checkpoint.from_directory(folder))
    except DivergedError as error:
        tune.report({**reports.row, "status": DIVERGED, "why": str(error), "score": float("inf")})
    except UserError as error:
        tune.report({**reports.row, "status": REFUSED, "why": str(error), "score": float("inf")})
    finally:
        shutil.rmtree(config.output_dir, ignore_errors=True)  # Ray keeps a copy in the sweep's folder


def _train_or_resume(config: TrainingConfig, reports: Reports) -> Path:
    """Train to the end; returns the run folder, in the trial's own working directory."""
    console = PlainConsole(stderr=True, force_terminal=False, width=200)
    saved = tune.get_checkpoint()
    if saved is None:
        return train(config, console, ["sb3-flock", "sweep"], callbacks=[reports]).folder
    folder = Path(config.output_dir) / "resumed"
    saved.to_directory(folder)
    if not (folder / "final_model.zip").exists():
        resume(folder, console, command=["sb3-flock", "sweep", "--resume"], callbacks=[reports])
    return folder


class Reports(BaseCallback):
    """Reports every evaluation to Ray, with a copy of the run folder after every checkpoint."""

    def __init__(self, total_timesteps: int) -> None:
        super().__init__()
        self.row: dict[str, Any] = {"timesteps": 0, "total_timesteps": total_timesteps, "score": float("inf")}
        self._seen: tuple[Path | None, int] = (None, 0)

    def _on_training_start(self) -> None:
        self._seen = self.read(self._folder)
        self.row["timesteps"] = self.num_timesteps
        tune.report(dict(self.row))

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        """Report what was written during the last vector step."""
        before, self._seen = self._seen, self.read(self._folder, self._seen)
        if self._seen != before:
            self.row["timesteps"] = self.num_timesteps
            is_saved = self._seen[0] != before[0]
            tune.report(dict(self.row), checkpoint=tune.Checkpoint.from_directory(self._folder) if is_saved else None)

    @property
    def _folder(self) -> Path:
        return Path(self.logger.get_dir() or ".")

    def read(self, folder: Path, seen: tuple[Path | None, int] = (None, 0)) -> tuple[Path | None, int]:
        """The newest checkpoint and the time of the last evaluation; a new evaluation is copied into the row.

        :param seen: the previous result
        """
        saved, history = checkpoint_paths(folder)[-1:], folder / "evaluations.npz"
        evaluated = history.stat().st_mtime_ns if history.exists() else 0
        if evaluated != seen[1]:
            curves = read_curves(history)
            # A run that an earlier version began may lack a metric until its next evaluation.
            self.row.update({name: float(curves[name][-1]) for name in columns() if name in curves})
            self.row.update(score=float(curves["score"].min()), minutes=float(curves["seconds"][-1]) / 60)
        return saved[0] if saved else None, evaluated


def evaluate_trial(point: dict[str, Any], sweep: Mapping[str, Any], policy: bytes) -> None:
    """Evaluate a policy at one point of a sweep.

    :param policy: the policy's zip
    """
    th.set_num_threads(1)
    config = SweepConfig(**sweep)
    started = time.monotonic()
    loaded = _load_bytes(policy)
    scenario, seed = config.evaluation(point, loaded.scenario)
    try:
        metrics = evaluate(loaded, scenario, config.episodes, seed)
    except UserError as error:
        tune.report({"status": REFUSED, "why": str(error)})
        return
    tune.report({"status": DONE, "minutes": (time.monotonic() - started) / 60, **_tested(metrics)})


def _load_bytes(policy: bytes) -> LoadedPolicy:
    """A policy from the bytes of its zip."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy.zip"
        path.write_bytes(policy)
        return load_policy(path)


def _tested(metrics: Mapping[str, Metric]) -> dict[str, Any]:
    """The means of the test, as a report."""
    means = {name: np.nan if metric.mean is None else metric.mean for name, metric in metrics.items()}
    return {"test": {**means, "score": score(means)}}
