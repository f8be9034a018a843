"""Statistics over a sweep's trials, by rliable (Agarwal et al., 2021).

A few seeds give no ranking without their spread. The statistics are the interquartile mean over runs and tasks with its 95 %
interval from a bootstrap stratified by task, performance profiles, and the probability that a run of one setting is better
than a run of another.
"""

from __future__ import annotations

import csv
import io
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from sb3_flock.evaluation.metrics import METRICS, is_higher_better
from sb3_flock.evaluation.report import add_short_columns, plain_table, short_cells
from sb3_flock.sweep.config import SweepConfig
from sb3_flock.sweep.run import Folder, Trial, short
from sb3_flock.sweep.trials import DONE
from sb3_flock.viz.figures import LINE_STYLES, new_figure, save_as

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RESAMPLES = 2_000
_BEST = 10
"""Number of trials in the table of a search."""
_POINTS = 101
"""Number of metric values at which a profile is drawn."""
_STYLES = [marker + line for marker in ("", "o", "s", "^", "x") for line in LINE_STYLES]


@dataclass(frozen=True)
class Setting:
    """One setting of a sweep, over its seeds and tasks."""

    name: str
    values: NDArray[np.float64]
    """``(runs, tasks)``, in the metric's own unit."""
    lost: int
    """Trials that did not end with a test. The statistics leave out their seeds, in every task."""
    iqm: float
    low: float
    high: float
    """Interquartile mean with its 95 % interval."""
    p_best_better: float
    p_low: float
    p_high: float
    """Probability that a run of the best setting is better than a run of this one, with its 95 % interval; NaN for the best."""


def report(config: SweepConfig, trials: Sequence[Trial], out: str) -> list[Table]:
    """The tables for a terminal; for a grid of trainings also writes ``ranking.csv``, ``.png`` and ``.svg`` to ``out``.

    A search has a table of its best trials and no ranking: each of its points has one trial, and is chosen by the score.
    """
    if config.policy is not None:
        return [trials_table(config, trials)]
    if config.search:
        ordered = sorted((trial for trial in trials if trial.status == DONE), key=lambda trial: trial.report["score"])
        return [trials_table(config, ordered[:_BEST])]
    settings = rank(config, trials, config.metric)
    if not settings:
        return []
    folder = Folder(out)
    folder.write("ranking.csv", ranking_csv(settings, config.metric).encode())
    figure = ranking_figure(settings, config.metric)
    for kind in ("png", "svg"):
        picture = io.BytesIO()
        save_as(figure, picture, kind)
        folder.write(f"ranking.{kind}", picture.getvalue())
    return [ranking_table(settings, config.metric)]


def trials_table(config: SweepConfig, trials: Sequence[Trial]) -> Table:
    """The metrics of each trial, one line each."""
    keys = [*(config.grid or config.search)]
    table = plain_table(gap=1)
    for key in keys:
        table.add_column(key.split(".")[-1], overflow="fold")
    add_short_columns(table)
    for trial in trials:
        table.add_row(*(short(trial.point[key]) for key in keys), *short_cells(trial.metrics))
    return table


def _heading(metric: str) -> str:
    """The metric's heading in narrow tables, or its name."""
    return (METRICS[metric].column if metric in METRICS else None) or metric


def _format(metric: str, value: float) -> str:
    return METRICS[metric].format(value) if metric in METRICS else f"{value:.3f}"


def rank(config: SweepConfig, trials: Sequence[Trial], metric: str) -> list[Setting]:
    """The settings of a grid, best first, without those that have no finished run.

    :param metric: ``score`` or one of :data:`~sb3_flock.evaluation.metrics.METRICS`
    """
    from rliable import metrics

    by_name = {name: _matrix(config, of, metric) for name, of in _by_setting(config, trials).items()}
    sign = 1.0 if is_higher_better(metric) else -1.0
    larger_is_better = {name: sign * values for name, (values, _) in by_name.items() if values.size}
    if not larger_is_better:
        return []
    means, intervals = _intervals(larger_is_better, lambda values: np.array([metrics.aggregate_iqm(values)]))
    order = sorted(means, key=lambda name: -float(means[name][0]))
    best = order[0]
    pairs = {name: (larger_is_better[best], larger_is_better[name]) for name in order[1:]}
    wins, win_intervals = _intervals(pairs, lambda x, y: np.array([metrics.probability_of_improvement(x, y)]))
    return [
        Setting(
            name,
            *by_name[name],
            sign * float(means[name][0]) + 0.0,  # no minus before a zero
            *sorted(sign * float(end) + 0.0 for end in intervals[name][:, 0]),
            *((np.nan, np.nan, np.nan) if name == best else (float(wins[name][0]), *map(float, win_intervals[name][:, 0]))),
        )
        for name in order
    ]


def _by_setting(config: SweepConfig, trials: Sequence[Trial]) -> dict[str, list[Trial]]:
    keys = [key for key in config.grid if key != "seed" and key not in config.tasks]
    groups: dict[str, list[Trial]] = {}
    for trial in trials:
        groups.setdefault(", ".join(f"{key.split('.')[-1]} {short(trial.point[key])}" for key in keys) or "all", []).append(
            trial
        )
    return groups


def _matrix(config: SweepConfig, trials: Sequence[Trial], metric: str) -> tuple[NDArray[np.float64], int]:
    """The values ``(runs, tasks)`` and the number of trials that did not end.

    A run is a seed that ended in every task with this metric defined.
    """
    tasks: dict[str, dict[Any, float]] = {}
    for trial in trials:
        value = trial.metrics.get(metric, np.nan) if trial.status == DONE else np.nan
        tasks.setdefault(str([trial.point[key] for key in config.tasks]), {})[trial.point.get("seed", 0)] = value
    seeds = [
        seed for seed in next(iter(tasks.values())) if all(np.isfinite(task.get(seed, np.nan)) for task in tasks.values())
    ]
    values = np.array([[task[seed] for task in tasks.values()] for seed in seeds])
    return values, sum(trial.status != DONE for trial in trials)


def _intervals(scores: dict[str, Any], statistic: Callable[..., Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    from rliable import library

    if not scores:
        return {}, {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # rliable passes its generator to arch under an old name
        random = np.random.RandomState(0)
        found: tuple[dict[str, Any], dict[str, Any]] = library.get_interval_estimates(
            scores, statistic, reps=_RESAMPLES, random_state=random
        )
    return found


def ranking_table(settings: Sequence[Setting], metric: str) -> Table:
    """The settings, best first, one line each."""
    table = plain_table()
    table.add_column("setting", overflow="fold")
    for heading in ("runs", "lost", f"IQM {_heading(metric)}", "95 % interval", "P(best better)"):
        table.add_column(heading, justify="right")
    for setting in settings:
        is_best = np.isnan(setting.p_best_better)
        table.add_row(
            setting.name,
            str(len(setting.values)),
            str(setting.lost),
            _format(metric, setting.iqm),
            f"{_format(metric, setting.low)} .. {_format(metric, setting.high)}",
            "" if is_best else f"{setting.p_best_better:.2f} ({setting.p_low:.2f} .. {setting.p_high:.2f})",
        )
    return table


def ranking_csv(settings: Sequence[Setting], metric: str) -> str:
    """The same as CSV."""
    text = io.StringIO()
    columns = ("iqm", "low", "high", "p_best_better", "p_low", "p_high")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["metric", "setting", "runs", "tasks", "lost", *columns])
    for setting in settings:
        values = [getattr(setting, name) for name in columns]
        writer.writerow([metric, setting.name, *setting.values.shape, setting.lost, *values])
    return text.getvalue()


def ranking_figure(settings: Sequence[Setting], metric: str) -> Figure:
    """Interquartile means with their intervals beside the performance profiles, legible in grayscale."""
    from rliable import library

    figure, (means, profiles) = new_figure(10.0, 1.5 + 0.45 * max(5, len(settings)), columns=2)
    names = [setting.name for setting in settings]
    for row, setting in enumerate(settings):
        means.plot([setting.low, setting.high], [row, row], "-", color="0.5", linewidth=4, solid_capstyle="butt")
        means.plot(setting.values.ravel(), np.full(setting.values.size, row), "|", color="black", markersize=9)
        means.plot(setting.iqm, row, "o", color="black")
    means.set_yticks(range(len(names)), names)
    means.invert_yaxis()
    means.set(xlabel=metric, title="interquartile mean, 95 % interval, runs")

    larger = is_higher_better(metric)
    sign = 1.0 if larger else -1.0
    everything = np.concatenate([setting.values.ravel() for setting in settings])
    margin = 0.05 * (everything.max() - everything.min()) or 0.5
    at = np.linspace(everything.min() - margin, everything.max() + margin, _POINTS)
    scores = {setting.name: sign * setting.values for setting in settings}
    taus = np.sort(sign * at)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)
        shares, bands = library.create_performance_profile(scores, taus, reps=_RESAMPLES)
    for name, style in zip(names, cycle(_STYLES), strict=False):
        line = profiles.plot(sign * taus, shares[name], style, linewidth=1.5, markevery=10, markersize=5, label=name)[0]
        profiles.fill_between(sign * taus, bands[name][0], bands[name][1], alpha=0.12, color=line.get_color(), linewidth=0)
    word = "above" if larger else "below"
    profiles.set(xlabel=metric, ylabel=f"share of runs {word}", title="performance profiles", ylim=(-0.02, 1.02))
    figure.legend(*profiles.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    for axes in (means, profiles):
        axes.grid(alpha=0.3)
        axes.title.set_fontsize(10)
    return figure
