"""The tags that do not belong, each with its kind and its evidence in words and numbers."""

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
    """All suspects of a component, in order of their ids."""
    return _Report(searched).suspects()


class _Report:
    def __init__(self, searched: OutlierSearch) -> None:
        self._searched = searched
        self._names = [segment.name for segment in searched.graph.segments]
        self._cases = cases(searched.tracks, searched.evidence, searched.places)
        self._views: Views = views_of(searched.graph, searched.solution.state, searched.tracks)
        self._chances: FloatArray = chances(searched.tracks, searched.place, self._views)

    def suspects(self) -> list[OutlierTag]:
        """Each case once; then ids that nothing supports."""
        found: dict[int, OutlierTag] = {}
        for i, j in swapped_pairs(self._cases, self._searched.evidence, self._searched.places):
            found[i], found[j] = self._swap(i, j), self._swap(j, i)
        wrong = wrong_runs(self._cases, self._searched.tracks)
        for i, case in enumerate(self._cases):
            if i not in found and (stand := self._false_detection_place(case)) is not None:
                found[i] = self._false_detection(case, stand)
        for run, which in wrong.items():
            left = [i for i in which if i not in found]
            for i in left:
                found[i] = self._inconsistent(self._cases[i], run, len(which))
        for i, case in enumerate(self._cases):
            if i not in found:
                found[i] = self._displacement(case)
        return sorted([*found.values(), *self._unsupported_tags()], key=lambda each: (each.family, each.tag_id))

    def _displacement(self, case: SeveralPlaces) -> OutlierTag:
        kind = case.kind()
        apart_m, sigmas = self._shift(case)
        if kind == MOVED:
            elsewhere = [c for c in case.seen if c not in case.stands[0].segments]
            words = f"by {_metres(apart_m)} ({sigmas:.0f} sigma) between runs: {self._where(case)}"
            return self._outlier(case, kind, elsewhere, words)
        if kind == MOVING:
            during = [c for c, way in case.seen.items() if len(way) > 1]
            words = (
                f"by {_metres(apart_m)} ({sigmas:.0f} sigma) during {self._list_segments(during)}: {self._where(case)}"
            )
            return self._outlier(case, kind, during, words)
        words = f"two tags with one id, {_metres(apart_m)} ({sigmas:.0f} sigma) apart: {self._where(case)}"
        return self._outlier(case, kind, list(case.seen), words)

    def _swap(self, i: int, j: int) -> OutlierTag:
        case, other = self._cases[i], self._cases[j]
        apart_m, sigmas = self._shift(case)
        first = {c for c, way in case.seen.items() if way == (0,)}
        words = (
            f"with tag {other.tag.tag_id}: each hangs where the other was, {_metres(apart_m)} ({sigmas:.0f} sigma) "
            f"away: {self._where(case)}"
        )
        return self._outlier(case, SWAPPED, [c for c in case.seen if c not in first], words, other.tag.tag_id)

    def _inconsistent(self, case: SeveralPlaces, run: int, n_wrong: int) -> OutlierTag:
        apart_m, sigmas = self._shift(case)
        words = (
            f"{self._names[run]} has this tag and {n_wrong - 1} more, most of those it shares, elsewhere than all "
            f"others have them, this one by {_metres(apart_m)} ({sigmas:.0f} sigma): {self._where(case)}"
        )
        return self._outlier(case, INCONSISTENT, [run], words)

    def _false_detection_place(self, case: SeveralPlaces) -> int | None:
        """A place that only false detections speak for."""
        searched = self._searched
        for k, stand in enumerate(case.stands):
            if stand.n_tracks > 1 or stand.n_observations > MOST_OBSERVATIONS:
                continue
            rest = sum(each.n_observations for each in case.stands) - stand.n_observations
            of_evidence = searched.evidence.which[searched.places.place == stand.label]
            came_back = any(way.count(k) and way[0] != k and way[-1] != k for way in case.seen.values())
            # The place is wrong for sure; what is asked is only why.
            if rest > MOST_OBSERVATIONS and (self._chances[of_evidence[0]] < FALSE_ALARM or came_back):
                return k
        return None

    def _false_detection(self, case: SeveralPlaces, k: int) -> OutlierTag:
        stand = case.stands[k]
        nearest = min(self._shift(case, other, k) for other in range(len(case.stands)) if other != k)
        rest = sum(each.n_observations for each in case.stands) - stand.n_observations
        words = (
            f"{plural(stand.n_observations, 'observation')} in {self._list_segments(stand.segments)} "
            f"{_metres(nearest[0])} "
            f"({nearest[1]:.0f} sigma) from where {plural(rest, 'other')} have it: a false detection"
        )
        return self._outlier(case, PHANTOM, list(stand.segments), words)

    def _unsupported_tags(self) -> list[OutlierTag]:
        """Ids read once or a few times from where they should have been read more often."""
        searched = self._searched
        tracks = searched.tracks
        alone = np.bincount(tracks.id, minlength=len(tracks.ids))[tracks.id] == 1
        asked = alone & (self._chances < 1.0)
        found = []
        for s in np.flatnonzero(asked & (self._chances < FALSE_ALARM / max(int(asked.sum()), 1))):
            tag, run = tracks.ids[tracks.id[s]], self._names[tracks.segment[s]]
            n = int(tracks.n_observations[s])
            words = (
                f"{plural(n, 'observation')} in {run} and none elsewhere, though it was in view as much the same in "
                f"{int(self._views.near[s])} keyframes (by chance once in {1.0 / max(self._chances[s], 1e-9):.0f} "
                "times): a false detection"
            )
            found.append(OutlierTag(tag.family, tag.tag_id, PHANTOM, (run,), words))
        return found

    def _outlier(
        self, case: SeveralPlaces, kind: str, runs: Sequence[int], words: str, swapped_with: int | None = None
    ) -> OutlierTag:
        names = tuple(self._names[c] for c in sorted(runs))
        return OutlierTag(case.tag.family, case.tag.tag_id, kind, names, words, swapped_with)

    def _shift(self, case: SeveralPlaces, first: int = 0, second: int = 1) -> tuple[float, float]:
        return shift(case, self._searched.evidence, self._searched.places, first, second)

    def _where(self, case: SeveralPlaces) -> str:
        """Who saw it at which instance."""
        told = [
            f"in {self._list_segments(stand.segments)} ({plural(stand.n_observations, 'observation')})"
            for stand in case.stands[:_MOST_NAMED]
        ]
        more = len(case.stands) - _MOST_NAMED
        return ", then ".join([*told, f"in {more} more places"] if more > 0 else told)

    def _list_segments(self, segments: Sequence[int]) -> str:
        names = [self._names[c] for c in sorted(segments)]
        return " and ".join(names[-2:]) if len(names) < 3 else f"{', '.join(names[:-1])} and {names[-1]}"


def _metres(distance_m: float) -> str:
    return f"{distance_m:.2f} m"
