"""``sb3-flock config``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_flock.cli import shared, train
from sb3_flock.cli.messages import written_to
from sb3_flock.cli.parsing import Parser


def add(parser: Parser) -> None:
    """Add the arguments."""
    parser.describe(
        "--n-vehicles 5 -o mine.yaml",
        description="Print the config that `train` would run with the same flags, as YAML with a comment on every key.",
        renamed=train.RENAMED,
    )
    shared.add_output(parser, "write the config to this file instead of printing it")
    train.add_config_flags(parser)


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Print or write the config."""
    from sb3_flock.serialization.yaml_io import to_yaml

    text = to_yaml(train.config_of(options))
    if options.output is None:
        print(text, end="")
    else:
        with written_to("--output", options.output):
            Path(options.output).write_text(text, encoding="utf-8")
        print(options.output)
    return 0
