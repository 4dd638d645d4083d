"""The report's figures and sentences: which runs were merged, accuracy, doubts, and what to do next.

They are made only from the document that map.json is written from, so report and map cannot disagree.
"""

from collections.abc import Iterable, Sequence
from math import degrees
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import plural
from groundsbot.offline.report.accuracy_texts import headline, scale_texts
from groundsbot.offline.report.cells import UNKNOWN, has_several_families, length_text, percent_text, tag_label
from groundsbot.offline.report.verdict import contradiction_sentence, doubts, enumerate_names

# Advice that leaves the largest sigma above this share of it is not worth a drive.
_WORTHWHILE_SHARE: Final = 0.9
# Share of a variance that is called most of it.
_MOST_OF_VARIANCE: Final = 0.5
_KINDS_OF_MOVES: Final = ("moved", "moving", "swapped")


def sentences(document: dict[str, Any]) -> list[str]:
    """Return three to seven sentences in plain English, beginning with contradictions to the model, if any."""
    told = [
        contradiction_sentence(document),
        _joining_sentence(document),
        headline(document),
        _scale_sentence(document),
        *_doubt_sentences(document),
        *_next_steps(document),
    ]
    return [sentence for sentence in told if sentence]


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


def _scale_sentence(document: dict[str, Any]) -> str:
    scale, source = scale_texts(document)
    told = f"The scale is known to {scale}"
    return "" if scale == UNKNOWN else f"{told}, {source}." if source else f"{told}."


def _doubt_sentences(document: dict[str, Any]) -> list[str]:
    told = [
        f"{doubt.clause}: {doubt.names}" if doubt.names else doubt.clause
        for doubt in doubts(document)
        if doubt.section not in ("words", "warnings", "map")  # which have sentences of their own
    ]
    warnings = [*document["losses"], *document["warnings"]]
    return [
        *([f"Check this: {'; '.join(told)}."] if told else []),
        *([f"There is one warning: {warnings[0].rstrip('.')}."] if len(warnings) == 1 else []),
        *([f"The map comes with {plural(len(warnings), 'warning')}, below."] if len(warnings) > 1 else []),
    ]


def next_step(document: dict[str, Any]) -> str:
    """Return what to do next; empty if nothing is advised."""
    return next(iter(_next_steps(document)), "")


def _next_steps(document: dict[str, Any]) -> list[str]:
    if len(document["components"]) > 1:
        return ["To join the components, drive one more run past two or more tags of each, and map all runs again."]
    return [*_suspects_sentences(document), *advice_sentences(document)]


def advice_sentences(document: dict[str, Any]) -> list[str]:
    """Return the best advice for the scale, for the worst tag and for the heading of a map of one component."""
    several = has_several_families(document)
    told = [
        scale_sentence(document),
        *(advice_sentence(each, several_families=several) for each in document["advice"][:1]),
        heading_sentence(document),
    ]
    return [each for each in told if each]


def _suspects_sentences(document: dict[str, Any]) -> list[str]:
    """Return what to do about suspect tags, if there are any."""
    suspects = document["suspect_tags"]
    if not suspects:
        return []
    named = enumerate_names([str(each["tag_id"]) for each in suspects])
    one = len(suspects) == 1
    which, use, them = (
        (f"tag {named} is", "its place there, and none of its other places in the map", "it")
        if one
        else (f"tags {named} are", "their places there, and none of their other places in the map", "them")
    )
    later = [
        f"{tag_label(places[-1], several_families=False)} is later than {tag_label(places[0], several_families=False)}"
        for each in suspects
        if each["has_ordered_places"] and len(places := places_of_move(document["tags"], each)) > 1
    ]
    order = f" (by the logs' clocks, {enumerate_names(later)})" if later else ""
    then = f"Use {use}{order}; this needs no new drive, since the rest of the map does not depend on {them}."
    return [f"See in the building where {which} now. {then}"]


def places_of_move(tags: Iterable[dict[str, Any]], suspect: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the places of a tag that was moved or swapped, in order of their names; none of another suspect tag.

    Names (a, b, ... z, aa) follow time where the suspect has ordered places.
    """
    if suspect["kind"] not in _KINDS_OF_MOVES:
        return []
    own = [tag for tag in tags if (tag["family"], tag["tag_id"]) == (suspect["family"], suspect["tag_id"])]
    return sorted(own, key=lambda tag: (len(tag["instance"]), tag["instance"]))


def scale_sentence(document: dict[str, Any]) -> str:
    """Return how to determine the scale of the first component; empty unless it is most of the largest shape sigma."""
    known = [tag for tag in document["tags"] if tag["component"] == 0 and tag["shape_sigma_m"] is not None]
    sigma = next((each["sigma"] for each in document["metres"] if each["component"] == 0), None)
    if not known or not sigma:
        return ""
    places_m = np.array([tag["position_m"][:2] for tag in known])
    worst = int(np.argmax([tag["shape_sigma_m"] for tag in known]))
    by_scale_m = sigma * float(np.linalg.norm(places_m[worst] - places_m.mean(axis=0)))
    if by_scale_m**2 <= _MOST_OF_VARIANCE * known[worst]["shape_sigma_m"] ** 2:
        return ""
    away_m = np.linalg.norm(places_m - places_m[worst], axis=1)
    farthest = int(np.argmax(away_m))
    a, b = (tag_label(known[i], several_families=False) for i in (worst, farthest))
    return (
        f"Most of the largest sigma is the scale ({percent_text(sigma)}): one distance between two tags by tape "
        f"determines it, as from tag {a} to tag {b}, about {away_m[farthest]:.1f} m (--distance {a},{b}=METRES,SIGMA)."
    )


def heading_sentence(document: dict[str, Any]) -> str:
    """Return how to fix the heading of the first component; empty unless the frame adds more to sigmas than the shape.

    That is where the variance of a typical tag from the start is more than twice that relative to the other tags.
    Without a gyro it says that turns are what the map knows least.
    """
    component = document["components"][0]
    known = [tag for tag in document["tags"] if tag["component"] == 0 and tag["sigma_m"] is not None]
    if component.get("datum") is not None or component["heading_sigma_rad"] is None or not known:
        return ""
    from_start_m, shape_m = (float(np.median([tag[name] for tag in known])) for name in ("sigma_m", "shape_sigma_m"))
    if from_start_m**2 <= 2.0 * shape_m**2:
        return ""
    has_gyro = any(each["name"] == "gyro_scale" for each in document["calibration"])
    wheels_only = " Between tags only the wheels tell how far robots turn; a gyro would tell it better."
    return (
        f"The heading of the whole ({degrees(component['heading_sigma_rad']):.1f} degrees) is fixed by a known "
        "direction (--frame A,B: x from tag A to tag B) or by two tags at known places (--frame survey.csv), hardly by "
        f"more drives.{'' if has_gyro else wheels_only}"
    )


def advice_sentence(advice: dict[str, Any], *, several_families: bool) -> str:
    """Return what to do and its effect on the worst tag, from an entry of `advice` in map.json."""
    now, then = length_text(advice["sigma_m"]), length_text(advice["sigma_then_m"])
    among = " relative to the other tags" if advice["of_shape"] else ""
    worst = f"the largest sigma{among}, tag {tag_label(advice['worst_tag'], several_families=several_families)}'s"
    if not would_help(advice):
        one = "pass" if advice["kind"] == "pass" else "tag"
        change = f"stay at {now}" if now == then else f"fall from {now} to {then} at best"
        return f"One more {one} would hardly help: {worst}, would {change}."
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
