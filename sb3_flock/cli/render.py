"""``sb3-flock render``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_flock.cli import shared
from sb3_flock.cli.messages import written_to
from sb3_flock.cli.parsing import Parser, count


def add(parser: Parser) -> None:
    """Add the arguments."""
    parser.describe(
        "flock -o episode.html --episode 3",
        description="Simulate one episode and write it: .gif, .mp4 and .html are videos, .png and .svg show the paths.",
        renamed={**shared.ROLLOUT_RENAMED, "--out": "--output"},
    )
    shared.add_rollout(parser)
    shared.add_output(parser, "file to write; its ending is the format", required=True)
    parser.add_argument("--episode", type=count(0), default=0, metavar="N", help="number of the seed's episode [0]")
    shared.add_speed(parser)
    parser.add_argument(
        "--view", choices=("plan", "simulator"), default="plan", help="from above, or the simulator's own pictures [plan]"
    )


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Render, and print the file's path."""
    from sb3_flock.console import PlainConsole
    from sb3_flock.viz.video import check_video, check_view, render

    with written_to("--output", options.output):
        check_video(Path(options.output), options.speed)
    controller, name, scenario = shared.rollout_of(options)
    check_view(options.view, Path(options.output), scenario)
    title = f"{options.policy or name}: {scenario.bodies}, episode {options.episode} of seed {options.seed}"
    with PlainConsole(stderr=True).status("simulating"), written_to("--output", options.output):
        path = render(
            controller, scenario, options.output, options.seed, options.episode, options.speed, title, options.view
        )
    print(path)
    return 0
