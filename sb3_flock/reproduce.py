"""The paper's tables and figures, ours beside theirs, in one folder (``sb3-flock reproduce``)."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from sb3_flock.config.training import TrainingConfig
from sb3_flock.controllers import CONTROLLERS, make_controller
from sb3_flock.envs.vec_env import make_vec_env
from sb3_flock.evaluation import robustness
from sb3_flock.evaluation.metrics import Metric, columns
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
"""The paper's experiments by the shipped policy's name."""

OURS = {"ours": "ddpg-", "ours, with a second look": "ddpg-bc-"}
"""Our rows, and how the names of their policies begin."""

CROSSING = "crossing-5v2o"
"""The policy trained for obstacles that cross the flock."""

TRAINED = "ours, trained for it"
"""Its rows."""

FLEETS = (1, 2, 3, 5, 8, 12, 20, 50, 200)
"""Vehicles that the general policy is flown with."""

_MOST_IN_THE_ARENA = 50
"""Vehicles that start in the paper's arena and leave room for obstacles."""

COLUMNS = {
    "tracking error": "tracking_error",
    "min. sep. obstacles": "min_separation_obstacles",
    "... in encounters": "encounter_min_separation_obstacles",
    "min. sep. neighbors": "min_separation_neighbors",
    "mean separation": "mean_separation",
    "too close to a neighbor": "neighbor_violation_rate",
    "... to an obstacle": "obstacle_violation_rate",
    "connected": "connectivity",
}


@dataclass(frozen=True)
class Size:
    """How much is flown and measured."""

    episodes: int
    fleet_episodes: int
    timed_steps: int


FULL, QUICK = Size(1000, 200, 100), Size(100, 20, 20)


def reproduce(out: str | Path, quick: bool = False, console: Console | None = None) -> Path:
    """Fly the shipped policies and the hand-written controllers; write every table and figure of the paper with ours.

    :param out: folder for ``results.md``, ``tables.json`` and the figures as PNG and SVG
    :param quick: 100 episodes instead of 1000, and the other measurements shortened alike
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
    ours = {name: {label: policies[own] for label, own in _ours(name).items()} for name in SETTINGS}
    parts = [_head(size)]
    with console.status("") as status:
        tables: dict[str, Any] = {}
        for name, scenario in SETTINGS.items():
            status.update(f"{scenario.bodies}: {size.episodes} episodes of each controller")
            tables[name] = _fly_all(ours[name], scenario, size.episodes)
        parts.append(_tables(tables))
        status.update("a hard test: crossing obstacles")
        trained = policies[CROSSING]
        parts.append(_crossing(_fly_all({TRAINED: trained, **ours["ddpg-5v2o"]}, trained.scenario, size.episodes)))
        status.update("figures")
        parts.append(_flight_figures(folder, policies["ddpg-5v2o"]))
        parts.append(_training_curve(folder))
        status.update("one policy with 1 to 200 vehicles")
        parts.append(_fleets(folder, policies["general"], size.fleet_episodes))
        status.update("sensors that err")
        parts.append(_sensors(policies["ddpg-5v2o"], size.episodes // 4 or 1))
        status.update("time of training against the number of vehicles")
        parts.append(_training_time(folder, size.timed_steps))
    (folder / "results.md").write_text("\n\n".join(parts) + "\n", encoding="utf-8")
    (folder / "tables.json").write_text(json.dumps(tables, indent=1, default=vars) + "\n", encoding="utf-8")
    return folder / "results.md"


def _head(size: Size) -> str:
    packages = ", ".join(f"{name} {number}" for name, number in versions().items())
    return (
        "# The paper's tables and figures, ours beside theirs\n\n"
        f"{size.episodes} episodes a row (seed 0), distances in meters, settled values as `docs/choices.md` defines them. "
        f"Made by `sb3-flock reproduce` with {packages}."
    )


def _ours(name: str) -> dict[str, str]:
    """The names of our policies for an experiment of :data:`SETTINGS`, by label."""
    return {label: name.replace("ddpg-", kind) for label, kind in OURS.items()}


def _fly_all(ours: dict[str, LoadedPolicy], scenario: Scenario, episodes: int) -> dict[str, dict[str, Metric]]:
    """The metrics of the policies, by label, and of every hand-written controller that is installed."""
    rows = {
        label: evaluate(policy, scenario.replace(motion_lag=policy.scenario.motion_lag), episodes, seed=0)
        for label, policy in ours.items()
    }
    for name in CONTROLLERS:
        try:
            controller = make_controller(name)
        except SettingsError:  # its library is not installed: the row is left out
            continue
        rows[name] = evaluate(controller, scenario, episodes, seed=0)
    return rows


def _tables(tables: dict[str, dict[str, dict[str, Metric]]]) -> str:
    """Tables I and II with our rows and the peers'."""
    parts = ["## Tables I and II"]
    for name, rows in tables.items():
        scenario = SETTINGS[name]
        policies = " and ".join(f"`{own}`" for own in _ours(name).values())
        lines_ = [f"{scenario.bodies} ({policies}):\n", *_header()]
        for table, figures in PAPER[scenario.n_vehicles, scenario.n_obstacles].items():
            lines_.append(_row(f"paper, {table}", figures))
        for label, own in _ours(name).items():
            card = read_card(own)
            lines_.append(_row(f"{label}, median of {len(card['seeds'])} trainings, on record", median_of_seeds(card)))
        lines_ += _rows(rows)
        parts.append("\n".join(lines_))
    return "\n\n".join(parts)


def _crossing(rows: dict[str, dict[str, Metric]]) -> str:
    lines_ = [
        "## A hard test: obstacles that cross the flock\n",
        "5 vehicles, 2 obstacles, `--scenario crossing` "
        f"(`{CROSSING}` is trained for it, `ddpg-5v2o` and `ddpg-bc-5v2o` are not):\n",
    ]
    return "\n".join([*lines_, *_header(), *_rows(rows)])


def _rows(rows: dict[str, dict[str, Metric]]) -> list[str]:
    shown = {label: f"{label}, the shipped one, flown now" for label in (*OURS, TRAINED)}
    return [
        _row(shown.get(name, f"`{name}`"), {metric: values.mean for metric, values in metrics.items()})
        for name, metrics in rows.items()
    ]


def _header() -> list[str]:
    return ["| | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]


def _row(label: str, values: dict[str, Any]) -> str:
    cells = []
    for metric in COLUMNS.values():
        value = values.get(metric)
        is_rate = metric.endswith("rate") or metric == "connectivity"
        cells.append("" if value is None else f"{100 * value:.2f} %" if is_rate else f"{value:.3f}")
    return f"| {label} | " + " | ".join(cells) + " |"


def _flight_figures(folder: Path, policy: LoadedPolicy) -> str:
    save(plot_trajectories(record_trajectory(policy, policy.scenario, seed=0, episode=1)), folder / "trajectories")
    save(plot_observation(policy.scenario), folder / "observation")
    return (
        "## One flight, and what a vehicle sees\n\n![paths of one episode](trajectories.png)\n\n"
        "![ten neighbors and the channel that shows them](observation.png)"
    )


def _training_curve(folder: Path) -> str:
    """The return of the evaluations during the trainings on record, by flock episodes practiced."""
    series = {}
    for name, scenario in SETTINGS.items():
        seeds = read_card(name)["seeds"]
        steps = load_policy(name).config.training_scenarios()[0]
        episodes = np.array(seeds[0]["curve"]["timesteps"]) / (steps.n_vehicles * steps.max_cycles)
        returns = np.array([seed["curve"]["return"] for seed in seeds])
        series[scenario.bodies] = (episodes, returns)
    save(plot_lines(series, "episodes of a flock practiced", "return of a vehicle, 100 episodes"), folder / "training")
    return (
        "## Training curves\n\n![return against episodes](training.png)\n\nThe line is the median over the trainings, the shade "
        "all of them. The paper's policy was stable after about 10 000 episodes."
    )


def _fleets(folder: Path, policy: LoadedPolicy, episodes: int) -> str:
    """One policy flown by ever more vehicles, untrained for most of their numbers."""
    rows = []
    for n in FLEETS:
        arena = max(1.0, (n / _MOST_IN_THE_ARENA) ** 0.5)
        cycles = round(policy.scenario.max_cycles * arena)
        scenario = policy.scenario.replace(n_vehicles=n, arena=arena, max_cycles=cycles)
        rows.append(evaluate(policy, scenario, max(1, episodes // max(1, n // 20)), seed=0))
    lines_ = [
        "## One policy, any number of vehicles\n",
        f"`general`, 2 obstacles; beyond {_MOST_IN_THE_ARENA} vehicles arena and time grow, so that all find a start.\n",
        *_header(),
    ]
    lines_ += [
        _row(f"{n} vehicle{'s' * (n > 1)}", {name: metric.mean for name, metric in row.items()})
        for n, row in zip(FLEETS, rows, strict=True)
    ]
    series = {
        "tracking error [m]": (FLEETS, np.array([row["tracking_error"].mean for row in rows])),
        "least possible tracking error [m]": (FLEETS, np.array([densest_tracking(n) for n in FLEETS])),
        "vehicle-steps too close to a neighbor": (
            FLEETS,
            np.array([row["neighbor_violation_rate"].mean or 0.0 for row in rows]),
        ),
        "share not connected": (FLEETS, np.array([1 - (row["connectivity"].mean or 0.0) for row in rows])),
    }
    save(plot_lines(series, "vehicles", "meters or share", log_x=True), folder / "fleets")
    return "\n".join([*lines_, "\n![metrics against vehicles](fleets.png)"])


def _sensors(policy: LoadedPolicy, episodes: int) -> str:
    rows = evaluate_with_errors(policy, policy.scenario, episodes)
    lines_ = [
        "## Sensors that err\n",
        f"`ddpg-5v2o`, trained with exact ones; {episodes} episodes a row (`sb3-flock evaluate ddpg-5v2o --sensors`):\n",
        "| sensor errors | " + " | ".join(metric.column for metric in columns().values()) + " |",
        "|---" * (len(columns()) + 1) + "|",
    ]
    return "\n".join([*lines_, *(f"| {name} | " + " | ".join(robustness.cells(row)) + " |" for name, row in rows.items())])


def densest_tracking(n_vehicles: int, separation: float = 0.1) -> float:
    """About the smallest mean distance to a waypoint of vehicles that keep apart [m]: a triangular lattice's nearest points.

    The lattice is centered on a point, between two or among three, whichever is best; other packings may be a little better.
    """
    i, j = (axis.ravel() for axis in np.meshgrid(*2 * [np.arange(-40, 41)]))
    points = separation * np.stack((i + j / 2, j * np.sqrt(3) / 2), axis=-1)
    centers = separation * np.array([(0.0, 0.0), (0.5, 0.0), (0.5, np.sqrt(3) / 6)])
    distances = np.sort(np.linalg.norm(points - centers[:, None], axis=-1), axis=1)
    return float(distances[:, :n_vehicles].mean(1).min())


def _training_time(folder: Path, steps: int) -> str:
    """Seconds a flock step of training against the number of vehicles, at two rates of updates."""
    fleets = (1, 3, 5, 8, 12)
    measured = {
        "one update a flock step": [_seconds_per_flock_step(n, 1 / n, steps) for n in fleets],
        "two updates for five transitions (our default)": [_seconds_per_flock_step(n, 0.4, steps) for n in fleets],
    }
    series = {label: (fleets, 1000 * np.array(values)) for label, values in measured.items()}
    save(plot_lines(series, "vehicles", "milliseconds a flock step"), folder / "training_time")
    cycles = Scenario().max_cycles
    lines_ = [
        "## Time of training\n",
        "| vehicles | " + " | ".join(map(str, fleets)) + " |",
        "|---" * (len(fleets) + 1) + "|",
    ]
    for label, values in measured.items():
        lines_.append(f"| {label}: ms a flock step | " + " | ".join(f"{1000 * value:.1f}" for value in values) + " |")
        lines_.append(
            f"| ms an episode of {cycles} steps | " + " | ".join(f"{1000 * cycles * value:.0f}" for value in values) + " |"
        )
    note = (
        "The paper reports 122, 140 and 147 ms an episode for (3, 1), (5, 1) and (5, 2), and not its episodes' length or its "
        "rate of updates. The tensor does not grow with the number of vehicles; acting and storing do, and so do the updates "
        "where they are counted for each transition."
    )
    return "\n".join([*lines_, "", "![time against vehicles](training_time.png)", "", note])


def _seconds_per_flock_step(n_vehicles: int, utd_ratio: float, steps: int) -> float:
    """Measured over ``steps`` vector steps of the default training, after a warm-up."""
    config = TrainingConfig()
    algorithm = config.algorithm.replace(utd_ratio=utd_ratio, learning_starts=config.algorithm.batch_size)
    config = config.replace(scenario=Scenario(n_vehicles=n_vehicles, n_obstacles=2), algorithm=algorithm, n_flocks=8)
    env = make_vec_env(config.scenario, config.n_flocks, seed=0)
    try:
        model = build_model(config, env)
        mixing = NeighborInclusiveReward(config.scenario.reward.lambda_)
        model.learn(10 * env.num_envs + config.algorithm.batch_size, mixing)
        start = time.perf_counter()
        model.learn(steps * env.num_envs, mixing, reset_num_timesteps=False)
        return (time.perf_counter() - start) / (steps * config.n_flocks)
    finally:
        env.close()
