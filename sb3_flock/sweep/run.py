"""Runs a sweep by Ray Tune, on this machine or a cluster, in a folder from which the sweep can be resumed."""

from __future__ import annotations

import csv
import importlib.util
import io
import logging
import os
import posixpath
import re
import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_flock._compat import find_ray_cluster, ray_trials
from sb3_flock._renamed import rename_key
from sb3_flock.evaluation.metrics import METRICS
from sb3_flock.serialization.yaml_io import to_yaml
from sb3_flock.settings import RunError, SettingsError
from sb3_flock.sweep.config import SweepConfig, is_integer, load_sweep

if TYPE_CHECKING:
    from fsspec import AbstractFileSystem

_CONFIG, _POLICY, RESULTS = "sweep.yaml", "policy.zip", "results.csv"


@dataclass(frozen=True)
class Trial:
    """How one trial ended."""

    name: str
    point: dict[str, Any]
    status: str
    """``done``, ``diverged``, ``refused``, ``failed`` or ``unfinished``; a resumed sweep continues the last two."""
    why: str
    """Cause of a status other than ``done``, or empty."""
    metrics: dict[str, float]
    """Means over the episodes of the test: :data:`~sb3_flock.evaluation.metrics.METRICS` and ``score``; empty if not done."""
    report: dict[str, Any]
    """The last report of the trial."""
    run: str
    """Path of its run folder in the sweep's folder; empty if nothing was saved."""


class Folder:
    """The folder of a sweep's results: local, shared, or any URL that fsspec knows.

    :param out: path or URL
    :raises SettingsError: for a URL that cannot be used
    """

    def __init__(self, out: str) -> None:
        import fsspec

        try:
            self.filesystem: AbstractFileSystem
            self.filesystem, path = fsspec.core.url_to_fs(out)
        except (ImportError, ValueError, OSError) as error:
            raise SettingsError(f"{out}: {' '.join(str(error).split())}") from None
        self.name = out
        self.path = path.rstrip("/")
        self.is_plain = "://" not in out and "::" not in out

    def of(self, name: str) -> str:
        """Path of a file in the folder."""
        return posixpath.join(self.path, name)

    def exists(self, name: str = "") -> bool:
        """Whether the folder, or a file of this name in it, exists."""
        with self._storage_errors():
            return bool(self.filesystem.exists(self.of(name) if name else self.path))

    def write(self, name: str, data: bytes) -> None:
        """Write a file."""
        with self._storage_errors():
            self.filesystem.makedirs(self.path, exist_ok=True)
            self.filesystem.pipe_file(self.of(name), data)

    def read(self, name: str) -> bytes:
        """A file's bytes."""
        with self._storage_errors():
            return bytes(self.filesystem.cat_file(self.of(name)))

    @contextmanager
    def _storage_errors(self) -> Iterator[None]:
        """Report errors of the storage as one line."""
        try:
            yield
        except OSError as error:
            raise SettingsError(f"{self.name}: {error.strerror or ' '.join(str(error).split())}") from None

    def for_ray(self) -> dict[str, Any]:
        """The arguments of Ray Tune for this storage; Ray itself handles a plain path, and checks that all machines share it."""
        if self.is_plain:
            return {}
        from pyarrow.fs import FSSpecHandler, PyFileSystem

        return {"storage_filesystem": PyFileSystem(FSSpecHandler(self.filesystem))}


def sweep(config: SweepConfig, out: str, address: str | None = None) -> list[Trial]:
    """Run every trial, and leave ``results.csv`` and each trial's run folder in ``out``.

    :param config: the sweep
    :param out: a new folder, or the URL of one
    :param address: address of a running Ray cluster, such as ``"auto"``; ``None`` starts one on this machine's cores
    :raises SettingsError: for a value of a point that is not accepted, or a folder or an address that cannot be used
    :raises PolicyError: for a policy that cannot be used
    :raises RunError: if Ray does not run
    """
    _check_ray(address)
    policy = _check_points(config)
    folder = Folder(out)
    if folder.exists():
        raise SettingsError(f"{out}: it exists already; resume its sweep, or choose another folder")
    with _cluster(config, address):
        folder.write(_CONFIG, to_yaml(config).encode())
        if policy is not None:
            folder.write(_POLICY, policy)
        return _run(config, folder, policy)


def resume_sweep(out: str, address: str | None = None) -> tuple[SweepConfig, list[Trial]]:
    """Continue a sweep: unfinished and failed trials resume from their last checkpoints.

    Ray keeps the state of a sweep as pickles, which run any code in them: resume your own sweeps only.

    :param out: the folder of :func:`sweep`
    :raises SettingsError: for a folder without a sweep
    :raises RunError: if Ray does not run
    """
    _check_ray(address)
    folder = Folder(out)
    if not folder.exists(_CONFIG):
        raise SettingsError(f"{out}: not a sweep's folder (there is no {_CONFIG})")
    config = load_sweep(_CONFIG, text=folder.read(_CONFIG).decode())
    policy = folder.read(_POLICY) if config.policy is not None else None
    with _cluster(config, address):
        return config, _run(config, folder, policy)


def _check_points(config: SweepConfig) -> bytes | None:
    """Check every trial's config before the first one starts; returns the policy's zip, if there is a policy."""
    if config.policy is None:
        for point in config.points():
            trained = config.training(point)
            if config.search and trained.eval_freq == 0:
                raise SettingsError("eval_freq = 0: a search needs evaluations")
        return None
    from sb3_flock.serialization.load import load_policy

    policy = load_policy(config.policy)
    for point in config.points():
        policy.check(config.evaluation(point, policy.scenario)[0])
    return policy.path.read_bytes()


def _check_ray(address: str | None) -> None:
    """Check that the extra is installed and that the cluster answers; Ray itself would wait for minutes."""
    missing = [name for name in ("ray", "optuna", "rliable") if importlib.util.find_spec(name) is None]
    if missing:
        raise SettingsError(f"a sweep needs {missing[0]}: pip install 'sb3_flock[ray]'")
    if address is None:
        return
    try:
        found = find_ray_cluster(address)
        host, _, port = found.removeprefix("ray://").rpartition(":")
        socket.create_connection((host, int(port)), timeout=10).close()
    except (OSError, ValueError) as error:
        raise SettingsError(f"{address}: no Ray cluster answers there ({' '.join(str(error).split())})") from None


@contextmanager
def _cluster(config: SweepConfig, address: str | None) -> Iterator[None]:
    """Ray, on this machine or at the address, as long as the context is open."""
    os.environ.update(RAY_USAGE_STATS_ENABLED="0", TUNE_DISABLE_AUTO_CALLBACK_LOGGERS="1", RAY_AIR_NEW_OUTPUT="0")
    import ray

    logging.getLogger("ray.tune").setLevel(logging.CRITICAL)  # tracebacks of lost machines, which TrialsTable reports
    try:
        ray.init(address=address or "local", include_dashboard=False, log_to_driver=False, logging_level=logging.ERROR)
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise SettingsError(f"{address}: {' '.join(str(error).split())}") from None
    try:
        have = ray.cluster_resources()  # type: ignore[no-untyped-call]
        for name, wanted in (("CPU", config.resources.cpus), ("GPU", config.resources.gpus)):
            if address is None and wanted > have.get(name, 0):  # a cluster may grow
                raise SettingsError(f"resources.{name.lower()}s = {wanted}: this machine has {have.get(name, 0):g}")
        yield
    finally:
        ray.shutdown()


def _run(config: SweepConfig, folder: Folder, policy: bytes | None) -> list[Trial]:
    from ray import tune

    from sb3_flock.sweep.trials import evaluate_trial, train_trial

    try:
        values = config.model_dump(mode="json")
        trial: Any = (
            tune.with_parameters(train_trial, sweep=values)
            if policy is None
            else tune.with_parameters(evaluate_trial, sweep=values, policy=policy)
        )
        trial = tune.with_resources(trial, {"CPU": config.resources.cpus, "GPU": config.resources.gpus})
        storage = folder.for_ray()
        if tune.Tuner.can_restore(folder.path, **storage):
            tuner = tune.Tuner.restore(folder.path, trial, resume_unfinished=True, resume_errored=True, **storage)
        else:
            tuner = _new_tuner(config, folder, trial, storage)
        results = tuner.fit()
        ended = [_ended(trial, folder) for trial in ray_trials(results)]
        trials = sorted(ended, key=lambda trial: trial.name)
    except tune.TuneError as error:
        raise RunError(f"{str(error).strip().splitlines()[-1]}; the sweep in {folder.name} can be resumed") from error
    folder.write(RESULTS, _as_csv(config, trials).encode())
    return trials


def _new_tuner(config: SweepConfig, folder: Folder, trial: Any, storage: Mapping[str, Any]) -> Any:
    import ray
    from ray import tune

    from sb3_flock.sweep.table import TrialsTable

    space: dict[str, Any] = {key: tune.grid_search(values) for key, values in config.grid.items()}
    settings: dict[str, Any] = {}
    if config.search:
        import optuna
        from ray.tune.search.optuna import OptunaSearch

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        space = {}
        cores = ray.cluster_resources().get("CPU", 1)  # type: ignore[no-untyped-call]
        at_once = max(1, int(cores) // config.resources.cpus)
        searcher = OptunaSearch(_distributions(config), metric="score", mode="min", seed=config.search_seed)
        settings = {"search_alg": searcher, "num_samples": config.trials, "max_concurrent_trials": at_once}
    return tune.Tuner(
        trial,
        param_space=space,
        tune_config=tune.TuneConfig(
            trial_name_creator=trial_name, trial_dirname_creator=trial_name, reuse_actors=True, **settings
        ),
        run_config=tune.RunConfig(
            name=posixpath.basename(folder.path),
            storage_path=posixpath.dirname(folder.path),
            failure_config=tune.FailureConfig(max_failures=config.retries),
            checkpoint_config=tune.CheckpointConfig(num_to_keep=1),
            callbacks=[TrialsTable()],
            verbose=0,
            **storage,
        ),
    )


def trial_name(trial: Any) -> str:
    """A trial's number and its point, as the name of a folder."""
    words = [f"{key.split('.')[-1]}={short(value)}" for key, value in trial.config.items()]
    return re.sub(r"[^\w.=+-]+", "_", "-".join([trial.trial_id.split("_")[-1], *words]))[:120]


def short(value: Any) -> str:
    """A value of a point as tables show it."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _distributions(config: SweepConfig) -> dict[str, Any]:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    space: dict[str, Any] = {}
    for key, choices in config.search.items():
        if isinstance(choices, list):
            space[key] = CategoricalDistribution(choices)
        elif is_integer(key):
            space[key] = IntDistribution(int(choices.low), int(choices.high), log=choices.log)
        else:
            space[key] = FloatDistribution(choices.low, choices.high, log=choices.log)
    return space


def _ended(trial: Any, folder: Folder) -> Trial:
    report = trial.last_result or {}
    test = report.get("test", {})
    failed = trial.status == "ERROR"
    saved = trial.checkpoint
    return Trial(
        name=str(trial),
        point={rename_key(key): value for key, value in trial.config.items()},
        status="failed" if failed else report.get("status", "unfinished"),
        why=_first_cause(trial) if failed else report.get("why", ""),
        metrics={name: float(test[name]) for name in (*METRICS, "score") if name in test},
        report=report,
        run="" if saved is None else posixpath.relpath(saved.path, folder.path),
    )


def _first_cause(trial: Any) -> str:
    """The last line of the exception of the trial's process."""
    try:
        lines = str(trial.get_pickled_error() or trial.get_error()).strip().splitlines()
    except Exception:
        lines = []
    return lines[-1] if lines else "the trial left no error"


def _as_csv(config: SweepConfig, trials: Sequence[Trial]) -> str:
    fields = [*(config.grid or config.search), "status", "timesteps", "minutes", *METRICS, "score", "run", "why"]
    text = io.StringIO()
    writer = csv.DictWriter(text, fields, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for trial in trials:
        about = {"status": trial.status, "run": trial.run, "why": trial.why}
        writer.writerow({**trial.report, **trial.metrics, **trial.point, **about})
    return text.getvalue()


def default_out(file: str | Path) -> str:
    """The next free ``sweeps/<name>_<k>``."""
    stem = Path(file).stem
    number = 1
    while (Path("sweeps") / f"{stem}_{number}").exists():
        number += 1
    return str((Path("sweeps") / f"{stem}_{number}").resolve())
