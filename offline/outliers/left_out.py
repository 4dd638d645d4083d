"""Observations that no tag explains, left out of a component: false detections, and single passes that went astray.

A tag that was moved stays where it was moved to. A place that one pass in fifty, or one alone, gives a tag, whose other
passes all have it elsewhere, is that pass's error: somebody stood before the tag, a wheel slipped, a reflection was
read. And one or two observations are a misread code.
"""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.maps import OutlierTag
from groundsbot.offline.measurements import FEW_OBSERVATIONS, TagKey
from groundsbot.offline.outliers.evidence import to_other_tags
from groundsbot.offline.outliers.false_detections import MOST_OBSERVATIONS
from groundsbot.offline.outliers.kinds import (
    PHANTOM,
    SHARE_ASTRAY,
    SHARE_ASTRAY_WITHIN_SIGHT,
    SeveralPlaces,
    TagStand,
    cases,
    is_within_sight,
    minority,
)
from groundsbot.offline.outliers.outliers import OutlierSearch
from groundsbot.offline.sam import Graph, Solution, build_graph, solve

# Of a whitened residual: an observation of a tag itself is nearer but once in a thousand times.
_SAME_PLACE: Final = float(chi2.isf(1e-3, 2))


def find_false_detections(graph: Graph, suspects: Sequence[OutlierTag]) -> set[TagKey]:
    """Tags of the graph that are false detections and nothing else."""
    named = {(each.family, each.tag_id) for each in suspects if each.kind == PHANTOM}
    few = graph.n_observations() <= MOST_OBSERVATIONS
    return {tag for tag, is_few in zip(graph.tags, few, strict=True) if is_few and (tag.family, tag.tag_id) in named}


def stray_passes(searched: OutlierSearch) -> set[TagKey]:
    """Places of ids that next to nothing speaks for, beside one that more does."""
    which, tags = searched.evidence.which, searched.tags
    found = cases(searched.tracks, searched.evidence, searched.places)
    labels = [stand.label for case in found for stand in _astray(searched, case)]
    return {tags[s] for s in which[np.isin(searched.places.place, labels)].tolist()}


def _astray(searched: OutlierSearch, case: SeveralPlaces) -> list[TagStand]:
    """The places of a tag that are no places; all of them but one, or none."""
    if all(each.n_observations <= FEW_OBSERVATIONS < case.most.n_observations for each in case.others):
        return list(case.others)
    is_near = is_within_sight(case, searched.tracks, searched.evidence, searched.places, searched.picture)
    return minority(case, SHARE_ASTRAY_WITHIN_SIGHT if is_near else SHARE_ASTRAY)


def read_as_another(graph: Graph, solution: Solution, maps: Sequence[LocalMap]) -> set[TagKey]:
    """Tags of a single observation that lie where another tag is, which the same picture does not show.

    Where other observations of these drives were misread, such a one is the other tag, its code misread; none where
    none were. One that a tape or a finished map knows of is there.
    """
    if not any(each.n_misread for each in maps):
        return set()
    measured, observations = graph.problem.measured, graph.problem.observations
    n_observations = graph.n_observations()
    is_once = n_observations == 1
    for known in (measured.known.tags, measured.distances.tag_a, measured.distances.tag_b):
        is_once[known[known >= 0]] = False
    found = set()
    for tag in np.flatnonzero(is_once).tolist():
        (m,) = np.flatnonzero(observations.tag == tag).tolist()
        in_picture = observations.tag[observations.pose == observations.pose[m]]
        others = np.setdiff1d(np.flatnonzero(n_observations > 1), in_picture)
        squares = (observations.with_other_tags(m, others).residual(solution.state) ** 2).sum(axis=1)
        if len(others) and squares.min() < _SAME_PLACE:
            found.add(graph.tags[tag])
    return found


def without_tags(graph: Graph, solution: Solution, gone: Collection[TagKey]) -> tuple[Graph, Solution]:
    """The same solved without some tags and their observations; an id that has one place left goes by its own name."""
    if not gone:
        return graph, solution
    left = Counter(tag.whole for tag in graph.tags if tag not in gone)
    alone = {tag.whole for tag in gone if left[tag.whole] == 1}
    name = {tag: tag.whole if tag.whole in alone else tag for tag in graph.tags if tag not in gone}
    segments = []
    for segment in graph.segments:
        kept = segment.with_observations(
            np.array([segment.tags[t] not in gone for t in segment.observations.tag], dtype=np.bool_)
        )
        segments.append(replace(kept, tags=tuple(name[tag] for tag in kept.tags)))
    again = build_graph(segments)
    index = {tag: i for i, tag in enumerate(again.tags)}
    numbers = np.array([index.get(name.get(tag, tag.whole), 0) for tag in graph.tags], dtype=np.int64)
    again = replace(again, problem=replace(again.problem, measured=to_other_tags(graph.problem.measured, numbers)))
    places = {name[tag]: place_m for tag, place_m in graph.tags_of(solution.state).items() if tag in name}
    start = again.start(solution.state.poses, places, graph.calibration_of(solution.state))
    return again, solve(again.problem, start)
