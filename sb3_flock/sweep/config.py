"""SweepConfig: what a sweep varies, over which training config, with which resources."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import Field, model_validator

from sb3_flock.config.training import TrainingConfig
from sb3_flock.evaluation.metrics import METRICS
from sb3_flock.serialization.yaml_io import load_config, read_yaml
from sb3_flock.settings import Settings, SettingsError, field_of, format_value, resolve_path
from sb3_flock.sim import Scenario

MAX_TRIALS = 100_000
_GIVEN = ("output_dir", "torch_threads")
"""Fields that a sweep sets itself."""


class Range(Settings):
    """Numbers from ``low`` to ``high``; whole ones if the field's are."""

    low: float = Field(description="smallest value")
    high: float = Field(description="largest value")
    log: bool = Field(False, description="search the logarithm")

    @model_validator(mode="after")
    def _check(self) -> Range:
        if self.low > self.high or (self.log and self.low <= 0):
            raise ValueError(f"low = {self.low}: at most high = {self.high} is needed, and more than 0 with log")
        return self


class Resources(Settings):
    """What one trial takes of a machine."""

    cpus: int = Field(1, ge=1, le=1024, description="cores of a trial, and its torch threads")
    gpus: float = Field(0.0, ge=0, le=64, description="GPUs of a trial; a share lets trials fly side by side on one")


class SweepConfig(Settings):
    """A sweep: a grid or a search over any fields of the config that ``sb3-flock train`` takes.

    Fields are named as in ``--set``: leading groups may be left out.

    :raises SettingsError: one line naming the parameter, its value and what is accepted
    """

    base: dict[str, Any] = Field({}, description="a training config's file, beside this one, or its fields")
    grid: dict[str, list[Any]] = Field({}, description="values by field: every combination is a trial")
    search: dict[str, list[Any] | Range] = Field(
        {}, description="choices or {low, high, log} by field: Optuna looks for the lowest score at an evaluation"
    )
    trials: int = Field(50, ge=1, le=MAX_TRIALS, description="trials of a search")
    search_seed: int = Field(0, ge=0, le=2**32 - 1, description="seed of a search")
    policy: str | None = Field(
        None, description="fly this policy over the grid; null: train (a zip, a run folder or a name)"
    )
    episodes: int = Field(1000, ge=1, le=1_000_000, description="episodes a trial flies, with a policy")
    metric: str = Field("score", description="what the statistics rank by: score or a metric of `sb3-flock evaluate`")
    tasks: list[str] = Field([], description="fields of the grid that make another task, not another setting to rank")
    resources: Resources = Field(default_factory=Resources, description="what one trial takes")
    retries: int = Field(3, ge=0, le=1000, description="times that a trial goes on after its machine or process was lost")

    @model_validator(mode="after")
    def _check(self) -> SweepConfig:
        if bool(self.grid) == bool(self.search):
            raise ValueError("a grid or a search is needed, and not both")
        if self.search and self.policy is not None:
            raise ValueError("search: a policy is flown over a grid")
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

    def flight(self, point: Mapping[str, Any], trained_for: Scenario) -> tuple[Scenario, int]:
        """The scenario and the seed of the flights at ``point``: the policy's own, changed as ``base`` and ``point`` say.

        :raises SettingsError: for a field that does not tell on a flight, or a value that is not accepted
        """
        seed = load_config(TrainingConfig, overrides={key: value for key, value in point.items() if key == "seed"}).seed
        changes = {key: value for key, value in {**self.base, **point}.items() if key.startswith(_SCENARIO)}
        strange = [key for key in point if key not in changes and key != "seed"]
        if strange:
            raise SettingsError(f"grid: {strange[0]} does not tell on a flight, only the scenario's fields and seed do")
        overrides = {key.removeprefix(_SCENARIO): value for key, value in changes.items()}
        return load_config(Scenario, overrides=overrides, base=trained_for), seed

    def points(self) -> list[dict[str, Any]]:
        """The grid's points, or, of a search, some that try each end of each range and each choice."""
        if self.grid:
            return [dict(zip(self.grid, values, strict=True)) for values in itertools.product(*self.grid.values())]
        ends = {
            key: choices if isinstance(choices, list) else [fitting(key, choices.low), fitting(key, choices.high)]
            for key, choices in self.search.items()
        }
        first = {key: values[0] for key, values in ends.items()}
        return [{**first, key: value} for key, values in ends.items() for value in values]


_SCENARIO = "scenario."


def fitting(key: str, value: float) -> float:
    """An end of a range as its field has it: whole if that is."""
    return int(value) if is_whole(key) and value == int(value) else value


def is_whole(key: str) -> bool:
    """Whether a field of the training config, named in full, holds whole numbers."""
    return field_of(TrainingConfig, key).annotation is int


def load_sweep(
    path: str | Path, base: Mapping[str, Any] | None = None, text: str | None = None, **changes: Any
) -> SweepConfig:
    """Read a sweep's YAML file.

    :param base: further fields of the training config that all trials share
    :param text: the file's text, where it is not a local one
    :param changes: values of this config, instead of the file's
    :raises SettingsError: one line for a file or a value that is not accepted
    """
    values = {**read_yaml(Path(path), text), **changes}
    for name in ("grid", "search"):  # a list or a scalar is told by name before it is taken apart
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
        raise SettingsError(f"{idle[0]} does not tell on a flight, only the scenario's fields do")
    values["base"] = {**_named_in_full(_leaves(shared)), **added}
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
        if name == "init_from":  # trials run elsewhere
            named[name] = [_absolute(path) for path in value] if isinstance(value, list) else _absolute(value)
        else:
            named[name] = value
    return named


def _absolute(path: Any) -> Any:
    return str(Path(path).resolve()) if isinstance(path, str) and Path(path).exists() else path


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
