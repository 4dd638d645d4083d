"""Search for tags that moved or share an id: each gets several places, and the solve is repeated.

Each run is searched alone first, since a tag that moves during a run distorts its local map and so the alignment. Then
all runs of a component are searched together. That search starts with those tags split that accepted alignments place
differently.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.alignment import Merge
from groundsbot.offline.foundation import Workers, release_memory
from groundsbot.offline.local_map import LocalMap
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
from groundsbot.offline.sam import Graph, Priors, Solution, State, build_graph, solve_with_workers

# Each search is linearised at the result of the last one. Two suffice where a tag moved by many sigmas.
MOST_SEARCHES: Final = 5
_LOOSER: Final = 1e3
# If half of the tags with several tracks seem to have moved, something else is wrong. A drive with fewer such tags is
# treated as if it had this many.
FEW_AGAIN: Final = 3


@dataclass(frozen=True)
class OutlierSearch:
    """A solve in which tags have as many places as their observations require.

    Attributes:
        graph, solution: with the split tags.
        tracks: S tracks of the graph's segments.
        place: (S,) label, equal for tracks of one tag.
        evidence: evidence at the solution.
    """

    graph: Graph
    solution: Solution
    tracks: Tracks
    place: IntArray
    evidence: Evidence

    @cached_property
    def places(self) -> Places:
        """The places of the tracks of the evidence."""
        return minimise_places(self.evidence, self.place[self.evidence.which])

    def take_places(self) -> Places:
        """Return the places, hundreds of MiB for thousands of tags, which are then computed again where needed."""
        places = self.places
        del vars(self)["places"]
        return places

    @property
    def tags(self) -> list[TagKey]:
        """Tag of each of the S tracks."""
        return [self.graph.segments[c].tags[t] for c, t in zip(self.tracks.segment, self.tracks.tag, strict=True)]

    @property
    def picture(self) -> IntArray:
        """Pose index (M,) of the picture of each observation; -1 for an imported one, which has no picture."""
        from_pictures = [not len(segment.run.positions.tag) for segment in self.graph.segments]
        of_observation = np.repeat(from_pictures, [len(segment.observations) for segment in self.graph.segments])
        return np.where(of_observation, self.graph.problem.observations.pose, -1)


def with_outliers_apart(maps: Sequence[LocalMap], merged: Merge) -> list[LocalMap]:
    """Return the maps with a tag split into instances wherever accepted alignments place it differently."""
    names: dict[int, dict[TagKey, TagKey]] = {}
    n_places: Counter[TagKey] = Counter()
    alignments = ((pair.a, pair.b, pair.alignment) for pair in merged.pairs if pair.alignment is not None)
    accepted = [(a, b, each) for a, b, each in alignments if each.is_accepted]
    joined: dict[TagKey, list[tuple[int, int]]] = {tag: [] for _, _, each in accepted for tag in each.outliers}
    for a, b, each in accepted:
        for tag in each.inliers:
            if tag in joined:
                joined[tag].append((a, b))
    for tag in sorted(joined):
        group = {m: m for m, each in enumerate(maps) if tag in each.graph.tags}
        for a, b in joined[tag]:
            one, other = group[a], group[b]
            group = {m: one if g == other else g for m, g in group.items()}
        if len(places := dict.fromkeys(group.values())) > 1:
            first = n_places[tag.whole]
            letter = {g: letters(first + i) for i, g in enumerate(places)}
            n_places[tag.whole] += len(places)
            for m, g in group.items():
                names.setdefault(m, {})[tag] = tag._replace(instance=letter[g])
    return [rename_tags(each, names.get(m, {})) for m, each in enumerate(maps)]


def split_together(
    graph: Graph, solution: Solution, maps: Sequence[LocalMap], workers: Workers | None = None
) -> OutlierSearch | None:
    """Split and join the tags of a component until nothing changes.

    Measured starts and distances are given wide sigmas meanwhile, so that they only determine what tags do not: a wrong
    tape measurement must not mark a tag as an outlier.

    Args:
        graph: graph of the component.
        solution: solution of the graph.
        maps: maps of the graph's segments.
        workers: a cluster that may solve a fleet in parts; None: this process.

    Returns:
        The search at its last solution. None if the noise was fitted and most tags seem to have several places: then
        something else violates the model.
    """
    if len(graph.problem.measured):
        loose = replace(graph, problem=replace(graph.problem, measured=_loosen_priors(graph.problem.measured)))
        searched = _split(loose, solve_with_workers(loose.problem, solution.state, workers=workers), maps, workers)
        if searched is None:
            return None
        problem = replace(searched.graph.problem, measured=_priors_of_first_instances(graph, searched.graph))
        solution = solve_with_workers(problem, searched.solution.state, workers=workers)
        return replace(searched, graph=replace(searched.graph, problem=problem), solution=solution)
    return _split(graph, solution, maps, workers)


def _split(graph: Graph, solution: Solution, maps: Sequence[LocalMap], workers: Workers | None) -> OutlierSearch | None:
    scales = noise_scales([each.goodness for each in maps])
    searched = evidence_at(graph, solution, scales)
    noise_is_fitted = any(each.is_noisy for each in maps)
    cost_tolerance = max(each.cost_tolerance for each in maps)
    for _ in range(MOST_SEARCHES):
        best = best_places(searched, FALSE_ALARM, noise_is_fitted=noise_is_fitted)
        if best is None:
            return None
        if instances(searched.tracks, best) == searched.tags:
            break
        again, start = _with_places(searched, best)
        del searched  # its evidence takes hundreds of MiB
        searched = evidence_at(again, _solve(again, start, cost_tolerance, workers), scales)
    if noise_is_fitted:
        joined_place = _join_near_places(searched)
        if not is_same_partition(joined_place, searched.place):
            again, start = _with_places(searched, joined_place)
            del searched
            searched = evidence_at(again, _solve(again, start, cost_tolerance, workers), scales)
    return searched


def _join_near_places(searched: OutlierSearch) -> IntArray:
    """Return labels (S,) with one place for an id whose places are near each other but never in one picture.

    Each of these places has more than a few tracks. Where noise was fitted, errors of the drives explain the distance.
    """
    found = searched.place.copy()
    for case in cases(searched.tracks, searched.evidence, searched.places):
        is_near = is_within_sight(case, searched.tracks, searched.evidence, searched.places, searched.picture)
        if is_near and not minority(case, SHARE_ASTRAY_WITHIN_SIGHT * case.n_tracks):
            labels = [each.label for each in case.places]
            which = searched.evidence.which[np.isin(searched.places.place, labels)]
            found[which] = found[which[0]]
    return found


def cut_tracks(graph: Graph, at: LinearisedObservations) -> Tracks:
    """Return the tracks of a graph; a track also ends where its tag moves in sight."""
    whole = tracks_of(graph.segments)
    cut = find_contradictions(at, whole)
    return few_of_each_tag(graph, tracks_of(graph.segments, cut) if cut.any() else whole)


def evidence_at(graph: Graph, solution: Solution, scales: FloatArray) -> OutlierSearch:
    """Return the tracks at a solution, their evidence, and the places that they have in the graph."""
    at = linearise_observations(graph, solution.state, scales)
    tracks = cut_tracks(graph, at)
    place = split_places(graph.segments, tracks)
    return OutlierSearch(graph, solution, tracks, place, marginalise(at, tracks))


def best_places(searched: OutlierSearch, false_alarm: float, *, noise_is_fitted: bool = False) -> IntArray | None:
    """Return the labels (S,) of places that the evidence supports.

    None if the noise was fitted to the same tracks and most ids seem to have several places: then something else
    violates the model.
    """
    which = searched.evidence.which
    found = searched.place.copy()
    if len(which):
        freedom = freedom_of_places(searched.places) if noise_is_fitted else np.inf
        least_gain = excess(searched.places) * cost_bound(searched.tracks, searched.evidence, false_alarm, freedom)
        most_ids = max(int((np.bincount(searched.tracks.id) > 1).sum()), FEW_AGAIN) // 2
        label = search(
            searched.evidence,
            searched.tracks,
            searched.take_places(),
            least_gain,
            most_ids if noise_is_fitted else None,
        )
        if label is None:
            return None
        found[which] = searched.place.max() + 1 + label
    return found


def is_same_partition(place: IntArray, other: IntArray) -> bool:
    """Return whether two labellings (S,) group the tracks alike."""
    n_pairs = len(np.unique(np.column_stack([place, other]), axis=0))
    return n_pairs == len(np.unique(place)) == len(np.unique(other))


def _with_places(searched: OutlierSearch, place: IntArray) -> tuple[Graph, State]:
    """Return the graph of the same segments with these places (S,), and a start at the present poses."""
    graph, state = searched.graph, searched.solution.state
    again = build_graph(with_instances(graph.segments, searched.tracks, instances(searched.tracks, place)))
    again = replace(again, problem=replace(again.problem, measured=_priors_of_first_instances(graph, again)))
    start = again.start(state.poses, _unchanged_places(graph, again, state.tags), graph.calibration_of(state))
    return again, start


def _solve(graph: Graph, start: State, cost_tolerance: float, workers: Workers | None) -> Solution:
    """Solve a graph that is kept but not solved again."""
    release_memory()  # to the system, of a fleet a GiB of the search before
    solution = solve_with_workers(graph.problem, start, cost_tolerance, workers=workers)
    graph.problem.without_arrowhead()
    release_memory()
    return solution


def _loosen_priors(measured: Priors) -> Priors:
    """Return the priors with sigmas so wide that they contradict nothing."""
    starts, distances = measured.starts, measured.distances
    return Priors(
        replace(starts, whitening=starts.whitening / _LOOSER),
        replace(distances, sigma_m=distances.sigma_m * _LOOSER),
    )


def _priors_of_first_instances(before: Graph, after: Graph) -> Priors:
    """Return the priors of a graph, with each tag replaced by its first instance in another graph."""
    first = {tag.whole: i for i, tag in reversed(list(enumerate(after.tags)))}
    return to_other_tags(before.problem.measured, np.array([first[tag.whole] for tag in before.tags], dtype=np.int64))


def _unchanged_places(before: Graph, after: Graph, tags_m: FloatArray) -> dict[TagKey, FloatArray]:
    """Return the positions of tags whose number of observations is unchanged."""
    n_before = dict(zip(before.tags, before.n_observations().tolist(), strict=True))
    n_after = dict(zip(after.tags, after.n_observations().tolist(), strict=True))
    places = dict(zip(before.tags, tags_m, strict=True))
    return {tag: places[tag] for tag, n in n_after.items() if n_before.get(tag) == n}


def rename_tags(local_map: LocalMap, names: dict[TagKey, TagKey]) -> LocalMap:
    """Return the same map with some of its tags renamed."""
    if not names:
        return local_map
    segment = local_map.segment
    renamed = replace(segment, tags=tuple(names.get(tag, tag) for tag in segment.tags))
    graph = replace(
        local_map.graph, segments=(renamed,), tags=tuple(names.get(tag, tag) for tag in local_map.graph.tags)
    )
    return replace(local_map, segment=renamed, graph=graph)
