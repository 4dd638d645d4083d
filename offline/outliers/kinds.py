"""Classification of tags with several places, by which runs observed which place, and in which order."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Final

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.outliers.evidence import Evidence
from groundsbot.offline.outliers.places import Places
from groundsbot.offline.outliers.tracks import Tracks, without_repeats

MOVED: Final = "moved"
MOVING: Final = "moving"
SWAPPED: Final = "swapped"
DUPLICATED: Final = "duplicated"
PHANTOM: Final = "phantom"
INCONSISTENT: Final = "inconsistent"

# Sigma of each coordinate with which a tag is mounted at the former position of another one.
_MOUNTING_SIGMA_M: Final = 0.05
# False alarm rate of the test that two places are the same.
_DIFFERENT_PLACE: Final = 1e-3
# Two tags with one id that are nearer to each other than this appear in one picture.
_WITHIN_SIGHT_M: Final = 2.0
# Largest share of an id's tracks that may be wrong: in general, and at places within sight of each other that cannot be
# two tags.
SHARE_ASTRAY: Final = 0.02
SHARE_ASTRAY_WITHIN_SIGHT: Final = 0.25
_MANY: Final = 3
# A run is wrong itself if it has at least this many of its shared tags, and more than this share of them, at other
# places than all other runs.
_LEAST_WRONG: Final = 3
_SHARE_WRONG: Final = 0.5


@dataclass(frozen=True)
class IdPlace:
    """One of the places of an id.

    Attributes:
        label: label of the place among those of the evidence.
        segments: indices of those that observed the id there.
        n_observations: number of observations there.
        n_tracks: number of tracks there.
    """

    label: int
    segments: tuple[int, ...]
    n_observations: int
    n_tracks: int


@dataclass(frozen=True)
class SeveralPlaces:
    """An id with several places.

    Attributes:
        places: places in order of time, or of the first stamps of the runs where these overlap.
        sequences: for each segment that observed the id, its places in order of time, as indices of `places`, without
            repetitions in a row.
        has_ordered_segments: whether no two of these segments overlap in time.
        has_ordered_places: whether each place was observed for the last time before the next one was for the first, by
            the logs' clocks.
        at_once: whether one of the segments observed the id at two places at the same time.
    """

    tag: TagKey
    places: tuple[IdPlace, ...]
    sequences: dict[int, tuple[int, ...]]
    has_ordered_segments: bool
    has_ordered_places: bool
    at_once: bool

    @property
    def main(self) -> IdPlace:
        """Place with the most tracks."""
        return max(self.places, key=lambda each: (each.n_tracks, each.n_observations))

    @property
    def n_tracks(self) -> int:
        """Number of tracks of the id."""
        return sum(each.n_tracks for each in self.places)

    @property
    def others(self) -> tuple[IdPlace, ...]:
        """All places but the main one."""
        main = self.main
        return tuple(each for each in self.places if each is not main)

    def kind(self) -> str:
        """Return moved, moving or duplicated, by the order in which segments observed the places."""
        sequences = list(self.sequences.values())
        if self.at_once or any(len(set(each)) < len(each) for each in sequences):
            return DUPLICATED
        mixed = [each for each in sequences if len(each) > 1]
        if self.has_ordered_segments:
            whole = without_repeats([place for each in sequences for place in each])
            if len(set(whole)) < len(whole):
                return DUPLICATED
        elif any(len(set(one) & set(other)) > 1 for one, other in combinations(mixed, 2)):
            return DUPLICATED
        return MOVING if mixed else MOVED


def cases(tracks: Tracks, evidence: Evidence, places: Places) -> list[SeveralPlaces]:
    """Return all ids with several places."""
    label = np.full(len(tracks), -1, dtype=np.int64)
    label[evidence.which] = places.place
    found = []
    for tag, own in zip(tracks.ids, tracks.of_ids(), strict=True):
        labels = list(dict.fromkeys(label[own].tolist()))
        if len(labels) < 2:
            continue
        places_of_id = tuple(_id_place(tracks, each, own[label[own] == each]) for each in labels)
        sequences = {
            c: without_repeats([labels.index(int(label[s])) for s in own if tracks.segment[s] == c])
            for c in dict.fromkeys(tracks.segment[own].tolist())
        }
        found.append(
            SeveralPlaces(
                tag,
                places_of_id,
                sequences,
                has_ordered_segments=tracks.one_after_the_other(own),
                has_ordered_places=all(
                    tracks.last_ns[own[label[own] == one]].max() < tracks.first_ns[own[label[own] == following]].min()
                    for one, following in pairwise(labels)
                ),
                at_once=_in_two_places_at_once(tracks, own, label[own]),
            )
        )
    return found


def is_within_sight(case: SeveralPlaces, tracks: Tracks, evidence: Evidence, places: Places, picture: IntArray) -> bool:
    """Return whether an id seems duplicated, at places near enough for one picture, and no picture shows both.

    Args:
        case: the id.
        tracks: tracks of all M observations.
        evidence: evidence of the tracks.
        places: places of the evidence.
        picture: (M,) picture of each observation; -1: none.
    """
    pairs = list(combinations(range(len(case.places)), 2))
    if case.kind() != DUPLICATED or any(shift(case, evidence, places, *pair)[0] >= _WITHIN_SIGHT_M for pair in pairs):
        return False
    pictures_of = [
        picture[np.isin(tracks.of_observation, evidence.which[places.place == each.label]) & (picture >= 0)]
        for each in case.places
    ]
    return not any(len(np.intersect1d(pictures_of[i], pictures_of[j])) for i, j in pairs)


def minority(case: SeveralPlaces, n_astray: float) -> list[IdPlace]:
    """Return all places but the main one; none if that has few tracks, or if another one has more than `n_astray`."""
    n_astray = max(1.0, n_astray)
    is_minority = case.main.n_tracks >= _MANY and all(each.n_tracks <= n_astray for each in case.others)
    return list(case.others) if is_minority else []


def swapped_pairs(found: Sequence[SeveralPlaces], evidence: Evidence, places: Places) -> list[tuple[int, int]]:
    """Return pairs of cases (indices) that exchanged their places; each case is in one pair at most."""
    pairs: list[tuple[int, int]] = []
    for i, j in combinations(range(len(found)), 2):
        one, other = found[i], found[j]
        taken = {k for pair in pairs for k in pair}
        if {i, j} & taken or len(one.places) != 2 or len(other.places) != 2:
            continue
        for is_reversed in (False, True):  # the order of the other's places may depend on the runs that observed it
            of_other = other.places[::-1] if is_reversed else other.places
            is_exchanged = all(
                _is_same_place(evidence, places, one.places[a].label, of_other[1 - a].label) for a in (0, 1)
            )
            # A run that observed one tag before the exchange did not observe the other after it.
            is_simultaneous = all(
                one.sequences[c] == tuple(1 - at if is_reversed else at for at in other.sequences[c])
                for c in one.sequences.keys() & other.sequences.keys()
            )
            if is_exchanged and is_simultaneous:
                pairs.append((i, j))
                break
    return pairs


def wrong_runs(found: Sequence[SeveralPlaces], tracks: Tracks) -> dict[int, list[int]]:
    """Return the segments that have most of their shared tags elsewhere than all others, and the indices of the cases.

    Args:
        found: all ids with several places.
        tracks: all tracks.
    """
    n_shared: dict[int, int] = {}
    for own in tracks.of_ids():
        observers = np.unique(tracks.segment[own]).tolist()
        for c in observers if len(observers) > 1 else []:
            n_shared[c] = n_shared.get(c, 0) + 1
    alone: dict[int, list[int]] = {}
    for i, case in enumerate(found):
        # Two other segments must agree, since of two segments either may be wrong.
        for place in case.places:
            others = {c for each in case.places if each is not place for c in each.segments}
            if len(place.segments) == 1 and len(case.places) == 2 and len(others - set(place.segments)) > 1:
                alone.setdefault(place.segments[0], []).append(i)
    return {
        c: which
        for c, which in alone.items()
        if len(which) >= _LEAST_WRONG and len(which) > _SHARE_WRONG * n_shared.get(c, 0)
    }


def shift(
    case: SeveralPlaces, evidence: Evidence, places: Places, first: int = 0, second: int = 1
) -> tuple[float, float]:
    """Return the distance between two places of a case, in metres and in sigmas."""
    offset_m, covariance = places.apart(evidence, case.places[first].label, case.places[second].label)
    return float(np.hypot(*offset_m)), float(np.sqrt(offset_m @ np.linalg.solve(covariance, offset_m)))


def _in_two_places_at_once(tracks: Tracks, own: IntArray, label: IntArray) -> bool:
    """Return whether tracks `own` (m,) with different places (labels, m) overlap in time in one segment."""
    return any(
        p != q
        and tracks.segment[s] == tracks.segment[t]
        and max(tracks.first_ns[s], tracks.first_ns[t]) <= min(tracks.last_ns[s], tracks.last_ns[t])
        for (s, p), (t, q) in combinations(zip(own.tolist(), label.tolist(), strict=True), 2)
    )


def _is_same_place(evidence: Evidence, places: Places, p: int, q: int) -> bool:
    offset_m, covariance = places.apart(evidence, p, q)
    covariance = covariance + 2.0 * _MOUNTING_SIGMA_M**2 * np.eye(2)
    return float(offset_m @ np.linalg.solve(covariance, offset_m)) < float(chdtri(2, _DIFFERENT_PLACE))


def _id_place(tracks: Tracks, label: int, own: IntArray) -> IdPlace:
    segments = tuple(dict.fromkeys(tracks.segment[own].tolist()))
    return IdPlace(label, segments, int(tracks.n_observations[own].sum()), len(own))
