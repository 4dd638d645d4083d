"""Report of outlier tags, each with its kind and its evidence in words and numbers."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, plural
from groundsbot.offline.maps import OutlierTag
from groundsbot.offline.outliers.false_detections import MOST_OBSERVATIONS, Views, chances, views_of
from groundsbot.offline.outliers.kinds import (
    INCONSISTENT,
    MOVED,
    MOVING,
    PHANTOM,
    SWAPPED,
    SeveralPlaces,
    cases,
    shift,
    swapped_pairs,
    wrong_runs,
)
from groundsbot.offline.outliers.outliers import OutlierSearch
from groundsbot.offline.outliers.search import FALSE_ALARM

_MOST_NAMED: Final = 4


def outlier_report(searched: OutlierSearch) -> list[OutlierTag]:
    """Return all outlier tags of a component, in order of their ids."""
    return _Report(searched).outliers()


class _Report:
    """Kinds and evidence of the outliers of one search."""

    def __init__(self, searched: OutlierSearch) -> None:
        self._searched = searched
        self._names = [segment.name for segment in searched.graph.segments]
        self._cases = cases(searched.tracks, searched.evidence, searched.places)
        self._views: Views = views_of(searched.graph, searched.solution.state, searched.tracks)
        self._chances: FloatArray = chances(searched.tracks, searched.place, self._views)

    def outliers(self) -> list[OutlierTag]:
        """Return each case once, and the unsupported ids."""
        found: dict[int, OutlierTag] = {}
        for i, j in swapped_pairs(self._cases, self._searched.evidence, self._searched.places):
            found[i], found[j] = self._swap(i, j), self._swap(j, i)
        wrong = wrong_runs(self._cases, self._searched.tracks)
        for i, case in enumerate(self._cases):
            if i not in found and (k := self._false_detection_place(case)) is not None:
                found[i] = self._false_detection(case, k)
        for run, which in wrong.items():
            for i in which:
                if i not in found:
                    found[i] = self._inconsistent(self._cases[i], run, len(which))
        for i, case in enumerate(self._cases):
            if i not in found:
                found[i] = self._displacement(case)
        return sorted([*found.values(), *self._unsupported_tags()], key=lambda each: (each.family, each.tag_id))

    def _displacement(self, case: SeveralPlaces) -> OutlierTag:
        kind = case.kind()
        shift = self._shift(case)
        if kind == MOVED:
            elsewhere = [c for c in case.sequences if c not in case.places[0].segments]
            return self._outlier(case, kind, elsewhere, f"by {shift} between runs: {self._where(case)}")
        if kind == MOVING:
            during = [c for c, sequence in case.sequences.items() if len(sequence) > 1]
            words = f"by {shift} during {self._list_segments(during)}: {self._where(case)}"
            return self._outlier(case, kind, during, words)
        return self._outlier(
            case, kind, list(case.sequences), f"two tags with one id, {shift} apart: {self._where(case)}"
        )

    def _swap(self, i: int, j: int) -> OutlierTag:
        case, other = self._cases[i], self._cases[j]
        moved = [c for c, sequence in case.sequences.items() if sequence != (0,)]
        words = (
            f"with tag {other.tag.tag_id}: each is where the other was, {self._shift(case)} away: {self._where(case)}"
        )
        return self._outlier(case, SWAPPED, moved, words, other.tag.tag_id)

    def _inconsistent(self, case: SeveralPlaces, run: int, n_wrong: int) -> OutlierTag:
        words = (
            f"{self._names[run]} has this tag and {n_wrong - 1} more, most of those it shares, elsewhere than all "
            f"others have them, this one by {self._shift(case)}: {self._where(case)}"
        )
        return self._outlier(case, INCONSISTENT, [run], words)

    def _false_detection_place(self, case: SeveralPlaces) -> int | None:
        """Return the index of a place that only false detections support; None without one."""
        searched = self._searched
        for k, place in enumerate(case.places):
            if place.n_tracks > 1 or place.n_observations > MOST_OBSERVATIONS:
                continue
            n_others = sum(each.n_observations for each in case.places) - place.n_observations
            of_evidence = searched.evidence.which[searched.places.place == place.label]
            came_back = any(each.count(k) and each[0] != k and each[-1] != k for each in case.sequences.values())
            # The search has already found the place to be wrong, so this test only decides on the cause.
            if n_others > MOST_OBSERVATIONS and (self._chances[of_evidence[0]] < FALSE_ALARM or came_back):
                return k
        return None

    def _false_detection(self, case: SeveralPlaces, k: int) -> OutlierTag:
        place = case.places[k]
        searched = self._searched
        nearest = min(
            shift(case, searched.evidence, searched.places, other, k) for other in range(len(case.places)) if other != k
        )
        n_others = sum(each.n_observations for each in case.places) - place.n_observations
        words = (
            f"{plural(place.n_observations, 'observation')} in {self._list_segments(place.segments)} "
            f"{_shift_text(*nearest)} from where {plural(n_others, 'other')} place it: a false detection"
        )
        return self._outlier(case, PHANTOM, list(place.segments), words)

    def _unsupported_tags(self) -> list[OutlierTag]:
        """Return ids with one track of few observations, which near views should have shown more often."""
        searched = self._searched
        tracks = searched.tracks
        alone = np.bincount(tracks.id, minlength=len(tracks.ids))[tracks.id] == 1
        tested = alone & (self._chances < 1.0)
        found = []
        for s in np.flatnonzero(tested & (self._chances < FALSE_ALARM / max(int(tested.sum()), 1))):
            tag, run = tracks.ids[tracks.id[s]], self._names[tracks.segment[s]]
            n = int(tracks.n_observations[s])
            words = (
                f"{plural(n, 'observation')} in {run} and none elsewhere, though {int(self._views.near[s])} keyframes "
                f"had about the same view of it (by chance once in {1.0 / max(self._chances[s], 1e-9):.0f} times): "
                "a false detection"
            )
            found.append(OutlierTag(tag.family, tag.tag_id, PHANTOM, (run,), words))
        return found

    def _outlier(
        self, case: SeveralPlaces, kind: str, runs: Sequence[int], words: str, swapped_with: int | None = None
    ) -> OutlierTag:
        names = tuple(self._names[c] for c in sorted(runs))
        return OutlierTag(case.tag.family, case.tag.tag_id, kind, names, words, swapped_with, case.has_ordered_places)

    def _shift(self, case: SeveralPlaces) -> str:
        """Return the distance between the first two places of a case."""
        return _shift_text(*shift(case, self._searched.evidence, self._searched.places))

    def _where(self, case: SeveralPlaces) -> str:
        """Return the segments and numbers of observations of each place, in order of time where that is known."""
        named = [
            f"in {self._list_segments(place.segments)} ({plural(place.n_observations, 'observation')})"
            for place in case.places[:_MOST_NAMED]
        ]
        n_more = len(case.places) - _MOST_NAMED
        between = ", then " if case.has_ordered_places else ", elsewhere "
        return between.join([*named, f"in {n_more} more places"] if n_more > 0 else named)

    def _list_segments(self, segments: Sequence[int]) -> str:
        names = [self._names[c] for c in sorted(segments)]
        return " and ".join(names[-2:]) if len(names) < 3 else f"{', '.join(names[:-1])} and {names[-1]}"


def _shift_text(distance_m: float, sigmas: float) -> str:
    return f"{distance_m:.2f} m ({sigmas:.0f} sigma)"
