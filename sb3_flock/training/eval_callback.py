"""The callback that evaluates the policy during a training and keeps the best model."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure

from sb3_flock.controllers.policy import PolicyController
from sb3_flock.evaluation.metrics import score
from sb3_flock.evaluation.report import short_summary
from sb3_flock.evaluation.rollout import rollout
from sb3_flock.serialization.save import atomic_write
from sb3_flock.sim import Scenario
from sb3_flock.viz.figures import TrajectoryRecorder, plot_trajectories

SELECTION_SEED = 1_000_000
"""Seed of the episodes on which the best model is chosen; no result is reported on them."""


class FlockEvalCallback(BaseCallback):
    """Evaluates the policy on the same episodes every so many transitions, logs ``eval/``, and keeps the best model.

    SB3's ``EvalCallback`` needs a vector env and steps it in Python; this one simulates all episodes at once.

    :param scenario: the task to evaluate on
    :param eval_freq: transitions between evaluations; 0 for none
    :param n_eval_episodes: episodes of an evaluation
    :param folder: where ``evaluations.npz`` is written; ``None`` for nowhere
    :param save_best: called with the model and ``folder / "best_model.zip"`` at a new lowest score; the default is SB3's save
    :param report: called with one line about each evaluation
    """

    def __init__(
        self,
        scenario: Scenario,
        eval_freq: int,
        n_eval_episodes: int = 100,
        folder: str | Path | None = None,
        save_best: Callable[[BaseAlgorithm, Path], Any] = lambda model, path: model.save(path),
        report: Callable[[str], None] = lambda line: None,
    ) -> None:
        super().__init__()
        self.scenario, self.eval_freq, self.n_eval_episodes = scenario, eval_freq, n_eval_episodes
        self.folder, self.save_best, self.report = None if folder is None else Path(folder), save_best, report
        self.best_score = np.inf
        self._last = 0
        self._history: dict[str, list[Any]] = {"timesteps": [], "seconds": [], "results": [], "ep_lengths": []}
        self._started = 0.0

    def _on_step(self) -> bool:
        return True

    def state_dict(self) -> dict[str, Any]:
        """The evaluations so far."""
        seconds = time.monotonic() - self._started
        return {"best_score": self.best_score, "last": self._last, "history": self._history, "seconds": seconds}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore :meth:`state_dict`."""
        self.best_score, self._last, self._history = state["best_score"], state["last"], dict(state["history"])
        self._started = time.monotonic() - state["seconds"]

    def _on_training_start(self) -> None:
        self._started = time.monotonic()

    def _on_rollout_end(self) -> None:
        if self.eval_freq and self.num_timesteps // self.eval_freq > self._last // self.eval_freq:
            self._evaluate()

    def _on_training_end(self) -> None:
        if self.eval_freq and self._last < self.num_timesteps:
            self._evaluate()

    def _evaluate(self) -> None:
        recorder = TrajectoryRecorder(self.scenario)
        values = rollout(PolicyController(self.model), self.scenario, self.n_eval_episodes, SELECTION_SEED, watch=recorder)
        means = {name: float(np.nanmean(value)) if not np.isnan(value).all() else np.nan for name, value in values.items()}
        current = score(means)
        for name, mean in {**means, "score": current}.items():
            self.logger.record(f"eval/{name}", mean)
            missing = [np.nan] * len(self._history["timesteps"])  # of a metric that came after the run began
            self._history.setdefault(name, missing).append(mean)
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self._log_trajectory(recorder)
        self._last = self.num_timesteps
        self._history["timesteps"].append(self.num_timesteps)
        self._history["seconds"].append(time.monotonic() - self._started)
        self._history["results"].append(values["return"])
        self._history["ep_lengths"].append([self.scenario.max_cycles] * self.n_eval_episodes)
        is_best = current < self.best_score
        self.best_score = min(self.best_score, current)
        if self.folder is not None:
            history: dict[str, Any] = {name: np.asarray(rows) for name, rows in self._history.items()}
            with atomic_write(self.folder / "evaluations.npz") as temporary, open(temporary, "wb") as file:
                np.savez(file, **history)
            if is_best:
                self.save_best(self.model, self.folder / "best_model.zip")
        self.logger.dump(self.num_timesteps)
        best = " (best)" if is_best else ""
        self.report(f"evaluation at {self.num_timesteps}: {short_summary(means)}, score {current:.3f}{best}")

    def _log_trajectory(self, recorder: TrajectoryRecorder) -> None:
        """The paths of the first of these episodes, as a figure for TensorBoard where matplotlib is installed."""
        if importlib.util.find_spec("matplotlib") is not None:
            figure = Figure(plot_trajectories(recorder.trajectory()), close=False)
            self.logger.record("eval/trajectory", figure, exclude=("stdout", "log", "json", "csv"))
