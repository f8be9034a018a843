"""A policy's metrics with sensor errors and with other dynamics, each alone, and with several at once as in the field."""

from __future__ import annotations

import math
from typing import Any

from rich.table import Table

from sb3_flock.evaluation.metrics import Metric, summarize
from sb3_flock.evaluation.report import add_short_columns, plain_table, short_cells
from sb3_flock.evaluation.rollout import as_controller, rollout
from sb3_flock.sim import Scenario
from sb3_flock.sim.actuators import Actuators
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


def conditions(scenario: Scenario) -> dict[str, Scenario]:
    """The scenario under other conditions, by name: one sensor error or one change of the actuators in each, and in the last
    one several at once, as vehicles meet them outside.

    Lengths are fractions of the scenario's own, times are steps. In the paper's task the lags are 0.1 and 0.3 s, the bounds of
    acceleration 1 and 0.3 m/s^2, and the field conditions 0.01 m of noise, 10 % of detections missed, a delay of 0.1 s, a lag of
    0.1 s and 5 % slip.
    """
    step = scenario.time_step
    hiding, noise, lags = (round(value, 12) for value in (scenario.neighbor_separation / 2, scenario.link_range / 15, step))
    sensors = {
        **sensor_errors(scenario),
        "field of view of 180 deg": SensorErrors(field_of_view=math.pi),
        f"bodies of {hiding:g} m hide": SensorErrors(occlusion=hiding),
        "odometry error of 10%": SensorErrors(odometry_noise=0.1),
    }
    accelerations = [round(scenario.max_speed / (1.5 * step) * share, 12) for share in (1.0, 0.3)]
    actuators = {
        **{f"speed lag of {n * step:g} s": Actuators(speed_lag=round(n * step, 12)) for n in (1, 3)},
        **{f"acceleration of {value:g} m/s^2": Actuators(max_acceleration=value) for value in accelerations},
        "slip of 5%": Actuators(slip=0.05),
    }
    field = {
        "sensors": SensorErrors(position_noise=noise, dropout=0.1, delay=step),
        "actuators": Actuators(speed_lag=lags, slip=0.05),
    }
    exact = {"sensors": SensorErrors(), "actuators": Actuators()}
    return {
        **{name: scenario.replace(**{**exact, "sensors": errors}) for name, errors in sensors.items()},
        **{name: scenario.replace(**{**exact, "actuators": changed}) for name, changed in actuators.items()},
        "field conditions": scenario.replace(**field),
    }


def evaluate_robustness(policy: Any, scenario: Scenario, episodes: int, seed: int = 0) -> dict[str, dict[str, Metric]]:
    """The metrics under each of :func:`conditions`; the parameters are those of :func:`~sb3_flock.evaluation.evaluate`.

    A safety filter guarantees nothing in these rows, but for the first.
    """
    return {
        name: summarize(rollout(as_controller(policy, changed), changed, episodes, seed))
        for name, changed in conditions(scenario).items()
    }


def cells(row: dict[str, Metric]) -> list[str]:
    """One row's numbers as table cells."""
    return short_cells({name: metric.mean for name, metric in row.items()})


def errors_table(rows: dict[str, dict[str, Metric]]) -> Table:
    """The metrics under each condition, one row each."""
    table = plain_table(gap=1)
    table.add_column("conditions", no_wrap=True)
    add_short_columns(table)
    for name, row in rows.items():
        table.add_row(name, *cells(row))
    return table
