import json
import re

import pytest

from sb3_flock import reproduce as module
from sb3_flock.cli import main
from sb3_flock.controllers import CONTROLLERS
from sb3_flock.evaluation.metrics import METRICS
from sb3_flock.evaluation.model_cards import over_seeds, read_card
from sb3_flock.evaluation.report import PAPER
from sb3_flock.pretrained import shipped_policies
from sb3_flock.reproduce import (
    ANY_SIZE,
    COLUMNS,
    CROSSING,
    CURVES,
    EXPERIMENTS,
    FILTERS,
    FLOCK_SIZES,
    ROWS,
    SHOWN,
    TASKS,
    Size,
    densest_tracking,
)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The folder that the command writes, with very few episodes."""
    folder = tmp_path_factory.mktemp("results")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "QUICK", Size(episodes=2, flock_size_episodes=1, timed_steps=2))
        assert main(["reproduce", "--quick", "--out", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def tables(results):
    """The cells of every row by the heading of its section, without the headings' rows."""
    found = {}
    for section in (results / "results.md").read_text().split("\n## ")[1:]:
        title, *lines = section.splitlines()
        rows = [line for line in lines if line.startswith("| ") and not line.startswith("| |")]
        found[title] = [[cell.strip() for cell in row.removeprefix("|").removesuffix("|").split("|")] for row in rows]
    return found


def test_every_figure_is_written_and_linked(results):
    page = (results / "results.md").read_text()
    for stem in ("trajectories", "observation", "training", "flock_sizes", "training_time"):
        assert f"({stem}.png)" in page
        assert (results / f"{stem}.png").stat().st_size > 10_000
        assert (results / f"{stem}.svg").stat().st_size > 5_000


def test_the_rows_name_what_is_shipped_and_every_shipped_policy_has_its_own():
    assert all(set(rows.tasks) <= set(TASKS) and rows.filters for rows in ROWS)
    names = {rows.name for rows in ROWS} | {SHOWN, ANY_SIZE, *CURVES}
    assert names - set(CONTROLLERS) == set(shipped_policies())
    assert {"orca", "olfati-saber"} <= {rows.name for rows in ROWS if rows.tasks == tuple(TASKS)}


def test_every_controller_is_in_every_table_of_its_tasks_with_each_filter(results, tables):
    page = (results / "results.md").read_text()
    experiments, crossing = tables["Tables I and II"], tables["A hard test: obstacles that cross the flock"]
    for rows in ROWS:
        for section, of_section in ((experiments, EXPERIMENTS), (crossing, CROSSING)):
            shown = [row[1] for row in section if row[0].startswith(f"`{rows.name}`") and "median" not in row[0]]
            assert shown == [f"`{name}`" for task in rows.tasks if task in of_section for name in rows.filters]
    for scenario in EXPERIMENTS.values():
        assert f"{scenario.bodies}:\n\n| | filter | tracking error | " in page
        for table, figures in PAPER[scenario.n_vehicles, scenario.n_obstacles].items():
            assert [f"paper, {table}", "", f"{figures['tracking_error']:.3f}"] in [row[:3] for row in experiments]
    assert "`--obstacle-motion crossing`" in page
    assert page.count("The filter `announce` needs communication") == len(TASKS) + 1  # and one policy with many vehicles


def test_each_shipped_policy_has_the_median_and_the_range_of_its_trainings_in_every_table(tables):
    for title, tasks in (("Tables I and II", EXPERIMENTS), ("A hard test: obstacles that cross the flock", CROSSING)):
        medians = [row for row in tables[title] if "median" in row[0]]
        expected = [
            (task, rows) for task in tasks for rows in ROWS if task in rows.tasks and rows.name in shipped_policies()
        ]
        assert expected
        for (task, rows), (label, safety_filter, *cells) in zip(expected, medians, strict=True):
            card = read_card(rows.name)
            assert label.startswith(f"`{rows.name}` ({rows.note}), median (range) of {len(card['seeds'])} trainings")
            assert label.endswith(", from the model card")
            assert safety_filter == f"`{card['config']['scenario']['safety_filter']}`"
            over = over_seeds(card, task)
            for cell, name in zip(cells, COLUMNS.values(), strict=True):
                metric = over.get(name)
                if metric is None:
                    assert cell == ""
                    continue
                factor = 100 if METRICS[name].is_rate else 1
                shown = [
                    float(number) for number in re.fullmatch(r"([\d.]+)(?: %)? \(([\d.]+) to ([\d.]+)\)", cell).groups()
                ]
                assert shown == pytest.approx([factor * metric.mean, factor * metric.low, factor * metric.high], abs=0.051)


def test_free_and_success_have_their_intervals(tables):
    for title, rows in tables.items():
        if title in {"Sensor errors and other dynamics", "Time of training"}:
            continue
        for label, _, *cells in rows:
            assert len(cells) == len(COLUMNS)
            if "median" in label:
                continue  # all cells have a range
            if "paper, Table" in label:
                assert "(" not in "".join(cells)
            else:
                assert all(re.fullmatch(r"[\d.]+ % \([\d.]+ to [\d.]+\)", cell) for cell in cells[-2:]), label


def test_with_the_filter_no_separation_to_neighbors_is_violated(tables):
    violations = list(COLUMNS).index("neighbor violations") + 2
    filtered = [row for rows in tables.values() for row in rows if row[1] == "`announce`"]
    assert len(filtered) > 20
    cells = {row[violations] for row in filtered}
    assert cells <= {"0.00 %", "0.00 % (0.00 to 0.00)", ""}  # "": a single vehicle


def test_flock_sizes_and_sensor_errors_have_a_row_each(tables):
    sizes = [row[:2] for row in tables["One policy, any number of vehicles"]]
    assert sizes == [[f"{n} vehicle{'s' * (n > 1)}", f"`{name}`"] for n in FLOCK_SIZES for name in FILTERS]
    errors = [row[0] for row in tables["Sensor errors and other dynamics"]]
    assert sum(name.startswith(("noise of ", "delay of ")) for name in errors) == 8


def test_the_tables_are_written_as_json(results):
    tables = json.loads((results / "tables.json").read_text())
    assert set(tables) == set(TASKS)
    for task, table in tables.items():
        assert list(table) == [rows.name for rows in ROWS if task in rows.tasks]
        for rows in ROWS:
            for metrics in table.get(rows.name, {}).values():
                assert set(metrics) >= set(COLUMNS.values())
        assert list(table["orca"]) == list(FILTERS)
        assert table["go-to-waypoint"]["off"]["tracking_error"]["mean"] < 0.01


def test_a_folder_that_cannot_be_created_is_an_error_of_one_line(capsys, tmp_path):
    (tmp_path / "file").touch()
    assert main(["reproduce", "--output", str(tmp_path / "file" / "x")]) == 2
    errors = capsys.readouterr().err
    assert f"--output {tmp_path / 'file' / 'x'}: " in errors
    assert errors.count("\n") == 1


@pytest.mark.parametrize(
    ("n", "optimum"), [(1, 0.0), (2, 0.05), (3, 0.0577), (4, 0.0683), (5, 0.078), (7, 0.0857), (12, 0.1197)]
)
def test_the_tracking_error_of_the_densest_flocks_is_nearly_optimal(n, optimum):
    assert optimum - 1e-4 <= densest_tracking(n) <= 1.03 * optimum + 1e-4
