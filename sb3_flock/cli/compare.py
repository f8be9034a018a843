"""``sb3-flock compare``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_flock.cli import shared
from sb3_flock.cli.messages import written_to
from sb3_flock.cli.parsing import Parser


def add(parser: Parser) -> None:
    """Add the arguments."""
    parser.describe(
        "runs/ddpg_5v2o_1 runs/ddpg_5v2o_2 -o curves.png",
        description="Print the best evaluations of trainings and what differs in their configs; plot their curves.",
        renamed={"--out": "--output"},
    )
    parser.add_argument("runs", nargs="+", metavar="RUN", help="run folders")
    shared.add_output(parser, "also plot the evaluations to this .png or .svg")


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Print the tables, and plot where asked for."""
    from sb3_flock.console import PlainConsole
    from sb3_flock.viz.compare import differences_table, load_runs, plot_curves, results_table
    from sb3_flock.viz.figures import check_figure_file, save_as

    if options.output is not None:
        with written_to("--output", options.output):
            check_figure_file(Path(options.output))
    runs = load_runs(options.runs)
    console = PlainConsole()
    console.print(results_table(runs))
    differences = differences_table(runs)
    if differences is not None:
        console.print(differences)
    if options.output is not None:
        with written_to("--output", options.output):
            save_as(plot_curves(runs), Path(options.output), Path(options.output).suffix[1:])
        print(options.output)
    return 0
