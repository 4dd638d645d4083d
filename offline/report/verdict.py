"""Doubts about a map, and the verdict that follows from them: the first line of report and terminal.

They are made only from the document that map.json is written from.
"""

from collections.abc import Iterator, Sequence
from typing import Any, Final, NamedTuple

from groundsbot.calib.foundation import plural
from groundsbot.offline.maps import MAX_SIGMAS
from groundsbot.offline.report.cells import percent_text

# A tag with fewer observations has little redundancy.
FEW_OBSERVATIONS: Final = 3
_MOST_NAMED: Final = 4
_MOST_REASONS: Final = 3
_WITH_CARE: Final = "Use this map with care"
# Weights of doubts.
FORBIDS: Final = 2
NEEDS_CARE: Final = 1
SLIGHT: Final = 0


class Doubt(NamedTuple):
    """Something in a map that is to be mistrusted.

    Attributes:
        n: number of what `name` says, a noun in the singular.
        clause: what is wrong; without names.
        section: id of the report's section that shows it.
        names: the tags or runs concerned; may be empty.
        weight: FORBIDS, NEEDS_CARE or SLIGHT.
    """

    n: int
    name: str
    clause: str
    section: str
    names: str = ""
    weight: int = NEEDS_CARE


def doubts(document: dict[str, Any]) -> list[Doubt]:
    """Return all doubts about a map, the gravest first."""
    found = [
        *_doubts_of_solve(document),
        *_doubts_of_checks(document),
        *_doubts_of_joins(document),
        *_doubts_of_tags(document),
    ]
    return sorted(found, key=lambda doubt: -doubt.weight)


def verdict(document: dict[str, Any]) -> int:
    """Return the weight of the gravest doubt; SLIGHT without one."""
    return max((doubt.weight for doubt in doubts(document)), default=SLIGHT)


def verdict_sentence(document: dict[str, Any]) -> str:
    """Return whether the map can be used, and why not or why with care."""
    found = doubts(document)
    weight = verdict(document)
    own = [doubt for doubt in found if doubt.weight == weight]
    reasons = [doubt.clause for doubt in own[:_MOST_REASONS]]
    if weight == SLIGHT:
        told = "nothing in it contradicts anything else by more than chance allows"
        return f"Use this map: {'; '.join([told, *reasons])}."
    if len(own) == 1 and own[0].names:
        reasons = [f"{own[0].clause}: {own[0].names}"]
    n_more = sum(doubt.n for doubt in own[_MOST_REASONS:])
    if n_more:
        reasons.append(f"there {'is' if n_more == 1 else 'are'} {plural(n_more, 'more doubt')}")
    with_care = "Use each component of this map alone, with care" if len(document["components"]) > 1 else _WITH_CARE
    use = "Do not use this map" if weight == FORBIDS else with_care
    *first, last = reasons
    return f"{use}, because {'; '.join([*first, f'and {last}'] if first else [last])}."


def contradiction_sentence(document: dict[str, Any]) -> str:
    """Return that drives contradict the model, by how much, and what to do; empty if they do not."""
    components = document["components"]
    worst = _worst_component(document)
    misfit = components[worst]["misfit"] if components else None
    if misfit is None:
        return ""
    _, places = _MISFIT_PHRASES[misfit["kind"]]
    look = enumerate_names([*(["suspect tags"] if document["suspect_tags"] else []), *places])
    return (
        f"{_contradiction_clause(document)} by more than chance explains (chi-square {misfit['chi_square']:.0f}, "
        f"{misfit['expected']} expected), so all sigmas were multiplied by "
        f"{components[worst]['sigma_factor']:.1f}. Check {look} in the report; {misfit['run']} fits worst: check its "
        "log, or repeat the drive."
    )


def _contradiction_clause(document: dict[str, Any]) -> str:
    """Return which drives contradict what."""
    components, worst = document["components"], _worst_component(document)
    misfit = components[worst]["misfit"]
    what, _ = _MISFIT_PHRASES[misfit["kind"]]
    if len(components[worst]["runs"]) == 1:
        return f"The drive {misfit['run']} contradicts {what}"
    where = f"In component {worst + 1} drives" if len(components) > 1 else "These drives"
    return f"{where} contradict {what}"


def _worst_component(document: dict[str, Any]) -> int:
    components = document["components"]
    return max(range(len(components)), key=lambda i: float(components[i]["sigma_factor"]), default=0)


_MISFIT_PHRASES: Final = {
    "joins": ("each other", ("the comparison of wheels with tags", "calibration")),
    "windows": ("the model", ("the drive's residuals",)),
}


def _doubts_of_solve(document: dict[str, Any]) -> Iterator[Doubt]:
    components = document["components"]
    n_bad = sum(not each["converged"] for each in components)
    if n_bad:
        clause = "its solve did not converge" if len(components) == 1 else f"{plural(n_bad, 'solve')} did not converge"
        yield Doubt(n_bad, "unconverged solve", clause, "warnings", weight=FORBIDS)
    if not document["tags"]:
        clause = "it has no tags, so nothing corrects the wheels' odometry"
        yield Doubt(1, "map without tags", clause, "map", weight=FORBIDS)
    n_misfits = sum(each["misfit"] is not None for each in components)
    if n_misfits:
        clause = _contradiction_clause(document)
        factor = components[_worst_component(document)]["sigma_factor"]
        told = f"{clause[0].lower()}{clause[1:]} (all sigmas were multiplied by {factor:.1f})"
        yield Doubt(n_misfits, "drive contradiction", told, "words")
    if len(components) > 1:
        clause = f"its {len(components)} components could not be joined, so distances between them are unknown"
        yield Doubt(len(components), "unjoined component", clause, "warnings")
    if document["losses"]:
        n = len(document["losses"])
        yield Doubt(n, "data gap", "data of its logs were lost", "warnings")


def _doubts_of_checks(document: dict[str, Any]) -> Iterator[Doubt]:
    contradicting = [check for check in document["checks"] if check_contradicts(check)]
    if contradicting:
        check = contradicting[0]
        about = "a full turn" if check["name"] == "turn" else "the scale"
        clause = (
            f"wheels and tags of {check['robot_id']} contradict each other about {about} by "
            f"{percent_text(abs(check['value']))} ({check['sigmas']:.0f} sigma)"
        )
        yield Doubt(len(contradicting), "wheel-tag contradiction", clause, "checks")
    if any(metre["sigma"] is None for metre in document["metres"]):
        yield Doubt(1, "unknown scale", "nothing determines its scale", "metres")
    taped = [each for each in document["measurements"] if each["contradicts"]]
    if taped:
        clause = f"{plural(len(taped), 'measurement')} by hand {_do_or_does(taped)} not fit the rest"
        yield Doubt(len(taped), "unfitting measurement", clause, "measurements")


def _doubts_of_joins(document: dict[str, Any]) -> Iterator[Doubt]:
    unsure = [each for each in document["alignments"] if not each["is_sure"]]
    if unsure:
        clause = f"{plural(len(unsure), 'alignment')} {_was_or_were(unsure)} uncertain and not used"
        yield Doubt(len(unsure), "uncertain alignment", clause, "alignments", _pairs(unsure))
    weak = [each for each in document["alignments"] if each["is_sure"] and each["is_weak"]]
    if weak:
        clause = f"{plural(len(weak), 'alignment')} {'rests' if len(weak) == 1 else 'rest'} on one tag"
        yield Doubt(len(weak), "weak alignment", clause, "alignments", _pairs(weak))


def _doubts_of_tags(document: dict[str, Any]) -> Iterator[Doubt]:
    suspects = document["suspect_tags"]
    if suspects:
        clause = f"{plural(len(suspects), 'tag')} {_is_or_are(suspects)} suspect"
        names = enumerate_names([f"{each['tag_id']} ({each['kind']})" for each in suspects])
        yield Doubt(len(suspects), "suspect tag", clause, "suspects", names)
    warnings = document["warnings"]
    if warnings:
        yield Doubt(
            len(warnings), "warning", f"it comes with {plural(len(warnings), 'warning')}", "warnings", weight=SLIGHT
        )
    few = [tag for tag in document["tags"] if tag["n_observations"] < FEW_OBSERVATIONS]
    if few:
        clause = f"{plural(len(few), 'tag')} {_was_or_were(few)} observed fewer than {FEW_OBSERVATIONS} times"
        names = enumerate_names([str(tag["tag_id"]) for tag in few])
        yield Doubt(len(few), "hardly observed tag", clause, "tags", names, SLIGHT)


def check_contradicts(check: dict[str, Any]) -> bool:
    """Whether wheels and tags differ by more than chance allows."""
    return check["sigmas"] is not None and check["sigmas"] > MAX_SIGMAS


def enumerate_names(names: Sequence[str]) -> str:
    """Return `a`, `a and b` or `a, b and c`, with at most a few names."""
    shown = list(names[:_MOST_NAMED])
    if len(names) > _MOST_NAMED:
        shown.append(f"{len(names) - _MOST_NAMED} more")
    return shown[0] if len(shown) == 1 else f"{', '.join(shown[:-1])} and {shown[-1]}"


def _pairs(alignments: Sequence[dict[str, Any]]) -> str:
    return enumerate_names([f"{each['from']} with {each['to']}" for each in alignments])


def _do_or_does(entries: Sequence[object]) -> str:
    return "does" if len(entries) == 1 else "do"


def _is_or_are(entries: Sequence[object]) -> str:
    return "is" if len(entries) == 1 else "are"


def _was_or_were(entries: Sequence[object]) -> str:
    return "was" if len(entries) == 1 else "were"
