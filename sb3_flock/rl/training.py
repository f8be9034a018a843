"""One function that trains from one config and leaves a run folder."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch as th
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_flock.envs.demonstrations import DemonstratedEnv
from sb3_flock.envs.flocking_v0 import parallel_env
from sb3_flock.envs.side_by_side import SideBySide
from sb3_flock.envs.vec_env import ParameterSharingVecEnv, flatten
from sb3_flock.evaluation.controllers import TEACHERS, Foresight
from sb3_flock.rl.algorithms import build_model
from sb3_flock.rl.callbacks import DemonstratedActions, FadingNoise, FlockMetrics, NeighborInclusiveReward
from sb3_flock.rl.checkpoints import LoadedCheckpoint, Stateful, inexactness, newest_checkpoint
from sb3_flock.rl.config import TrainingConfig
from sb3_flock.rl.config_io import load_config
from sb3_flock.rl.loading import PolicyError, check_device, checkpoint_paths, load_policy
from sb3_flock.rl.logs import make_logger, told_once
from sb3_flock.rl.progress import FlockProgress
from sb3_flock.rl.run_folder import describe_run, locked, new_run_folder
from sb3_flock.rl.safety import Checkpoints, FiniteLosses, Signals
from sb3_flock.rl.saving import save_model
from sb3_flock.rl.selection import Evaluation
from sb3_flock.settings import RunError, SettingsError
from sb3_flock.sim import Scenario, World, episode_rng

_WIDE_BATCH = 1024
"""Batch from which a second torch thread saves a fifth of an update's time or more; at 128 it saves nothing."""


@dataclass(frozen=True)
class TrainingResult:
    """What a training leaves."""

    folder: Path
    config: TrainingConfig
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
    ``progress.csv``, ``evaluations.npz``, the newest checkpoints ``rl_model_<steps>_steps.zip``, ``best_model.zip`` (lowest
    :func:`~sb3_flock.evaluation.metrics.score` at an evaluation) and, once it is complete, ``final_model.zip``. SIGINT and
    SIGTERM wait for a checkpoint; :func:`resume` goes on from one.

    :param config: everything that decides the run
    :param console: where progress goes; the default prints to stderr
    :param command: the words of the command line, for ``command.txt``
    :param callbacks: further SB3 callbacks, called after ours
    :raises SettingsError: for a device or a folder that cannot be used
    :raises PolicyError: for a policy to start from that cannot be used
    :raises WorldError: if the arena is too crowded to start
    :raises RunError: if the disk is full, a worker dies or a loss is not finite; what was saved stays
    """
    console = console or Console(stderr=True)
    with Signals().waiting() as signals:
        model, env = _prepare(config)
        try:
            folder = new_run_folder(config, command)
            with locked(folder), _faults_told(folder):
                return _run(config, folder, model, None, console, callbacks, signals)
        finally:
            env.close()


def resume(
    folder: str | Path,
    console: Console | None = None,
    changes: Mapping[str, Any] | None = None,
    command: Sequence[str] | None = None,
    callbacks: Iterable[BaseCallback] = (),
) -> TrainingResult:
    """Go on with a run from its newest whole checkpoint, or from its start if there is none.

    On the CPU, with one thread, in one process and with the same versions the result is the same to the last bit as that of a
    run never interrupted; otherwise a line says why it is not.

    :param folder: the run folder
    :param console: as in :func:`train`
    :param changes: fields of the config to change: those in :data:`RESUMABLE`
    :param command: the words of the command line, added to ``command.txt``
    :param callbacks: as in :func:`train`; what they hold is not in the checkpoint
    :raises SettingsError: for a folder that is not a run's or is in use, a field that cannot change, a run that is complete
    :raises RunError: as in :func:`train`
    """
    folder, console = Path(folder), console or Console(stderr=True)
    if not (folder / "config.yaml").is_file():
        raise SettingsError(f"resume {folder}: not a run folder (there is no config.yaml)")
    config = load_config(TrainingConfig, folder / "config.yaml")
    fixed = [name for name in changes or {} if name not in RESUMABLE]
    if fixed:
        raise SettingsError(f"{fixed[0]} cannot change in a resumed run, only {', '.join(RESUMABLE)}")
    config = load_config(TrainingConfig, overrides=changes, base=config)

    def tell(line: str) -> None:
        console.print(line, soft_wrap=True, highlight=False)

    with Signals().waiting() as signals, locked(folder), _faults_told(folder):
        for half_written in folder.glob(".*.tmp"):
            half_written.unlink()
        checkpoint = newest_checkpoint(folder, config, tell)
        done = checkpoint.num_timesteps if checkpoint else 0
        is_complete = done >= config.total_timesteps and (folder / "final_model.zip").exists()
        if is_complete or ("total_timesteps" in (changes or {}) and done >= config.total_timesteps):
            raise SettingsError(
                f"resume {folder}: {done} transitions are flown; a larger total_timesteps than {config.total_timesteps} is "
                "needed to go on"
            )
        model, env = _prepare(config)
        try:
            tell(f"resumes {folder} after {done} of {config.total_timesteps} transitions{inexactness(checkpoint, config)}")
            if checkpoint:
                checkpoint.restore_model(model)
            describe_run(folder, config, command)
            return _run(config, folder, model, checkpoint, console, callbacks, signals)
        finally:
            env.close()


RESUMABLE = (
    "total_timesteps",
    "device",
    "torch_threads",
    "num_cpus",
    "eval_freq",
    "eval_episodes",
    "test_episodes",
    "save_freq",
    "keep_checkpoints",
)
"""Fields that a resumed run may change: all but the first leave what is learned as it is, or nearly."""


def _prepare(config: TrainingConfig) -> tuple[OffPolicyAlgorithm, VecEnv]:
    """The model, untrained, and its flocks; whatever can be wrong with a config comes out here."""
    th.set_num_threads(config.torch_threads or (1 if config.learner.batch_size < _WIDE_BATCH else _cores()))
    check_device(config.device)
    for scenario in (config.scenario, *config.flown_scenarios()):  # too crowded? Better told before there is a run folder
        World(scenario).reset([episode_rng(config.seed, 0)])
    env = VecMonitor(_flocks(config))
    try:
        return _build(config, env), env
    except BaseException:
        env.close()
        raise


def _flocks(config: TrainingConfig) -> ParameterSharingVecEnv:
    """The flocks flown in training, with a teacher where ``practice`` names one."""
    flocks = [_flock(config, scenario) for scenario in config.flown_scenarios()]
    env = flocks[0] if len(flocks) == 1 else SideBySide(flocks)
    return flatten(env, config.n_flocks, config.num_cpus, config.seed)


def _flock(config: TrainingConfig, flown: Scenario) -> parallel_env:
    practice = config.practice
    if practice.teacher is None:
        return parallel_env(flown)
    teacher = TEACHERS[practice.teacher]
    if teacher is Foresight:
        teacher = partial(Foresight, gains=practice.foresight)
    return DemonstratedEnv(
        flown, teacher, practice.teacher_share, practice.teacher_noise, advises=config.learner.guidance > 0
    )


def _run(
    config: TrainingConfig,
    folder: Path,
    model: OffPolicyAlgorithm,
    checkpoint: LoadedCheckpoint | None,
    console: Console,
    callbacks: Iterable[BaseCallback],
    signals: Signals,
) -> TrainingResult:
    """Learn until the end or a signal."""
    console.print(_summary(config, model, folder), soft_wrap=True, highlight=False)
    progress = FlockProgress(console, config.total_timesteps)
    rewards, metrics = NeighborInclusiveReward(config.scenario.reward.lambda_), FlockMetrics()
    evaluation = Evaluation(config, folder, progress)
    stateful: dict[str, Stateful] = {"rewards": rewards, "metrics": metrics, "evaluation": evaluation}
    parts: list[BaseCallback] = [
        rewards,
        DemonstratedActions(),
        metrics,
        evaluation,
        FiniteLosses(),
        progress,
        *callbacks,
        Checkpoints(config, folder, stateful, checkpoint, signals),
    ]
    if model.action_noise is not None:
        parts.append(FadingNoise(config.learner.noise, config.learner.final_noise))
    try:
        model.set_logger(make_logger(folder, model.num_timesteps))
        with told_once():
            model.learn(
                config.total_timesteps - model.num_timesteps,
                CallbackList(parts),
                log_interval=model.n_envs,
                reset_num_timesteps=checkpoint is None,
            )
        save_model(model, folder / "final_model.zip", config)
    except (KeyboardInterrupt, SystemExit):
        progress.stop()
        console.print(_go_on(folder), soft_wrap=True, highlight=False)
        raise
    finally:
        progress.stop()
        with contextlib.suppress(OSError):
            model.logger.close()
    best = folder / "best_model.zip"
    return TrainingResult(folder, config, model, best if best.exists() else folder / "final_model.zip")


@contextlib.contextmanager
def _faults_told(folder: Path) -> Iterator[None]:
    """A fault of the disk or of a worker ends in one line that says how to go on."""
    try:
        yield
    except OSError as error:
        where = folder if error.filename is None else os.fsdecode(error.filename)
        raise RunError(f"{where}: {error.strerror or error}; {_go_on(folder)}") from error
    except RunError as error:
        raise type(error)(f"{error}; {_go_on(folder)}") from error


def _go_on(folder: Path) -> str:
    saved = checkpoint_paths(folder)
    return f"{saved[-1].name if saved else 'nothing'} is saved; to go on: sb3-flock train --resume {folder}"


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


def _summary(config: TrainingConfig, model: OffPolicyAlgorithm, folder: Path) -> str:
    """What is trained, on what, where: one line."""
    flown = config.flown_scenarios()
    return (
        f"{config.algo} for {config.scenario.bodies}; practice in {config.n_flocks} flocks of "
        f"{' and of '.join(str(scenario.n_vehicles) for scenario in flown)} among {flown[0].n_obstacles}; device {model.device}, "
        f"torch threads {th.get_num_threads()} on {_cores()} cores; {folder}"
    )


def _cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
