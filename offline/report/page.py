"""The report as one page: text and tables, style, script, plotly's own script and the data in one file.

Names of runs, families of tags and events come from files of unknown origin. All text goes through an element tree,
which escapes it; data is in a script element that is not executed, and contains no `<` that could end it.
"""

import json
from collections.abc import Sequence
from importlib.resources import files
from string import Template
from typing import Any, Final
from xml.etree.ElementTree import Element, SubElement, tostring

from groundsbot.offline.report.cells import ReportTable

_ASSETS: Final = "groundsbot.offline.report.assets"
# Longer tables are collapsed.
_MOST_ROWS_SHOWN: Final = 30
_ABOVE: Final = ("suspects",)
_LONG_CELL: Final = 40  # characters; such a cell keeps a readable width in a narrow window
_MIDDLE: Final = ("advice", "alignments", "holding", "starts", "robots", "checks", "metres", "measurements")
_BELOW: Final = ("runs", "tags", "noise")


def page(
    title: str,
    sentences: Sequence[str],
    warnings: Sequence[str],
    tables: Sequence[ReportTable],
    figures: dict[str, Any],
) -> str:
    """Return the whole page as text."""
    from plotly.offline import get_plotlyjs

    main, by_key = Element("main"), {table.key: table for table in tables}
    _text(main, "h1", title)
    words = SubElement(main, "div", id="words")
    for sentence in sentences:
        _text(words, "p", sentence)
    if warnings:
        listed = SubElement(_section(main, "warnings", "Warnings"), "ul")
        for warning in warnings:
            _text(listed, "li", warning)
    _add_tables(main, by_key, _ABOVE)
    _add_map(main, figures["components"])
    _add_unmerged_maps(main, figures["components"])
    _add_tables(main, by_key, _MIDDLE)
    _add_searches(main, figures["searches"])
    _add_timelines(main, figures["timelines"], figures["n_timelines"])
    _add_tables(main, by_key, _BELOW)
    title_element = Element("title")
    title_element.text = title
    return Template(_asset("page.html")).substitute(
        title=_html(title_element),
        main=_html(main),
        data=as_script_data(figures),
        style=_asset("page.css"),
        script=_asset("page.js"),
        plotly=get_plotlyjs(),
    )


def as_script_data(value: object) -> str:
    """Return JSON that is safe inside a script element, whatever its strings are."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    # The only characters that HTML could interpret there.
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _add_map(main: Element, components: Sequence[dict[str, Any]]) -> None:
    section = _section(
        main,
        "map",
        "The map",
        "Drag to move, turn the wheel to zoom, click twice to see all. Point at a tag to see its sigmas. "
        "A click in the legend shows or hides a layer.",
    )
    if any(component["has_both"] for component in components):
        frames = {component["frame"] for component in components}
        from_frame = f"relative to {frames.pop()}" if len(frames) == 1 else "relative to each frame"
        _add_buttons(
            section, "ellipses", {"shape": "relative to the other tags", "frame": from_frame}, "95 % ellipses:"
        )
    for index, component in enumerate(components):
        caption = f"Component {index + 1}, in the frame of {component['frame']}" if len(components) > 1 else ""
        _figure(section, "map", index, caption)


def _add_unmerged_maps(main: Element, components: Sequence[dict[str, Any]]) -> None:
    if not any(component["is_merged"] for component in components):
        return
    section = _section(
        main,
        "before",
        "Before merging",
        "Each run solved alone, placed by the alignments. Lines connect the positions of one tag in different runs.",
    )
    _add_buttons(section, "layers", {"over": "over each other", "apart": "apart"})
    for index, component in enumerate(components):
        if component["is_merged"]:
            _figure(section, "before", index, f"Component {index + 1}" if len(components) > 1 else "")


def _add_searches(main: Element, searches: Sequence[dict[str, Any]]) -> None:
    if not searches:
        return
    section = _section(
        main,
        "searches",
        "Search for time offsets",
        "Cost of each delay of the pictures' stamps relative to robot.yaml; half a unit above the minimum is one "
        "sigma. The line marks the estimate. A single, narrow minimum means that the offset is well determined.",
    )
    for index, each in enumerate(searches):
        _figure(section, "search", index, each["robot"])


def _add_timelines(main: Element, timelines: Sequence[dict[str, Any]], n_timelines: int) -> None:
    section = _section(
        main,
        "timelines",
        "Drive by drive",
        "Speed by the wheels; tags in view of a keyframe; residuals of its observations in sigmas, as root mean square "
        "and largest (grey): about 1 where the noise model is right. Grey bands: no wheel readings. Marks above: "
        "events of the recorder, losses in red.",
    )
    for index, each in enumerate(timelines):
        _figure(section, "timeline", index, each["run"])
    if n_timelines > len(timelines):
        _note(section, f"The first {len(timelines)} of {n_timelines}.")


def _add_tables(main: Element, tables: dict[str, ReportTable], keys: Sequence[str]) -> None:
    for key in keys:
        if key in tables:
            _add_table(main, tables[key])


def _add_table(main: Element, table: ReportTable) -> None:
    section = _section(main, table.key, table.title, table.note)
    holder = section
    if len(table.rows) > _MOST_ROWS_SHOWN:
        holder = SubElement(section, "details")
        _text(holder, "summary", f"{len(table.rows)} rows")
    element = SubElement(SubElement(holder, "div", {"class": "scroll"}), "table")
    head = SubElement(SubElement(element, "thead"), "tr")
    for column in table.columns:
        _text(head, "th", column).set("scope", "col")
    body = SubElement(element, "tbody")
    for row in table.rows:
        line = SubElement(body, "tr")
        for cell in row:
            element = _text(line, "td", cell)
            if len(cell) > _LONG_CELL:
                element.set("class", "long")
    if table.more:
        _note(section, f"{table.more} more in map.json.")


def _section(main: Element, key: str, title: str, note: str = "") -> Element:
    section = SubElement(main, "section", id=key)
    _text(section, "h2", title)
    if note:
        _note(section, note)
    return section


def _add_buttons(section: Element, name: str, labels: dict[str, str], before: str = "") -> None:
    """Add a choice of the page's script, the first value chosen."""
    buttons = _text(section, "p", before)
    buttons.set("class", "buttons")
    for i, (value, label) in enumerate(labels.items()):
        button = _text(buttons, "button", label)
        button.attrib |= {"type": "button", "data-choice": name, "data-value": value}
        button.set("aria-pressed", "false" if i else "true")


def _figure(section: Element, kind: str, index: int, caption: str) -> None:
    figure = SubElement(section, "figure")
    if caption:
        _text(figure, "figcaption", caption)
    SubElement(figure, "div", {"class": f"plot {kind}", "data-index": str(index)})


def _note(section: Element, text: str) -> None:
    _text(section, "p", text).set("class", "note")


def _text(parent: Element, kind: str, text: str) -> Element:
    element = SubElement(parent, kind)
    element.text = text
    return element


def _html(element: Element) -> str:
    return tostring(element, encoding="unicode", method="html")


def _asset(name: str) -> str:
    return files(_ASSETS).joinpath(name).read_text(encoding="utf-8")
