"""``sb3-flock evaluate``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_flock.cli import shared
from sb3_flock.cli.messages import written_to
from sb3_flock.cli.parsing import Parser, count
from sb3_flock.errors import SettingsError


def add(parser: Parser) -> None:
    """Add the arguments."""
    parser.describe(
        "runs/ddpg_5v2o_1 --n-vehicles 8 -o result.json",
        description="Simulate many episodes of a saved policy at once and print every metric with its interval.",
        renamed={**shared.ROLLOUT_RENAMED, "--json": "--output", "--sensors": "--robustness"},
    )
    shared.add_rollout(parser)
    names = ("-n", "--episodes", "--n-eval-episodes")  # the last as in SB3
    parser.add_argument(*names, type=count(1), default=1000, metavar="N", help="number of episodes [1000]")
    shared.add_output(parser, "also write the metrics to this file, as JSON")
    parser.add_argument(
        "--robustness",
        action="store_true",
        help="also show the effect of sensor errors, of lag, bounded acceleration and slip, and of several at once",
    )


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Evaluate, print, and write JSON where asked for."""
    from sb3_flock.console import PlainConsole
    from sb3_flock.sim.simulators import SIMULATORS

    if options.output is not None and not Path(options.output).absolute().parent.is_dir():
        raise SettingsError(f"--output {options.output}: there is no folder {Path(options.output).parent}")
    controller, name, scenario = shared.rollout_of(options)
    if options.robustness and scenario.dynamics in SIMULATORS:
        raise SettingsError(f"--robustness: the simulator {scenario.dynamics} has dynamics of its own, which are not varied")
    console = PlainConsole(stderr=True)
    metrics = shared.evaluate_and_print(controller, name, scenario, options.episodes, options.seed, console)
    if options.robustness:
        from sb3_flock.evaluation.robustness import errors_table, evaluate_robustness

        with console.status("simulating sensor errors and other dynamics"):
            PlainConsole().print(errors_table(evaluate_robustness(controller, scenario, options.episodes, options.seed)))
    if options.output is not None:
        from sb3_flock.evaluation.report import write_json
        from sb3_flock.serialization.save import versions

        meta = {
            **({"controller": name} if options.policy is None else controller.describe()),
            "episodes": options.episodes,
            "seed": options.seed,
            "scenario": scenario.model_dump(mode="json"),
            "evaluated_with": versions(),
        }
        with written_to("--output", options.output):
            write_json(options.output, metrics, meta)
    return 0
