"""The terminal: what is printed may hold names and values from strangers' files, and shows as it is."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

from sb3_flock.errors import printable

LEAST_WIDTH = 80
"""Tables are never narrower, so that no digit is cut: a narrower terminal wraps their lines."""


class PlainConsole(Console):
    """A rich console for plain text: no markup, no emoji codes, and nothing that moves the terminal's cursor.

    :param options: as for rich's ``Console``
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(markup=False, emoji=False, highlight=False, **options)

    def render_str(self, text: str, **options: Any) -> Text:
        """The text with ``?`` in place of everything that is not printable."""
        return super().render_str("\n".join(map(printable, text.split("\n"))), **options)

    def print(self, *objects: Any, **options: Any) -> None:
        """Print; a table has room for its digits, also where the terminal does not."""
        width = self.width
        if width >= LEAST_WIDTH or not any(isinstance(thing, Table) for thing in objects):
            super().print(*objects, **options)
            return
        self.width = LEAST_WIDTH
        try:
            super().print(*objects, **options)
        finally:
            self.width = width
