"""The paper's tables and figures beside the results of this package, in one folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from sb3_flock.config.training import TrainingConfig
from sb3_flock.console import PlainConsole
from sb3_flock.controllers import CONTROLLERS, Controller, make_controller
from sb3_flock.envs.vec_env import make_vec_env
from sb3_flock.evaluation import robustness
from sb3_flock.evaluation.metrics import METRICS, EpisodeMetric, Metric, columns
from sb3_flock.evaluation.model_cards import over_seeds, read_card
from sb3_flock.evaluation.report import PAPER
from sb3_flock.evaluation.robustness import evaluate_robustness
from sb3_flock.evaluation.rollout import evaluate
from sb3_flock.evaluation.tasks import CROSSING, EXPERIMENTS, TASKS, with_bodies_of
from sb3_flock.rl.callbacks import NeighborInclusiveReward
from sb3_flock.rl.registry import build_model
from sb3_flock.serialization.load import LoadedPolicy, load_policy
from sb3_flock.serialization.save import versions
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario
from sb3_flock.viz.figures import check_matplotlib, plot_lines, plot_observation, plot_trajectories, record_trajectory, save

FILTERS = ("off", "announce")
"""The safety filters with which each controller is evaluated, a row each."""


@dataclass(frozen=True)
class Rows:
    """A shipped policy or a baseline controller in the tables, with each of the filters."""

    name: str
    note: str = ""
    """What stands behind its name."""
    tasks: tuple[str, ...] = tuple(TASKS)
    """The tables it is in."""
    filters: tuple[str, ...] = FILTERS


ROWS = (
    Rows("paper-plain", "the paper's method without any addition"),
    Rows("ddpg", "reinforcement learning alone"),
    Rows("flock", "motion channels, imitation of an expert"),
    Rows("olfati-saber"),
    Rows("orca"),
    Rows("random", filters=("off",)),
    Rows("go-to-waypoint", filters=("off",)),
)
"""The rows of the tables: each name is a shipped policy's or a controller's."""

SHOWN = "flock"
"""The policy of the figures of one episode and of the sensor errors."""

ANY_SIZE = "flock"
"""The policy that is evaluated with many flock sizes."""

CURVES = ("paper-plain", "ddpg", "flock")
"""The policies whose training curves are drawn."""

FLOCK_SIZES = (1, 2, 3, 5, 8, 12, 20, 50, 200)
"""Numbers of vehicles with which :data:`ANY_SIZE` is evaluated."""

_MOST_IN_THE_ARENA = 50
"""Number of vehicles that start in the paper's arena and leave room for obstacles."""

COLUMNS = {
    "tracking error": "tracking_error",
    "min. sep. obstacles": "min_separation_obstacles",
    "... in encounters": "encounter_min_separation_obstacles",
    "min. sep. neighbors": "min_separation_neighbors",
    "mean separation": "mean_separation",
    "neighbor violations": "neighbor_violation_rate",
    "obstacle violations": "obstacle_violation_rate",
    "connected": "connectivity",
    "free": "violation_free_rate",
    "success": "success_rate",
}
"""The metrics of the tables by their headings."""

_ABOUT_ANNOUNCE = (
    "The filter `announce` needs communication: in each step every vehicle sends its heading and one number, the speed that it "
    "will reach at least, to its neighbors."
)


@dataclass(frozen=True)
class Size:
    """Numbers of episodes, and of vector steps for the timing."""

    episodes: int
    flock_size_episodes: int
    timed_steps: int


FULL, QUICK = Size(1000, 200, 100), Size(100, 20, 20)


def reproduce(out: str | Path, quick: bool = False, console: Console | None = None) -> Path:
    """Evaluate the shipped policies and the baseline controllers; write every table and figure of the paper beside them.

    :param out: folder for ``results.md``, ``tables.json`` and the figures as PNG and SVG
    :param quick: 100 episodes instead of 1000, and shorter measurements of the rest
    :return: the path of ``results.md``
    :raises SettingsError: if matplotlib is missing or the folder cannot be written
    """
    check_matplotlib()
    size, console = QUICK if quick else FULL, console or PlainConsole(stderr=True)
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"{out}: {error.strerror or error}") from None
    names = {row.name for row in ROWS if row.name not in CONTROLLERS} | {SHOWN, ANY_SIZE, *CURVES}
    policies = {name: load_policy(name) for name in names}
    tables: dict[str, dict[str, dict[str, dict[str, Metric]]]] = {}
    sections: dict[str, Callable[[], str]] = {
        "tables I and II": lambda: _experiments(tables, policies, size.episodes),
        "crossing obstacles": lambda: _crossing(tables, policies, size.episodes),
        "figures": lambda: _episode_figures(folder, policies[SHOWN]),
        "training curves": lambda: _training_curve(folder, policies),
        "one policy with 1 to 200 vehicles": lambda: _flock_sizes(folder, policies[ANY_SIZE], size.flock_size_episodes),
        "sensor errors and other dynamics": lambda: _robustness(policies[SHOWN], size.episodes // 4 or 1),
        "time of training against the number of vehicles": lambda: _training_time(folder, size.timed_steps),
    }
    parts = [_head(size)]
    with console.status("") as status:
        for title, section in sections.items():
            status.update(title)
            parts.append(section())
    (folder / "results.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    (folder / "tables.json").write_text(json.dumps(tables, indent=1, default=vars) + "\n", encoding="utf-8")
    return folder / "results.md"


def _head(size: Size) -> str:
    packages = ", ".join(f"{name} {number}" for name, number in versions().items())
    return (
        "# The paper's tables and figures beside the results of this package\n\n"
        f"{size.episodes} episodes a row (seed 0), distances in meters, steady-state values as `docs/paper_deviations.md` "
        "defines them. In a free episode no vehicle violates any separation. Free episodes and successes have their 95 % "
        f"intervals in parentheses. `docs/safety.md` describes the filters. Made by `sb3-flock reproduce` with {packages}."
    )


def _experiments(tables: dict[str, Any], policies: Mapping[str, LoadedPolicy], episodes: int) -> str:
    """Tables I and II with the rows of this package; the metrics go into ``tables``."""
    parts = ["## Tables I and II"]
    for task, scenario in EXPERIMENTS.items():
        figures = PAPER[scenario.n_vehicles, scenario.n_obstacles].items()
        paper = [_row(f"paper, {table}", "", _without_intervals(means)) for table, means in figures]
        parts.append(_table(f"{scenario.bodies}:", [*paper, *_rows(tables, task, policies, episodes)]))
    return "\n\n".join(parts)


def _crossing(tables: dict[str, Any], policies: Mapping[str, LoadedPolicy], episodes: int) -> str:
    parts = ["## A hard test: obstacles that cross the flock"]
    for task, scenario in CROSSING.items():
        caption = f"{scenario.bodies}, `--obstacle-motion crossing`:"
        parts.append(_table(caption, _rows(tables, task, policies, episodes)))
    return "\n\n".join(parts)


def _rows(tables: dict[str, Any], task: str, policies: Mapping[str, LoadedPolicy], episodes: int) -> list[str]:
    """The rows of a task: medians over the trainings of its own policies, then what :data:`ROWS` says."""
    scenario, medians, evaluated = TASKS[task], [], []
    tables[task] = {}
    for rows in ROWS:
        if task not in rows.tasks:
            continue
        label = f"`{rows.name}`" + (f" ({rows.note})" if rows.note else "")
        if rows.name in policies:
            medians.append(_over_trainings(label, task, read_card(rows.name)))
        tables[task][rows.name] = found = _evaluate(rows, policies, scenario, episodes)
        evaluated += [_row(label, f"`{safety_filter}`", metrics) for safety_filter, metrics in found.items()]
    return medians + evaluated


def _over_trainings(label: str, task: str, card: Mapping[str, Any]) -> str:
    """A row with the median over the trainings of a policy, and the lowest and the highest."""
    label += f", median (range) of {len(card['seeds'])} trainings, from the model card"
    scenario = card["config"]["scenario"]
    return _row(label, f"`{scenario['safety_filter']}`", over_seeds(card, task), ranges=True)


def _evaluate(
    rows: Rows, policies: Mapping[str, LoadedPolicy], scenario: Scenario, episodes: int
) -> dict[str, dict[str, Metric]]:
    """The metrics by safety filter; none for a controller whose library is not installed.

    A policy flies its own scenario, with what it was trained to observe, with the bodies of the task.
    """
    controller: LoadedPolicy | Controller
    if rows.name in policies:
        controller = policies[rows.name]
        scenario = with_bodies_of(controller.scenario, scenario)
    else:
        try:
            controller = make_controller(rows.name)
        except SettingsError:
            return {}
    return {name: evaluate(controller, scenario.replace(safety_filter=name), episodes, seed=0) for name in rows.filters}


def _table(caption: str, rows: Sequence[str]) -> str:
    header = ["| | filter | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 2) + "|"]
    return "\n".join([caption, "", *header, *rows, "", _ABOUT_ANNOUNCE])


def _without_intervals(means: Mapping[str, float]) -> dict[str, Metric]:
    return {name: Metric(mean, None, None, 0) for name, mean in means.items()}


def _row(label: str, safety_filter: str, metrics: Mapping[str, Metric], ranges: bool = False) -> str:
    """:param ranges: show the interval of every metric, not of the binary ones alone"""
    kinds = [METRICS[name] for name in COLUMNS.values()]
    cells = [_cell(kind, metrics.get(kind.name), ranges or kind.is_binary) for kind in kinds]
    return f"| {label} | {safety_filter} | " + " | ".join(cells) + " |"


def _cell(kind: type[EpisodeMetric], metric: Metric | None, has_interval: bool) -> str:
    if metric is None or metric.mean is None:
        return ""

    def number(value: float) -> str:
        return f"{value:.3f}" if not kind.is_rate else f"{100 * value:.{1 if kind.is_binary else 2}f}"

    interval = ""
    if has_interval and metric.low is not None and metric.high is not None:
        interval = f" ({number(metric.low)} to {number(metric.high)})"
    return f"{number(metric.mean)}{' %' if kind.is_rate else ''}{interval}"


def _episode_figures(folder: Path, policy: LoadedPolicy) -> str:
    save(plot_trajectories(record_trajectory(policy, policy.scenario, seed=0, episode=1)), folder / "trajectories")
    save(plot_observation(policy.scenario), folder / "observation")
    return (
        "## One episode, and what a vehicle observes\n\n![paths of one episode](trajectories.png)\n\n"
        "![ten neighbors and the channel that shows them](observation.png)"
    )


def _training_curve(folder: Path, policies: Mapping[str, LoadedPolicy]) -> str:
    """The tracking error of the evaluations during the trainings of the model cards, against transitions."""
    series = {}
    for name in CURVES:
        curves = [seed["curve"] for seed in read_card(name)["seeds"]]
        series[name] = (np.array(curves[0]["timesteps"]), np.array([curve["tracking_error"] for curve in curves]))
    save(plot_lines(series, "transitions", "tracking error [m]", log_y=True), folder / "training")
    bodies = {policies[name].scenario.bodies for name in CURVES}
    return (
        "## Training curves\n\n![tracking error against transitions](training.png)\n\n"
        f"The trainings of {', '.join(f'`{name}`' for name in CURVES)}, evaluated on {' and '.join(sorted(bodies))}: the line "
        "is the median over the trainings, the shade covers all of them. A transition is one step of one vehicle. The paper's "
        "policy was stable after about 10 000 episodes, of a length that it does not state."
    )


def _flock_sizes(folder: Path, policy: LoadedPolicy, episodes: int) -> str:
    """One policy with more and more vehicles; most of these flock sizes were not in its training."""
    drawn = policy.scenario.safety_filter
    rows, drawn_rows = [], []
    for n in FLOCK_SIZES:
        arena = max(1.0, (n / _MOST_IN_THE_ARENA) ** 0.5)
        cycles = round(policy.scenario.max_cycles * arena)
        for name in dict.fromkeys((*FILTERS, drawn)):
            scenario = policy.scenario.replace(n_vehicles=n, arena=arena, max_cycles=cycles, safety_filter=name)
            metrics = evaluate(policy, scenario, max(1, episodes // max(1, n // 20)), seed=0)
            rows.append(_row(f"{n} vehicle{'s' * (n > 1)}", f"`{name}`", metrics))
            if name == drawn:
                drawn_rows.append({key: metric.mean for key, metric in metrics.items()})
    series = {
        "tracking error [m]": [row["tracking_error"] for row in drawn_rows],
        "least possible tracking error [m]": [densest_tracking(n) for n in FLOCK_SIZES],
        "vehicle-steps with a neighbor violation": [row["neighbor_violation_rate"] or 0.0 for row in drawn_rows],
        "share not connected": [1 - (row["connectivity"] or 0.0) for row in drawn_rows],
    }
    curves = {label: (FLOCK_SIZES, np.array(values)) for label, values in series.items()}
    save(plot_lines(curves, "vehicles", "meters or share", log_x=True), folder / "flock_sizes")
    caption = (
        f"`{ANY_SIZE}`, {policy.scenario.n_obstacles} obstacles; beyond {_MOST_IN_THE_ARENA} vehicles arena and time grow, so "
        f"that all find a start. The figure shows the filter `{drawn}`, with which the policy was trained."
    )
    return "\n\n".join(
        ["## One policy, any number of vehicles", _table(caption, rows), "![metrics against vehicles](flock_sizes.png)"]
    )


def _robustness(policy: LoadedPolicy, episodes: int) -> str:
    rows = evaluate_robustness(policy, policy.scenario, episodes)
    headings = list(columns().values())
    lines = [
        "## Sensor errors and other dynamics\n",
        f"`{SHOWN}`, trained with none of these, filter `{policy.scenario.safety_filter}`; {episodes} episodes a row "
        f"(`sb3-flock evaluate {SHOWN} --robustness`):\n",
        "| conditions | " + " | ".join(headings) + " |",
        "|---" * (len(headings) + 1) + "|",
        *(f"| {name} | " + " | ".join(robustness.cells(row)) + " |" for name, row in rows.items()),
    ]
    return "\n".join(lines)


def densest_tracking(n_vehicles: int, separation: float = 0.1) -> float:
    """About the least mean distance to a waypoint of vehicles that keep a separation [m].

    The vehicles are the nearest points of a triangular lattice, which is centered on one point, between two or among three,
    whichever is best. Other packings may be slightly better.

    :param separation: smallest distance between two vehicles [m]
    """
    i, j = (axis.ravel() for axis in np.meshgrid(*2 * [np.arange(-40, 41)]))
    points = separation * np.stack((i + j / 2, j * np.sqrt(3) / 2), axis=-1)
    centers = separation * np.array([(0.0, 0.0), (0.5, 0.0), (0.5, np.sqrt(3) / 6)])
    distances = np.sort(np.linalg.norm(points - centers[:, None], axis=-1), axis=1)
    return float(distances[:, :n_vehicles].mean(1).min())


def _training_time(folder: Path, steps: int) -> str:
    """Time of a flock step in training against the number of vehicles, at two rates of updates."""
    sizes = (1, 3, 5, 8, 12)
    measured = {
        "one update a flock step": [_seconds_per_flock_step(n, 1 / n, steps) for n in sizes],
        "two updates for five transitions (the default)": [_seconds_per_flock_step(n, 0.4, steps) for n in sizes],
    }
    series = {label: (sizes, 1000 * np.array(values)) for label, values in measured.items()}
    save(plot_lines(series, "vehicles", "milliseconds a flock step"), folder / "training_time")
    cycles = Scenario().max_cycles
    lines = [
        "## Time of training\n",
        "| vehicles | " + " | ".join(map(str, sizes)) + " |",
        "|---" * (len(sizes) + 1) + "|",
    ]
    for label, values in measured.items():
        lines.append(f"| {label}: ms a flock step | " + " | ".join(f"{1000 * value:.1f}" for value in values) + " |")
        lines.append(
            f"| ms an episode of {cycles} steps | " + " | ".join(f"{1000 * cycles * value:.0f}" for value in values) + " |"
        )
    note = (
        "The paper reports 122, 140 and 147 ms an episode for (3, 1), (5, 1) and (5, 2), and not its episodes' length or its "
        "rate of updates. The observation does not grow with the number of vehicles. Acting and storing take time for each "
        "vehicle, and so do updates where their number follows the transitions."
    )
    return "\n".join([*lines, "", "![time against vehicles](training_time.png)", "", note])


def _seconds_per_flock_step(n_vehicles: int, utd_ratio: float, steps: int) -> float:
    """Measured over ``steps`` vector steps of the default training, after a warm-up."""
    config = TrainingConfig()
    algorithm = config.algorithm.replace(utd_ratio=utd_ratio, learning_starts=config.algorithm.batch_size)
    config = config.replace(scenario=Scenario(n_vehicles=n_vehicles, n_obstacles=2), algorithm=algorithm, n_flocks=8)
    env = make_vec_env(config.scenario, config.n_flocks, seed=0)
    try:
        model = build_model(config, env)
        mix = NeighborInclusiveReward(config.scenario.reward.lambda_)
        model.learn(10 * env.num_envs + config.algorithm.batch_size, mix)
        start = time.perf_counter()
        model.learn(steps * env.num_envs, mix, reset_num_timesteps=False)
        return (time.perf_counter() - start) / (steps * config.n_flocks)
    finally:
        env.close()
