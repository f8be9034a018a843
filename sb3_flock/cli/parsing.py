"""The parser: argparse with errors in one line, hints, and the flags of the previous release."""

from __future__ import annotations

import argparse
import difflib
import importlib
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from sb3_flock._renamed import warn_renamed
from sb3_flock.errors import UserError

if TYPE_CHECKING:
    from sb3_flock.settings import Settings

FAILED = 1
USAGE_ERROR = 2
INTERRUPTED = 130


class Parser(argparse.ArgumentParser):
    """argparse with errors in one line and without guesses at abbreviated flags.

    :param module: a subcommand's module, imported when its words are parsed: its ``add(parser)`` describes the subcommand and
        adds the arguments, its ``run(options, words)`` runs it
    """

    def __init__(self, module: str | None = None, **kwargs: Any) -> None:
        self.flags: list[str] = []
        self.fields: list[str] = []
        """What ``--set`` takes, for hints."""
        self._module = module
        self._renamed: Mapping[str, str] = {}
        super().__init__(allow_abbrev=False, **kwargs)

    def describe(
        self, example: str, description: str, renamed: Mapping[str, str] | None = None, usage: str | None = None
    ) -> None:
        """Describe a subcommand.

        :param example: words behind its name
        :param renamed: old to new names of flags; an old one works, with a warning
        """
        self.description, self.epilog, self.usage = description, f"example: {self.prog} {example}", usage
        self._renamed = renamed or {}

    def add_argument(self, *args: Any, **kwargs: Any) -> argparse.Action:
        """Add an argument, and remember its flags for hints."""
        action = super().add_argument(*args, **kwargs)
        self.flags += action.option_strings
        return action

    def add_set(self, example: str, settings: type[Settings], which: str = "them all") -> None:
        """Add ``--set`` for the fields of a settings class."""
        from sb3_flock.settings import leaf_paths

        self.fields += [".".join(path) for path in leaf_paths(settings)]
        self.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="KEY=VALUE",
            help=f"change any other field, such as {example}; `sb3-flock config` lists {which}",
        )

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Parse, with old flags under their present names."""
        if self._module is not None:
            command, self._module = importlib.import_module(self._module), None
            self.set_defaults(run=command.run, parser=self)
            command.add(self)
        words = list(sys.argv[1:] if args is None else args)
        return super().parse_known_args([self._present(word) for word in words], namespace)

    def _present(self, word: str) -> str:
        flag, equals, value = word.partition("=")
        if flag not in self._renamed:
            return word
        warn_renamed(flag, self._renamed[flag])
        return f"{self._renamed[flag]}{equals}{value}"

    def refuse(self, unknown: Sequence[str]) -> None:
        """End the process because of unknown words, with a hint at the flag or field that may have been meant."""
        wrong = next((word for word in unknown if word.startswith("-")), unknown[0])
        self.error(f"unrecognized arguments: {' '.join(unknown)}{self._hint(wrong.partition('=')[0])}")

    def _hint(self, flag: str) -> str:
        close = difflib.get_close_matches(flag.replace("_", "-"), self.flags, n=1, cutoff=0.75)
        if close:
            return f"; did you mean {close[0]}?"
        from sb3_flock.settings import suggest

        hint = suggest(flag.lstrip("-").replace("-", "_"), self.fields)
        return hint.replace("did you mean ", "did you mean --set ").replace("?", "=VALUE?")

    def error(self, message: str) -> Any:
        """End the process with one line."""
        self.exit(USAGE_ERROR, f"{self.prog}: {UserError(message)} (try {self.prog} --help)\n")


class VersionAction(argparse.Action):
    """Print the version and exit."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Called by argparse."""
        from importlib.metadata import version

        print(f"sb3-flock {version('sb3_flock')}")
        parser.exit()


def whole_number(text: str) -> int | str:
    """An integer that is written as ``1e5`` or ``2.0`` as an integer; any other text as it is."""
    try:
        value = float(text)
    except ValueError:
        return text
    is_plain = text.strip().lstrip("+-").isdigit()
    return int(value) if math.isfinite(value) and value.is_integer() and not is_plain else text


def count(least: int) -> Callable[[str], int]:
    """The type of an argument that is an integer of at least ``least``."""

    def integer(text: str) -> int:
        try:
            value = int(whole_number(text))
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(f"{text}: an integer of at least {least} is needed")
        return value

    return integer


def listed(names: Iterable[str]) -> str:
    """Names as help shows them."""
    return ", ".join(names)
