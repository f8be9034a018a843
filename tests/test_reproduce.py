import json

import pytest

from sb3_flock import reproduce as module
from sb3_flock.cli import main
from sb3_flock.evaluation.report import PAPER
from sb3_flock.reproduce import COLUMNS, FLEETS, OURS, SETTINGS, Size, densest_tracking


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Everything made by the command itself, with as few episodes as can be."""
    folder = tmp_path_factory.mktemp("results")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "QUICK", Size(episodes=2, fleet_episodes=1, timed_steps=2))
        assert main(["reproduce", "--quick", "--out", str(folder)]) == 0
    return folder


def test_every_table_and_figure_is_written_and_linked(results):
    page = (results / "results.md").read_text()
    for stem in ("trajectories", "observation", "training", "fleets", "training_time"):
        assert f"({stem}.png)" in page
        assert (results / f"{stem}.png").stat().st_size > 10_000
        assert (results / f"{stem}.svg").stat().st_size > 5_000
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    for name, scenario in SETTINGS.items():
        assert f"{scenario.bodies} (`{name}` and `second-look-" in page
        for figures in PAPER[scenario.n_vehicles, scenario.n_obstacles].values():
            assert any(f"{figures['tracking_error']:.3f}" in row and "paper" in row for row in rows)
    for label in (
        "`random`",
        "`go-to-waypoint`",
        "`olfati-saber`",
        "`orca`",
        *(f"{ours}, the shipped one, flown now" for ours in OURS),
    ):
        assert sum(row.startswith(f"| {label} |") for row in rows) == len(SETTINGS) + 1  # and the crossing obstacles
    assert sum(row.startswith("| ours, trained for it, the shipped one, flown now |") for row in rows) == 1
    assert sum(", on record |" in row for row in rows) == len(SETTINGS) * len(OURS)
    assert sum(row.startswith(("| noise of ", "| delay of ")) for row in rows) == 8
    assert sum(row.split(" | ")[0] in {f"| {n} vehicle{'s' * (n > 1)}" for n in FLEETS} for row in rows) == len(FLEETS)


def test_the_tables_are_there_for_programs_too(results):
    tables = json.loads((results / "tables.json").read_text())
    assert set(tables) == set(SETTINGS)
    for rows in tables.values():
        assert all(set(rows[ours]) >= set(COLUMNS.values()) for ours in OURS)
        assert rows["go-to-waypoint"]["tracking_error"]["mean"] < 0.01


def test_a_folder_that_cannot_be_is_told_in_one_line(capsys, tmp_path):
    (tmp_path / "file").touch()
    assert main(["reproduce", "--out", str(tmp_path / "file" / "x")]) == 2
    assert capsys.readouterr().err.startswith("sb3-flock: --out ")


@pytest.mark.parametrize(
    ("n", "optimum"), [(1, 0.0), (2, 0.05), (3, 0.0577), (4, 0.0683), (5, 0.078), (7, 0.0857), (12, 0.1197)]
)
def test_the_densest_flocks_are_about_the_best_possible(n, optimum):
    assert optimum - 1e-4 <= densest_tracking(n) <= 1.03 * optimum + 1e-4
