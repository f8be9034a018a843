"""Choosing the best model of a training: the same episodes every so often, a score, a zip."""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Figure

from sb3_flock.evaluation.episodes import PolicyController, fly
from sb3_flock.evaluation.figures import record, trajectories
from sb3_flock.evaluation.metrics import score
from sb3_flock.rl.config import TrainingConfig
from sb3_flock.rl.progress import FlockProgress
from sb3_flock.rl.saving import save_model, write_whole

SELECTION_SEED = 1_000_000
"""Seed of the episodes on which the best model is chosen; no result is reported on them."""


class Evaluation(BaseCallback):
    """Flies the same episodes every ``eval_freq`` transitions, logs ``eval/``, keeps the best model by its score."""

    def __init__(self, config: TrainingConfig, folder: Path, progress: FlockProgress) -> None:
        super().__init__()
        self.config, self.folder, self.progress = config, folder, progress
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
        """Go on from :meth:`state_dict`."""
        self.best_score, self._last, self._history = state["best_score"], state["last"], dict(state["history"])
        self._started = time.monotonic() - state["seconds"]

    def _on_training_start(self) -> None:
        self._started = time.monotonic()

    def _on_rollout_end(self) -> None:
        freq = self.config.eval_freq
        if freq and self.num_timesteps // freq > self._last // freq:
            self._evaluate()

    def _on_training_end(self) -> None:
        if self.config.eval_freq and self._last < self.num_timesteps:
            self._evaluate()

    def _evaluate(self) -> None:
        config = self.config
        values = fly(PolicyController(self.model), config.scenario, config.eval_episodes, SELECTION_SEED)
        means = {name: float(np.nanmean(value)) if not np.isnan(value).all() else np.nan for name, value in values.items()}
        current = score(means)
        for name, mean in {**means, "score": current}.items():
            self.logger.record(f"eval/{name}", mean)
            self._history.setdefault(name, []).append(mean)
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self._show_flight()
        self._last = self.num_timesteps
        self._history["timesteps"].append(self.num_timesteps)
        self._history["seconds"].append(time.monotonic() - self._started)
        self._history["results"].append(values["return"])
        self._history["ep_lengths"].append([config.scenario.max_cycles] * config.eval_episodes)
        history: dict[str, Any] = {name: np.asarray(rows) for name, rows in self._history.items()}
        with write_whole(self.folder / "evaluations.npz") as aside, open(aside, "wb") as file:
            np.savez(file, **history)
        is_best = current < self.best_score
        if is_best:
            self.best_score = current
            save_model(self.model, self.folder / "best_model.zip", config, optimizers=False)
        self.logger.dump(self.num_timesteps)
        self.progress.report_evaluation(
            f"evaluation at {self.num_timesteps}: tracking {means['tracking_error']:.3f} m, "
            f"too close {100 * means['neighbor_violation_rate']:.2f} %, "
            f"obstacle {100 * means['obstacle_violation_rate']:.2f} %, connected {100 * means['connectivity']:.1f} %, "
            f"score {current:.3f}{' (best)' if is_best else ''}"
        )

    def _show_flight(self) -> None:
        """The paths of the first of these episodes, as a picture for TensorBoard where matplotlib is installed."""
        if importlib.util.find_spec("matplotlib") is not None:
            flight = record(PolicyController(self.model), self.config.scenario, SELECTION_SEED)
            picture = Figure(trajectories(flight), close=False)
            self.logger.record("eval/flight", picture, exclude=("stdout", "log", "json", "csv"))
