"""The paper's figures, drawn by matplotlib (the ``figures`` extra), readable in greyscale: line styles and markers differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sb3_flock.evaluation.rollout import iter_rollout
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario, World, episode_rng, observe

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LINE_STYLES = ("-", "--", "-.", ":")
_MARKERS = "osD^vP*X"
FIGURES = (".png", ".svg")
"""File name endings of figures."""
_VEHICLE, _OBSTACLE, _WAYPOINT = "#1b7837", "#c51b7d", "black"
"""Green vehicles, pink obstacles, a black waypoint, as in the paper; dark, middle and black in greyscale."""


@dataclass(frozen=True)
class Trajectory:
    """The positions of one episode; every array starts with the initial state, so it has one row more than steps."""

    scenario: Scenario
    positions: NDArray[np.float64]
    """``(steps + 1, vehicles, 2)`` [m]."""
    obstacles: NDArray[np.float64]
    """``(steps + 1, obstacles, 2)`` [m]."""
    waypoints: NDArray[np.float64]
    """``(steps + 1, 2)`` [m]."""


class TrajectoryRecorder:
    """Keeps the positions of a world's first flock, each time that it is called with the world.

    :param scenario: the task
    """

    def __init__(self, scenario: Scenario) -> None:
        self.scenario = scenario
        self._seen: list[tuple[NDArray[np.float64], ...]] = []

    def __call__(self, world: World) -> None:
        self._seen.append((world.positions[0], world.obstacle_positions[0], world.waypoints[0]))

    def trajectory(self) -> Trajectory:
        """What was seen so far."""
        return Trajectory(self.scenario, *(np.stack(parts) for parts in zip(*self._seen, strict=True)))


def record_trajectory(policy: Any, scenario: Scenario, seed: int = 0, episode: int = 0) -> Trajectory:
    """Simulate one episode and keep every position; the parameters are those of
    :func:`~sb3_flock.evaluation.rollout.iter_rollout`.
    """
    recorder = TrajectoryRecorder(scenario)
    for world in iter_rollout(policy, scenario, seed, episode):
        recorder(world)
    return recorder.trajectory()


def new_figure(width: float = 5.0, height: float = 4.0, columns: int = 1, rows: int = 1) -> tuple[Figure, Any]:
    """A figure and its axes; needs no display.

    :raises SettingsError: if matplotlib is not installed
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise SettingsError("figures need matplotlib: pip install 'sb3_flock[figures]'") from None
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns)


def save(figure: Figure, stem: str | Path) -> None:
    """Write ``<stem>.png`` and ``<stem>.svg``, the same bytes each time."""
    for kind in ("png", "svg"):
        save_as(figure, Path(f"{stem}.{kind}"), kind)


def save_as(figure: Figure, path: str | Path | BinaryIO, kind: str) -> None:
    """Write a ``"png"`` or an ``"svg"``, whatever the file's name."""
    import matplotlib as mpl

    metadata: dict[str, Any] = {"Software": None} if kind == "png" else {"Date": None, "Creator": None}
    with mpl.rc_context({"svg.hashsalt": "sb3_flock"}):
        figure.savefig(path, format=kind, dpi=150, metadata=metadata)


def plot_trajectories(trajectory: Trajectory) -> Figure:
    """Paths of vehicles, obstacles and waypoint over one episode: circles at the starts, filled shapes at the ends."""
    figure, axes = new_figure(5.4, 5.0)
    _draw_trajectory(axes, trajectory)
    return figure


def plot_side_by_side(by_name: Mapping[str, Trajectory]) -> Figure:
    """Several trajectories side by side, on one scale."""
    figure, axes = new_figure(0.4 + 5.0 * len(by_name), 5.0, columns=len(by_name))
    panels = np.atleast_1d(axes)
    for panel, (name, trajectory) in zip(panels, by_name.items(), strict=True):
        _draw_trajectory(panel, trajectory)
        panel.set_title(name)
        panel.sharex(panels[0])
        panel.sharey(panels[0])
    return figure


def _draw_trajectory(axes: Axes, trajectory: Trajectory) -> None:
    scenario = trajectory.scenario
    groups = (
        ("vehicles", np.moveaxis(trajectory.positions, 1, 0), _VEHICLE, "-", "^"),
        ("obstacles", np.moveaxis(trajectory.obstacles, 1, 0), _OBSTACLE, "--", "s"),
        ("waypoint", trajectory.waypoints[None], _WAYPOINT, ":", "*"),
    )
    for label, paths, color, style, marker in groups:
        for i, path in enumerate(paths):
            axes.plot(*path.T, color=color, linestyle=style, linewidth=1.2, label=label if i == 0 else None)
            axes.plot(*path[0], marker="o", markersize=5, markerfacecolor="white", color=color)
            axes.plot(*path[-1], marker=marker, markersize=7, color=color)
    for center in trajectory.obstacles[-1]:
        _circle(axes, center, scenario.obstacle_separation, _OBSTACLE)
    for center in trajectory.positions[-1]:
        _circle(axes, center, scenario.neighbor_separation / 2, _VEHICLE)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    axes.margins(0.08)
    axes.grid(alpha=0.3)
    axes.legend(loc="best", fontsize=8)


def _circle(axes: Axes, center: NDArray[np.float64], radius: float, color: str) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle(tuple(center), radius, fill=False, color=color, linewidth=0.8, alpha=0.7))


def plot_observation(scenario: Scenario, n_neighbors: int = 10, seed: int = 0) -> Figure:
    """Neighbors in a vehicle's body frame beside its neighbor channel (the paper's observation figure)."""
    scenario = scenario.replace(n_vehicles=n_neighbors + 1, n_obstacles=0)
    world = World(scenario)
    world.reset([episode_rng(seed, 0)])
    rng, reach = np.random.default_rng(seed), scenario.link_range
    angles, distances = rng.uniform(-np.pi, np.pi, n_neighbors), reach * np.sqrt(rng.uniform(0.05, 0.98, n_neighbors))
    offsets = distances[:, None] * np.stack((np.cos(angles), np.sin(angles)), axis=-1)
    world.positions = np.concatenate((np.zeros((1, 2)), offsets))[None]
    world.headings = np.zeros((1, n_neighbors + 1))
    channel = observe(world.sense(), scenario)[0, 0, 0]

    figure, (left, right) = new_figure(8.0, 3.8, columns=2)
    radius = scenario.channel_radii[0]
    anchors = np.linspace(-radius, radius, scenario.n_anchors)
    left.plot(*(axis.ravel() for axis in np.meshgrid(anchors, anchors)), ".", color="0.7", markersize=2, label="anchors")
    left.plot(*offsets.T, "^", color=_VEHICLE, label="neighbors")
    left.plot(0, 0, marker=">", color="black", markersize=9, linestyle="none", label="vehicle, heading +x")
    _circle(left, np.zeros(2), reach, "black")
    left.set(xlabel="forward [m]", ylabel="left [m]", aspect="equal", title="neighbors in the body frame")
    figure.legend(loc="outside lower left", ncols=3, fontsize=8)
    half = anchors[1] - anchors[0]
    extent = (-radius - half / 2, radius + half / 2) * 2
    image = right.imshow(channel.T, origin="lower", extent=extent, cmap="Greys")
    right.set(
        xlabel="forward [m]", ylabel="left [m]", title=f"neighbor channel, {scenario.n_anchors} x {scenario.n_anchors}"
    )
    figure.colorbar(image, ax=right)
    return figure


def plot_lines(
    series: Mapping[str, tuple[Sequence[float] | NDArray[np.float64], NDArray[np.float64]]],
    xlabel: str,
    ylabel: str,
    log_x: bool = False,
    log_y: bool = False,
    levels: Mapping[str, float] | None = None,
) -> Figure:
    """Curves with their spread over the rows (seeds): the median as a line, all rows within the shade.

    :param series: label to x, ``(points,)``, and y, ``(rows, points)``
    :param log_x: logarithmic, with a tick at each point
    :param log_y: logarithmic
    :param levels: horizontal lines by label
    """
    figure, axes = new_figure(6.0, 4.0)
    for (label, (x, y)), style, marker in zip(series.items(), cycle(LINE_STYLES), cycle(_MARKERS), strict=False):
        rows = np.atleast_2d(y)
        (line,) = axes.plot(x, np.median(rows, axis=0), style, marker=marker, markersize=4, label=label)
        if len(rows) > 1:
            axes.fill_between(x, rows.min(0), rows.max(0), color=line.get_color(), alpha=0.2, linewidth=0)
    for (label, level), style in zip((levels or {}).items(), cycle(LINE_STYLES[::-1]), strict=False):
        axes.axhline(level, color="0.4", linestyle=style, linewidth=1, label=label)
    if log_x:
        axes.set_xscale("log")
        points = sorted({float(value) for x, _ in series.values() for value in x})
        axes.set_xticks(points, [f"{value:g}" for value in points])
        axes.set_xticks([], minor=True)
    if log_y:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}")
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def check_matplotlib() -> None:
    """Check for matplotlib before the work.

    :raises SettingsError: if it is not installed
    """
    new_figure()


def check_figure_file(path: Path, kinds: Sequence[str] = FIGURES) -> None:
    """Check a file's name before the work.

    :raises SettingsError: for another kind of file, a folder that is not there or, for a figure, a missing matplotlib
    """
    if path.suffix not in kinds:
        raise SettingsError(f"{path}: a name that ends in {', '.join(kinds)} is needed")
    if not path.absolute().parent.is_dir():
        raise SettingsError(f"{path}: there is no folder {path.parent}")
    if path.suffix in FIGURES:
        check_matplotlib()
