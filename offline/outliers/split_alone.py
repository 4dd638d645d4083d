"""Search one drive alone for tags that moved or share an id, before it is aligned with others."""

from collections import Counter
from itertools import combinations
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.local_map import LocalMap, solve_local_map
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.outliers.evidence import linearise_observations, noise_scales
from groundsbot.offline.outliers.outliers import (
    FEW_AGAIN,
    MOST_SEARCHES,
    OutlierSearch,
    best_places,
    cut_tracks,
    evidence_at,
    is_same_partition,
)
from groundsbot.offline.outliers.search import FALSE_ALARM
from groundsbot.offline.outliers.tracks import Tracks, instances, tracks_of, with_instances

# Three tags rarely share an id. From this many places of an id on, other ways to join its tracks are tried.
_MANY_PLACES: Final = 3
_MOST_JOINS: Final = 12


class SplitCache:
    """Cache of `split_alone`, which two steps call for the same map."""

    def __init__(self) -> None:
        self._results: list[tuple[LocalMap, LocalMap]] = []

    def split(self, local_map: LocalMap) -> LocalMap:
        """Return the result of `split_alone`."""
        for before, after in self._results:
            if before is local_map:
                return after
        after = split_alone(local_map)
        self._results.append((local_map, after))
        return after

    def explain_by_tags(self, before: LocalMap) -> LocalMap:
        """Return the map with split tags if it then fits and few tags are split, else the map itself.

        Most tags seem to have moved where the odometry is wrong. So less than half of the tags with several tracks may
        be split.
        """
        after = self.split(before)
        tracks = tracks_of([before.segment])
        n_again = int((np.bincount(tracks.id) > 1).sum())
        n_split = len({tag.whole for tag in after.segment.tags if tag.instance})
        return after if after.goodness.fits and 2 * n_split < max(n_again, FEW_AGAIN) else before


def split_alone(local_map: LocalMap, false_alarm: float = FALSE_ALARM) -> LocalMap:
    """Return the local map with several places for each tag that moved or shares its id; the map itself without such.

    Two tags with one id may lead the solve of a drive to a wrong local minimum. So a drive that does not fit is solved
    with a separate tag for each track, connected by odometry only. Tracks are then joined, the most certain pair first.

    Args:
        local_map: local map of one segment.
        false_alarm: probability that a map without such tags gets a split.
    """
    found = local_map
    if not found.goodness.fits:
        factors = np.maximum(1.0, [[found.goodness.odometry_factor, found.goodness.observation_factor]])
        tracks = cut_tracks(found.graph, linearise_observations(found.graph, found.solution.state, factors))
        if len(tracks) > len(tracks.ids):
            found = _in_few_places(_relabel(found, tracks, np.arange(len(tracks))), factors, false_alarm)
    # A remaining misfit distorts the map and may be what made tags seem to move: the scales allow for it.
    return _in_few_places(found, noise_scales([found.goodness]), false_alarm)


def join_places(local_map: LocalMap) -> LocalMap:
    """Return the map solved again with one place for each id."""
    if not any(tag.instance for tag in local_map.segment.tags):
        return local_map
    tracks = tracks_of([local_map.segment])
    ids = [tracks.ids[i] for i in tracks.id]
    return solve_local_map(with_instances([local_map.segment], tracks, ids)[0])


def _in_few_places(local_map: LocalMap, scales: FloatArray, false_alarm: float) -> LocalMap:
    """Split and join tags until nothing changes; an id that then has many places is also searched from other joins.

    Odometry drifts on a long way back to two tags with one id. One may then appear where the other was. The most
    certain join is wrong in that case, and nothing else fits with it.
    """
    found = _search_alone(local_map, scales, false_alarm)
    n_places = Counter(key.whole for key in found.segment.tags)
    for tag in [each for each, n in n_places.items() if n >= _MANY_PLACES]:
        before = evidence_at(local_map.graph, local_map.solution, scales)
        for place in _joins(before, tag)[:_MOST_JOINS]:
            other = _search_alone(_relabel(local_map, before.tracks, place), scales, false_alarm)
            if other.goodness.fits >= found.goodness.fits and _n_places(other, tag) < _n_places(found, tag):
                found = other
            if _n_places(found, tag) < _MANY_PLACES:
                break
    return found


def _joins(searched: OutlierSearch, tag: TagKey) -> list[IntArray]:
    """Return labels (S,) of places for each join of two places of an id, the most certain join first.

    Distant places are joined too: a heading error moves them along an arc, which a linearisation does not model.
    """
    which, places = searched.evidence.which, searched.places
    own = np.array([searched.tracks.ids[i] == tag for i in searched.tracks.id[which]], dtype=np.bool_)
    found = []
    for p, q in combinations(np.unique(places.place[own]).tolist(), 2):
        offset_m, covariance = places.apart(searched.evidence, p, q)
        one, other = (searched.place[which[places.place == label][0]] for label in (p, q))
        joined = np.where(searched.place == other, one, searched.place)
        found.append((float(offset_m @ np.linalg.solve(covariance, offset_m)), joined))
    return [place for _, place in sorted(found, key=lambda each: each[0])]


def _n_places(local_map: LocalMap, tag: TagKey) -> int:
    return sum(key.whole == tag for key in local_map.segment.tags)


def _search_alone(local_map: LocalMap, scales: FloatArray, false_alarm: float) -> LocalMap:
    """Split and join the tags of a local map until nothing changes."""
    found = local_map
    for _ in range(MOST_SEARCHES):
        searched = evidence_at(found.graph, found.solution, scales)
        best = best_places(searched, false_alarm)
        if best is None or is_same_partition(best, searched.place):
            break
        found = _relabel(found, searched.tracks, best)
    return found


def _relabel(local_map: LocalMap, tracks: Tracks, place: IntArray) -> LocalMap:
    """Solve the segment again with these places (S,), under instance names that no other run has."""
    tag_of = instances(tracks, place, f"{local_map.segment.name} ")
    return solve_local_map(with_instances([local_map.segment], tracks, tag_of)[0])
