"""Tables of the report, and how their cells format numbers."""

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

_MOST_ROWS: Final = 1000
UNKNOWN: Final = "\N{EN DASH}"


class ReportTable(NamedTuple):
    """A table of the report; `more` rows were left out."""

    key: str  # its id in the page
    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    more: int = 0


def table_of(key: str, title: str, note: str, columns: Iterable[str], rows: Sequence[Sequence[str]]) -> ReportTable:
    """Return a table of the first rows, as many as fit a page, with the number of rows left out."""
    kept = tuple(tuple(row) for row in rows[:_MOST_ROWS])
    return ReportTable(key, title, note, tuple(columns), kept, len(rows) - len(kept))


def number(value: float | None, digits: int) -> str:
    """Return a number with this many decimals; a dash for None."""
    return UNKNOWN if value is None else f"{value:.{digits}f}"


def numbers(values: Sequence[float | None] | None) -> str:
    """Return numbers with three decimals, separated by commas."""
    return UNKNOWN if values is None else ", ".join(number(value, 3) for value in values)
