import io

import numpy as np
import pytest
from rich.console import Console

from sb3_flock.cli import main
from sb3_flock.config.training import TrainingConfig
from sb3_flock.evaluation import METRICS, EpisodeMetric, register_metric
from sb3_flock.serialization.yaml_io import load_config, to_yaml
from sb3_flock.settings import SettingsError
from sb3_flock.viz.compare import differences_table, load_runs, plot_curves, results_table


def run_folder(folder, scores=(0.5, 0.2, 0.3), **changes):
    """A run folder as a training leaves it, with made-up evaluations."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text(to_yaml(load_config(TrainingConfig, overrides=changes)))
    points = np.arange(len(scores), dtype=float)
    curves = {"timesteps": 10_000 * (1 + points), "seconds": 90.0 * (1 + points), "score": np.array(scores)}
    for place, name in enumerate(
        ("tracking_error", "neighbor_violation_rate", "obstacle_violation_rate", "connectivity"), start=1
    ):
        curves[name] = place / 100 + points / 1000
    np.savez(folder / "evaluations.npz", **curves)
    return folder


@pytest.fixture
def runs(tmp_path):
    first = run_folder(tmp_path / "runs" / "a" / "one", total_timesteps=300_000, lambda_=0.7)
    return [first, run_folder(tmp_path / "runs" / "b", (0.1, 0.4), total_timesteps=300_000, lambda_=0.5)]


def text(table, width=80):
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(table)
    return console.export_text()


def test_each_run_is_shown_at_its_best(runs):
    shown = text(results_table(load_runs(runs))).splitlines()
    assert shown[4].split() == ["a/one", "20k", "300k", "4", "0.011", "3.10%", "2.10%", "4.10%", "-", "-"]
    assert shown[5].split() == ["b", "10k", "300k", "3", "0.010", "3.00%", "2.00%", "4.00%", "-", "-"]
    assert max(map(len, shown)) <= 80


def test_only_what_differs_in_the_configs_is_shown(runs):
    shown = text(differences_table(load_runs(runs))).splitlines()
    assert [line.split() for line in shown if line.strip()][2:] == [["scenario.reward.lambda_", "0.7", "0.5"]]
    assert differences_table(load_runs([runs[0], runs[0]])) is None


def test_the_curves_are_drawn(runs):
    figure = plot_curves(load_runs(runs))
    assert [[len(line.get_xdata()) for line in axes.lines] for axes in figure.axes] == [[3, 2]] * 6
    assert [axes.get_title() for axes in figure.axes[::4]] == ["tracking error [m]", "violation free rate"]
    np.testing.assert_allclose(figure.axes[0].lines[1].get_ydata(), [0.01, 0.011])
    assert np.isnan(figure.axes[4].lines[0].get_ydata()).all()  # of a metric that was registered later


def test_every_metric_of_narrow_tables_has_a_panel(runs, restored):
    restored(METRICS)
    register_metric(type("Gain", (EpisodeMetric,), {"name": "gain", "unit": "m", "column": "gain"}))
    curves = dict(np.load(runs[0] / "evaluations.npz"))
    np.savez(runs[0] / "evaluations.npz", **curves, gain=np.array([-1.0, 0.5, 2.0]))
    *panels, unused = plot_curves(load_runs(runs)).axes
    assert (len(panels), panels[-1].get_title(), unused.axison) == (7, "gain [m]", False)
    assert panels[-1].get_ylim()[0] < -1.0 < 0.0 == panels[0].get_ylim()[0]


def test_the_command(runs, tmp_path, capsys):
    picture = tmp_path / "curves.png"
    assert main(["compare", *map(str, runs), "--output", str(picture)]) == 0
    shown = capsys.readouterr().out
    assert "lambda_" in shown
    assert shown.splitlines()[-1] == str(picture)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(["compare", str(runs[0])]) == 0
    assert "differs" not in capsys.readouterr().out


def test_mistakes_are_one_line(runs, tmp_path, capsys):
    with pytest.raises(SettingsError, match="not a run folder"):
        load_runs([tmp_path])
    (runs[0] / "evaluations.npz").write_bytes(b"PK nothing")
    with pytest.raises(SettingsError, match="damaged"):
        load_runs(runs)
    (runs[0] / "evaluations.npz").unlink()
    with pytest.raises(SettingsError, match="no evaluation yet"):
        load_runs(runs)
    assert main(["compare", str(runs[1]), "--output", "curves.pdf"]) == 2
    message = "sb3-flock: --output curves.pdf: a name that ends in .png, .svg is needed\n"
    assert capsys.readouterr().err == message


def test_hostile_evaluations_are_not_run(runs):
    class Hostile:
        def __reduce__(self):
            return exec, ("raise SystemExit('ran')",)

    arrays = dict.fromkeys(("timesteps", "seconds", "score"), np.array([Hostile()], dtype=object))
    np.savez(runs[0] / "evaluations.npz", **arrays, allow_pickle=True)
    with pytest.raises(SettingsError, match="damaged"):
        load_runs(runs)
