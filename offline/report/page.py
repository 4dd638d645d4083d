"""The report as one page: text and tables, style, script, plotly's own script and the data in one file.

Names of runs, families of tags and events come from files of unknown origin. All text goes through an element tree,
which escapes it; data is in a script element that is not executed, and contains no `<` that could end it.
"""

import json
from collections.abc import Sequence
from importlib.resources import files
from itertools import zip_longest
from string import Template
from typing import Any, Final, NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring

from groundsbot.calib.foundation import plural
from groundsbot.offline.report.cells import ReportTable
from groundsbot.offline.report.sentences import KeyFigure
from groundsbot.offline.report.verdict import FORBIDS, NEEDS_CARE, SLIGHT, Doubt

_ASSETS: Final = "groundsbot.offline.report.assets"
# Longer tables are collapsed.
_MOST_ROWS_SHOWN: Final = 30
_ABOVE: Final = ("suspects",)
_LONG_CELL: Final = 40  # characters; such a cell keeps a readable width in a narrow window
_MIDDLE: Final = ("advice", "alignments", "holding", "starts", "robots", "checks", "metres", "measurements")
_BELOW: Final = ("runs", "tags", "noise")
_CLASSES: Final = {SLIGHT: "use", NEEDS_CARE: "care", FORBIDS: "no"}
# What the contents call the sections.
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

    main, by_key = Element("main"), {table.key: table for table in tables}
    header = SubElement(main, "header")
    _add_map(main, figures["components"])
    _add_timeline(main, figures["timelines"], figures["residual_rms"])
    words = SubElement(_section(main, "summary", "Summary"), "div", id="words")
    for sentence in sentences:
        _text(words, "p", sentence)
    if warnings:
        listed = SubElement(_section(main, "warnings", "Warnings"), "ul")
        for warning in warnings:
            _text(listed, "li", warning)
    _add_tables(main, by_key, _ABOVE)
    _add_unmerged_maps(main, figures["components"])
    _add_tables(main, by_key, _MIDDLE)
    _add_searches(main, figures["searches"])
    _add_tables(main, by_key, _BELOW)
    _add_opening(header, opening, [section.get("id", "") for section in main.iter("section")])
    title_element = Element("title")
    title_element.text = opening.title
    return Template(_asset("page.html")).substitute(
        title=_html(title_element),
        main=_html(main),
        data=as_script_data(figures),
        style=_asset("page.css"),
        script="".join(_asset(name) for name in ("map.js", "timeline.js", "page.js")),
        plotly=get_plotlyjs(),
    )


def as_script_data(value: object) -> str:
    """Return JSON that is safe inside a script element, whatever its strings are."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    # The only characters that HTML could interpret there.
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _add_opening(header: Element, opening: Opening, sections: Sequence[str]) -> None:
    """Add the verdict, the figures and the contents."""
    _text(header, "h1", opening.title)
    verdict = _text(header, "p", opening.verdict)
    verdict.attrib |= {"id": "verdict", "class": _CLASSES[opening.weight]}
    if opening.next_step:
        _text(header, "p", f"Next: {opening.next_step}").set("id", "next")
    listed = SubElement(header, "dl")
    for name, value, note in opening.figures:
        _text(_key_figure(listed, name, value), "small", note)
    links = SubElement(_key_figure(listed, "doubts", str(sum(doubt.n for doubt in opening.doubts))), "small")
    for doubt in opening.doubts:
        known = doubt.section in sections or doubt.section == "words"
        link = _text(links, "a" if known else "span", plural(doubt.n, doubt.name))
        if known:
            link.set("href", f"#{doubt.section}")
    contents = SubElement(header, "nav")
    for section in sections:
        _text(contents, "a", _LINKS[section]).set("href", f"#{section}")


def _key_figure(listed: Element, name: str, value: str) -> Element:
    """Add a figure, and return the element that its note is to be added to."""
    group = SubElement(listed, "div")
    _text(group, "dt", name)
    _text(group, "dd", value).set("class", "value")
    return SubElement(group, "dd")


def _add_map(main: Element, components: Sequence[dict[str, Any]]) -> None:
    section = _section(main, "map", "The map")
    choices = SubElement(section, "div", {"class": "choices"})
    if any(component["has_both"] for component in components):
        frames = {component["frame"] for component in components}
        from_frame = f"relative to {frames.pop()}" if len(frames) == 1 else "relative to each frame"
        _add_buttons(choices, "ellipses", {"shape": "relative to the other tags", "frame": from_frame}, "Sigmas:")
    if any(component["tags"] for component in components):
        _add_buttons(choices, "tags", {"sigma": "sigma", "run": "run"}, "Tags by:")
    _add_buttons(choices, "legend", {"folded": "folded", "shown": "shown"}, "Legend:")
    for index, component in enumerate(components):
        caption = f"Component {index + 1}, in the frame of {component['frame']}" if len(components) > 1 else ""
        _figure(section, "map", index, caption)
    _note(
        section,
        "Drag to move, turn the wheel or pinch to zoom, click twice to see all. Point at a tag to see its sigmas. "
        "A click in the legend shows or hides a layer; one in a table of tags shows the tag here. Suspect tags are "
        "red crosses, with an arrow from the old place to the new.",
    )


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


def _add_timeline(main: Element, timelines: Sequence[dict[str, Any]], residual_rms: float) -> None:
    section = _section(main, "timeline", "Drive by drive")
    line = SubElement(section, "p", {"class": "run"})
    choice = SubElement(_text(line, "label", "Run: "), "select", id="run")
    for index, each in enumerate(timelines):
        _text(choice, "option", each["run"]).set("value", str(index))
    SubElement(line, "output", id="moment")
    SubElement(section, "input", {"type": "range", "id": "time", "min": "0", "step": "0.1", "aria-label": "time"})
    _figure(section, "timeline", 0, "")
    _note(
        section,
        "Move along the timeline or pull the slider: the circle in the map shows where the robot was. Click at a "
        "trajectory in the map: the timeline shows when. Speed by the wheels; tags in view of a keyframe; residuals of "
        "its observations, as root mean square and largest (grey), scaled so that 1 is as expected: the root mean "
        f"square over the whole map, {residual_rms:.2f} sigma of the solve. Grey bands: no wheel readings. Triangles: "
        "events of the recorder, losses in red.",
    )


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
    for row, target in zip_longest(table.rows, table.targets, fillvalue=""):
        line = SubElement(body, "tr")
        if target:
            line.attrib |= {"data-tags": str(target), "tabindex": "0", "title": "show in the map"}
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
    buttons.set("class", f"buttons {name}")
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
