"""``sb3-flock reproduce``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from sb3_flock.cli import shared
from sb3_flock.cli.messages import written_to
from sb3_flock.cli.parsing import Parser


def add(parser: Parser) -> None:
    """Add the arguments."""
    parser.describe(
        "--quick -o results",
        description="Evaluate the shipped policies and the baseline controllers; write the paper's tables and figures "
        "with ours.",
        renamed={"--out": "--output"},
    )
    shared.add_output(parser, "folder to write to [results]", metavar="DIR", default="results")
    parser.add_argument("--quick", action="store_true", help="100 episodes a row instead of 1000, the rest shortened alike")


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Reproduce, and print the path of the page."""
    import torch as th

    from sb3_flock.reproduce import reproduce

    th.set_num_threads(1)
    with written_to("--output", options.output):
        print(reproduce(options.output, options.quick))
    return 0
