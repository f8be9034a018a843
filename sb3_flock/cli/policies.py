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
        "ddpg-bc-5v2o",
        description="List the shipped policies with their results on test episodes, or show the model card of one.",
    )
    parser.add_argument("name", nargs="?", metavar="NAME", help="show this policy's model card")


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Print the list or the card."""
    from rich.console import Console

    console = Console(highlight=False)
    if options.name is None:
        console.print(_list())
        console.print(
            "A task 5v2o has 5 vehicles and 2 obstacles. RL is reinforcement learning alone; RL+MPC also imitates the MPC "
            "expert.\n`sb3-flock policies NAME` shows a model card, `sb3-flock play NAME` the policy."
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
    from sb3_flock.serialization.migrate import migrate_config

    return TrainingConfig(**migrate_config(TrainingConfig, card["config"], card.get("format", 3))[0])


def _shipped(card: Mapping[str, Any]) -> dict[str, Any]:
    """The record of the training whose policy was shipped."""
    return next(record for record in card["seeds"] if record["seed"] == card["shipped_seed"])


def _method(config: TrainingConfig) -> tuple[str, str]:
    """How the policy was trained, short and in words."""
    expert = config.train_env.expert
    if expert is None:
        return "RL", "reinforcement learning alone"
    name = expert.upper()
    words = (
        f"reinforcement learning with an {name} expert, which drives {config.train_env.expert_fraction:.0%} of the episodes"
    )
    if config.algorithm.bc_coef:
        words += f"; behavior cloning of its actions (weight {config.algorithm.bc_coef:g})"
    return f"RL+{name}", words


def _print_card(name: str, console: Any) -> None:
    from sb3_flock.evaluation.metrics import METRICS
    from sb3_flock.evaluation.model_cards import over_seeds, read_card
    from sb3_flock.evaluation.report import add_short_columns, plain_table, short_cells
    from sb3_flock.pretrained import shipped_policies

    card = read_card(name)
    shipped, path, config = _shipped(card), shipped_policies()[name], _config(card)
    number = len(card["seeds"])
    channels = "; motion channels" if config.scenario.motion_lag else ""
    facts = {
        "task": card["task"],
        "method": f"{config.algo}: {_method(config)[1]}{channels}",
        "trained": f"{shipped['transitions']} transitions, {shipped['minutes']:g} minutes",
        "command": shipped["command"],
        "with": listed(f"{package} {version}" for package, version in card["versions"].items()),
        "trainings": f"{number}, which differ in the seed; the policy is that of seed {card['shipped_seed']}",
        "file": f"{path.name}, {path.stat().st_size / 1e6:.1f} MB",
    }
    grid = plain_table()
    grid.show_header = False
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for key, value in facts.items():
        grid.add_row(key, value)
    console.print(name)
    console.print(grid)
    table = plain_table()
    table.add_column("metric", no_wrap=True)
    table.add_column("policy", justify="right", no_wrap=True)
    table.add_column(f"median of {number}", justify="right", no_wrap=True)
    table.add_column("range", justify="right", no_wrap=True)
    trainings = over_seeds(card)
    for metric, kind in METRICS.items():
        value, over = shipped["metrics"].get(metric), trainings.get(metric)
        cells = ["-" if value is None else kind.format(value), "-", "-"]
        if over is not None:
            assert over.mean is not None
            assert over.low is not None
            assert over.high is not None
            cells[1:] = kind.format(over.mean), f"{kind.format(over.low)} to {kind.format(over.high)}"
        table.add_row(metric, *cells)
    console.print(f"Results on {card['episodes']} episodes of the task:")
    console.print(table)
    if "tasks" in shipped:
        table = plain_table(gap=1)
        table.add_column("task", no_wrap=True)
        add_short_columns(table)
        for task in shipped["tasks"]:
            medians = {metric: over.mean for metric, over in over_seeds(card, task).items()}
            table.add_row(task, *short_cells(medians))
        console.print(f"Medians of the {number} trainings on {card['episodes']} episodes of each task:")
        console.print(table)
