"""The sentences at the top of the report: what was joined, how good it is, what to mistrust, what to do next.

They are made from the document that map.json is written from, and from nothing else, so that report and map cannot
say different things.
"""

from collections.abc import Sequence
from math import degrees
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import plural
from groundsbot.offline.maps import MAX_SIGMAS

# A tag read less often has little to contradict it.
FEW_READINGS: Final = 3
_MOST_NAMED: Final = 4


def sentences(document: dict[str, Any]) -> list[str]:
    """Three to seven sentences in plain English, the first what the model does not explain."""
    told = [
        contradiction_sentence(document),
        _joining_sentence(document),
        headline(document),
        _scale(document),
        *_mistrust(document),
        *_next(document),
    ]
    return [sentence for sentence in told if sentence]


def contradiction_sentence(document: dict[str, Any]) -> str:
    """That drives contradict the model, how sure that is, and what to do; empty where they do not."""
    components = document["components"]
    worst = max(range(len(components)), key=lambda i: float(components[i]["sigma_factor"]), default=0)
    misfit = components[worst]["misfit"] if components else None
    if misfit is None:
        return ""
    where = f"In component {worst + 1} drives" if len(components) > 1 else "These drives"
    if len(components[worst]["runs"]) == 1:
        where = f"The drive {misfit['run']}"
    what, look = _MISFITS[misfit["kind"]]
    times, run = components[worst]["sigma_factor"], misfit["run"]
    return (
        f"{where} {'contradicts' if where.startswith('The ') else 'contradict'} {what} by more than chance explains "
        f"({misfit['chi_square']:.0f} squared sigmas, {misfit['expected']} expected): all sigmas are {times:.1f} times "
        f"as large as computed. Look at {look}; {run} fits worst: look at its log, or drive it again."
    )


_MISFITS: Final = {
    "joins": ("each other", "suspect tags, wheels held against tags and calibration in the report"),
    "windows": ("the model", "suspect tags and at the drive's residuals in the report"),
}


def largest_sigma_m(covariance: Sequence[Sequence[float | None]]) -> float | None:
    """Standard deviation along the worst direction on the floor; None where it is not known."""
    floor = np.array([row[:2] for row in covariance[:2]], dtype=np.float64)
    if not np.isfinite(floor).all():
        return None
    return float(np.sqrt(max(np.linalg.eigvalsh(floor)[-1], 0.0)))


def check_contradicts(check: dict[str, Any]) -> bool:
    """Whether wheels and tags differ by more than chance allows."""
    return check["sigmas"] is not None and check["sigmas"] > MAX_SIGMAS


def linking_tags(document: dict[str, Any], component: int = 0) -> list[dict[str, Any]]:
    """Tags of a component that more than one run read, most runs first."""
    tags = [tag for tag in document["tags"] if tag["component"] == component and len(tag["runs"]) > 1]
    return sorted(tags, key=lambda tag: (-len(tag["runs"]), -tag["n_observations"], tag["family"], tag["tag_id"]))


def enumerate_names(names: Sequence[str]) -> str:
    """`a`, `a and b`, `a, b and c`, and no more than a few of them."""
    shown = list(names[:_MOST_NAMED])
    if len(names) > _MOST_NAMED:
        shown.append(f"{len(names) - _MOST_NAMED} more")
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"


def _joining_sentence(document: dict[str, Any]) -> str:
    n_runs, components = _n_drives(document["runs"]), document["components"]
    driven_m = sum(run["distance_m"] or 0.0 for run in document["runs"])
    n_tags = len(document["tags"])
    if len(components) > 1:
        first = components[0]
        return (
            f"{plural(n_runs, 'run')} ({driven_m:.1f} m driven, {plural(n_tags, 'tag')}) could not be joined into "
            f"one map: they fall into {len(components)} components, each in a frame of its own, of which the largest "
            f"holds {plural(len(first['runs']), 'run')} and {plural(len(first['tags']), 'tag')}."
        )
    names = enumerate_names([*dict.fromkeys(run["stretch_of"] or run["run"] for run in document["runs"])])
    if len(document["runs"]) == 1:
        return f"One run, {names}, drove {driven_m:.1f} m and placed {plural(n_tags, 'tag')}; nothing was to be joined."
    n_links = len(linking_tags(document))
    by = f"by {plural(n_links, 'tag')} that more than one of them read" if n_links else "by what was measured by hand"
    runs, tags = plural(n_runs, "run"), plural(n_tags, "tag")
    return f"{runs} ({names}; {driven_m:.1f} m driven) became one map of {tags}, joined {by}."


def _n_drives(runs: Sequence[dict[str, Any]]) -> int:
    return len({run["stretch_of"] or run["run"] for run in runs})


def headline(document: dict[str, Any]) -> str:
    """How well the map is known, its shape first."""
    tags = [tag for tag in document["tags"] if tag["component"] == 0]
    known = [(sigma, tag) for tag in tags if (sigma := largest_sigma_m(tag["covariance"])) is not None]
    if not known:
        return "It places no tag, so that nothing corrects what the wheels say."
    told = _shape(document, tags, float(np.median([sigma for sigma, _ in known])))
    pairs = document["start_to_start"]
    if len(pairs) == 1:
        pair = pairs[0]
        told += (
            f"; from the start of {pair['a']} to that of {pair['b']} it is {pair['distance_m']:.2f} m, give or take "
            f"{_metres(pair['sigma_m'])}"
        )
    return told + "."


def _shape(document: dict[str, Any], tags: Sequence[dict[str, Any]], seen_from_start_m: float) -> str:
    """How well tags are known relative to each other, and seen from the first start."""
    component = document["components"][0]
    where, the_tags = ("In the largest component ", "tags") if len(document["components"]) > 1 else ("", "Tags")
    start = f"the start of {component['frame_run']}"
    if component["heading_sigma_rad"] is None:
        return f"{where}{the_tags} are known to {_metres(seen_from_start_m)} (median, one sigma), seen from {start}"
    median_m = float(np.median([tag["shape_sigma_m"] for tag in tags]))
    worst = max(tags, key=lambda tag: float(tag["shape_sigma_m"]))
    return (
        f"{where}{the_tags} are known to {_metres(median_m)} relative to each other (median, one sigma; the worst, tag "
        f"{worst['tag_id']}{worst['instance']}, to {_metres(worst['shape_sigma_m'])}); seen from {start}, whose "
        f"heading is uncertain by {degrees(component['heading_sigma_rad']):.1f} degrees, to "
        f"{_metres(seen_from_start_m)}"
    )


def _scale(document: dict[str, Any]) -> str:
    if not document["metres"] or document["metres"][0]["sigma"] is None:
        return ""
    metre = document["metres"][0]
    kind, share = max(metre["shares"].items(), key=lambda each: each[1], default=("", 0.0))
    told = f"The length of a metre is known to {_percent(metre['sigma'])}"
    return f"{told}, {100.0 * share:.0f} % of that through {_HOLDS[kind]}." if kind else f"{told}."


_HOLDS: Final = {
    "wheels": "the wheels' radii",
    "track": "the distance between the wheels",
    "tags": "the size of the tags",
    "mount": "where the camera sits",
    "distances": "distances measured by hand",
    "starts": "starts measured by hand",
}


def _mistrust(document: dict[str, Any]) -> list[str]:
    doubts = []
    contradicting = [check for check in document["checks"] if check_contradicts(check)]
    if contradicting:
        check = contradicting[0]
        about = "a full turn" if check["name"] == "turn" else "the length of a metre"
        doubts.append(
            f"wheels and tags of {check['robot_id']} contradict each other about {about} by "
            f"{_percent(abs(check['value']))} ({check['sigmas']:.0f} sigma)"
        )
    taped = [each for each in document["measurements"] if each["contradicts"]]
    if taped:
        doubts.append(f"{plural(len(taped), 'measurement')} by hand {_do(taped)} not fit to the rest")
    suspects = document["suspect_tags"]
    if suspects:
        names = enumerate_names([f"{each['tag_id']} ({each['kind']})" for each in suspects])
        doubts.append(f"{_tags_do(suspects)} not belong: {names}")
    unsure = [each for each in document["alignments"] if not each["is_sure"]]
    if unsure:
        names = enumerate_names([f"{each['from']} with {each['to']}" for each in unsure])
        doubts.append(
            f"{plural(len(unsure), 'alignment')} could not be told for sure and {_were(unsure)} left out: {names}"
        )
    weak = [each for each in document["alignments"] if each["is_sure"] and each["is_weak"]]
    if weak:
        names = enumerate_names([f"{each['from']} with {each['to']}" for each in weak])
        doubts.append(f"{plural(len(weak), 'join')} {'rests' if len(weak) == 1 else 'rest'} on one tag alone: {names}")
    few = [tag for tag in document["tags"] if tag["n_observations"] < FEW_READINGS]
    if few:
        names = enumerate_names([str(tag["tag_id"]) for tag in few])
        doubts.append(f"{plural(len(few), 'tag')} {_were(few)} read less than {FEW_READINGS} times: {names}")
    told = [f"Mistrust this: {'; '.join(doubts)}."] if doubts else []
    n_warnings = len(document["warnings"])
    if n_warnings:
        told.append(f"The map comes with {plural(n_warnings, 'warning')}, below.")
    if contradiction_sentence(document):
        return told
    return told or ["Nothing in it contradicts anything else by more than chance allows."]


def _next(document: dict[str, Any]) -> list[str]:
    """What would help."""
    if len(document["components"]) > 1:
        return ["To join the components, drive one more run past two or more tags of each of them."]
    several = has_several_families(document)
    return [advice_sentence(each, several_families=several) for each in document["advice"][:1]]


def advice_sentence(advice: dict[str, Any], *, several_families: bool) -> str:
    """What to do, and what that would do to the worst tag; of an entry of `advice` in map.json."""
    now, then = _metres(advice["sigma_m"]), _metres(advice["sigma_then_m"])
    worst = f"the largest sigma, tag {tag_label(advice['worst_tag'], several_families=several_families)}'s"
    if not would_help(advice):
        return f"One more drive or tag would hardly help: {worst}, would stay at {now}."
    first, *others = [f"tag {tag_label(each, several_families=several_families)}" for each in advice["tags"]]
    if advice["kind"] == "pass":
        what = (
            f"One more pass from {first} to {others[0]}, {advice['length_m']:.0f} m along the way of {advice['run']},"
        )
    else:
        x_m, y_m = advice["way_m"][0]
        what = (
            f"One more tag at x {x_m:.1f} m, y {y_m:.1f} m (beside the way of {advice['run']}; nearest is {first}), "
            "and the same drives again,"
        )
    return f"{what} would bring {worst}, from {now} to about {then}."


def would_help(advice: dict[str, Any]) -> bool:
    """Whether a person would see a difference."""
    return _metres(advice["sigma_m"]) != _metres(advice["sigma_then_m"])


def has_several_families(document: dict[str, Any]) -> bool:
    """Whether a tag's number alone does not name it."""
    return len({tag["family"] for tag in document["tags"]}) > 1


def tag_label(tag: dict[str, Any], *, several_families: bool) -> str:
    """Number and instance, and the family where that is needed to tell tags apart."""
    label = f"{tag['tag_id']}{tag['instance']}"
    return f"{tag['family']}:{label}" if several_families else label


def _do(entries: Sequence[object]) -> str:
    return "does" if len(entries) == 1 else "do"


def _were(entries: Sequence[object]) -> str:
    return "was" if len(entries) == 1 else "were"


def _tags_do(entries: Sequence[object]) -> str:
    return f"{plural(len(entries), 'tag')} {_do(entries)}"


def _metres(value_m: float) -> str:
    """Centimetres as long as there are any, else millimetres."""
    return f"{value_m:.2f} m" if value_m >= 0.095 else f"{100.0 * value_m:.1f} cm"


def _percent(share: float) -> str:
    return f"{100.0 * share:.2f} %"
