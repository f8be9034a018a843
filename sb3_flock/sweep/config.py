"""SweepConfig: the fields that a sweep varies, the training config that they are fields of, and the resources."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from sb3_flock._renamed import rename_key
from sb3_flock.config.training import TrainingConfig
from sb3_flock.evaluation.metrics import METRICS
from sb3_flock.serialization.migrate import FORMAT, check_format
from sb3_flock.serialization.yaml_io import load_config, read_yaml
from sb3_flock.settings import Settings, SettingsError, field_of, format_value, resolve_path
from sb3_flock.sim import Scenario

MAX_TRIALS = 100_000
_GIVEN = ("output_dir", "torch_threads")
"""Fields that a sweep sets itself."""


class Range(Settings):
    """Numbers from ``low`` to ``high``; integers if the field holds integers."""

    low: float = Field(description="smallest value")
    high: float = Field(description="largest value")
    log: bool = Field(False, description="search the logarithm")

    @model_validator(mode="after")
    def _check(self) -> Range:
        if self.low > self.high or (self.log and self.low <= 0):
            raise ValueError(f"low = {self.low}: at most high = {self.high} is needed, and more than 0 with log")
        return self


class Resources(Settings):
    """The resources of one trial."""

    cpus: int = Field(1, ge=1, le=1024, description="cores of a trial, and its torch threads")
    gpus: float = Field(0.0, ge=0, le=64, description="GPUs of a trial; trials share a GPU if it is a fraction")


class SweepConfig(Settings):
    """A sweep: a grid or a search over any fields of :class:`~sb3_flock.config.training.TrainingConfig`.

    Leading groups of a field's name may be left out: ``lambda_`` is ``scenario.reward.lambda_``.

    :raises SettingsError: one line naming the parameter, its value and what is accepted
    """

    base: dict[str, Any] = Field({}, description="file of a training config, beside this one, or a mapping of its fields")
    grid: dict[str, list[Any]] = Field({}, description="values by field: every combination is a trial")
    search: dict[str, list[Any] | Range] = Field(
        {}, description="choices or {low, high, log} by field: Optuna looks for the lowest score at an evaluation"
    )
    trials: int = Field(50, ge=1, le=MAX_TRIALS, description="trials of a search")
    search_seed: int = Field(0, ge=0, le=2**32 - 1, description="seed of a search")
    policy: str | None = Field(
        None, description="policy to evaluate over the grid (a zip, a run folder or a name); null: train"
    )
    episodes: int = Field(1000, ge=1, le=1_000_000, description="episodes of each evaluation of a policy")
    metric: str = Field("score", description="metric of the ranking: score or a metric of the evaluation")
    tasks: list[str] = Field([], description="fields of the grid that make another task, not another setting to rank")
    resources: Resources = Field(default_factory=Resources, description="resources of one trial")
    retries: int = Field(
        3, ge=0, le=1000, description="number of times that a trial is resumed after its machine or process was lost"
    )

    @model_validator(mode="after")
    def _check(self) -> SweepConfig:
        if bool(self.grid) == bool(self.search):
            raise ValueError("a grid or a search is needed, and not both")
        if self.search and self.policy is not None:
            raise ValueError("search: a policy is evaluated over a grid")
        for key, values in {**self.grid, **self.search}.items():
            if isinstance(values, list) and (not values or any(value in values[:i] for i, value in enumerate(values))):
                raise ValueError(f"{key} = {format_value(values)}: a list of different values is needed")
        if math.prod(map(len, self.grid.values())) > MAX_TRIALS:
            raise ValueError(f"grid: more than {MAX_TRIALS} trials")
        if self.metric != "score" and self.metric not in METRICS:
            raise ValueError(f"metric = {format_value(self.metric)}: score or one of {', '.join(METRICS)} is needed")
        unknown = [task for task in self.tasks if task not in self.grid]
        if unknown:
            raise ValueError(f"tasks = {unknown[0]}: a field of the grid is needed")
        return self

    def training(self, point: Mapping[str, Any]) -> TrainingConfig:
        """The config of the trial at ``point``.

        :raises SettingsError: for a value that is not accepted
        """
        threads = {"torch_threads": self.resources.cpus, "output_dir": "runs"}
        return load_config(TrainingConfig, overrides={**self.base, **point, **threads})

    def evaluation(self, point: Mapping[str, Any], trained_for: Scenario) -> tuple[Scenario, int]:
        """The scenario and the seed of the evaluation at ``point``.

        :param trained_for: the policy's scenario, which ``base`` and ``point`` change
        :raises SettingsError: for a field that does not affect an evaluation, or a value that is not accepted
        """
        seed = load_config(TrainingConfig, overrides={key: value for key, value in point.items() if key == "seed"}).seed
        changes = {key: value for key, value in {**self.base, **point}.items() if key.startswith(_SCENARIO)}
        idle = [key for key in point if key not in changes and key != "seed"]
        if idle:
            raise SettingsError(f"grid: {idle[0]} does not affect an evaluation, only the scenario's fields and seed do")
        overrides = {key.removeprefix(_SCENARIO): value for key, value in changes.items()}
        return load_config(Scenario, overrides=overrides, base=trained_for), seed

    def points(self) -> list[dict[str, Any]]:
        """The grid's points; of a search, points that cover each end of each range and each choice."""
        if self.grid:
            return [dict(zip(self.grid, values, strict=True)) for values in itertools.product(*self.grid.values())]
        ends = {
            key: choices if isinstance(choices, list) else [_of_field(key, choices.low), _of_field(key, choices.high)]
            for key, choices in self.search.items()
        }
        first = {key: values[0] for key, values in ends.items()}
        return [{**first, key: value} for key, values in ends.items() for value in values]


_SCENARIO = "scenario."


def _of_field(key: str, value: float) -> float:
    """An end of a range in its field's type."""
    return int(value) if is_integer(key) and value == int(value) else value


def is_integer(key: str) -> bool:
    """Whether a field of the training config holds integers.

    :param key: the field's whole path
    """
    return field_of(TrainingConfig, key).annotation is int


def load_sweep(
    path: str | Path, base: Mapping[str, Any] | None = None, text: str | None = None, **changes: Any
) -> SweepConfig:
    """Read a sweep's YAML file; names of the previous release are read with a warning.

    :param base: further fields of the training config that all trials share
    :param text: the file's text, if the file is not local
    :param changes: values of this config, instead of the file's
    :raises SettingsError: one line for a file or a value that is not accepted
    """
    values = {**read_yaml(Path(path), text), **changes}
    check_format(values.pop("format", FORMAT))
    for name in ("grid", "search"):
        if not isinstance(values.get(name, {}), Mapping):
            raise SettingsError(f"{name} = {format_value(values[name])}: a mapping of fields to values is needed")
    shared = values.get("base") or {}
    if isinstance(shared, str):
        whole = load_config(TrainingConfig, Path(path).parent / shared).model_dump(mode="json")
        shared = {name: value for name, value in whole.items() if name not in _GIVEN}
    if not isinstance(shared, Mapping):
        raise SettingsError(f"base = {format_value(shared)}: a config's file or a mapping of its fields is needed")
    added = _named_in_full((base or {}).items())
    idle = [name for name in added if values.get("policy") is not None and not name.startswith(_SCENARIO)]
    if idle:
        raise SettingsError(f"{idle[0]} does not affect an evaluation, only the scenario's fields do")
    values["base"] = {**_without_idle_options(dict(_leaves(shared))), **added}
    for name in ("grid", "search"):
        values[name] = _named_in_full(values.get(name, {}).items())
    if isinstance(values.get("tasks"), list):
        values["tasks"] = [".".join(resolve_path(TrainingConfig, str(task))) for task in values["tasks"]]
    return SweepConfig(**values)


def _named_in_full(items: Iterable[tuple[str, Any]]) -> dict[str, Any]:
    named = {}
    for key, value in items:
        name = ".".join(resolve_path(TrainingConfig, str(key)))
        if name in _GIVEN:
            raise SettingsError(f"{name}: a sweep sets it by itself")
        if name == "init_from":  # trials run in other working directories
            named[name] = [_absolute(path) for path in value] if isinstance(value, list) else _absolute(value)
        else:
            named[name] = value
    return named


def _without_idle_options(base: Mapping[str, Any]) -> dict[str, Any]:
    """The shared fields under their whole names.

    The previous release wrote the base's file out in full, and ignored these options where they did not apply to a trial's
    algorithm. They are refused there now; without a value they apply where they can.
    """
    named = _named_in_full(base.items())
    if any(rename_key(key) != key for key in base):
        idle = {"algorithm.mirror_augmentation": True, "network.action_bound": "inverting"}
        return {name: value for name, value in named.items() if name not in idle or value != idle[name]}
    return named


def _absolute(path: Any) -> Any:
    return str(Path(path).resolve()) if isinstance(path, str) and Path(path).exists() else path


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
