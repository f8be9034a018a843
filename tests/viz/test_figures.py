import sys

import numpy as np
import pytest

from sb3_flock import Scenario
from sb3_flock.controllers import make_controller
from sb3_flock.evaluation import rollout
from sb3_flock.settings import SettingsError
from sb3_flock.viz.figures import (
    check_figure_file,
    check_matplotlib,
    plot_lines,
    plot_observation,
    plot_side_by_side,
    plot_trajectories,
    record_trajectory,
    save,
)

SCENARIO = Scenario(n_vehicles=3, n_obstacles=2, max_cycles=50)


@pytest.fixture(scope="module")
def trajectory():
    return record_trajectory(make_controller("olfati-saber"), SCENARIO, seed=3, episode=2)


def test_a_trajectory_is_the_episode_of_that_number(trajectory):
    assert trajectory.positions.shape == (51, 3, 2)
    assert trajectory.obstacles.shape == (51, 2, 2)
    distances = np.linalg.norm(trajectory.positions - trajectory.waypoints[:, None], axis=-1)
    values = rollout(make_controller("olfati-saber"), SCENARIO, episodes=3, seed=3)
    assert distances[26:].mean() == pytest.approx(values["tracking_error"][2])


def test_every_body_is_drawn_along_its_whole_path(trajectory):
    axes = plot_trajectories(trajectory).axes[0]
    paths = [line.get_xydata() for line in axes.get_lines() if len(line.get_xydata()) == 51]
    bodies = [*np.moveaxis(trajectory.positions, 1, 0), *np.moveaxis(trajectory.obstacles, 1, 0), trajectory.waypoints]
    assert len(paths) == len(bodies)
    for path, body in zip(paths, bodies, strict=True):
        np.testing.assert_array_equal(path, body)
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["vehicles", "obstacles", "waypoint"]


def test_the_observation_figure_shows_the_channel_of_the_neighbors_beside_them():
    figure = plot_observation(Scenario(), n_neighbors=10, seed=1)
    left, right = figure.axes[:2]
    neighbors = next(line.get_xydata() for line in left.get_lines() if line.get_label() == "neighbors")
    assert (np.linalg.norm(neighbors, axis=1) < Scenario().link_range).all()
    channel = right.get_images()[0].get_array()
    anchors = np.linspace(-0.15, 0.15, 11)
    grid = np.stack(np.meshgrid(anchors, anchors), axis=-1)  # rows along y (left), columns along x (forward), as drawn
    expected = np.exp(-0.5 * np.square(np.linalg.norm(grid[:, :, None] - neighbors, axis=-1) / 0.03)).sum(-1)
    np.testing.assert_allclose(channel, expected, atol=1e-5)


def test_curves_show_the_median_and_all_seeds():
    rows = np.array([[1.0, 2.0], [5.0, 0.0], [3.0, 9.0]])
    axes = plot_lines({"a": ([1, 10], rows)}, "x", "y", levels={"paper": 2.5}).axes[0]
    np.testing.assert_array_equal(axes.get_lines()[0].get_ydata(), [3.0, 2.0])
    shade = axes.collections[0].get_paths()[0].vertices
    assert (shade[:, 1].min(), shade[:, 1].max()) == (0.0, 9.0)


def test_pictures_are_written_twice_the_same(trajectory, tmp_path):
    for stem in ("a", "b"):
        save(plot_trajectories(trajectory), tmp_path / stem)
    for kind in ("png", "svg"):
        first, second = ((tmp_path / f"{stem}.{kind}").read_bytes() for stem in "ab")
        assert first == second
        assert len(first) > 5000


def test_without_matplotlib_one_line_names_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(SettingsError, match=r"pip install 'sb3_flock\[figures\]'"):
        check_matplotlib()


def test_several_trajectories_are_side_by_side_on_one_scale(trajectory):
    panels = plot_side_by_side({"ours": trajectory, "paper": trajectory}).axes
    assert [axes.get_title() for axes in panels] == ["ours", "paper"]
    assert panels[0].get_xlim() == panels[1].get_xlim()
    assert panels[0].get_ylim() == panels[1].get_ylim()


@pytest.mark.parametrize(("name", "message"), [("a.pdf", "ends in .png, .svg"), ("none/a.png", "there is no folder")])
def test_a_figures_file_is_checked_before_the_work(tmp_path, name, message):
    with pytest.raises(SettingsError, match=message):
        check_figure_file(tmp_path / name)
    check_figure_file(tmp_path / "a.svg")


def test_a_logarithmic_axis_has_plain_numbers():
    figure = plot_lines({"a": ([1, 2], np.array([[0.1, 0.9]]))}, "steps", "error", log_y=True)
    (axes,) = figure.axes
    assert axes.get_yscale() == "log"
    figure.canvas.draw()
    shown = {label.get_text() for label in (*axes.get_yticklabels(), *axes.get_yticklabels(minor=True))}
    assert "0.1" in shown
    assert not any("$" in text for text in shown)
