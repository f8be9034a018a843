"""What goes to stderr: warnings as one line each, and errors of the library with the flag they belong to."""

from __future__ import annotations

import contextlib
import sys
import warnings
from collections.abc import Iterator
from typing import Any

from sb3_flock._renamed import RenamedWarning
from sb3_flock.errors import SettingsError, UserError


@contextlib.contextmanager
def warnings_as_lines() -> Iterator[None]:
    """Show each warning as one line on stderr, once, without its place in the source."""
    shown = set()

    def show(message: Warning | str, *_: Any, **__: Any) -> None:
        from sb3_flock.serialization.yaml_io import EarlierFormatWarning

        text = " ".join(str(message).split())
        if isinstance(message, EarlierFormatWarning):
            text += f"; `sb3-flock migrate {message.path}` rewrites it"
        if text not in shown:
            shown.add(text)
            print(f"sb3-flock: warning: {UserError(text)}", file=sys.stderr)

    with warnings.catch_warnings():
        warnings.filterwarnings("always", category=UserWarning, module="sb3_flock")
        warnings.simplefilter("always", RenamedWarning)
        warnings.showwarning = show
        yield


@contextlib.contextmanager
def errors_of(flag: str, value: Any) -> Iterator[None]:
    """Put the flag before an error of the library that is about the flag's value.

    :raises SettingsError: one line
    """
    try:
        yield
    except UserError as error:
        if not str(error).startswith(f"{value}: "):
            raise
        raise SettingsError(f"{flag} {error}") from None


@contextlib.contextmanager
def written_to(flag: str, value: Any) -> Iterator[None]:
    """The same for a file or folder that is written: if it cannot be, the value is a mistake of the user.

    :raises SettingsError: one line
    """
    try:
        with errors_of(flag, value):
            yield
    except OSError as error:
        raise SettingsError(f"{flag} {value}: {error.strerror or error}") from None
