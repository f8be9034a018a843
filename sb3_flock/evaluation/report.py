"""Evaluation results for people (a table beside the paper's figures) and for programs (JSON)."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from sb3_flock.evaluation.metrics import METRICS, MINIMA, Metric
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
"""The figures of Lyu et al. (2018) by (vehicles, obstacles), table and metric; (3, 1) stands in both tables, differently."""

_RATES = ("obstacle_violation_rate", "neighbor_violation_rate", "connectivity", "success_rate")


SHORT_COLUMNS = {
    "tracking_error": ("tracking", "{:.3f}"),
    "neighbor_violation_rate": ("too close", "{:.2%}"),
    "obstacle_violation_rate": ("obstacle", "{:.2%}"),
    "connectivity": ("connected", "{:.1%}"),
}
"""The metrics of a narrow table: heading and format."""


def plain_table() -> Table:
    """An empty table in the style of all of ours."""
    return Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))


def add_short_columns(table: Table) -> None:
    """Columns for :data:`SHORT_COLUMNS`."""
    for heading, _ in SHORT_COLUMNS.values():
        table.add_column(heading, justify="right", no_wrap=True)


def short_cells(means: Mapping[str, float | None], missing: str = "-") -> list[str]:
    """What stands in them: each metric's mean, or ``missing`` where there is none (``None``, NaN)."""
    values = [(means.get(name), pattern) for name, (_, pattern) in SHORT_COLUMNS.items()]
    return [missing if value is None or np.isnan(value) else pattern.format(value) for value, pattern in values]


def metrics_table(metrics: dict[str, Metric], scenario: Scenario) -> Table:
    """All metrics with their intervals, beside the paper's figures where it has some for as many vehicles and obstacles."""
    paper = PAPER.get((scenario.n_vehicles, scenario.n_obstacles), {})
    table = plain_table()
    table.add_column("metric", no_wrap=True)
    for heading in ("mean", "95 % interval", "worst", *(f"paper {name.removeprefix('Table ')}" for name in paper)):
        table.add_column(heading, justify="right", no_wrap=True)
    for name in METRICS:
        metric = metrics[name]
        cells = [_number(name, metric.mean)]
        cells.append(f"{_number(name, metric.low).rstrip('%')} .. {_number(name, metric.high)}" if metric.n else "")
        cells.append(_number(name, metric.worst) if name in MINIMA and metric.n else "")
        cells += [_number(name, row[name]) if name in row else "" for row in paper.values()]
        table.add_row(name.replace("encounter_min_separation", "encounter_min_sep"), *cells)
    return table


def _number(name: str, value: float | None) -> str:
    if value is None:
        return "-"
    if name in _RATES:
        return f"{100 * value:.2f}%"
    return f"{value:.1f}" if name == "return" else f"{value:.3f}"


def write_json(path: str | Path, metrics: dict[str, Metric], meta: dict[str, Any]) -> None:
    """Write ``{"meta": {...}, "metrics": {name: {"mean", "low", "high", "n", and for the minima "worst"}}}``.

    :raises OSError: if the file cannot be written
    """
    plain = {name: asdict(metric) for name, metric in metrics.items()}
    for name, values in plain.items():
        if name not in MINIMA:
            del values["worst"]
    Path(path).write_text(json.dumps({"meta": meta, "metrics": plain}, indent=2) + "\n", encoding="utf-8")
