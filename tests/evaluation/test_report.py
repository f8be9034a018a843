import io
import json

import numpy as np
from rich.console import Console

from sb3_flock import Scenario
from sb3_flock.evaluation import METRICS, summarize
from sb3_flock.evaluation.report import PAPER, metrics_table, write_json

VALUES = summarize({name: np.array([0.1, 0.2, np.nan]) for name in METRICS})


def text(scenario, width=80):
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(metrics_table(VALUES, scenario))
    return console.export_text()


def test_the_papers_figures_are_beside_ours_with_both_tables_for_3_vehicles_and_1_obstacle():
    both = text(Scenario(n_vehicles=3, n_obstacles=1))
    headings = [line.split() for line in both.splitlines()[:4]]
    assert ["paper", "paper"] in headings
    assert [words[-2:] for words in headings if "metric" in words] == [["I", "II"]]
    for value in ("0.080", "0.125", "0.138", "0.158", "0.094", "0.102", "0.185", "0.187"):
        assert value in both
    assert "0.147" in text(Scenario(n_vehicles=5, n_obstacles=2))
    assert "paper" not in text(Scenario(n_vehicles=4))


def test_the_table_fits_80_columns_and_names_every_metric():
    shown = text(Scenario())
    assert max(map(len, shown.splitlines())) <= 80
    for name in METRICS:
        assert name.replace("min_separation_obs", "min_sep_obs" if "encounter" in name else "min_separation_obs") in shown
    assert "…" not in shown


def test_the_widest_values_fit_80_columns_too():
    values = {name: np.full(50, 1.0) for name in METRICS} | {"connectivity": np.linspace(0.995, 1, 50)}
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(metrics_table(summarize(values), Scenario(n_vehicles=3, n_obstacles=1)))
    shown = console.export_text()
    assert ["success_rate", "100.00%", "92.87", "..", "100.00%"] in [line.split() for line in shown.splitlines()]
    assert "…" not in shown
    assert max(map(len, shown.splitlines())) <= 80


def test_the_papers_setups_are_the_experiments():
    assert set(PAPER) == {(3, 1), (5, 1), (5, 2)}
    assert set(PAPER[3, 1]) == {"Table I", "Table II"}


def test_the_json_has_the_agreed_form(tmp_path):
    write_json(tmp_path / "out.json", summarize({**{name: np.array([np.nan]) for name in METRICS}}), {"seed": 3})
    written = json.loads((tmp_path / "out.json").read_text())
    assert written["meta"] == {"seed": 3}
    assert written["metrics"]["return"] == {"mean": None, "low": None, "high": None, "n": 0}
    assert set(written["metrics"]["min_separation_neighbors"]) == {"mean", "low", "high", "n", "worst"}
    assert set(written["metrics"]) == set(METRICS)
