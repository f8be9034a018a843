"""The paper's tables and figures beside the results of this package, in one folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from sb3_flock.config.training import TrainingConfig
from sb3_flock.controllers import CONTROLLERS, make_controller
from sb3_flock.envs.vec_env import make_vec_env
from sb3_flock.evaluation import robustness
from sb3_flock.evaluation.metrics import METRICS, Metric, columns
from sb3_flock.evaluation.model_cards import median_of_seeds, read_card
from sb3_flock.evaluation.report import PAPER
from sb3_flock.evaluation.robustness import evaluate_with_errors
from sb3_flock.evaluation.rollout import evaluate
from sb3_flock.pretrained import shipped_policies
from sb3_flock.rl.callbacks import NeighborInclusiveReward
from sb3_flock.rl.registry import build_model
from sb3_flock.serialization.load import LoadedPolicy, load_policy
from sb3_flock.serialization.save import versions
from sb3_flock.settings import SettingsError
from sb3_flock.sim import Scenario
from sb3_flock.viz.figures import check_matplotlib, plot_lines, plot_observation, plot_trajectories, record_trajectory, save

SETTINGS = {
    "ddpg-3v1o": Scenario(n_vehicles=3, n_obstacles=1),
    "ddpg-5v1o": Scenario(n_vehicles=5, n_obstacles=1),
    "ddpg-5v2o": Scenario(n_vehicles=5, n_obstacles=2),
}
"""The paper's experiments by the name of their shipped `ddpg` policy."""

KINDS = {"ddpg (the paper's observation)": "ddpg-", "ddpg-bc (motion channels, expert)": "ddpg-bc-"}
"""The kinds of shipped policies by the label of their rows, with the first part of their names."""

CROSSING = "crossing-5v2o"
"""The policy trained for obstacles that cross the flock."""

TRAINED = "ddpg-bc, trained for crossing obstacles"
"""The label of its row."""

FLOCK_SIZES = (1, 2, 3, 5, 8, 12, 20, 50, 200)
"""Numbers of vehicles with which the policy `general` is evaluated."""

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
}
"""The metrics of the tables by their headings."""


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
    size, console = QUICK if quick else FULL, console or Console(stderr=True)
    folder = Path(out)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SettingsError(f"{out}: {error.strerror or error}") from None
    policies = {name: load_policy(name) for name in shipped_policies()}
    tables: dict[str, dict[str, dict[str, Metric]]] = {}
    sections: dict[str, Callable[[], str]] = {
        "tables I and II": lambda: _tables(tables, policies, size.episodes),
        "crossing obstacles": lambda: _crossing(policies, size.episodes),
        "figures": lambda: _episode_figures(folder, policies["ddpg-5v2o"]),
        "training curves": lambda: _training_curve(folder),
        "one policy with 1 to 200 vehicles": lambda: _flock_sizes(folder, policies["general"], size.flock_size_episodes),
        "sensor errors": lambda: _sensors(policies["ddpg-5v2o"], size.episodes // 4 or 1),
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
        f"defines them. Made by `sb3-flock reproduce` with {packages}."
    )


def _policies_for(name: str) -> dict[str, str]:
    """The names of the shipped policies for an experiment of :data:`SETTINGS`, by label."""
    return {label: name.replace("ddpg-", kind) for label, kind in KINDS.items()}


def _evaluate_all(policies: Mapping[str, LoadedPolicy], scenario: Scenario, episodes: int) -> dict[str, dict[str, Metric]]:
    """The metrics of the policies, by label, and of every baseline controller that is installed."""
    rows = {
        label: evaluate(policy, scenario.replace(motion_lag=policy.scenario.motion_lag), episodes, seed=0)
        for label, policy in policies.items()
    }
    for name in CONTROLLERS:
        try:
            controller = make_controller(name)
        except SettingsError:  # its library is not installed: the row is left out
            continue
        rows[name] = evaluate(controller, scenario, episodes, seed=0)
    return rows


def _tables(tables: dict[str, Any], policies: Mapping[str, LoadedPolicy], episodes: int) -> str:
    """Tables I and II with the rows of this package; the metrics go into ``tables``."""
    parts = ["## Tables I and II"]
    for name, scenario in SETTINGS.items():
        shipped = _policies_for(name)
        tables[name] = _evaluate_all({label: policies[own] for label, own in shipped.items()}, scenario, episodes)
        names = " and ".join(f"`{own}`" for own in shipped.values())
        lines = [f"{scenario.bodies} ({names}):\n", *_header()]
        for table, figures in PAPER[scenario.n_vehicles, scenario.n_obstacles].items():
            lines.append(_row(f"paper, {table}", figures))
        for label, own in shipped.items():
            card = read_card(own)
            lines.append(
                _row(f"{label}, median of {len(card['seeds'])} trainings, from the model card", median_of_seeds(card))
            )
        parts.append("\n".join([*lines, *_rows(tables[name])]))
    return "\n\n".join(parts)


def _crossing(policies: Mapping[str, LoadedPolicy], episodes: int) -> str:
    others = _policies_for("ddpg-5v2o")
    labeled = {TRAINED: policies[CROSSING], **{label: policies[name] for label, name in others.items()}}
    lines = [
        "## A hard test: obstacles that cross the flock\n",
        f"5 vehicles, 2 obstacles, `--obstacle-motion crossing` (`{CROSSING}` is trained for crossing obstacles, "
        f"{' and '.join(f'`{name}`' for name in others.values())} are not):\n",
        *_header(),
    ]
    return "\n".join([*lines, *_rows(_evaluate_all(labeled, policies[CROSSING].scenario, episodes))])


def _rows(rows: Mapping[str, Mapping[str, Metric]]) -> list[str]:
    labels = {label: f"{label}, the shipped policy" for label in (*KINDS, TRAINED)}
    return [_row(labels.get(name, f"`{name}`"), _means(metrics)) for name, metrics in rows.items()]


def _means(metrics: Mapping[str, Metric]) -> dict[str, float | None]:
    return {name: metric.mean for name, metric in metrics.items()}


def _header() -> list[str]:
    return ["| | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]


def _row(label: str, values: Mapping[str, float | None]) -> str:
    cells = []
    for name in COLUMNS.values():
        value = values.get(name)
        cells.append("" if value is None else f"{100 * value:.2f} %" if METRICS[name].is_rate else f"{value:.3f}")
    return f"| {label} | " + " | ".join(cells) + " |"


def _episode_figures(folder: Path, policy: LoadedPolicy) -> str:
    save(plot_trajectories(record_trajectory(policy, policy.scenario, seed=0, episode=1)), folder / "trajectories")
    save(plot_observation(policy.scenario), folder / "observation")
    return (
        "## One episode, and what a vehicle observes\n\n![paths of one episode](trajectories.png)\n\n"
        "![ten neighbors and the channel that shows them](observation.png)"
    )


def _training_curve(folder: Path) -> str:
    """The return of the evaluations during the trainings of the model cards, against flock episodes of the training env."""
    series = {}
    for name, scenario in SETTINGS.items():
        seeds = read_card(name)["seeds"]
        flock = load_policy(name).config.training_scenarios()[0]
        episodes = np.array(seeds[0]["curve"]["timesteps"]) / (flock.n_vehicles * flock.max_cycles)
        returns = np.array([seed["curve"]["return"] for seed in seeds])
        series[scenario.bodies] = (episodes, returns)
    save(plot_lines(series, "flock episodes in training", "return of a vehicle, 100 episodes"), folder / "training")
    return (
        "## Training curves\n\n![return against episodes](training.png)\n\nThe line is the median over the trainings, the "
        "shade covers all of them. The paper's policy was stable after about 10 000 episodes."
    )


def _flock_sizes(folder: Path, policy: LoadedPolicy, episodes: int) -> str:
    """One policy with more and more vehicles; most of these flock sizes were not in its training."""
    rows = {}
    for n in FLOCK_SIZES:
        arena = max(1.0, (n / _MOST_IN_THE_ARENA) ** 0.5)
        cycles = round(policy.scenario.max_cycles * arena)
        scenario = policy.scenario.replace(n_vehicles=n, arena=arena, max_cycles=cycles)
        rows[n] = _means(evaluate(policy, scenario, max(1, episodes // max(1, n // 20)), seed=0))
    series = {
        "tracking error [m]": [row["tracking_error"] for row in rows.values()],
        "least possible tracking error [m]": [densest_tracking(n) for n in FLOCK_SIZES],
        "vehicle-steps with a neighbor violation": [row["neighbor_violation_rate"] or 0.0 for row in rows.values()],
        "share not connected": [1 - (row["connectivity"] or 0.0) for row in rows.values()],
    }
    curves = {label: (FLOCK_SIZES, np.array(values)) for label, values in series.items()}
    save(plot_lines(curves, "vehicles", "meters or share", log_x=True), folder / "flock_sizes")
    lines = [
        "## One policy, any number of vehicles\n",
        f"`general`, 2 obstacles; beyond {_MOST_IN_THE_ARENA} vehicles arena and time grow, so that all find a start.\n",
        *_header(),
        *(_row(f"{n} vehicle{'s' * (n > 1)}", row) for n, row in rows.items()),
        "\n![metrics against vehicles](flock_sizes.png)",
    ]
    return "\n".join(lines)


def _sensors(policy: LoadedPolicy, episodes: int) -> str:
    rows = evaluate_with_errors(policy, policy.scenario, episodes)
    headings = list(columns().values())
    lines = [
        "## Sensor errors\n",
        f"`ddpg-5v2o`, trained without errors; {episodes} episodes a row (`sb3-flock evaluate ddpg-5v2o --sensors`):\n",
        "| sensor errors | " + " | ".join(headings) + " |",
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
