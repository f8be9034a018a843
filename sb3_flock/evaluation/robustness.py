"""A policy's metrics under sensor errors: noise, missed detections and delay, each alone."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from sb3_flock.evaluation.metrics import Metric, summarize
from sb3_flock.evaluation.report import add_short_columns, plain_table, short_cells
from sb3_flock.evaluation.rollout import as_controller, rollout
from sb3_flock.sim import Scenario
from sb3_flock.sim.sensors import SensorErrors


def sensor_errors(scenario: Scenario) -> dict[str, SensorErrors]:
    """Sensor errors by name, from none to large; noise is a fraction of the link range, delay a number of steps."""
    noise = [round(scenario.link_range * share, 12) for share in (1 / 30, 1 / 15, 2 / 15, 4 / 15)]
    delays = [round(scenario.time_step * steps, 12) for steps in (1, 2, 4, 8)]
    return {
        "none": SensorErrors(),
        **{f"noise of {value:g} m": SensorErrors(position_noise=value) for value in noise},
        **{f"{share:.0%} of detections missed": SensorErrors(dropout=share) for share in (0.1, 0.3, 0.5)},
        **{f"delay of {value:g} s": SensorErrors(delay=value) for value in delays},
    }


def evaluate_with_errors(policy: Any, scenario: Scenario, episodes: int, seed: int = 0) -> dict[str, dict[str, Metric]]:
    """The metrics under each of :func:`sensor_errors`; the parameters are those of :func:`~sb3_flock.evaluation.evaluate`."""
    rows = ((name, scenario.replace(sensors=errors)) for name, errors in sensor_errors(scenario).items())
    return {name: summarize(rollout(as_controller(policy, row), row, episodes, seed)) for name, row in rows}


def cells(row: dict[str, Metric]) -> list[str]:
    """One row's numbers as table cells."""
    return short_cells({name: metric.mean for name, metric in row.items()})


def errors_table(rows: dict[str, dict[str, Metric]]) -> Table:
    """The metrics under each error, one row each."""
    table = plain_table(gap=1)
    table.add_column("sensor errors", no_wrap=True)
    add_short_columns(table)
    for name, row in rows.items():
        table.add_row(name, *cells(row))
    return table
