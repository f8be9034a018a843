"""One function that trains from a config and leaves a run folder, and one that resumes it."""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch as th
from rich.console import Console
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from sb3_flock.config.training import TrainingConfig
from sb3_flock.console import PlainConsole
from sb3_flock.controllers import EXPERTS
from sb3_flock.envs.expert_env import ExpertEnv
from sb3_flock.envs.flocking_v0 import parallel_env
from sb3_flock.envs.multi_flock import MultiFlockEnv
from sb3_flock.envs.vec_env import ParameterSharingVecEnv, flatten_batch
from sb3_flock.rl.callbacks import (
    FlockMetrics,
    LinearNoiseDecay,
    NeighborInclusiveReward,
    StopOnNonFiniteLoss,
    StoreExecutedActions,
)
from sb3_flock.rl.compiled_update import can_compile
from sb3_flock.rl.ddpg import FlockTD3
from sb3_flock.rl.registry import build_model
from sb3_flock.serialization.archive import check_clock
from sb3_flock.serialization.load import PolicyError, check_device, checkpoint_paths, load_policy
from sb3_flock.serialization.save import save_model
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.settings import RunError, SettingsError, leaf_paths
from sb3_flock.sim import Scenario, World, episode_rng
from sb3_flock.training.checkpoint import (
    LoadedCheckpoint,
    Stateful,
    reproducibility_warnings,
    save_checkpoint,
    whole_checkpoints,
)
from sb3_flock.training.checkpoint_callback import CheckpointCallback
from sb3_flock.training.eval_callback import FlockEvalCallback
from sb3_flock.training.logger import make_logger, quiet_writer_thread
from sb3_flock.training.progress_callback import FlockProgressCallback
from sb3_flock.training.run_dir import check_encoding, create_run_dir, describe_run, lock_run_dir
from sb3_flock.training.signals import GracefulShutdown

_WIDE_BATCH = 1024
"""Batch from which a second torch thread saves a fifth of an update's time or more; at 128 it saves nothing."""


@dataclass(frozen=True)
class TrainingResult:
    """The result of a training."""

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
    :func:`~sb3_flock.evaluation.metrics.score` at an evaluation) and, once it is complete, ``final_model.zip``. SIGINT,
    SIGTERM and SIGHUP are delayed until a checkpoint is saved; :func:`resume` continues from one.

    :param config: everything that decides the training
    :param console: where progress goes; the default prints to stderr
    :param command: the command line, for ``command.txt``
    :param callbacks: further SB3 callbacks, called after the package's own
    :raises SettingsError: for a device or a folder that cannot be used
    :raises PolicyError: for a policy to start from that cannot be used
    :raises WorldError: if the arena is too crowded to start
    :raises RunError: if the disk is full, a worker dies or a loss is not finite; saved files stay
    """
    console = console or PlainConsole(stderr=True)
    with GracefulShutdown().waiting() as signals:
        model, env = _prepare(config)
        try:
            folder = create_run_dir(config, command)
            with lock_run_dir(folder), _faults_as_run_errors(folder):
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
    """Continue a run from its newest whole checkpoint, or from its start if there is none.

    On the CPU, with one thread, in one process and with the same versions the result equals that of an uninterrupted run to
    the last bit; otherwise a line says why it does not.

    :param folder: the run folder
    :param console: as in :func:`train`
    :param changes: fields of the config to change: those in :data:`RESUMABLE`
    :param command: the command line, added to ``command.txt``
    :param callbacks: as in :func:`train`; their states are not in the checkpoint
    :raises SettingsError: for a folder that is not a run's or is in use, a field that cannot change, in ``changes`` or by an
        edit of ``config.yaml``, a run that is complete
    :raises RunError: as in :func:`train`
    """
    folder, console = Path(folder), console or PlainConsole(stderr=True)
    if not (folder / "config.yaml").is_file():
        raise SettingsError(f"resume {folder}: not a run folder (there is no config.yaml)")
    check_encoding(folder)
    config = load_config(TrainingConfig, folder / "config.yaml")
    fixed = [name for name in changes or {} if name not in RESUMABLE]
    if fixed:
        raise SettingsError(f"{fixed[0]} cannot change in a resumed run, only {', '.join(RESUMABLE)}")
    config = load_config(TrainingConfig, overrides=changes, base=config)

    def report(line: str) -> None:
        console.print(line, soft_wrap=True, highlight=False)

    with GracefulShutdown().waiting() as signals, lock_run_dir(folder), _faults_as_run_errors(folder):
        for half_written in folder.glob(".*.tmp"):
            half_written.unlink()
        checkpoint, model, env = _restore(folder, config, changes or {}, report)
        try:
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
    "n_eval_episodes",
    "n_test_episodes",
    "save_freq",
    "keep_checkpoints",
)
"""Fields that a resumed run may change: except for the first, they hardly change what is learned."""


def _restore(
    folder: Path, config: TrainingConfig, changes: Mapping[str, Any], report: Callable[[str], None]
) -> tuple[LoadedCheckpoint | None, OffPolicyAlgorithm, VecEnv]:
    """The newest checkpoint that can be restored, the model that continues from it, and its env; without one, a new model."""
    for checkpoint in itertools.chain(whole_checkpoints(folder, config, report), [None]):
        done = checkpoint.num_timesteps if checkpoint else 0
        is_complete = done >= config.total_timesteps and (folder / "final_model.zip").exists()
        if is_complete or ("total_timesteps" in changes and done >= config.total_timesteps):
            raise SettingsError(
                f"resume {folder}: {done} transitions are done; a larger total_timesteps than {config.total_timesteps} is "
                "needed to continue"
            )
        edits = _edits(checkpoint, config) if checkpoint else ""
        model, env = _prepare(config)
        try:
            if checkpoint:
                checkpoint.restore_model(model)
        except PolicyError as error:
            env.close()
            report(f"skipped {error}")
        except BaseException:
            env.close()
            raise
        else:
            why = reproducibility_warnings(checkpoint, config)
            report(f"resumes {folder} after {done} of {config.total_timesteps} transitions{edits}{why}")
            return checkpoint, model, env
    raise AssertionError("unreachable")


def _edits(checkpoint: LoadedCheckpoint, config: TrainingConfig) -> str:
    """What differs from the checkpoint's own config, as a part of a line.

    :raises SettingsError: if it is none of :data:`RESUMABLE`
    """
    values, own = (dict(_leaves(each)) for each in (config, checkpoint.config))
    edits = {name: (own[name], value) for name, value in values.items() if value != own[name] and name != "output_dir"}
    fixed = [
        f"{name} = {new} ({old} in {checkpoint.path.name})" for name, (old, new) in edits.items() if name not in RESUMABLE
    ]
    if fixed:
        raise SettingsError(
            f"{checkpoint.path.parent / 'config.yaml'}: {', '.join(fixed)}: these cannot change in a resumed run"
        )
    return "".join(f"; {name} = {new} ({old} before)" for name, (old, new) in edits.items())


def _leaves(config: TrainingConfig) -> Iterator[tuple[str, Any]]:
    """Every parameter of a config with its whole name."""
    for path in leaf_paths(TrainingConfig):
        yield ".".join(path), functools.reduce(getattr, path, config)


def _prepare(config: TrainingConfig) -> tuple[OffPolicyAlgorithm, VecEnv]:
    """The untrained model and its env; every error in a config is raised here, before there is a run folder."""
    th.set_num_threads(config.torch_threads or (1 if config.algorithm.batch_size < _WIDE_BATCH else cores()))
    check_device(config.device)
    check_clock()
    for scenario in (config.scenario, *config.training_scenarios()):  # raises if the arena is too crowded
        World(scenario).reset([episode_rng(config.seed, 0)])
    env = VecMonitor(make_training_env(config))
    try:
        return _build(config, env), env
    except BaseException:
        env.close()
        raise


def make_training_env(config: TrainingConfig) -> ParameterSharingVecEnv:
    """The flattened training env, with an expert where ``train_env`` names one."""

    def make_env(n_flocks: int) -> parallel_env | MultiFlockEnv:
        flocks = [_make_flocks(config, scenario, n_flocks) for scenario in config.training_scenarios()]
        return flocks[0] if len(flocks) == 1 else MultiFlockEnv(flocks)

    return flatten_batch(make_env, config.n_flocks, config.num_cpus, config.seed)


def _make_flocks(config: TrainingConfig, scenario: Scenario, n_flocks: int) -> parallel_env:
    train_env, safety = config.train_env, config.training_safety(scenario)
    if train_env.expert is None:
        return parallel_env(
            scenario,
            n_flocks=n_flocks,
            action_repeat=train_env.action_repeat,
            safety=safety,
            randomization=train_env.randomization,
        )
    make_expert = EXPERTS[train_env.expert]
    return ExpertEnv(
        scenario,
        lambda world: make_expert(world, train_env.mpc),
        train_env.expert_fraction,
        train_env.expert_noise_std,
        queries=config.algorithm.bc_coef > 0,
        n_flocks=n_flocks,
        action_repeat=train_env.action_repeat,
        safety=safety,
        randomization=train_env.randomization,
    )


def _run(
    config: TrainingConfig,
    folder: Path,
    model: OffPolicyAlgorithm,
    checkpoint: LoadedCheckpoint | None,
    console: Console,
    callbacks: Iterable[BaseCallback],
    signals: GracefulShutdown,
) -> TrainingResult:
    """Train until the end or a signal."""
    console.print(_summary(config, model, folder), soft_wrap=True, highlight=False)
    progress = FlockProgressCallback(console, config.total_timesteps)
    rewards, metrics = NeighborInclusiveReward(config.scenario.reward.lambda_), FlockMetrics()
    evaluation = FlockEvalCallback(
        config.scenario,
        config.eval_freq,
        config.n_eval_episodes,
        folder,
        save_best=lambda model, path: save_model(model, path, config, optimizers=False),
        report=progress.report_evaluation,
    )
    stateful: dict[str, Stateful] = {"rewards": rewards, "metrics": metrics, "evaluation": evaluation}
    parts: list[BaseCallback] = [
        rewards,
        StoreExecutedActions(),
        metrics,
        evaluation,
        StopOnNonFiniteLoss(),
        progress,
        *callbacks,
        CheckpointCallback(
            folder,
            config.save_freq,
            config.keep_checkpoints,
            lambda model, path, parts: save_checkpoint(model, path, config, parts),
            stateful,
            checkpoint,
            signals,
        ),
    ]
    if model.action_noise is not None:
        parts.append(LinearNoiseDecay(*config.algorithm.action_noise_stds))
    model.set_logger(make_logger(folder, model.num_timesteps))
    try:
        with quiet_writer_thread():
            model.learn(
                config.total_timesteps - model.num_timesteps,
                CallbackList(parts),
                log_interval=model.n_envs,
                reset_num_timesteps=checkpoint is None,
            )
        save_model(model, folder / "final_model.zip", config)
    except (KeyboardInterrupt, SystemExit):
        progress.stop()
        console.print(_how_to_resume(folder), soft_wrap=True, highlight=False)
        raise
    finally:
        progress.stop()
        with contextlib.suppress(OSError):
            model.logger.close()
    best = folder / "best_model.zip"
    return TrainingResult(folder, config, model, best if best.exists() else folder / "final_model.zip")


@contextlib.contextmanager
def _faults_as_run_errors(folder: Path) -> Iterator[None]:
    """A fault of the disk or of a worker ends in one line that says how to continue."""
    try:
        yield
    except OSError as error:
        where = folder if error.filename is None else os.fsdecode(error.filename)
        raise RunError(f"{where}: {error.strerror or error}; {_how_to_resume(folder)}") from error
    except RunError as error:
        raise type(error)(f"{error}; {_how_to_resume(folder)}") from error


def _how_to_resume(folder: Path) -> str:
    saved = checkpoint_paths(folder)
    return f"{saved[-1].name if saved else 'nothing'} is saved; resume {folder} to continue"


def _build(config: TrainingConfig, env: VecEnv) -> OffPolicyAlgorithm:
    """The model, with the weights of ``init_from`` where there is one."""
    try:
        model = build_model(config, env)
    except MemoryError:
        raise SettingsError(f"buffer_size = {config.algorithm.buffer_size}: more than this machine's memory") from None
    if isinstance(model, FlockTD3):
        may_use_two = cores() > 1 and os.environ.get("OMP_NUM_THREADS") != "1"
        model.update_threads = config.torch_threads or (2 if may_use_two else 1)
    if config.init_from is not None:
        initial = load_policy(config.init_from)
        initial.check(config.scenario)
        if (initial.config.network, initial.config.algo) != (config.network, config.algo):
            raise PolicyError(f"{initial.path}: its algorithm or networks are not those of this config (init_from)")
        model.policy.load_state_dict(initial.policy.state_dict())
    return model


def _summary(config: TrainingConfig, model: OffPolicyAlgorithm, folder: Path) -> str:
    """What is trained, on what, where: one line."""
    scenarios = config.training_scenarios()
    compiled = ""
    if isinstance(model, FlockTD3) and can_compile(model):
        compiled = f", of the compiled update {model.update_threads},"
    limits = ", ".join(config.scenario.guarantee_limits)
    drawn = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in config.train_env.randomization.items())
    return (
        f"{config.algo} for {config.scenario.bodies}; training env: {config.n_flocks} flocks of "
        f"{' and of '.join(str(scenario.n_vehicles) for scenario in scenarios)} vehicles, {scenarios[0].n_obstacles} obstacles "
        f"each; device {model.device}, "
        f"torch threads {th.get_num_threads()}{compiled} on {cores()} cores; {folder}"
        + (f"; drawn for each flock and episode: {drawn}" if drawn else "")
        + (f"; the safety filter guarantees no separation with {limits}" if limits else "")
    )


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
