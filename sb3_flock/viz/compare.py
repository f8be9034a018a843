"""Trainings side by side: their results, their configs' differences and their learning curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import cycle
from operator import getitem
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from sb3_flock.config.training import TrainingConfig
from sb3_flock.evaluation.metrics import METRICS, columns
from sb3_flock.evaluation.report import add_short_columns, plain_table, short_cells
from sb3_flock.serialization.archive import read_curves
from sb3_flock.serialization.yaml_io import load_config
from sb3_flock.settings import SettingsError, leaf_paths
from sb3_flock.viz.figures import LINE_STYLES, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Run:
    """A training's record: its run folder's ``config.yaml`` and ``evaluations.npz``."""

    name: str
    config: TrainingConfig
    curves: dict[str, NDArray[Any]]
    """Each ``(evaluations,)``: ``timesteps``, ``seconds``, ``score`` and every metric's mean."""

    @property
    def best(self) -> int:
        """Number of the evaluation with the lowest score, at which ``best_model.zip`` was saved."""
        return int(np.argmin(self.curves["score"]))


def load_runs(folders: Sequence[str | Path]) -> list[Run]:
    """Read run folders; no code in them is executed.

    :raises SettingsError: for a folder that is no run, or one without an evaluation so far
    """
    shortest = _shortest_names([str(Path(folder)) for folder in folders])
    return [_load(Path(folder), name) for folder, name in zip(folders, shortest, strict=True)]


def _load(folder: Path, name: str) -> Run:
    if not (folder / "config.yaml").is_file():
        raise SettingsError(f"{folder}: not a run folder (there is no config.yaml)")
    config = load_config(TrainingConfig, folder / "config.yaml")
    try:
        stored = read_curves(folder / "evaluations.npz")
        curves = {key: stored[key] for key in ("timesteps", "seconds", "score")}
        missing = np.full(len(curves["score"]), np.nan)  # of metrics that were registered later
        curves.update({name: stored.get(name, missing) for name in columns()})
    except FileNotFoundError:
        raise SettingsError(f"{folder}: there is no evaluation yet (evaluations.npz)") from None
    except (ValueError, KeyError, TypeError) as error:
        raise SettingsError(f"{folder}: evaluations.npz is damaged ({' '.join(str(error).split())[:100]})") from None
    if len({curve.shape for curve in curves.values()}) != 1 or curves["score"].ndim != 1 or not len(curves["score"]):
        raise SettingsError(f"{folder}: evaluations.npz is damaged (its curves differ in length)")
    return Run(name, config, curves)


def _shortest_names(paths: Sequence[str]) -> list[str]:
    """Paths without the folders that all of them share."""
    parts = [Path(path).parts for path in paths]
    shared = 0
    while all(len(part) > shared + 1 for part in parts) and len({part[shared] for part in parts}) == 1:
        shared += 1
    return [str(Path(*part[shared:])) for part in parts]


def results_table(runs: Sequence[Run]) -> Table:
    """The best evaluation of each run, and when it was."""
    table = plain_table(gap=1)
    table.add_column("run", overflow="fold")
    for heading in ("best at", "of", "min"):
        table.add_column(heading, justify="right", no_wrap=True)
    add_short_columns(table)
    for run in runs:
        curves, best = run.curves, run.best
        values = short_cells({name: curve[best] for name, curve in curves.items()})
        when = f"{_thousands(curves['timesteps'][best])}", f"{_thousands(run.config.total_timesteps)}"
        table.add_row(run.name, *when, f"{float(curves['seconds'][-1]) / 60:.0f}", *values)
    return table


def _thousands(steps: float) -> str:
    return f"{steps / 1000:.0f}k" if steps >= 1000 else f"{steps:.0f}"


def differences_table(runs: Sequence[Run]) -> Table | None:
    """The config's fields that are not the same in all runs, or ``None`` if there are none."""
    configs = [run.config.model_dump(mode="json") for run in runs]
    rows = {".".join(path): [reduce(getitem, path, config) for config in configs] for path in leaf_paths(TrainingConfig)}
    differing = {name: values for name, values in rows.items() if any(value != values[0] for value in values)}
    if not differing:
        return None
    table = plain_table()
    table.add_column("differs", no_wrap=True)
    for run in runs:
        table.add_column(run.name, overflow="fold", justify="right")
    for name, values in differing.items():
        table.add_row(name, *("null" if value is None else str(value) for value in values))
    return table


def plot_curves(runs: Sequence[Run]) -> Figure:
    """The runs' evaluations against transitions, a panel for each metric of narrow tables."""
    metrics = [METRICS[name] for name in columns()]
    rows = -(-len(metrics) // 2)
    figure, panels = new_figure(10.0, 3.5 * rows, columns=2, rows=rows)
    for axes, metric in zip(panels.flat, metrics, strict=False):
        for run, style in zip(runs, cycle(LINE_STYLES), strict=False):
            axes.plot(run.curves["timesteps"], run.curves[metric.name], style, linewidth=1.3, label=run.name)
        axes.set(xlabel="transitions", title=metric.name.replace("_", " ") + (f" [{metric.unit}]" if metric.unit else ""))
        axes.set_ylim(bottom=0 if all(not (run.curves[metric.name] < 0).any() for run in runs) else None)
        axes.grid(alpha=0.3)
        axes.title.set_fontsize(10)
    for unused in panels.flat[len(metrics) :]:
        unused.set_axis_off()
    figure.legend(*panels.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure
