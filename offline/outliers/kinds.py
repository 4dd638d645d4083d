"""What happened to a tag that has several places: who saw it where, and in which order."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.outliers.evidence import Evidence
from groundsbot.offline.outliers.places import Places
from groundsbot.offline.outliers.tracks import Tracks

MOVED: Final = "moved"
MOVING: Final = "moving"
SWAPPED: Final = "swapped"
DUPLICATED: Final = "duplicated"
PHANTOM: Final = "phantom"
INCONSISTENT: Final = "inconsistent"

# Somebody who hangs one tag where another one was does it this well.
_REHUNG_SIGMA_M: Final = 0.05
_NOT_THERE: Final = 1e-3
# Two tags with one id that are nearer to each other than this are seen together.
_WITHIN_SIGHT_M: Final = 2.0
# Passes that go astray: of hundreds a few; of a place within sight of the tag's own, which is no other tag's, more.
SHARE_ASTRAY: Final = 0.02
SHARE_ASTRAY_WITHIN_SIGHT: Final = 0.25
_MANY: Final = 3
# A run of whose shared tags so many lie elsewhere than others have them is wrong itself.
_LEAST_WRONG: Final = 3
_SHARE_WRONG: Final = 0.5


@dataclass(frozen=True)
class TagStand:
    """One of the places of an id.

    Attributes:
        label: of the place among those of the evidence.
        segments: indices of those that saw it there.
        n_observations: there; n_tracks: there.
    """

    label: int
    segments: tuple[int, ...]
    n_observations: int
    n_tracks: int


@dataclass(frozen=True)
class SeveralPlaces:
    """An id with several places.

    Attributes:
        stands: in order of time; where the order of runs is unknown, in that of their first stamps.
        seen: for each segment that saw it, in that order, the places in order of time, as indices of stands, none twice
            in a row.
        is_ordered: whether no two of these segments were driven at the same time.
        at_once: whether one of them saw it in two places at the same time.
    """

    tag: TagKey
    stands: tuple[TagStand, ...]
    seen: dict[int, tuple[int, ...]]
    is_ordered: bool
    at_once: bool

    @property
    def most(self) -> TagStand:
        """The place with most tracks."""
        return max(self.stands, key=lambda each: (each.n_tracks, each.n_observations))

    @property
    def others(self) -> tuple[TagStand, ...]:
        """All places but that one."""
        most = self.most
        return tuple(each for each in self.stands if each is not most)

    def kind(self) -> str:
        """Moved, moving or duplicated, by who saw it where."""
        ways = list(self.seen.values())
        if self.at_once or any(len(set(way)) < len(way) for way in ways):
            return DUPLICATED
        mixed = [way for way in ways if len(way) > 1]
        if self.is_ordered:
            whole_way = _without_repeats([at for way in ways for at in way])
            if len(set(whole_way)) < len(whole_way):
                return DUPLICATED
        elif any(len(set(one) & set(other)) > 1 for one, other in combinations(mixed, 2)):
            return DUPLICATED
        return MOVING if mixed else MOVED


def cases(tracks: Tracks, evidence: Evidence, places: Places) -> list[SeveralPlaces]:
    """All ids with several places."""
    label = np.full(len(tracks), -1, dtype=np.int64)
    label[evidence.which] = places.place
    found = []
    for tag, own in zip(tracks.ids, tracks.of_ids(), strict=True):
        labels = list(dict.fromkeys(label[own].tolist()))
        if len(labels) < 2:
            continue
        stands = tuple(_stand(tracks, each, own[label[own] == each]) for each in labels)
        seen = {
            c: _without_repeats([labels.index(int(label[s])) for s in own if tracks.segment[s] == c])
            for c in dict.fromkeys(tracks.segment[own].tolist())
        }
        at_once = _in_two_places_at_once(tracks, own, label[own])
        found.append(SeveralPlaces(tag, stands, seen, tracks.one_after_the_other(own), at_once))
    return found


def is_within_sight(case: SeveralPlaces, tracks: Tracks, evidence: Evidence, places: Places, picture: IntArray) -> bool:
    """Whether these seem two tags with one id, so near that pictures would show both, and none does.

    Args:
        case: of the tracks.
        tracks: of all M observations.
        evidence: of the tracks.
        places: of the evidence.
        picture: (M,) the picture of each observation, -1 where it is of none.
    """
    pairs = list(combinations(range(len(case.stands)), 2))
    if case.kind() != DUPLICATED or any(shift(case, evidence, places, *pair)[0] >= _WITHIN_SIGHT_M for pair in pairs):
        return False
    seen_in = [
        picture[np.isin(tracks.of_observation, evidence.which[places.place == stand.label]) & (picture >= 0)]
        for stand in case.stands
    ]
    return not any(len(np.intersect1d(seen_in[i], seen_in[j])) for i, j in pairs)


def minority(case: SeveralPlaces, share: float) -> list[TagStand]:
    """All places but the one sighted most; none where that has few tracks, or another one more than its share."""
    n_astray = max(1.0, share * sum(each.n_tracks for each in case.stands))
    is_minority = case.most.n_tracks >= _MANY and all(each.n_tracks <= n_astray for each in case.others)
    return list(case.others) if is_minority else []


def swapped_pairs(found: Sequence[SeveralPlaces], evidence: Evidence, places: Places) -> list[tuple[int, int]]:
    """Indices of cases of which each hangs where the other one was; each in one pair at most."""
    pairs: list[tuple[int, int]] = []
    for i, j in combinations(range(len(found)), 2):
        one, other = found[i], found[j]
        taken = {k for pair in pairs for k in pair}
        if {i, j} & taken or len(one.stands) != 2 or len(other.stands) != 2:
            continue
        for turned in (False, True):  # which of the other's two stands comes first may depend on who saw them
            stands = other.stands[::-1] if turned else other.stands
            crosswise = all(_is_same_place(evidence, places, one.stands[a].label, stands[1 - a].label) for a in (0, 1))
            # Who saw the one before the change did not see the other after it.
            together = all(
                one.seen[c] == tuple(1 - at if turned else at for at in other.seen[c])
                for c in one.seen.keys() & other.seen.keys()
            )
            if crosswise and together:
                pairs.append((i, j))
                break
    return pairs


def wrong_runs(found: Sequence[SeveralPlaces], tracks: Tracks) -> dict[int, list[int]]:
    """Segments that have most of their shared tags elsewhere than all others have them, and the cases of these."""
    shared: dict[int, int] = {}
    for own in tracks.of_ids():
        seen_by = np.unique(tracks.segment[own]).tolist()
        for c in seen_by if len(seen_by) > 1 else []:
            shared[c] = shared.get(c, 0) + 1
    alone: dict[int, list[int]] = {}
    for i, case in enumerate(found):
        # Two others who agree: of two runs nobody knows which is wrong.
        for stand in case.stands:
            others = {c for each in case.stands if each is not stand for c in each.segments}
            if len(stand.segments) == 1 and len(case.stands) == 2 and len(others - set(stand.segments)) > 1:
                alone.setdefault(stand.segments[0], []).append(i)
    return {
        c: which
        for c, which in alone.items()
        if len(which) >= _LEAST_WRONG and len(which) > _SHARE_WRONG * shared.get(c, 0)
    }


def shift(
    case: SeveralPlaces, evidence: Evidence, places: Places, first: int = 0, second: int = 1
) -> tuple[float, float]:
    """Metres between two stands of a case, and sigmas."""
    off, covariance = places.apart(evidence, case.stands[first].label, case.stands[second].label)
    return float(np.hypot(*off)), float(np.sqrt(off @ np.linalg.solve(covariance, off)))


def _in_two_places_at_once(tracks: Tracks, own: IntArray, label: IntArray) -> bool:
    """Whether tracks (indices) of different places (of each) in one run overlap in time."""
    return any(
        p != q
        and tracks.segment[s] == tracks.segment[t]
        and max(tracks.first_ns[s], tracks.first_ns[t]) <= min(tracks.last_ns[s], tracks.last_ns[t])
        for (s, p), (t, q) in combinations(zip(own.tolist(), label.tolist(), strict=True), 2)
    )


def _is_same_place(evidence: Evidence, places: Places, p: int, q: int) -> bool:
    off, covariance = places.apart(evidence, p, q)
    covariance = covariance + 2.0 * _REHUNG_SIGMA_M**2 * np.eye(2)
    return float(off @ np.linalg.solve(covariance, off)) < chi2.isf(_NOT_THERE, 2)


def _stand(tracks: Tracks, label: int, own: IntArray) -> TagStand:
    segments = tuple(dict.fromkeys(tracks.segment[own].tolist()))
    return TagStand(label, segments, int(tracks.n_observations[own].sum()), len(own))


def _without_repeats(way: Sequence[int]) -> tuple[int, ...]:
    return tuple(at for i, at in enumerate(way) if i == 0 or at != way[i - 1])
