import io

import pytest
from rich.table import Table

from sb3_flock.console import LEAST_WIDTH, PlainConsole


def printed(*objects, width=100, **options):
    console = PlainConsole(file=io.StringIO(), width=width, **options)
    console.print(*objects)
    return console.file.getvalue()


@pytest.mark.parametrize("text", ["runs/x[/y]", "runs[v2]", "[bold]a[/bold]", ":smile:", "a\\[b]"])
def test_text_shows_as_it_is(text):
    assert printed(text) == f"{text}\n"
    table = Table(box=None)
    table.add_column(text)
    table.add_row(text)
    assert printed(table).split() == [text, text]


def test_what_would_move_the_cursor_is_not_printed():
    hostile = "\x1b[2J\x1b]0;title\x07a\rb\u202ec"
    for force_terminal in (False, True):
        shown = printed(hostile, force_terminal=force_terminal)
        assert shown == "?[2J?]0;title?a?b?c\n"
    assert printed("two\nlines") == "two\nlines\n"


@pytest.mark.parametrize("width", [1, 20, LEAST_WIDTH])
def test_a_narrow_terminal_does_not_cut_a_tables_digits(width):
    table = Table(box=None)
    for column in range(6):
        table.add_column(f"column {column}", no_wrap=True)
    table.add_row(*["0.123456"] * 6)
    console = PlainConsole(file=io.StringIO(), width=width)
    console.print(table)
    assert console.file.getvalue().count("0.123456") == 6
    assert console.width == width


def test_the_words_of_a_paragraph_wrap_at_the_terminals_width():
    assert max(map(len, printed("word " * 20, width=20).splitlines())) <= 20
