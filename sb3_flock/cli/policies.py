"""``sb3-flock policies``."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sb3_flock._renamed import current_policy
from sb3_flock.cli.parsing import Parser, listed
from sb3_flock.errors import SettingsError
from sb3_flock.settings import suggest

if TYPE_CHECKING:
    from rich.table import Table

    from sb3_flock.config.training import TrainingConfig


def add(parser: Parser) -> None:
    """Add the arguments."""
    parser.describe(
        "flock",
        description="List the shipped policies with their results on test episodes, or show the model card of one.",
    )
    parser.add_argument("name", nargs="?", metavar="NAME", help="show this policy's model card")


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Print the list or the card."""
    from sb3_flock.console import PlainConsole

    console = PlainConsole()
    if options.name is None:
        console.print(_list())
        console.print(
            "A task 5v2o has 5 vehicles and 2 obstacles. RL is reinforcement learning alone; RL+MPC also imitates the MPC "
            "expert. Results are with the safety filter that a policy was trained with.\n"
            "`sb3-flock policies NAME` shows a model card, `sb3-flock play NAME` the policy."
        )
    else:
        _print_card(_known(options.name), console)
    return 0


def _known(name: str) -> str:
    from sb3_flock.pretrained import shipped_policies

    name = current_policy(name)
    names = shipped_policies()
    if name not in names:
        raise SettingsError(f"{name}: not a shipped policy{suggest(name, names)}; there are {listed(names)}")
    return name


def _list() -> Table:
    """A line for each policy; the metrics are of the training that was shipped."""
    from rich.table import Table

    from sb3_flock.evaluation.model_cards import read_card
    from sb3_flock.evaluation.report import add_short_columns, short_cells
    from sb3_flock.pretrained import shipped_policies

    table = Table(box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in ("name", "task", "method"):
        table.add_column(heading, no_wrap=heading != "task")
    add_short_columns(table)
    for name in shipped_policies():
        card = read_card(name)
        config = _config(card)
        scenario = config.scenario
        task = f"{scenario.n_vehicles}v{scenario.n_obstacles}o {scenario.obstacle_motion}"
        table.add_row(name, task, _method(config)[0], *short_cells(_shipped(card)["metrics"]))
    return table


def _config(card: Mapping[str, Any]) -> TrainingConfig:
    from sb3_flock.config.training import TrainingConfig
    from sb3_flock.serialization.migrate import migrate_card

    return TrainingConfig(**migrate_card(TrainingConfig, card)[0])


def _shipped(card: Mapping[str, Any]) -> dict[str, Any]:
    """The record of the training whose policy was shipped."""
    return next(record for record in card["seeds"] if record["seed"] == card["shipped_seed"])


def _method(config: TrainingConfig) -> tuple[str, str]:
    """How the policy was trained, short and in words."""
    expert = config.train_env.expert
    if expert is None:
        return "RL", "reinforcement learning alone"
    name = expert.upper()
    words, fraction = f"reinforcement learning with an {name} expert", config.train_env.expert_fraction
    if fraction:
        words += f", which drives {fraction:.0%} of the episodes"
    if config.algorithm.bc_coef:
        words += f"; behavior cloning of its actions (weight {config.algorithm.bc_coef:g})"
    return f"RL+{name}", words


def _print_card(name: str, console: Any) -> None:
    from sb3_flock.evaluation.model_cards import read_card
    from sb3_flock.evaluation.report import plain_table

    card = read_card(name)
    grid = plain_table()
    grid.show_header = False
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for key, value in _facts(name, card).items():
        grid.add_row(key, value)
    console.print(name)
    console.print(grid)
    console.print(f"Results on {card['episodes']} episodes of the task:")
    console.print(_results(card))
    if "tasks" in _shipped(card):
        number = len(card["seeds"])
        which = "Results" if number == 1 else f"Medians of the {number} trainings"
        console.print(f"{which} on {card['episodes']} episodes of each task, with the same filter:")
        console.print(_results_of_tasks(card))
    if "robustness" in card:
        episodes = card["robustness"]["episodes"]
        console.print(
            f"What the policy bears, {episodes} episodes of the task each (`sb3-flock evaluate {name} --robustness`):"
        )
        console.print(_robustness(card))


def _facts(name: str, card: Mapping[str, Any]) -> dict[str, str]:
    """What the card says about the training."""
    from sb3_flock.pretrained import shipped_policies

    shipped, path, config, number = _shipped(card), shipped_policies()[name], _config(card), len(card["seeds"])
    level = config.scenario.safety_filter
    channels = "; motion channels" if config.scenario.motion_lag else ""
    of_several = f"{number}, which differ in the seed; the policy is that of seed {card['shipped_seed']}"
    return {
        "task": f"{card['task']}, {'no safety filter' if level == 'off' else f'safety filter {level}'}",
        "method": f"{config.algo}: {_method(config)[1]}{channels}",
        "trained": f"{shipped['transitions']} transitions, {shipped['minutes']:g} minutes",
        "command": shipped["command"],
        "with": listed(f"{package} {version}" for package, version in card["versions"].items()),
        "trainings": of_several if number > 1 else f"1, of seed {card['shipped_seed']}",
        "file": f"{path.name}, {path.stat().st_size / 1e6:.1f} MB",
    }


def _results(card: Mapping[str, Any]) -> Table:
    """The metrics of the policy; beside them the median and the range over the trainings, if there are several."""
    from sb3_flock.evaluation.metrics import METRICS
    from sb3_flock.evaluation.model_cards import over_seeds
    from sb3_flock.evaluation.report import plain_table

    shipped, trainings, number = _shipped(card)["metrics"], over_seeds(card), len(card["seeds"])
    table = plain_table()
    table.add_column("metric", no_wrap=True)
    for heading in ("policy", *((f"median of {number}", "range") if number > 1 else ())):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, kind in METRICS.items():
        over = trainings.get(name)
        mean, low, high = (None, None, None) if over is None else (over.mean, over.low, over.high)
        cells = ["-" if value is None else kind.format(value) for value in (shipped.get(name), mean)]
        span = "-" if low is None or high is None else f"{kind.format(low)} to {kind.format(high)}"
        table.add_row(name, *[*cells, span][: len(table.columns) - 1])
    return table


def _results_of_tasks(card: Mapping[str, Any]) -> Table:
    """A line for each task: the medians over the trainings."""
    from sb3_flock.evaluation.model_cards import over_seeds
    from sb3_flock.evaluation.report import add_short_columns, plain_table, short_cells

    table = plain_table(gap=1)
    table.add_column("task", no_wrap=True)
    add_short_columns(table)
    for task in _shipped(card)["tasks"]:
        table.add_row(task, *short_cells({metric: over.mean for metric, over in over_seeds(card, task).items()}))
    return table


def _robustness(card: Mapping[str, Any]) -> Table:
    """A line for each sensor error and each change of the dynamics."""
    from sb3_flock.evaluation.metrics import Metric
    from sb3_flock.evaluation.robustness import errors_table

    rows, episodes = card["robustness"]["conditions"], card["robustness"]["episodes"]
    return errors_table(
        {name: {key: Metric(mean, None, None, episodes) for key, mean in row.items()} for name, row in rows.items()}
    )
