"""Result of merging, as warnings and as typed results."""

from collections.abc import Collection, Sequence
from math import degrees

from groundsbot.offline.alignment import Alignment, Group, Merge, PairAlignment, reason_not_joined
from groundsbot.offline.global_map import TagJoin
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.maps import AlignmentResult, AlternativeResult
from groundsbot.offline.measurements import TagKey

_TOO_LONG = (
    "this exceeds the work budget for logs of their size; map fewer drives at once and add the others by --extend"
)


def alignment_results(maps: Sequence[LocalMap], merged: Merge) -> tuple[AlignmentResult, ...]:
    """Return a result for each pair in which any two tags fit together."""
    return tuple(_result(maps, pair, pair.alignment) for pair in merged.pairs if pair.alignment is not None)


def merge_warnings(
    maps: Sequence[LocalMap],
    merged: Merge,
    named: Collection[tuple[str, int]] = (),
    not_joined: Sequence[TagJoin] | None = None,
) -> list[str]:
    """Return warnings about moved tags, ambiguous or contradictory alignments, and components that are not joined.

    Args:
        maps: that were merged.
        merged: the result.
        named: family and id of tags that other warnings name.
        not_joined: over single tags, with their reasons; None: that was not tried.
    """
    component = {m: i for i, group in enumerate(merged.groups) for m in group.members}
    warnings = []
    for pair in merged.pairs:
        alignment = pair.alignment
        if alignment is None:
            continue
        if alignment.is_accepted:
            warnings += _moved_tags(maps, pair, alignment, named)
        elif component[pair.a] == component[pair.b]:
            warnings.append(f"{_reason_not_joined(maps, pair)}; they are joined by other runs")
    warnings += _not_searched(maps, merged) + _contradictions(maps, merged)
    for number, group in enumerate(merged.groups[1:], start=2):
        warnings.append(f"component {number}: {why_not_merged(maps, merged, group, not_joined)}")
    return warnings


def why_not_merged(
    maps: Sequence[LocalMap], merged: Merge, group: Group, not_joined: Sequence[TagJoin] | None = None
) -> str:
    """Return why a component is not joined, for the pair that is nearest to joining it, and what would help."""
    crossing = [pair for pair in merged.pairs if (pair.a in group.members) != (pair.b in group.members)]
    if crossing:
        names = {maps[m].segment.name for m in group.members}
        nearest = max(crossing, key=_nearness)
        why = _reason_not_joined(maps, nearest, names)
        if len(nearest.shared) > 1:
            return why
        if not_joined is None and all(maps[m].had_corners or maps[m].graph.has_corners for m in (nearest.a, nearest.b)):
            return f"{why}, and with --model corners the one may suffice"
        tried = [join.reason for join in not_joined or () if (join.a in names) != (join.b in names)]
        return tried[0] if tried else why
    name = maps[group.members[0]].segment.name
    if not any(maps[m].graph.tags for m in group.members):
        return f"{name} saw no tag, so nothing connects it to the other runs; it is a separate trajectory"
    return f"{name} shares no tag with the others; drive it past two tags that another run saw"


def _not_searched(maps: Sequence[LocalMap], merged: Merge) -> list[str]:
    left = [pair for pair in merged.pairs if not pair.is_searched]
    if not left:
        return []
    a, b = (maps[m].segment.name for m in (left[0].a, left[0].b))
    told = f"{len(left)} of {len(merged.pairs)} pairs of drives that share tags were not aligned with each other"
    return [f"{told}, {a} and {b} among them: {_TOO_LONG}"]


def _nearness(pair: PairAlignment) -> tuple[float, int]:
    evidence_nats = float("-inf") if pair.alignment is None else pair.alignment.log_bayes_factor
    return evidence_nats, len(pair.shared)


def _reason_not_joined(maps: Sequence[LocalMap], pair: PairAlignment, told_of: set[str] | None = None) -> str:
    """Return why a pair is not joined; the first name is one of `told_of`."""
    a, b = maps[pair.a].segment.name, maps[pair.b].segment.name
    if (pair.alignment is None or not pair.alignment.alternatives) and told_of is not None and b not in told_of:
        a, b = b, a
    if not pair.is_searched:
        return f"{b} shares {len(pair.shared)} tags with {a}, but was not aligned with it: {_TOO_LONG}"
    return reason_not_joined(a, b, pair.shared, pair.alignment)


def _moved_tags(
    maps: Sequence[LocalMap], pair: PairAlignment, alignment: Alignment, named: Collection[tuple[str, int]]
) -> list[str]:
    a, b = maps[pair.a].segment.name, maps[pair.b].segment.name
    return [
        f"tag {tag.tag_id} is {off_m:.2f} m ({sigmas:.0f} sigma) elsewhere in {b} than in {a}: "
        "was it moved between or during the runs?"
        for tag, fits, off_m, sigmas in zip(
            alignment.shared, alignment.inlier, alignment.off_m, alignment.off_sigmas, strict=True
        )
        if not fits and (tag.family, tag.tag_id) not in named
    ]


def _contradictions(maps: Sequence[LocalMap], merged: Merge) -> list[str]:
    warnings = []
    for each in merged.contradictions:
        ring = ", ".join(maps[m].segment.name for m in each.cycle)
        gap_m, turn_deg = float((each.closure_error[:2] ** 2).sum() ** 0.5), abs(degrees(each.closure_error[2]))
        a, b = (maps[m].segment.name for m in (each.link.a, each.link.b))
        warnings.append(
            f"the alignments of {ring} contradict each other (around the cycle by {gap_m:.2f} m and {turn_deg:.1f} "
            f"deg, {each.sigmas:.0f} sigma); that of {a} with {b} was left out"
        )
    return warnings


def _result(maps: Sequence[LocalMap], pair: PairAlignment, alignment: Alignment) -> AlignmentResult:
    return AlignmentResult(
        from_run=maps[pair.a].segment.name,
        to_run=maps[pair.b].segment.name,
        T_from_to=alignment.T_a_b,
        n_shared=len(pair.shared),
        n_inliers=alignment.n_inliers,
        inlier_rmse_m=alignment.rmse_m,
        outliers=_ids(alignment.outliers),
        is_accepted=alignment.is_accepted,
        alternatives=tuple(AlternativeResult(each.T_a_b, _ids(each.inliers)) for each in alignment.alternatives),
    )


def _ids(tags: Sequence[TagKey]) -> tuple[tuple[str, int], ...]:
    return tuple((tag.family, tag.tag_id) for tag in tags)
