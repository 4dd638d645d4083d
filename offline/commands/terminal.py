"""Lines of the commands on a terminal: colours and tables."""

import os
from collections.abc import Iterable, Sequence
from typing import Final

import typer

from groundsbot.calib.foundation import printable

# Colours of the beginnings of lines.
_COLOURS: Final = {
    "Use this map with care": "yellow",
    "Use this map": "green",
    "Do not use this map": "red",
    "lost:": "red",
    "not located:": "red",
    "suspect:": "yellow",
    "warning:": "yellow",
    "not freed:": "yellow",
    "advice:": "cyan",
    "map:": "blue",
    "page:": "blue",
    "picture:": "blue",
    "report:": "blue",
    "trajectory:": "blue",
    "written:": "blue",
}


def echo_lines(lines: Iterable[str]) -> None:
    """Write lines to stdout; on a terminal with their first words in colour, unless NO_COLOR is set."""
    # `typer.echo` removes colours where stdout is no terminal.
    is_coloured = not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"
    for line in map(printable, lines):
        begin = next((each for each in _COLOURS if line.startswith(each)), "") if is_coloured else ""
        style = typer.style(begin, fg=_COLOURS[begin], bold=True) if begin else ""
        typer.echo(style + line.removeprefix(begin))


def table_lines(head: Sequence[str], rows: Sequence[Sequence[str]], n_text: int) -> list[str]:
    """Return the lines of a table.

    The first `n_text` columns, and those whose head is empty, are flush left, all others flush right.
    """
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    is_left = [i < n_text or not name for i, name in enumerate(head)]
    return [
        "  ".join(
            f"{cell:<{width}}" if left else f"{cell:>{width}}"
            for cell, width, left in zip(row, widths, is_left, strict=True)
        ).rstrip()
        for row in (head, *rows)
    ]
