"""The ``sb3-flock`` command: one module per subcommand.

The module of a subcommand is imported when it is called, and imports the rest when it runs, so that ``--help`` is quick.
Nothing outside this package knows about flags.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

from sb3_flock.cli.messages import warnings_as_lines
from sb3_flock.cli.parsing import FAILED, INTERRUPTED, USAGE_ERROR, Parser, VersionAction
from sb3_flock.errors import RunError, UserError

COMMANDS = {
    "train": "train a policy",
    "evaluate": "simulate many episodes of a policy and print its metrics",
    "render": "simulate one episode and write a figure, a video or a web page",
    "play": "simulate live in a window, with mouse and keys",
    "export": "write a policy as ONNX or C, for a vehicle's computer",
    "ros2": "drive one vehicle by a policy, as a node of ROS 2",
    "compare": "show trainings side by side",
    "reproduce": "write the paper's tables and figures with ours",
    "sweep": "train or evaluate at many settings, also on a Ray cluster",
    "config": "print a training's whole config, every key explained",
    "policies": "list the shipped policies, or show the model card of one",
    "migrate": "rewrite files of an earlier release in the present format",
}
"""The subcommands in the order of ``--help``, with a line each; a module has the name of its subcommand."""

ALIASES = {"play": ["enjoy"]}
"""Other names of subcommands, as rl_zoo3 has them."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    :param arguments: the words after ``sb3-flock``; the default is the process's own
    :return: the exit code: 0, 2 after a user's mistake (one line on stderr says which), 1 if the disk, a worker or a training
        fails or nobody reads the output, 130 after Ctrl-C
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    with warnings_as_lines():
        try:
            try:
                options = _parse(words)
                return int(options.run(options, words))
            finally:  # what was printed is written, or an error, now: at the end of the process Python would show a traceback
                sys.stdout.flush()
        except BrokenPipeError:
            _discard_output()
            return FAILED
        except OSError as error:  # such as a full disk behind a redirected output
            _discard_output()
            print(f"sb3-flock: {error.filename or 'output'}: {error.strerror or error}", file=sys.stderr)
            return FAILED
        except KeyboardInterrupt:
            print("sb3-flock: interrupted", file=sys.stderr)
            return INTERRUPTED
        except UserError as error:
            print(f"sb3-flock: {error}", file=sys.stderr)
            return USAGE_ERROR
        except (MemoryError, RunError) as error:
            is_memory = isinstance(error, MemoryError)
            what = " ".join(str(error).split()) or "something is too large"
            print(f"sb3-flock: {'not enough memory: ' if is_memory else ''}{what}", file=sys.stderr)
            return FAILED


def _discard_output() -> None:
    """Nobody reads what is still to be printed."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _parse(words: Sequence[str]) -> argparse.Namespace:
    """The options; a wrong flag ends the process with one line that suggests the right one."""
    parser = _parser()
    if any("\0" in word for word in words):  # only a caller of main can give one; no file's name has it
        parser.error("a null character is in the arguments")
    options, unknown = parser.parse_known_args(words)
    if unknown:
        options.parser.refuse(unknown)
    return options


def _parser() -> Parser:
    parser = Parser(
        prog="sb3-flock",
        description="Multi-vehicle flocking by reinforcement learning.",
        epilog="example: sb3-flock train --n-vehicles 5 --n-obstacles 2",
    )
    parser.add_argument("--version", action=VersionAction, nargs=0, help="show the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for name, line in COMMANDS.items():
        commands.add_parser(name, help=line, aliases=ALIASES.get(name, ()), module=f"{__name__}.{name}")
    return parser
