"""Rankings against values worked out by hand."""

import csv
import io

import numpy as np
import pytest

from sb3_flock.sweep.config import load_sweep
from sb3_flock.sweep.run import Trial
from sb3_flock.sweep.statistics import rank, ranking_csv, ranking_figure, ranking_table, report
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
    assert [setting.name for setting in rank(config, trials_of(config, one_metric("score", 1.0, 2.0)), "score")] == ["all"]


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
    shown = [line.split() for line in console.file.getvalue().splitlines() if "lambda_" in line]
    for row, cells in zip(rows, shown, strict=True):  # the middle one of three runs is the interquartile mean
        assert cells[:4] == ["lambda_", row["setting"].split()[1], "3", "0"]
        assert [float(cells[place]) for place in (4, 5, 7)] == pytest.approx(
            [float(row[name]) for name in ("iqm", "low", "high")], abs=5e-4
        )
    assert [len(cells) for cells in shown] == [8, 12, 12]
    assert shown[1][8:] == ["1.00", "(1.00", "..", "1.00)"]
    for row, setting in enumerate(settings):
        interval, runs, mean = figure.axes[0].get_lines()[3 * row : 3 * row + 3]
        assert list(interval.get_xdata()) == [setting.low, setting.high]
        assert sorted(runs.get_xdata()) == sorted(setting.values.ravel())
        assert list(mean.get_xdata()) == [setting.iqm]
        assert (interval.get_marker(), runs.get_marker(), mean.get_marker()) == ("None", "|", "o")
        for line in (interval, runs, mean):
            assert set(line.get_ydata()) == {row}
    profile = figure.axes[1].get_lines()[0]
    assert profile.get_ydata().max() == 1.0
    assert profile.get_ydata().min() == 0.0
    assert (profile.get_xdata().min(), profile.get_xdata().max()) == pytest.approx((-0.4, 8.4))  # 5 % beyond the runs
    band = figure.axes[1].collections[0].get_paths()[0].vertices
    assert (band[:, 0].min(), band[:, 0].max()) == pytest.approx((-0.4, 8.4))
    assert (band[:, 1].min(), band[:, 1].max()) == (0.0, 1.0)
    assert figure.axes[1].get_ylim() == pytest.approx((-0.02, 1.02))
    assert "IQM score" in console.file.getvalue()
    below = dict(zip(profile.get_xdata(), profile.get_ydata(), strict=True))
    assert all(share == 0 for x, share in below.items() if x < 0)  # the first setting's runs have the scores 0, 1 and 2
    assert all(share == 1 for x, share in below.items() if x > 2)
    assert all(share == pytest.approx(1 / 3) for x, share in below.items() if 0.1 < x < 0.9)


def test_a_grid_of_trainings_is_reported_by_its_ranking_and_three_files(tmp_path):
    config = load_sweep("", text="grid: {gamma: [0.9, 0.99], seed: [0, 1]}")
    (table,) = report(config, trials_of(config, one_metric("score", 4.0, 3.0, 2.0, 1.0)), str(tmp_path))
    assert table.columns[0].header == "setting"
    assert {path.name for path in tmp_path.iterdir()} == {"ranking.csv", "ranking.png", "ranking.svg"}
    rows = csv.DictReader(io.StringIO((tmp_path / "ranking.csv").read_text()))
    assert [(row["metric"], row["setting"]) for row in rows] == [("score", name) for name in ("gamma 0.99", "gamma 0.9")]
    assert (tmp_path / "ranking.png").read_bytes().startswith(b"\x89PNG")
    assert b"</svg>" in (tmp_path / "ranking.svg").read_bytes()
    assert report(config, trials_of(config, [None] * 4), str(tmp_path / "none")) == []


def test_a_search_is_reported_by_its_ten_best_trials(tmp_path):
    config = load_sweep("", text="search: {reward.lambda_: {low: 0, high: 1}}\ntrials: 13")
    scores = [5.0, 2.0, 9.0, 1.0, 3.0, 4.0, 6.0, 7.0, 8.0, 10.0, 11.0, 12.0]
    done = [
        Trial(str(i), {"scenario.reward.lambda_": score / 100}, "done", "", {"tracking_error": score}, {"score": score}, "")
        for i, score in enumerate(scores)
    ]
    lost = Trial("lost", {"scenario.reward.lambda_": 0.5}, "failed", "killed", {}, {}, "")
    (table,) = report(config, [lost, *done], str(tmp_path))
    assert table.columns[0].header == "lambda_"
    assert list(table.columns[0].cells) == [f"{score / 100:g}" for score in sorted(scores)[:10]]
    assert not list(tmp_path.iterdir())
