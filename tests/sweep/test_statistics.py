"""Rankings against values worked out by hand."""

import csv
import io

import numpy as np
import pytest

from sb3_flock.sweep.config import load_sweep
from sb3_flock.sweep.run import Trial
from sb3_flock.sweep.statistics import rank, ranking_csv, ranking_figure, ranking_table
from tests.helpers import quiet


def trials_of(config, values):
    return [
        Trial(str(i), point, "done" if value is not None else "diverged", "", {} if value is None else {**value}, {}, "")
        for i, (point, value) in enumerate(zip(config.points(), values, strict=True))
    ]


def one_metric(name, *numbers):
    return [None if number is None else {name: number} for number in numbers]


@pytest.mark.parametrize(("metric", "best"), [("tracking_error", "gamma 0.9"), ("connectivity", "gamma 0.99")])
def test_less_error_and_more_connectivity_are_better(metric, best):
    config = load_sweep("", text="grid: {gamma: [0.9, 0.99], seed: [0, 1, 2, 3]}")
    values = [0.10, 0.11, 0.12, 0.5, 0.20, 0.21, 0.22, 0.23]
    first, second = rank(config, trials_of(config, one_metric(metric, *values)), metric)
    assert first.name == best
    by_name = {setting.name: setting for setting in (first, second)}
    assert by_name["gamma 0.9"].iqm == pytest.approx(0.115)  # of four runs the best and the worst are left out
    assert by_name["gamma 0.99"].iqm == pytest.approx(0.215)
    assert np.isnan(first.p_best_better)
    wins = {"tracking_error": 12 / 16, "connectivity": 12 / 16}[metric]  # of all pairs of runs
    assert second.p_best_better == pytest.approx(wins)
    for setting in (first, second):
        assert setting.low <= setting.iqm <= setting.high
        assert setting.values.min() <= setting.low
        assert setting.high <= setting.values.max()


def test_lost_runs_are_counted_and_left_out_of_every_task():
    config = load_sweep("", text="grid: {gamma: [0.9], n_vehicles: [3, 5], seed: [0, 1, 2]}\ntasks: [n_vehicles]")
    (setting,) = rank(config, trials_of(config, one_metric("score", 1.0, None, 3.0, 5.0, 6.0, 7.0)), "score")
    np.testing.assert_array_equal(setting.values, [[1.0, 5.0], [3.0, 7.0]])  # (runs, tasks), without seed 1
    assert setting.lost == 1
    assert setting.iqm == pytest.approx(4.0)


def test_a_sweep_without_a_finished_trial_has_no_ranking():
    config = load_sweep("", text="grid: {seed: [0, 1]}")
    assert rank(config, trials_of(config, [None, None]), "score") == []


def test_table_csv_and_figure_hold_every_setting():
    config = load_sweep("", text="grid: {lambda_: [0, 0.5, 1], seed: [0, 1, 2]}")
    settings = rank(config, trials_of(config, one_metric("score", *np.arange(9.0))), "score")
    console = quiet()
    console.print(ranking_table(settings, "score"))
    rows = list(csv.DictReader(io.StringIO(ranking_csv(settings, "score"))))
    figure = ranking_figure(settings, "score")
    names = ["lambda_ 0", "lambda_ 0.5", "lambda_ 1"]
    assert [row["setting"] for row in rows] == names
    assert float(rows[1]["iqm"]) == pytest.approx(4.0)
    assert float(rows[1]["p_best_better"]) == 1.0
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == names
    for name in names:
        assert name in console.file.getvalue()
    profile = figure.axes[1].get_lines()[0]
    assert profile.get_ydata().max() == 1.0
    assert profile.get_ydata().min() == 0.0
