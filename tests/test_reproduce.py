import json

import pytest

from sb3_flock import reproduce as module
from sb3_flock.cli import main
from sb3_flock.evaluation.report import PAPER
from sb3_flock.reproduce import COLUMNS, FLOCK_SIZES, KINDS, SETTINGS, TRAINED, Size, densest_tracking


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """The folder that the command writes, with very few episodes."""
    folder = tmp_path_factory.mktemp("results")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "QUICK", Size(episodes=2, flock_size_episodes=1, timed_steps=2))
        assert main(["reproduce", "--quick", "--out", str(folder)]) == 0
    return folder


def test_every_table_and_figure_is_written_and_linked(results):
    page = (results / "results.md").read_text()
    for stem in ("trajectories", "observation", "training", "flock_sizes", "training_time"):
        assert f"({stem}.png)" in page
        assert (results / f"{stem}.png").stat().st_size > 10_000
        assert (results / f"{stem}.svg").stat().st_size > 5_000
    rows = [line for line in page.splitlines() if line.startswith("| ")]
    for name, scenario in SETTINGS.items():
        assert f"{scenario.bodies} (`{name}` and `{name.replace('ddpg', 'ddpg-bc')}`)" in page
        for figures in PAPER[scenario.n_vehicles, scenario.n_obstacles].values():
            assert any(f"{figures['tracking_error']:.3f}" in row and "paper" in row for row in rows)
    for label in (
        "`random`",
        "`go-to-waypoint`",
        "`olfati-saber`",
        "`orca`",
        *(f"{kind}, the shipped policy" for kind in KINDS),
    ):
        assert sum(row.startswith(f"| {label} |") for row in rows) == len(SETTINGS) + 1  # and the crossing obstacles
    assert sum(row.startswith(f"| {TRAINED}, the shipped policy |") for row in rows) == 1
    assert sum(", median of 3 trainings, from the model card |" in row for row in rows) == len(SETTINGS) * len(KINDS)
    assert "`--obstacle-motion crossing`" in page
    assert sum(row.startswith(("| noise of ", "| delay of ")) for row in rows) == 8
    assert sum(row.split(" | ")[0] in {f"| {n} vehicle{'s' * (n > 1)}" for n in FLOCK_SIZES} for row in rows) == len(
        FLOCK_SIZES
    )


def test_the_tables_are_written_as_json(results):
    tables = json.loads((results / "tables.json").read_text())
    assert set(tables) == set(SETTINGS)
    for rows in tables.values():
        assert all(set(rows[kind]) >= set(COLUMNS.values()) for kind in KINDS)
        assert rows["go-to-waypoint"]["tracking_error"]["mean"] < 0.01


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
