"""One function that trains from one config and leaves a run folder."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_flock.envs.vec_env import make_vec_env
from sb3_flock.evaluation.episodes import PolicyController, fly
from sb3_flock.evaluation.metrics import score
from sb3_flock.rl.algorithms import build_model
from sb3_flock.rl.callbacks import FadingNoise, FlockMetrics, NeighborInclusiveReward
from sb3_flock.rl.config import TrainingConfig
from sb3_flock.rl.config_io import to_yaml
from sb3_flock.rl.progress import FlockProgress
from sb3_flock.rl.saving import PolicyError, check_device, load_policy, save_model, versions
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, World, episode_rng

SELECTION_SEED = 1_000_000
"""Seed of the episodes on which the best model is chosen; no result is reported on them."""


_WIDE_BATCH = 1024
"""Batch from which a second torch thread saves a fifth of an update's time or more; at 128 it saves nothing."""


@dataclass(frozen=True)
class TrainingResult:
    """What a training leaves."""

    folder: Path
    model: OffPolicyAlgorithm
    best_model: Path
    """The zip that scored best, or the final one if there was no evaluation."""


def train(
    config: TrainingConfig,
    console: Console | None = None,
    command: Sequence[str] | None = None,
    callbacks: Iterable[BaseCallback] = (),
) -> TrainingResult:
    """Train one policy and leave a run folder ``<output_dir>/<algo>_<n>v<m>o_<k>``.

    The folder holds ``config.yaml`` (fully resolved), ``command.txt``, ``versions.txt``, TensorBoard's events and
    ``progress.csv``, ``evaluations.npz``, ``rl_model_<steps>_steps.zip`` every ``save_freq`` transitions,
    ``best_model.zip`` (lowest :func:`~sb3_flock.evaluation.metrics.score` at an evaluation) and ``final_model.zip``. An
    interrupted training leaves its ``final_model.zip`` too.

    :param config: everything that decides the run
    :param console: where progress goes; the default prints to stderr
    :param command: the words of the command line, for ``command.txt``
    :param callbacks: further SB3 callbacks, called after ours
    :raises SettingsError: for a device or a folder that cannot be used
    :raises PolicyError: for a policy to start from that cannot be used
    :raises WorldError: if the arena is too crowded to start
    """
    console = console or Console(stderr=True)
    th.set_num_threads(config.torch_threads or (1 if config.learner.batch_size < _WIDE_BATCH else _cores()))
    check_device(config.device)
    flown = config.flown_scenario()
    for scenario in (config.scenario, flown):  # too crowded to start? Better told before the run folder is made
        World(scenario).reset([episode_rng(config.seed, 0)])
    env = VecMonitor(make_vec_env(flown, config.n_flocks, config.num_cpus, seed=config.seed))
    try:
        model = _build(config, env)
        folder = _new_run_folder(config)
        model.set_logger(configure(str(folder), ["tensorboard", "csv"]))
        _describe_run(folder, config, command)
        console.print(_summary(config, flown, model, folder), soft_wrap=True, highlight=False)
        progress = FlockProgress(console, config.total_timesteps)
        parts: list[BaseCallback] = [
            NeighborInclusiveReward(flown.reward.lambda_),
            FlockMetrics(),
            Evaluation(config, folder, progress),
            Checkpoints(config, folder),
            progress,
            *callbacks,
        ]
        if model.action_noise is not None:
            parts.append(FadingNoise(config.learner.noise, config.learner.final_noise))
        try:
            model.learn(config.total_timesteps, CallbackList(parts), log_interval=config.n_flocks * flown.n_vehicles)
        finally:
            progress.stop()
            model.logger.close()
            save_model(model, folder / "final_model.zip", config)
    finally:
        env.close()
    best = folder / "best_model.zip"
    return TrainingResult(folder, model, best if best.exists() else folder / "final_model.zip")


class Evaluation(BaseCallback):
    """Flies the same episodes every ``eval_freq`` transitions, logs ``eval/``, keeps the best model by its score."""

    def __init__(self, config: TrainingConfig, folder: Path, progress: FlockProgress) -> None:
        super().__init__()
        self.config, self.folder, self.progress = config, folder, progress
        self.best_score = np.inf
        self._due = _Due(config.eval_freq)
        self._history: dict[str, list[Any]] = {"timesteps": [], "seconds": [], "results": [], "ep_lengths": []}
        self._started = 0.0

    def _on_step(self) -> bool:
        return True

    def _on_training_start(self) -> None:
        self._started = time.monotonic()

    def _on_rollout_end(self) -> None:
        if self._due(self.num_timesteps):
            self._evaluate()

    def _on_training_end(self) -> None:
        if self.config.eval_freq and (self._history["timesteps"] or [0])[-1] < self.num_timesteps:
            self._evaluate()

    def _evaluate(self) -> None:
        config = self.config
        values = fly(PolicyController(self.model), config.scenario, config.eval_episodes, SELECTION_SEED)
        means = {name: float(np.nanmean(value)) if not np.isnan(value).all() else np.nan for name, value in values.items()}
        current = score(means)
        for name, mean in {**means, "score": current}.items():
            self.logger.record(f"eval/{name}", mean)
            self._history.setdefault(name, []).append(mean)
        self._history["timesteps"].append(self.num_timesteps)
        self._history["seconds"].append(time.monotonic() - self._started)
        self._history["results"].append(values["return"])
        self._history["ep_lengths"].append([config.scenario.max_cycles] * config.eval_episodes)
        history: dict[str, Any] = {name: np.asarray(rows) for name, rows in self._history.items()}
        np.savez(self.folder / "evaluations.npz", **history)
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


class Checkpoints(BaseCallback):
    """Saves ``rl_model_<steps>_steps.zip`` every ``save_freq`` transitions."""

    def __init__(self, config: TrainingConfig, folder: Path) -> None:
        super().__init__()
        self.config, self.folder = config, folder
        self._due = _Due(config.save_freq)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self._due(self.num_timesteps):
            save_model(self.model, self.folder / f"rl_model_{self.num_timesteps}_steps.zip", self.config)


class _Due:
    """Tells when another ``freq`` transitions have been flown; never if ``freq`` is 0."""

    def __init__(self, freq: int) -> None:
        self.freq = freq
        self._next = freq

    def __call__(self, num_timesteps: int) -> bool:
        if not self.freq or num_timesteps < self._next:
            return False
        self._next = num_timesteps - num_timesteps % self.freq + self.freq
        return True


def _build(config: TrainingConfig, env: VecEnv) -> OffPolicyAlgorithm:
    """The model, with the weights of ``init_from`` where there is one."""
    try:
        model = build_model(config, env)
    except MemoryError:
        raise SettingsError(f"buffer_size = {config.learner.buffer_size}: more than this machine's memory") from None
    if config.init_from is not None:
        initial = load_policy(config.init_from)
        initial.check(config.scenario)
        if (initial.config.network, initial.config.algo) != (config.network, config.algo):
            raise PolicyError(f"{initial.path}: its algorithm or networks are not those of this config (init_from)")
        model.policy.load_state_dict(initial.policy.state_dict())
    return model


def _summary(config: TrainingConfig, flown: Scenario, model: OffPolicyAlgorithm, folder: Path) -> str:
    """What is trained, on what, where: one line."""
    return (
        f"{config.algo} for {config.scenario.n_vehicles} vehicles, {config.scenario.n_obstacles} obstacles; practice in "
        f"{config.n_flocks} flocks of {flown.n_vehicles} among {flown.n_obstacles}; device {model.device}, "
        f"torch threads {th.get_num_threads()} on {_cores()} cores; {folder}"
    )


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _new_run_folder(config: TrainingConfig) -> Path:
    """Make the next free ``<algo>_<n>v<m>o_<k>``; two trainings at once never share one."""
    root = Path(config.output_dir)
    stem = f"{config.algo}_{config.scenario.n_vehicles}v{config.scenario.n_obstacles}o"
    try:
        root.mkdir(parents=True, exist_ok=True)
        taken = [int(path.name[len(stem) + 1 :]) for path in root.glob(f"{stem}_*") if path.name[len(stem) + 1 :].isdigit()]
        number = max(taken, default=0) + 1
        while True:
            folder = root / f"{stem}_{number}"
            try:
                folder.mkdir()
            except FileExistsError:
                number += 1
            else:
                return folder
    except OSError as error:
        raise SettingsError(f"output_dir = {config.output_dir}: {error.strerror or error}") from None


def _describe_run(folder: Path, config: TrainingConfig, command: Sequence[str] | None) -> None:
    (folder / "config.yaml").write_text(to_yaml(config), encoding="utf-8")
    (folder / "command.txt").write_text(shlex.join(command or sys.argv) + "\n", encoding="utf-8")
    (folder / "versions.txt").write_text("".join(f"{name}=={number}\n" for name, number in versions().items()))
