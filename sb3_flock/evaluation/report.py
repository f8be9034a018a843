"""Evaluation results as a table beside the paper's figures, and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from sb3_flock.evaluation.metrics import METRICS, EpisodeMetric, Metric, columns
from sb3_flock.sim import Scenario

PAPER: dict[tuple[int, int], dict[str, dict[str, float]]] = {
    (3, 1): {
        "Table I": {
            "tracking_error": 0.08,
            "min_separation_obstacles": 0.138,
            "min_separation_neighbors": 0.094,
            "mean_separation": 0.185,
        },
        "Table II": {
            "tracking_error": 0.125,
            "min_separation_obstacles": 0.158,
            "min_separation_neighbors": 0.102,
            "mean_separation": 0.187,
        },
    },
    (5, 1): {
        "Table II": {
            "tracking_error": 0.152,
            "min_separation_obstacles": 0.152,
            "min_separation_neighbors": 0.110,
            "mean_separation": 0.174,
        },
    },
    (5, 2): {
        "Table II": {
            "tracking_error": 0.147,
            "min_separation_obstacles": 0.144,
            "min_separation_neighbors": 0.103,
            "mean_separation": 0.182,
        },
    },
}
"""The figures of Lyu et al. (2018) by (vehicles, obstacles), table and metric; both tables have (3, 1), and differ there."""


def plain_table(gap: int = 2) -> Table:
    """An empty table in the package's style, with so many characters between its columns."""
    return Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, gap - 1, 0, 0))


def add_short_columns(table: Table) -> None:
    """Add the columns of narrow tables, those of :func:`~sb3_flock.evaluation.metrics.columns`."""
    for heading in columns().values():
        table.add_column(heading.replace(" ", "\n"), justify="right", no_wrap=True)


def short_cells(means: Mapping[str, float | None], missing: str = "-") -> list[str]:
    """The cells of these columns: each metric's mean, or ``missing`` where there is none (``None``, NaN)."""
    values = [(means.get(name), METRICS[name]) for name in columns()]
    return [missing if value is None or np.isnan(value) else metric.format(value) for value, metric in values]


def short_summary(means: Mapping[str, float | None]) -> str:
    """These columns as one line, such as ``tracking 0.087, connected 99.20%``."""
    return ", ".join(f"{heading} {cell}" for heading, cell in zip(columns().values(), short_cells(means), strict=True))


def metrics_table(metrics: dict[str, Metric], scenario: Scenario) -> Table:
    """All metrics with their intervals, beside the paper's figures for the same numbers of bodies, if it has any."""
    paper = PAPER.get((scenario.n_vehicles, scenario.n_obstacles), {})
    table = plain_table()
    table.add_column("metric", no_wrap=True)
    for heading in ("mean", "95 % interval", "worst", *(name.replace("Table ", "paper\n") for name in paper)):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, kind in METRICS.items():
        metric = metrics[name]
        cells = [_cell(kind, metric.mean)]
        cells.append(f"{_cell(kind, metric.low).rstrip('%')} .. {_cell(kind, metric.high)}" if metric.n else "")
        cells.append(_cell(kind, metric.worst) if kind.is_minimum and metric.n else "")
        cells += [_cell(kind, row[name]) if name in row else "" for row in paper.values()]
        table.add_row(name.replace("encounter_min_separation", "encounter_min_sep"), *cells)
    return table


def _cell(metric: type[EpisodeMetric], value: float | None) -> str:
    return "-" if value is None else metric.format(value)


def write_json(path: str | Path, metrics: dict[str, Metric], meta: dict[str, Any]) -> None:
    """Write ``{"meta": {...}, "metrics": {name: {"mean", "low", "high", "n", and for the minima "worst"}}}``.

    :raises OSError: if the file cannot be written
    """
    plain = {name: asdict(metric) for name, metric in metrics.items()}
    for name, values in plain.items():
        if not METRICS[name].is_minimum:
            del values["worst"]
    Path(path).write_text(json.dumps({"meta": meta, "metrics": plain}, indent=2) + "\n", encoding="utf-8")
