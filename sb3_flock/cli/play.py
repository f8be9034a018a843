"""``sb3-flock play``, also called ``enjoy`` as in rl_zoo3."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from sb3_flock.cli import shared
from sb3_flock.cli.parsing import Parser


def add(parser: Parser) -> None:
    """Add the arguments."""
    parser.describe(
        "flock --n-vehicles 8",
        description="Simulate live in a window: drag the waypoint, drop obstacles, add vehicles, show what one of them senses, "
        "switch the safety filter.",
        renamed=shared.ROLLOUT_RENAMED,
    )
    shared.add_rollout(parser)
    shared.add_speed(parser)


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Open the window."""
    from sb3_flock.viz.play import play

    controller, _, scenario = shared.rollout_of(options)
    play(controller, scenario, options.seed, options.speed)
    return 0
