"""Tags that do not belong: found after the solve, given places of their own, and solved again.

A run on its own first: a tag that was carried about while it drove wrecks a local map, and with it the alignment. Then
all runs of a component together, begun with those tags apart that alignments found elsewhere.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.alignment import Merge
from groundsbot.offline.local_map import LocalMap, solve_local_map
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.outliers.evidence import (
    Evidence,
    LinearisedObservations,
    find_contradictions,
    linearise_observations,
    marginalise,
    noise_scales,
    to_other_tags,
)
from groundsbot.offline.outliers.grouping import few_of_each_tag
from groundsbot.offline.outliers.kinds import SHARE_ASTRAY_WITHIN_SIGHT, cases, is_within_sight, minority
from groundsbot.offline.outliers.places import Places, minimise_places
from groundsbot.offline.outliers.search import FALSE_ALARM, cost_bound, excess, freedom_of_places, search
from groundsbot.offline.outliers.tracks import (
    Tracks,
    instances,
    letters,
    split_places,
    tracks_of,
    with_instances,
)
from groundsbot.offline.sam import Graph, Priors, Solution, build_graph, solve

# Each search is linearised where the last one led; two do where a move is far beyond its sigma.
_MOST_SEARCHES: Final = 5
_LOOSER: Final = 1e3
# Two tags have one id now and then, three hardly: then other ways to join its tracks are tried, so many at most.
_MANY_PLACES: Final = 3
# Where a half of the tags that a drive came back to seem to have moved, something else is wrong; of so many or fewer.
_FEW_AGAIN: Final = 3
_MOST_JOINS: Final = 12


@dataclass(frozen=True)
class OutlierSearch:
    """A solve whose tags are where its observations say, split where need be.

    Attributes:
        graph, solution: with the splits.
        tracks: of the graph's segments.
        place: (S,) equal where tracks are of one tag.
        evidence: at the solution, and places: of its tracks.
    """

    graph: Graph
    solution: Solution
    tracks: Tracks
    place: IntArray
    evidence: Evidence
    places: Places

    @property
    def tags(self) -> list[TagKey]:
        """The tag of each track (S,)."""
        of = zip(self.tracks.segment, self.tracks.tag, strict=True)
        return [self.graph.segments[c].tags[t] for c, t in of]

    @property
    def picture(self) -> IntArray:
        """Return (M,) the pose of the picture of each observation; -1 for an imported one, which has no picture."""
        from_pictures = [not len(segment.run.positions.tag) for segment in self.graph.segments]
        of_observation = np.repeat(from_pictures, [len(segment.observations) for segment in self.graph.segments])
        return np.where(of_observation, self.graph.problem.observations.pose, -1)


class RunsAlone:
    """Local maps with their tags told apart, each looked at once though two steps ask for it."""

    def __init__(self) -> None:
        self._seen: list[tuple[LocalMap, LocalMap]] = []

    def split(self, local_map: LocalMap) -> LocalMap:
        """As `split_alone`."""
        for before, after in self._seen:
            if before is local_map:
                return after
        after = split_alone(local_map)
        self._seen.append((local_map, after))
        return after

    def explain_by_tags(self, before: LocalMap) -> LocalMap:
        """The map with tags apart where that makes it fit and most of those that it came back to stay; else as it was.

        Where wheels did not tell how the robot moved, most tags seem to have been moved.
        """
        after = self.split(before)
        tracks = tracks_of([before.segment])
        n_again = int((np.bincount(tracks.id) > 1).sum())
        n_split = len({tag.whole for tag in after.segment.tags if tag.instance})
        return after if after.goodness.fits and 2 * n_split < max(n_again, _FEW_AGAIN) else before


def split_alone(local_map: LocalMap, false_alarm: float = FALSE_ALARM) -> LocalMap:
    """A local map in which tags that were not in one place all along have several; the same where there are none.

    A drive that does not fit together may have ended in a wrong valley, led there by two tags with one id. Then it is
    solved with each track's tag apart, which wheels alone hold together, and tracks are joined from there, the
    surest first.
    """
    found = local_map
    if not found.goodness.fits:
        factors = np.maximum(1.0, [[found.goodness.odometry_factor, found.goodness.observation_factor]])
        tracks = _tracks(found.graph, linearise_observations(found.graph, found.solution.state, factors))
        if len(tracks) > len(tracks.ids):
            found = _in_few_places(_relabel(found, tracks, np.arange(len(tracks))), factors, false_alarm)
    # What is left that does not fit bends the map, and may well have done what seemed a tag's fault.
    return _in_few_places(found, noise_scales([found.goodness]), false_alarm)


def join_places(local_map: LocalMap) -> LocalMap:
    """With one place for each id again."""
    if not any(tag.instance for tag in local_map.segment.tags):
        return local_map
    tracks = tracks_of([local_map.segment])
    ids = [tracks.ids[i] for i in tracks.id]
    return solve_local_map(with_instances([local_map.segment], tracks, ids)[0])


def _in_few_places(local_map: LocalMap, scales: FloatArray, false_alarm: float) -> LocalMap:
    """Splits and joins until nothing changes; where an id comes out in many places, also from other joins.

    Two tags with one id that are passed again after a long way are both off by what is not known of the way. One may
    come to lie where the other one was, and the surest join be a wrong one, with which nothing else fits.
    """
    found = _search_alone(local_map, scales, false_alarm)
    n_places = Counter(key.whole for key in found.segment.tags)
    for tag in [each for each, n in n_places.items() if n >= _MANY_PLACES]:
        seen = _collect_tracks(local_map.graph, local_map.solution, scales)
        for place in _joins(seen, tag)[:_MOST_JOINS]:
            other = _search_alone(_relabel(local_map, seen.tracks, place), scales, false_alarm)
            if other.goodness.fits >= found.goodness.fits and _n_places(other, tag) < _n_places(found, tag):
                found = other
            if _n_places(found, tag) < _MANY_PLACES:
                break
    return found


def _joins(seen: OutlierSearch, tag: TagKey) -> list[IntArray]:
    """(S,) each: the places with two of an id joined, the surest first.

    However far apart they are: what turns by an angle moves on an arc, and a linearisation knows of no arcs.
    """
    which, places = seen.evidence.which, seen.places
    own = np.array([seen.tracks.ids[i] == tag for i in seen.tracks.id[which]], dtype=np.bool_)
    found = []
    for p, q in combinations(np.unique(places.place[own]).tolist(), 2):
        off, covariance = places.apart(seen.evidence, p, q)
        one, other = (seen.place[which[places.place == label][0]] for label in (p, q))
        joined = np.where(seen.place == other, one, seen.place)
        found.append((float(off @ np.linalg.solve(covariance, off)), joined))
    return [place for _, place in sorted(found, key=lambda each: each[0])]


def _n_places(local_map: LocalMap, tag: TagKey) -> int:
    return sum(key.whole == tag for key in local_map.segment.tags)


def _search_alone(local_map: LocalMap, scales: FloatArray, false_alarm: float) -> LocalMap:
    """Splits and joins until nothing changes."""
    found = local_map
    for _ in range(_MOST_SEARCHES):
        seen = _collect_tracks(found.graph, found.solution, scales)
        wanted = _best_places(seen, false_alarm)
        if wanted is None or _same(wanted, seen.place):
            break
        found = _relabel(found, seen.tracks, wanted)
    return found


def _relabel(local_map: LocalMap, tracks: Tracks, place: IntArray) -> LocalMap:
    """The segment solved anew with these places, whose names no other run has."""
    tag_of = instances(tracks, place, f"{local_map.segment.name} ")
    return solve_local_map(with_instances([local_map.segment], tracks, tag_of)[0])


def with_outliers_apart(maps: Sequence[LocalMap], merged: Merge) -> list[LocalMap]:
    """The maps with tags told apart that sure alignments found elsewhere in one map than in another."""
    names: dict[tuple[int, TagKey], TagKey] = {}
    n_places: Counter[TagKey] = Counter()
    sure = [pair for pair in merged.pairs if pair.alignment is not None and pair.alignment.is_accepted]
    outliers = {tag for pair in sure for tag in (pair.alignment.outliers if pair.alignment else ())}
    for tag in sorted(outliers):
        group = {m: m for m, each in enumerate(maps) if tag in each.graph.tags}
        for pair in sure:
            if pair.alignment is not None and tag in pair.alignment.inliers:
                one, other = group[pair.a], group[pair.b]
                group = {m: one if g == other else g for m, g in group.items()}
        if len(places := dict.fromkeys(group.values())) > 1:
            first = n_places[tag.whole]
            letter = {g: letters(first + i) for i, g in enumerate(places)}
            n_places[tag.whole] += len(places)
            names |= {(m, tag): tag._replace(instance=letter[g]) for m, g in group.items()}
    return [rename_tags(each, {tag: name for (m, tag), name in names.items() if m == i}) for i, each in enumerate(maps)]


def split_together(graph: Graph, solution: Solution, maps: Sequence[LocalMap]) -> OutlierSearch | None:
    """Splits and joins the tags of a component until nothing changes.

    What somebody measured only keeps together meanwhile what no tags do: a slip of the tape is no tag's fault. None
    where most tags of drives whose noise was fitted seem to have several places: then it is not the tags.

    Args:
        graph: of the component.
        solution: of it.
        maps: of the graph's segments.
    """
    if len(graph.problem.measured):
        loose = replace(graph, problem=replace(graph.problem, measured=_loosen_priors(graph.problem.measured)))
        seen = _split(loose, solve(loose.problem, solution.state), maps)
        if seen is None:
            return None
        problem = replace(seen.graph.problem, measured=_rename_ends(graph, seen.graph))
        return replace(seen, graph=replace(seen.graph, problem=problem), solution=solve(problem, seen.solution.state))
    return _split(graph, solution, maps)


def _split(graph: Graph, solution: Solution, maps: Sequence[LocalMap]) -> OutlierSearch | None:
    scales = noise_scales([each.goodness for each in maps])
    seen = _collect_tracks(graph, solution, scales)
    noise_is_fitted = any(each.is_noisy for each in maps)
    for _ in range(_MOST_SEARCHES):
        wanted = _best_places(seen, FALSE_ALARM, noise_is_fitted=noise_is_fitted)
        if wanted is None:
            return None
        if instances(seen.tracks, wanted) == seen.tags:
            break
        seen = _collect_tracks(*_solve_again(seen, wanted), scales)
    if noise_is_fitted:
        joined_place = _join_near_places(seen)
        if not _same(joined_place, seen.place):
            seen = _collect_tracks(*_solve_again(seen, joined_place), scales)
    return seen


def _join_near_places(seen: OutlierSearch) -> IntArray:
    """(S,) the places; one for an id of near places that were never seen at once, each sighted more than now and then.

    Where noise was fitted, that is an error of the drives.
    """
    found = seen.place.copy()
    for case in cases(seen.tracks, seen.evidence, seen.places):
        if is_within_sight(case, seen.tracks, seen.evidence, seen.places, seen.picture) and not minority(
            case, SHARE_ASTRAY_WITHIN_SIGHT
        ):
            which = seen.evidence.which[np.isin(seen.places.place, [each.label for each in case.stands])]
            found[which] = found[which[0]]
    return found


def _tracks(graph: Graph, at: LinearisedObservations) -> Tracks:
    """Cut also where a tag moved in sight."""
    whole = tracks_of(graph.segments)
    cut = find_contradictions(at, whole)
    return few_of_each_tag(graph, tracks_of(graph.segments, cut) if cut.any() else whole)


def _collect_tracks(graph: Graph, solution: Solution, scales: FloatArray) -> OutlierSearch:
    at = linearise_observations(graph, solution.state, scales)
    tracks = _tracks(graph, at)
    place = split_places(graph.segments, tracks)
    evidence = marginalise(at, tracks)
    return OutlierSearch(graph, solution, tracks, place, evidence, minimise_places(evidence, place[evidence.which]))


def _best_places(seen: OutlierSearch, false_alarm: float, *, noise_is_fitted: bool = False) -> IntArray | None:
    """(S,) the places that the evidence asks for.

    None where most ids ask for several though the noise was fitted to the same passes: then it is not the tags.
    """
    which = seen.evidence.which
    found = seen.place.copy()
    if len(which):
        freedom = freedom_of_places(seen.places) if noise_is_fitted else np.inf
        least_gain = excess(seen.places) * cost_bound(seen.tracks, seen.evidence, false_alarm, freedom)
        most_ids = max(int((np.bincount(seen.tracks.id) > 1).sum()), _FEW_AGAIN) // 2
        label = search(seen.evidence, seen.tracks, seen.places, least_gain, most_ids if noise_is_fitted else None)
        if label is None:
            return None
        found[which] = seen.place.max() + 1 + label
    return found


def _same(place: IntArray, other: IntArray) -> bool:
    """Whether two ways (S,) to number places gather the same tracks."""
    pairs = len(np.unique(np.column_stack([place, other]), axis=0))
    return pairs == len(np.unique(place)) == len(np.unique(other))


def _solve_again(seen: OutlierSearch, place: IntArray) -> tuple[Graph, Solution]:
    """The same segments with these places, from the poses as they are."""
    graph, state = seen.graph, seen.solution.state
    again = build_graph(with_instances(graph.segments, seen.tracks, instances(seen.tracks, place)))
    again = replace(again, problem=replace(again.problem, measured=_rename_ends(graph, again)))
    start = again.start(state.poses, _unchanged_places(graph, again, state.tags), graph.calibration_of(state))
    return again, solve(again.problem, start)


def _loosen_priors(measured: Priors) -> Priors:
    """With sigmas so wide that it contradicts nothing."""
    starts, distances = measured.starts, measured.distances
    return Priors(
        replace(starts, whitening=starts.whitening / _LOOSER),
        replace(distances, sigma_m=distances.sigma_m * _LOOSER),
    )


def _rename_ends(before: Graph, after: Graph) -> Priors:
    """What was measured, now to the first instance of each tag."""
    first = {tag.whole: i for i, tag in reversed(list(enumerate(after.tags)))}
    return to_other_tags(before.problem.measured, np.array([first[tag.whole] for tag in before.tags], dtype=np.int64))


def _unchanged_places(before: Graph, after: Graph, tags_m: FloatArray) -> dict[TagKey, FloatArray]:
    """Places of the tags that have the observations they had."""
    n_before = dict(zip(before.tags, before.n_observations().tolist(), strict=True))
    n_after = dict(zip(after.tags, after.n_observations().tolist(), strict=True))
    places = dict(zip(before.tags, tags_m, strict=True))
    return {tag: places[tag] for tag, n in n_after.items() if n_before.get(tag) == n}


def rename_tags(local_map: LocalMap, names: dict[TagKey, TagKey]) -> LocalMap:
    """The same map with some of its tags under other names."""
    if not names:
        return local_map
    segment = local_map.segment
    renamed = replace(segment, tags=tuple(names.get(tag, tag) for tag in segment.tags))
    graph = replace(
        local_map.graph, segments=(renamed,), tags=tuple(names.get(tag, tag) for tag in local_map.graph.tags)
    )
    return replace(local_map, segment=renamed, graph=graph)
