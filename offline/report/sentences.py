"""The report's figures and sentences: which runs were merged, accuracy, doubts, and what to do next.

They are made only from the document that map.json is written from, so report and map cannot disagree.
"""

from collections.abc import Sequence
from math import degrees
from typing import Any, Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import plural
from groundsbot.offline.maps import DatumKind
from groundsbot.offline.report.cells import UNKNOWN, length_text, percent_text
from groundsbot.offline.report.verdict import contradiction_sentence, doubts, enumerate_names

# Advice that leaves the largest sigma above this share of it is not worth a drive.
_WORTHWHILE_SHARE: Final = 0.9


def sentences(document: dict[str, Any]) -> list[str]:
    """Return three to seven sentences in plain English, beginning with contradictions to the model, if any."""
    told = [
        contradiction_sentence(document),
        _joining_sentence(document),
        headline(document),
        _scale_sentence(document),
        *_doubt_sentences(document),
        *_advice_sentences(document),
    ]
    return [sentence for sentence in told if sentence]


class KeyFigure(NamedTuple):
    """One of the figures on top of the report."""

    name: str
    value: str
    note: str


def key_figures(document: dict[str, Any]) -> list[KeyFigure]:
    """Return how large the map is, how accurate its shape and how accurate its scale."""
    tags = [tag for tag in document["tags"] if tag["component"] == 0]
    size = UNKNOWN
    if tags:
        places_m = np.array([tag["position_m"][:2] for tag in tags])
        wide_m, high_m = np.ptp(places_m, axis=0)
        size = f"over {wide_m:.0f} m x {high_m:.0f} m"
    n = len(document["components"])
    among = f"{len(tags)} in component 1, {size}; {n} components could not be joined" if n > 1 else size
    n_again = len(document["tags"]) - len(
        {(tag["family"], tag["tag_id"], tag["component"]) for tag in document["tags"]}
    )
    if n_again:
        among += f"; {n_again} of them further places of suspect tags"
    shape_m = [float(tag["shape_sigma_m"]) for tag in tags if tag["shape_sigma_m"] is not None]
    shape, told = UNKNOWN, "unknown with fewer than two tags"
    if shape_m:
        worst = max(tags, key=lambda tag: float(tag["shape_sigma_m"]))
        shape = length_text(float(np.median(shape_m)))
        of = "a tag" if n == 1 else "a tag of component 1"
        told = f"sigma of {of} relative to the others, median; {length_text(max(shape_m))} at most, tag "
        told += tag_label(worst, several_families=has_several_families(document))
    scale, source = _scale_texts(document)
    return [
        KeyFigure(plural(len(document["tags"]), "tag").partition(" ")[2], str(len(document["tags"])), among),
        KeyFigure("shape", shape, told),
        KeyFigure("scale", scale, f"sigma of all lengths, {source}" if source else "nothing determines it"),
    ]


def _scale_texts(document: dict[str, Any]) -> tuple[str, str]:
    """Return the sigma of the scale, and what most of it comes from."""
    if not document["metres"] or document["metres"][0]["sigma"] is None:
        return UNKNOWN, ""
    metre = document["metres"][0]
    kind, share = max(metre["shares"].items(), key=lambda each: each[1], default=("", 0.0))
    source = f"{100.0 * share:.0f} % of that from {_SCALE_SOURCES[kind]}" if kind else ""
    return percent_text(metre["sigma"]), source


def linking_tags(document: dict[str, Any], component: int = 0) -> list[dict[str, Any]]:
    """Return the tags of a component that more than one run observed, most runs first."""
    tags = [tag for tag in document["tags"] if tag["component"] == component and len(tag["runs"]) > 1]
    return sorted(tags, key=lambda tag: (-len(tag["runs"]), -tag["n_observations"], tag["family"], tag["tag_id"]))


def _joining_sentence(document: dict[str, Any]) -> str:
    n_runs, components = _n_drives(document["runs"]), document["components"]
    driven_m = sum(run["distance_m"] or 0.0 for run in document["runs"])
    n_tags = len(document["tags"])
    if len(components) > 1:
        first = components[0]
        return (
            f"{plural(n_runs, 'run')} ({driven_m:.1f} m driven, {plural(n_tags, 'tag')}) could not be merged into "
            f"one map: there are {len(components)} components, each in its own frame; the largest has "
            f"{plural(len(first['runs']), 'run')} and {plural(len(first['tags']), 'tag')}."
        )
    names = enumerate_names([*dict.fromkeys(run["stretch_of"] or run["run"] for run in document["runs"])])
    if len(document["runs"]) == 1:
        return f"One run, {names}, drove {driven_m:.1f} m and observed {plural(n_tags, 'tag')}; nothing was merged."
    n_links = len(linking_tags(document))
    by = f"by {plural(n_links, 'tag')} that several of them observed" if n_links else "by measurements by hand"
    runs, tags = plural(n_runs, "run"), plural(n_tags, "tag")
    return f"{runs} ({names}; {driven_m:.1f} m driven) were merged into one map of {tags}, connected {by}."


def _n_drives(runs: Sequence[dict[str, Any]]) -> int:
    return len({run["stretch_of"] or run["run"] for run in runs})


def headline(document: dict[str, Any]) -> str:
    """Return how accurate the map is, its shape first."""
    tags = [tag for tag in document["tags"] if tag["component"] == 0]
    known = [tag["sigma_m"] for tag in tags if tag["sigma_m"] is not None]
    if not known:
        return "It has no tags, so nothing corrects the wheels' odometry."
    told = _accuracy_clause(document, tags, float(np.median(known)))
    pairs = document["start_to_start"]
    if len(pairs) == 1:
        pair = pairs[0]
        told += (
            f"; from the start of {pair['a']} to that of {pair['b']} it is {pair['distance_m']:.2f} m, sigma "
            f"{length_text(pair['sigma_m'])}"
        )
    return told + "."


def _accuracy_clause(document: dict[str, Any], tags: Sequence[dict[str, Any]], seen_from_frame_m: float) -> str:
    """Return how accurate tags are relative to each other, and relative to the frame."""
    component = document["components"][0]
    where, the_tags = ("In the largest component ", "tags") if len(document["components"]) > 1 else ("", "Tags")
    if component["heading_sigma_rad"] is None:
        return (
            f"{where}{the_tags} are known to {length_text(seen_from_frame_m)} (median, one sigma), relative to the "
            f"start of {component['frame_run']}"
        )
    median_m = float(np.median([tag["shape_sigma_m"] for tag in tags]))
    worst = max(tags, key=lambda tag: float(tag["shape_sigma_m"]))
    return (
        f"{where}{the_tags} are known to {length_text(median_m)} relative to each other (median, one sigma; "
        f"the worst, tag {worst['tag_id']}{worst['instance']}, to {length_text(worst['shape_sigma_m'])}); "
        f"{_frame_clause(component, length_text(seen_from_frame_m))}"
    )


def _frame_clause(component: dict[str, Any], length: str) -> str:
    """Return which frame sigmas refer to, and how accurate tags are in it."""
    datum = component.get("datum")
    if datum is None:
        return (
            f"relative to the start of {component['frame_run']}, whose heading is uncertain by "
            f"{degrees(component['heading_sigma_rad']):.1f} degrees, to {length}"
        )
    if datum["kind"] == DatumKind.TAGS:
        return "all sigmas refer to the tags' own axes, so shift and turn of all tags together are not in them"
    if datum["kind"] == DatumKind.PAIR:
        return f"relative to {frame_name(component)}, to {length}"
    held_by = plural(sum(weight > 0.0 for weight in datum["weights"]), "surveyed tag")
    return (
        f"relative to the survey's frame, to {length}; all sigmas refer to that frame as {held_by} hold it, "
        "without the survey's own errors"
    )


def frame_name(component: dict[str, Any]) -> str:
    """Return what the sigmas of a component, an entry of `components`, refer to."""
    datum = component.get("datum")
    if datum is None:
        return f"the start of {component['frame_run']}"
    held_by = [tag for tag, weight in zip(component["tags"], datum["weights"], strict=True) if weight > 0.0]
    return DatumKind(datum["kind"]).frame_name([tag_label(tag, several_families=False) for tag in held_by])


def _scale_sentence(document: dict[str, Any]) -> str:
    scale, source = _scale_texts(document)
    told = f"The scale is known to {scale}"
    return "" if scale == UNKNOWN else f"{told}, {source}." if source else f"{told}."


_SCALE_SOURCES: Final = {
    "wheels": "the wheels' radii",
    "track": "the distance between the wheels",
    "tags": "the size of the tags",
    "mount": "the position of the camera",
    "distances": "distances measured by hand",
    "starts": "starts measured by hand",
}


def _doubt_sentences(document: dict[str, Any]) -> list[str]:
    told = [
        f"{doubt.clause}: {doubt.names}" if doubt.names else doubt.clause
        for doubt in doubts(document)
        if doubt.section not in ("words", "warnings", "map")  # which have sentences of their own
    ]
    n_warnings = len(document["losses"]) + len(document["warnings"])
    return [
        *([f"Check this: {'; '.join(told)}."] if told else []),
        *([f"The map comes with {plural(n_warnings, 'warning')}, below."] if n_warnings else []),
    ]


def next_step(document: dict[str, Any]) -> str:
    """Return what to do next; empty if nothing is advised."""
    return next(iter(_advice_sentences(document)), "")


def _advice_sentences(document: dict[str, Any]) -> list[str]:
    """Return what to do next."""
    if len(document["components"]) > 1:
        return ["To merge the components, drive one more run past two or more tags of each of them."]
    several = has_several_families(document)
    return [
        *_suspects_sentences(document),
        *(advice_sentence(each, several_families=several) for each in document["advice"][:1]),
        heading_sentence(document),
    ]


def _suspects_sentences(document: dict[str, Any]) -> list[str]:
    """Return where to look because of suspect tags, if there are any."""
    suspects = document["suspect_tags"]
    if not suspects:
        return []
    named = enumerate_names([str(each["tag_id"]) for each in suspects])
    which = f"tag {named} is" if len(suspects) == 1 else f"tags {named} are"
    return [f"Look where {which} now: each place is a tag of its own in the map, and bends nothing."]


def heading_sentence(document: dict[str, Any]) -> str:
    """Return how to fix the heading of the first component; empty unless the frame adds more to sigmas than the shape.

    That is where the variance of a typical tag from the start is more than twice that relative to the other tags.
    """
    component = document["components"][0]
    known = [tag for tag in document["tags"] if tag["component"] == 0 and tag["sigma_m"] is not None]
    if component.get("datum") is not None or component["heading_sigma_rad"] is None or not known:
        return ""
    from_start_m, shape_m = (float(np.median([tag[name] for tag in known])) for name in ("sigma_m", "shape_sigma_m"))
    if from_start_m**2 <= 2.0 * shape_m**2:
        return ""
    return (
        f"The heading of the whole ({degrees(component['heading_sigma_rad']):.1f} degrees) is fixed by a known "
        "direction (--frame A,B: x from tag A to tag B) or by two tags at known places (--frame survey.csv), hardly by "
        "more drives."
    )


def advice_sentence(advice: dict[str, Any], *, several_families: bool) -> str:
    """Return what to do and its effect on the worst tag, from an entry of `advice` in map.json."""
    now, then = length_text(advice["sigma_m"]), length_text(advice["sigma_then_m"])
    among = " relative to the other tags" if advice["of_shape"] else ""
    worst = f"the largest sigma{among}, tag {tag_label(advice['worst_tag'], several_families=several_families)}'s"
    if not would_help(advice):
        one = "pass" if advice["kind"] == "pass" else "tag"
        return f"One more {one} would hardly help: {worst}, would fall from {now} to {then} at best."
    first, *others = [f"tag {tag_label(each, several_families=several_families)}" for each in advice["tags"]]
    if advice["kind"] == "pass":
        what = (
            f"One more pass from {first} to {others[0]}, {advice['length_m']:.0f} m along the path of {advice['run']},"
        )
    else:
        x_m, y_m = advice["way_m"][0]
        what = (
            f"One more tag at x {x_m:.1f} m, y {y_m:.1f} m (beside the path of {advice['run']}; nearest is {first}), "
            "and the same drives again,"
        )
    return f"{what} would reduce {worst}, from {now} to about {then}."


def would_help(advice: dict[str, Any]) -> bool:
    """Whether the largest sigma falls by a tenth at least: less is not worth a drive."""
    helps: bool = advice["sigma_then_m"] < _WORTHWHILE_SHARE * advice["sigma_m"]
    return helps


def has_several_families(document: dict[str, Any]) -> bool:
    """Whether a tag needs its family beside its id."""
    return len({tag["family"] for tag in document["tags"]}) > 1


def tag_label(tag: dict[str, Any], *, several_families: bool) -> str:
    """Return id and instance, with the family if the map has several."""
    label = f"{tag['tag_id']}{tag['instance']}"
    return f"{tag['family']}:{label}" if several_families else label
