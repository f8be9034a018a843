"""``sb3-flock migrate``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from sb3_flock.cli.parsing import USAGE_ERROR, Parser
from sb3_flock.errors import UserError


def add(parser: Parser) -> None:
    """Add the arguments."""
    parser.describe(
        "mine.zip mine.yaml",
        description="Rewrite policies (zip), model cards (JSON) and configs (YAML) of an earlier release in the present "
        "format, in place. A policy keeps its weights to the last bit. No code from the files is run.",
    )
    parser.add_argument("files", nargs="+", metavar="FILE", help="files to rewrite; a run folder's checkpoints need not be")


def run(options: argparse.Namespace, words: Sequence[str]) -> int:
    """Rewrite each file, and print one line for each; a file that is refused does not stop the others."""
    from sb3_flock.serialization.migrate import FORMAT
    from sb3_flock.serialization.rewrite import rewrite

    code = 0
    for file in options.files:
        try:
            done = rewrite(file)
        except UserError as error:
            print(f"sb3-flock: {error}", file=sys.stderr)
            code = USAGE_ERROR
        else:
            print(f"{file}: {'rewritten in' if done else 'has'} the present format ({FORMAT})")
    return code
