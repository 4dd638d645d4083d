"""The report as one page: text and tables, style, script, plotly's own script and the data in one file.

Names of runs, families of tags and events come from files of unknown origin. The template escapes all text; data is in
a script element that is not executed, and contains no `<` that could end it.
"""

from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from groundsbot.calib.foundation import plural
from groundsbot.offline.report.accuracy_texts import KeyFigure
from groundsbot.offline.report.cells import ReportTable
from groundsbot.offline.report.verdict import FORBIDS, NEEDS_CARE, SLIGHT, Doubt

if TYPE_CHECKING:
    from jinja2 import Template

_ASSETS: Final = "groundsbot.offline.report.assets"
# Longer tables are collapsed.
_MOST_ROWS_SHOWN: Final = 30
_LONG_CELL: Final = 40  # characters; such a cell keeps a readable width in a narrow window
_CLASSES: Final = {SLIGHT: "use", NEEDS_CARE: "care", FORBIDS: "no"}
# What the contents call the sections, in the order of the page.
_LINKS: Final = {
    "map": "map",
    "timeline": "drives",
    "summary": "summary",
    "warnings": "warnings",
    "suspects": "suspects",
    "before": "before merging",
    "advice": "advice",
    "alignments": "alignments",
    "holding": "connecting tags",
    "starts": "starts",
    "robots": "robots",
    "checks": "wheels and tags",
    "metres": "scale",
    "measurements": "by hand",
    "searches": "time offsets",
    "runs": "runs",
    "tags": "tags",
    "noise": "noise",
}


class Opening(NamedTuple):
    """What stands above the map."""

    title: str
    verdict: str
    weight: int  # of the gravest doubt
    next_step: str  # may be empty
    figures: Sequence[KeyFigure]
    doubts: Sequence[Doubt]


def page(
    opening: Opening,
    sentences: Sequence[str],
    warnings: Sequence[str],
    tables: Sequence[ReportTable],
    figures: dict[str, Any],
) -> str:
    """Return the whole page as text."""
    from plotly.offline import get_plotlyjs

    by_key = {table.key: table for table in tables}
    is_there = dict.fromkeys(("map", "timeline", "summary", *by_key), True) | {
        "warnings": bool(warnings),
        "before": any(component["is_merged"] for component in figures["components"]),
        "searches": bool(figures["searches"]),
    }
    return _template().render(
        opening=opening,
        verdict_class=_CLASSES[opening.weight],
        links={key: name for key, name in _LINKS.items() if is_there.get(key)},
        sentences=sentences,
        warnings=warnings,
        tables=by_key,
        figures=figures,
        most_rows_shown=_MOST_ROWS_SHOWN,
        long_cell=_LONG_CELL,
        plural=plural,
        style=asset("page.css"),
        script="".join(asset(name) for name in ("plots.js", "map.js", "timeline.js", "page.js")),
        plotly=get_plotlyjs(),
    )


@cache
def _template() -> "Template":
    from jinja2 import Environment, StrictUndefined

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "ensure_ascii": False, "separators": (",", ":")}
    return environment.from_string(asset("page.html"))


def asset(name: str) -> str:
    """Return a part of the page: its style, or a script."""
    return files(_ASSETS).joinpath(name).read_text(encoding="utf-8")
