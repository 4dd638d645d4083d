"""Tables of the report, and how their cells format numbers."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple

_MOST_ROWS: Final = 1000
_MOST_NAMES: Final = 12  # in a cell
UNKNOWN: Final = "\N{EN DASH}"


class ReportTable(NamedTuple):
    """A table of the report; `more` rows were left out."""

    key: str  # its id in the page
    title: str
    note: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    more: int = 0
    targets: tuple[str, ...] = ()  # of each row, the tags that it shows in the map: see `tag_targets`


def table_of(
    key: str,
    title: str,
    note: str,
    columns: Iterable[str],
    rows: Sequence[Sequence[str]],
    targets: Sequence[str] = (),
) -> ReportTable:
    """Return a table of the first rows, as many as fit a page, with the number of rows left out."""
    kept = tuple(tuple(row) for row in rows[:_MOST_ROWS])
    return ReportTable(key, title, note, tuple(columns), kept, len(rows) - len(kept), tuple(targets[:_MOST_ROWS]))


def tag_targets(document: dict[str, Any]) -> list[str]:
    """Return for each tag its component and its index among the figure's tags, separated by a colon."""
    counts: Counter[int] = Counter()
    targets = []
    for tag in document["tags"]:
        targets.append(f"{tag['component']}:{counts[tag['component']]}")
        counts[tag["component"]] += 1
    return targets


def number(value: float | None, digits: int) -> str:
    """Return a number with this many decimals; a dash for None."""
    return UNKNOWN if value is None else f"{value:.{digits}f}"


def numbers(values: Sequence[float | None] | None) -> str:
    """Return numbers with three decimals, separated by commas."""
    return UNKNOWN if values is None else ", ".join(number(value, 3) for value in values)


def names_text(names: Sequence[str]) -> str:
    """Return names separated by commas; of many the first ones, and how many more there are."""
    text = ", ".join(names[:_MOST_NAMES])
    return text if len(names) <= _MOST_NAMES else f"{text} and {len(names) - _MOST_NAMES} more"


def length_text(value_m: float) -> str:
    """Return a length in centimetres, above 9.5 cm in metres."""
    return f"{value_m:.2f} m" if value_m >= 0.095 else f"{100.0 * value_m:.1f} cm"


def percent_text(share: float) -> str:
    """Return a share in per cent."""
    return f"{100.0 * share:.2f} %"


def has_several_families(document: dict[str, Any]) -> bool:
    """Whether a tag needs its family beside its id."""
    return len({tag["family"] for tag in document["tags"]}) > 1


def tag_label(tag: dict[str, Any], *, several_families: bool) -> str:
    """Return id and instance, with the family if the map has several."""
    label = f"{tag['tag_id']}{tag['instance']}"
    return f"{tag['family']}:{label}" if several_families else label
