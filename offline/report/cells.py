"""What a table of the report is, and how its cells say numbers."""

from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

_MOST_ROWS: Final = 1000
UNKNOWN: Final = "\N{EN DASH}"


class ReportTable(NamedTuple):
    """A table and what it is about; `more` rows were left out."""

    key: str  # names it in the page
    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    more: int = 0


def table_of(key: str, title: str, note: str, columns: Iterable[str], rows: Sequence[Sequence[str]]) -> ReportTable:
    """A table of the first rows, as many as a page takes; how many it leaves out it says itself."""
    kept = tuple(tuple(row) for row in rows[:_MOST_ROWS])
    return ReportTable(key, title, note, tuple(columns), kept, len(rows) - len(kept))


def number(value: float | None, digits: int) -> str:
    """So many digits after the point; a dash for what is not known."""
    return UNKNOWN if value is None else f"{value:.{digits}f}"


def numbers(values: Sequence[float | None] | None) -> str:
    """To a thousandth, beside each other."""
    return UNKNOWN if values is None else ", ".join(number(value, 3) for value in values)
