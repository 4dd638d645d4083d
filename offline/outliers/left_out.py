"""Removal of observations that no tag explains: false detections, misread codes and single wrong tracks.

A tag that was moved stays at its new place. A place that only one track in fifty, or a single one, gives a tag is
therefore an error of that track, such as a slipping wheel or a reflection. One or two observations are a misread code.
Where such errors are frequent among the other tags of a map, a tag may have as many of them as their frequency explains
(an empirical null distribution: Efron, "Large-scale simultaneous hypothesis testing", 2004).
"""

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import bdtrc, chdtri

from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.maps import OutlierTag
from groundsbot.offline.measurements import FEW_OBSERVATIONS, TagKey
from groundsbot.offline.outliers.evidence import to_other_tags
from groundsbot.offline.outliers.false_detections import MOST_OBSERVATIONS
from groundsbot.offline.outliers.kinds import (
    PHANTOM,
    SHARE_ASTRAY,
    SHARE_ASTRAY_WITHIN_SIGHT,
    IdPlace,
    SeveralPlaces,
    cases,
    is_within_sight,
    minority,
)
from groundsbot.offline.outliers.outliers import OutlierSearch
from groundsbot.offline.outliers.search import FALSE_ALARM
from groundsbot.offline.sam import Graph, Solution, build_graph, solve

# Bound of the squared whitened residual of an observation of a tag, with a false alarm rate of 1e-3.
_SAME_PLACE: Final = float(chdtri(2, 1e-3))


def find_false_detections(graph: Graph, suspects: Sequence[OutlierTag]) -> set[TagKey]:
    """Return the tags of a graph that only consist of false detections."""
    named = {(each.family, each.tag_id) for each in suspects if each.kind == PHANTOM}
    few = graph.n_observations() <= MOST_OBSERVATIONS
    return {tag for tag, is_few in zip(graph.tags, few, strict=True) if is_few and (tag.family, tag.tag_id) in named}


def stray_passes(searched: OutlierSearch) -> set[TagKey]:
    """Return the tags (instances) whose place is an error of few tracks, beside a place of the id with more support."""
    which, tags = searched.evidence.which, searched.tags
    found = cases(searched.tracks, searched.evidence, searched.places)
    wrong = [_wrong_places(searched, case) for case in found]
    n_wrong = [sum(each.n_tracks for each in places if each.n_observations > FEW_OBSERVATIONS) for places in wrong]
    n_ids = len(np.unique(searched.tracks.id[which]))
    for i, case in enumerate(found):
        n_others = len(which) - case.n_tracks
        if not wrong[i] and n_others:
            share = (sum(n_wrong) - n_wrong[i]) / n_others
            by_chance = bdtrc(np.arange(case.n_tracks + 1), case.n_tracks, share) > FALSE_ALARM / n_ids
            wrong[i] = minority(case, int(by_chance.sum()))
    labels = [place.label for places in wrong for place in places]
    return {tags[s] for s in which[np.isin(searched.places.place, labels)].tolist()}


def _wrong_places(searched: OutlierSearch, case: SeveralPlaces) -> list[IdPlace]:
    """Return the wrong places of an id: all but the main one, or none."""
    if all(each.n_observations <= FEW_OBSERVATIONS < case.main.n_observations for each in case.others):
        return list(case.others)
    is_near = is_within_sight(case, searched.tracks, searched.evidence, searched.places, searched.picture)
    return minority(case, (SHARE_ASTRAY_WITHIN_SIGHT if is_near else SHARE_ASTRAY) * case.n_tracks)


def read_as_another(graph: Graph, solution: Solution, maps: Sequence[LocalMap]) -> set[TagKey]:
    """Return tags with a single observation, at the position of another tag that the same picture does not show.

    Such an observation is of the other tag, with a misread code, if other codes of these drives were misread too. If
    none were, the result is empty. Tags of tape measurements and of a finished map are never returned.
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


def without_tags(graph: Graph, solution: Solution, removed: Collection[TagKey]) -> tuple[Graph, Solution]:
    """Solve a graph without some tags and their observations; an id with one remaining place loses its instance."""
    if not removed:
        return graph, solution
    n_places = Counter(tag.whole for tag in graph.tags if tag not in removed)
    single = {tag.whole for tag in removed if n_places[tag.whole] == 1}
    name = {tag: tag.whole if tag.whole in single else tag for tag in graph.tags if tag not in removed}
    segments = []
    for segment in graph.segments:
        is_kept = np.array([segment.tags[t] not in removed for t in segment.observations.tag], dtype=np.bool_)
        remaining = segment.with_observations(is_kept)
        segments.append(replace(remaining, tags=tuple(name[tag] for tag in remaining.tags)))
    again = build_graph(segments)
    index = {tag: i for i, tag in enumerate(again.tags)}
    numbers = np.array([index.get(name.get(tag, tag.whole), 0) for tag in graph.tags], dtype=np.int64)
    again = replace(again, problem=replace(again.problem, measured=to_other_tags(graph.problem.measured, numbers)))
    places = {name[tag]: place_m for tag, place_m in graph.tags_of(solution.state).items() if tag in name}
    start = again.start(solution.state.poses, places, graph.calibration_of(solution.state))
    solution = solve(again.problem, start)
    again.problem.arrowhead.without_scratch()
    return again, solution
