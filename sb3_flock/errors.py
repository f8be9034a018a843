"""Errors that several parts of the package raise. This module imports nothing, so that the command line starts at once."""

from __future__ import annotations


def printable(text: str) -> str:
    """The text with ``?`` in place of every letter that does not print, such as a line feed or an escape sequence."""
    return "".join(letter if letter.isprintable() else "?" for letter in text)


class UserError(ValueError):
    """A mistake that the user can correct; the message is one printable line, whatever a file or a flag put into it."""

    def __init__(self, message: str) -> None:
        super().__init__(printable(message[:_MAX_MESSAGE]))


_MAX_MESSAGE = 2000


class RunError(RuntimeError):
    """A run failed for a reason outside its parameters: a full disk, a dead worker, a diverged training."""


class ActionError(UserError):
    """Actions are not finite or have another shape than they need."""


class SettingsError(UserError):
    """A parameter has a value that is not accepted.

    :param parts: one message for each parameter
    """

    def __init__(self, *parts: str) -> None:
        self.parts = parts
        super().__init__("; ".join(parts))
