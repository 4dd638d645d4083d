"""What merging found, in words for a person and typed for the result."""

from collections.abc import Collection, Sequence
from math import degrees

from groundsbot.calib.arrays import FloatArray
from groundsbot.offline.alignment import Alignment
from groundsbot.offline.corner_graph import has_corners
from groundsbot.offline.fit_results import AlignmentResult, RivalResult
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.merge import Group, Merge, PairAlignment
from groundsbot.offline.run_tags import TagKey
from groundsbot.offline.tag_joins import TagJoin

_MOST_NAMED = 8
_TOO_LONG = (
    "that takes more work than logs of their size are worth; map fewer drives at once and add the others by --extend"
)


def alignment_results(maps: Sequence[LocalMap], merged: Merge) -> tuple[AlignmentResult, ...]:
    """Each pair in which any two tags fit together."""
    return tuple(_result(maps, pair, pair.alignment) for pair in merged.pairs if pair.alignment is not None)


def merge_warnings(
    maps: Sequence[LocalMap],
    merged: Merge,
    named: Collection[tuple[str, int]] = (),
    not_joined: Sequence[TagJoin] | None = None,
) -> list[str]:
    """Tags that lie elsewhere, alignments that are ambiguous or contradict others, and why components are apart.

    Args:
        maps: that were merged.
        merged: the result.
        named: family and id of tags of which nothing more is to be said.
        not_joined: over single tags, with their reasons; None: that was not tried.
    """
    component = {m: i for i, group in enumerate(merged.groups) for m in group.members}
    warnings = []
    for pair in merged.pairs:
        alignment = pair.alignment
        if alignment is None:
            continue
        if alignment.is_sure:
            warnings += _elsewhere(maps, pair, alignment, named)
        elif component[pair.a] == component[pair.b]:
            warnings.append(f"{_why_not_joined(maps, pair)}; other runs join them")
    warnings += _not_searched(maps, merged) + _contradictions(maps, merged)
    for i, group in enumerate(merged.groups[1:], start=1):
        warnings.append(f"component {i}: {reason_apart(maps, merged, group, not_joined)}")
    return warnings


def reason_apart(
    maps: Sequence[LocalMap], merged: Merge, group: Group, not_joined: Sequence[TagJoin] | None = None
) -> str:
    """Why a component is one of its own, told of the pair that is nearest to joining it, and what would help."""
    crossing = [pair for pair in merged.pairs if (pair.a in group.members) != (pair.b in group.members)]
    if crossing:
        names = {maps[m].chain.name for m in group.members}
        nearest = max(crossing, key=_nearness)
        why = _why_not_joined(maps, nearest, names)
        if len(nearest.shared) > 1:
            return why
        if not_joined is None and all(has_corners(maps[m].graph) for m in (nearest.a, nearest.b)):
            return f"{why}, and --model corners may do with the one"
        tried = [join.reason for join in not_joined or () if (join.a in names) != (join.b in names)]
        return tried[0] if tried else why
    name = maps[group.members[0]].chain.name
    if not any(maps[m].graph.tags for m in group.members):
        return f"{name} saw no tag, so nothing ties it to the other runs; it is kept as a trajectory of its own"
    return f"{name} shares no tag with the others; drive it past two tags that another run saw"


def _not_searched(maps: Sequence[LocalMap], merged: Merge) -> list[str]:
    left = [pair for pair in merged.pairs if not pair.is_searched]
    if not left:
        return []
    a, b = (maps[m].chain.name for m in (left[0].a, left[0].b))
    told = f"{len(left)} of {len(merged.pairs)} pairs of drives that share tags were not laid over each other"
    return [f"{told}, {a} and {b} among them: {_TOO_LONG}"]


def _nearness(pair: PairAlignment) -> tuple[float, int]:
    evidence_nats = float("-inf") if pair.alignment is None else pair.alignment.evidence_nats
    return evidence_nats, len(pair.shared)


def _why_not_joined(maps: Sequence[LocalMap], pair: PairAlignment, told_of: set[str] | None = None) -> str:
    """Why a pair is not joined; the first name is one of `told_of`."""
    a, b = maps[pair.a].chain.name, maps[pair.b].chain.name
    if (pair.alignment is None or not pair.alignment.rivals) and told_of is not None and b not in told_of:
        a, b = b, a
    if not pair.is_searched:
        return f"{b} shares {len(pair.shared)} tags with {a}, but was not laid over it: {_TOO_LONG}"
    return why_not_joined(a, b, pair.shared, pair.alignment)


def why_not_joined(a: str, b: str, shared: Sequence[TagKey], alignment: Alignment | None) -> str:
    """Why run b is not joined to a, by name; they share a tag at least."""
    if alignment is not None and alignment.rivals:
        return _ambiguous(a, b, alignment)
    if len(shared) == 1:
        return f"{b} shares only tag {shared[0].tag_id} with {a}; one more shared tag would do"
    if alignment is not None and alignment.is_sure:
        return f"the alignment of {b} with {a} contradicts those of other runs"
    if alignment is not None:
        return (
            f"of the {len(shared)} tags that {b} shares with {a} only {_names(alignment.inliers)} lie the same "
            "way in both maps, which chance may bring about; were tags moved between the runs? One more shared tag "
            "that stayed would do"
        )
    return (
        f"{b} shares {len(shared)} tags with {a}, but no two of them lie the same way in both maps: "
        "were tags moved between the runs? Two shared tags that stayed would do"
    )


def _ambiguous(a: str, b: str, alignment: Alignment) -> str:
    ways = [alignment, *alignment.rivals]
    first = set(alignment.inliers)
    told = [f"tags {_names(ways[0].inliers)} put {b}'s start at {_place(ways[0].T_a_b)}"]
    told += [
        f"tags {_names(tuple(tag for tag in way.inliers if tag not in first) or way.inliers)} at {_place(way.T_a_b)}"
        for way in ways[1:3]
    ]
    more = f", and there are {len(ways) - 3} more ways" if len(ways) > 3 else ""
    return (
        f"how {b} lies in {a} is ambiguous, because {', '.join(told)}{more}: nothing tells which tags stayed and which "
        "were moved or relabelled; a few more shared tags that stayed would do"
    )


def _elsewhere(
    maps: Sequence[LocalMap], pair: PairAlignment, alignment: Alignment, named: Collection[tuple[str, int]]
) -> list[str]:
    a, b = maps[pair.a].chain.name, maps[pair.b].chain.name
    return [
        f"tag {tag.tag_id} lies {off_m:.2f} m ({sigmas:.0f} sigma) elsewhere in {b} than in {a}: "
        "moved between the runs, or carried about?"
        for tag, fits, off_m, sigmas in zip(
            alignment.shared, alignment.inlier, alignment.off_m, alignment.off_sigmas, strict=True
        )
        if not fits and (tag.family, tag.tag_id) not in named
    ]


def _contradictions(maps: Sequence[LocalMap], merged: Merge) -> list[str]:
    warnings = []
    for each in merged.contradictions:
        ring = ", ".join(maps[m].chain.name for m in each.ring)
        gap_m, turn_deg = float((each.gap[:2] ** 2).sum() ** 0.5), abs(degrees(each.gap[2]))
        a, b = (maps[m].chain.name for m in (each.link.a, each.link.b))
        warnings.append(
            f"the alignments of {ring} contradict each other (their ring gapes by {gap_m:.2f} m and {turn_deg:.1f} "
            f"deg, {each.sigmas:.0f} sigma); that of {a} with {b} was left out"
        )
    return warnings


def _result(maps: Sequence[LocalMap], pair: PairAlignment, alignment: Alignment) -> AlignmentResult:
    return AlignmentResult(
        from_run=maps[pair.a].chain.name,
        to_run=maps[pair.b].chain.name,
        T_from_to=alignment.T_a_b,
        n_shared=len(pair.shared),
        n_inliers=alignment.n_inliers,
        inlier_rmse_m=alignment.rmse_m,
        outliers=_ids(alignment.outliers),
        is_sure=alignment.is_sure,
        rivals=tuple(RivalResult(each.T_a_b, _ids(each.inliers)) for each in alignment.rivals),
    )


def _ids(tags: Sequence[TagKey]) -> tuple[tuple[str, int], ...]:
    return tuple((tag.family, tag.tag_id) for tag in tags)


def _names(tags: Sequence[TagKey]) -> str:
    named = ", ".join(f"{tag.tag_id}{tag.instance}" for tag in tags[:_MOST_NAMED])
    return named if len(tags) <= _MOST_NAMED else f"{named} and {len(tags) - _MOST_NAMED} more"


def _place(T: FloatArray) -> str:
    return f"({T[0]:.2f}, {T[1]:.2f}) m turned by {degrees(T[2]):.1f} deg"
