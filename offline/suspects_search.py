"""Which sightings of an id are of one tag: splits that lower the cost by more than chance does, worst first.

To split a place in two frees two numbers, so what the cost falls by is chi-square with two degrees of freedom where
nothing was moved. Many splits are looked at, and the least likely of them must be less likely than one false alarm a
map shared out among all (Bonferroni; Holm's later steps are hardly milder). A tag that was moved pulls its neighbours
along: so the worst one is freed first, and the others are judged with it free. What was split wrongly on the way, or
beforehand, is joined again where it costs less than that.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import Final

import numpy as np
from scipy import linalg, sparse
from scipy.special import chdtri
from scipy.stats import chi2

from calib.arrays import BoolArray, FloatArray, IntArray
from offline.suspects_evidence import Evidence
from offline.suspects_sightings import Sightings

# One map in a hundred names a tag that is where it was.
FALSE_ALARM: Final = 0.01
# Of so few sightings every split is looked at; of more, those that a move, a double or a slip brings about.
_FEW: Final = 4
# A place is somewhere within a kilometre: ties down what no reading does.
_NOWHERE: Final = 1e-6
_MOST_SPLITS: Final = 200
# Of fewer tags the one in the middle may well have been moved itself.
_MANY: Final = 5


@dataclass(frozen=True)
class Stiffness:
    """L less what places give way, L - U V' (2 K, 2 K), of which only small parts are ever asked for.

    Attributes:
        information: (2 K, 2 K) L, of the evidence.
        given: (2 K, m) U; way: (2 K, m) V.
    """

    information: FloatArray
    given: FloatArray
    way: FloatArray

    def among(self, members: IntArray) -> FloatArray:
        """(2 m, 2 m) between some sightings."""
        rows = (2 * members[:, None] + np.arange(2)).reshape(-1)
        return np.asarray(self.information[np.ix_(rows, rows)] - self.given[rows] @ self.way[rows].T)

    def together(self, members: IntArray) -> FloatArray:
        """(2, 2) of some sightings moved as one."""
        return np.asarray(self.among(members).reshape(len(members), 2, -1, 2).sum(axis=(0, 2)))

    def against(self, members: IntArray) -> FloatArray:
        """(2 K, 2) what all feel of some sightings moved as one."""
        rows = 2 * members[:, None] + np.arange(2)
        whole = self.information[:, rows].sum(axis=1)
        return np.asarray(whole - self.given @ self.way[rows].sum(axis=0).T)

    def freed(self, against: FloatArray, inner: FloatArray) -> "Stiffness":
        """Once these are free: less A inner^-1 A'."""
        way = np.hstack([self.way, np.linalg.solve(inner, against.T).T])
        return Stiffness(self.information, np.hstack([self.given, against]), way)


@dataclass(frozen=True)
class Places:
    """Sightings gathered into places, and where these are.

    Attributes:
        place: (K,) of each sighting of the evidence, 0 to P - 1.
        offset: (2 P,) of the places from the middle of their sightings' in the evidence; covariance: (2 P, 2 P).
        pull: (2 K,) by which each sighting would rather be elsewhere; stiffness: against that.
    """

    place: IntArray
    offset: FloatArray
    covariance: FloatArray
    pull: FloatArray
    stiffness: Stiffness

    def apart(self, evidence: Evidence, p: int, q: int) -> tuple[FloatArray, FloatArray]:
        """Place q as seen from place p (2,), and its covariance (2, 2)."""
        rows = np.concatenate([2 * p + np.arange(2), 2 * q + np.arange(2)])
        difference = np.hstack([-np.eye(2), np.eye(2)])
        covariance = difference @ self.covariance[np.ix_(rows, rows)] @ difference.T
        return self.at(evidence, q) - self.at(evidence, p), covariance

    def at(self, evidence: Evidence, p: int) -> FloatArray:
        """(2,) of place p."""
        middle = evidence.places_m[np.flatnonzero(self.place == p)].mean(axis=0)
        return np.asarray(middle + self.offset[2 * p : 2 * p + 2])


def settled(evidence: Evidence, place: IntArray) -> Places:
    """The least cost where sightings (K,) of one label have one place."""
    _, place = np.unique(place, return_inverse=True)
    n = int(place.max(initial=-1)) + 1
    # Sightings of one place may have been linearised at several; they are taken from the middle of these.
    sums = np.zeros((n, 2))
    np.add.at(sums, place, evidence.places_m)
    middle = sums / np.bincount(place, minlength=n)[:, None]
    score = evidence.score + evidence.information @ (middle[place] - evidence.places_m).reshape(-1)
    to_place = (2 * place[:, None] + np.arange(2)).reshape(-1)
    ones = np.ones(len(to_place))
    gather = sparse.csr_array((ones, (to_place, np.arange(len(to_place)))), shape=(2 * n, len(to_place)))
    of_places: FloatArray = np.asarray(gather @ evidence.information).T  # which is symmetric
    square = gather @ of_places + _NOWHERE * np.eye(2 * n)
    covariance = linalg.inv(square, check_finite=False)
    offset: FloatArray = -covariance @ np.asarray(gather @ score)
    stiffness = Stiffness(evidence.information, of_places, of_places @ covariance)
    return Places(place, offset, covariance, score + of_places @ offset, stiffness)


def bound(sightings: Sightings, evidence: Evidence, false_alarm: float = FALSE_ALARM) -> float:
    """By how many squared sigmas a split must lower the cost, all that could be looked at counted."""
    own = sightings.id[evidence.which]
    n_tests = sum(len(_splits_of(sightings, evidence.which[own == each])) for each in np.unique(own))
    return float(chi2.isf(false_alarm / max(n_tests, 1), 2))


def excess(places: Places) -> float:
    """How many times what chance brings the places of one tag ask to be split by, in the middle of them; 1 at least.

    A tag that was moved contradicts itself, but not most of the others. Where these do too, something bends the map
    that no covariance knows, and a tag must stand out from that.
    """
    ratios = []
    for label in range(int(places.place.max(initial=-1)) + 1):
        members = np.flatnonzero(places.place == label)[1:]  # the first follows from the others
        if len(members):
            n = 2 * len(members)
            inner = places.stiffness.among(members) + _NOWHERE * np.eye(n)
            pull = places.pull.reshape(-1, 2)[members].reshape(-1)
            ratios.append(float(pull @ np.linalg.solve(inner, pull)) / chdtri(n, 0.5))
    return max(1.0, float(np.median(ratios))) if len(ratios) >= _MANY else 1.0


def search(evidence: Evidence, sightings: Sightings, begin: Places, least_gain: float) -> IntArray:
    """(K,) the places that the evidence asks for.

    Args:
        evidence: of K sightings.
        sightings: they are of these.
        begin: see `settled`.
        least_gain: see `bound`.
    """
    labels, pull, stiffness = begin.place.copy(), begin.pull, begin.stiffness
    candidates: dict[int, list[IntArray]] = {}
    for _ in range(_MOST_SPLITS):
        best_gain, best = least_gain, None
        for label in range(int(labels.max(initial=-1)) + 1):
            if label not in candidates:
                candidates[label] = _candidates(sightings, evidence.which, np.flatnonzero(labels == label))
            gains = [_gain(pull, stiffness, members) for members in candidates[label]]
            if gains and max(gains) > best_gain:
                best_gain, best = max(gains), (label, candidates[label][int(np.argmax(gains))])
        if best is None:
            break
        label, members = best
        labels[members] = labels.max() + 1
        candidates.pop(label)
        freed = stiffness.against(members)
        inner = freed.reshape(-1, 2, 2)[members].sum(axis=0) + _NOWHERE * np.eye(2)
        own = pull.reshape(-1, 2)[members].sum(axis=0)
        pull = pull - freed @ np.linalg.solve(inner, own)
        stiffness = stiffness.freed(freed, inner)
    return _simplest(evidence, sightings, _joined_again(evidence, sightings, labels, least_gain), least_gain)


def gain_of(places: Places, members: IntArray) -> tuple[float, FloatArray]:
    """What it brings to give some sightings (indices) a place of their own, in squared sigmas; and its information."""
    return _gain(places.pull, places.stiffness, members), places.stiffness.together(members)


def _gain(pull: FloatArray, stiffness: Stiffness, members: IntArray) -> float:
    own = pull.reshape(-1, 2)[members].sum(axis=0)
    inner = stiffness.together(members) + _NOWHERE * np.eye(2)
    return float(own @ np.linalg.solve(inner, own))


def _joined_again(evidence: Evidence, sightings: Sightings, labels: IntArray, least_gain: float) -> IntArray:
    """Without the splits that chance explains, the least of them first."""
    own = sightings.id[evidence.which]
    while True:
        found = settled(evidence, labels)
        labels = found.place
        id_of = np.zeros(int(labels.max(initial=-1)) + 1, dtype=np.int64)
        id_of[labels] = own
        least, pair = least_gain, None
        for each in np.flatnonzero(np.bincount(id_of) > 1):
            several = np.flatnonzero(id_of == each)
            for i, p in enumerate(several):
                for q in several[i + 1 :]:
                    off, covariance = found.apart(evidence, int(p), int(q))
                    cost = float(off @ np.linalg.solve(covariance, off))
                    if cost < least:
                        least, pair = cost, (int(p), int(q))
        if pair is None:
            return labels
        labels = np.where(labels == pair[1], pair[0], labels)


def _simplest(evidence: Evidence, sightings: Sightings, labels: IntArray, least_gain: float) -> IntArray:
    """With one move instead of there and back, where chance explains what that costs more.

    A tag that was moved by little, one of whose sightings errs towards its first place, looks like two tags.
    """
    own = sightings.id[evidence.which]
    for each in np.unique(own):
        members = np.flatnonzero(own == each)
        members = members[np.argsort(_rank(sightings)[evidence.which[members]])]
        if not sightings.came_back(evidence.which[members], labels[members]):
            continue
        most = least_gain + _cost(evidence, labels)
        for i in range(1, len(members)):
            moved = labels.copy()
            moved[members[:i]], moved[members[i:]] = labels.max() + 1, labels.max() + 2
            found = settled(evidence, moved)
            off, covariance = found.apart(evidence, int(found.place[members[0]]), int(found.place[members[-1]]))
            cost = _cost(evidence, moved)
            if cost < most and float(off @ np.linalg.solve(covariance, off)) >= least_gain:
                most, labels = cost, moved
    return labels


def _cost(evidence: Evidence, labels: IntArray) -> float:
    """Of places (K,), in squared sigmas over that of no step from where the evidence was linearised."""
    found = settled(evidence, labels)
    step = np.stack([found.at(evidence, int(p)) for p in found.place]) - evidence.places_m
    along = step.reshape(-1)
    return float(along @ (evidence.information @ along + 2.0 * evidence.score))


def _candidates(sightings: Sightings, which: IntArray, members: IntArray) -> list[IntArray]:
    """Members of the evidence that might have a place of their own."""
    ordered = members[np.argsort(_rank(sightings)[which[members]])]
    return [ordered[mask] for mask in _splits_of(sightings, which[ordered])]


def _rank(sightings: Sightings) -> IntArray:
    rank = np.empty(len(sightings), dtype=np.int64)
    rank[sightings.in_time] = np.arange(len(sightings))
    return rank


def _splits_of(sightings: Sightings, members: IntArray) -> tuple[BoolArray, ...]:
    """Masks of the sightings of one place, in order of time, that may have another."""
    _, chain = np.unique(sightings.chain[members], return_inverse=True)
    return _splits(tuple(chain.tolist()))


@lru_cache(maxsize=4096)
def _splits(chain: tuple[int, ...]) -> tuple[BoolArray, ...]:
    """Each split of few sightings; of more: each alone, each run alone, runs before and after, the end of a run."""
    n = len(chain)
    if n < 2:
        return ()
    if n <= _FEW:
        return tuple(np.array((False, *mask)) for mask in product((False, True), repeat=n - 1) if any(mask))
    of = np.array(chain)
    masks = [np.arange(n) == i for i in range(n)]
    masks += [np.arange(n) >= i for i in range(1, n)]
    for each in np.unique(of):
        own = np.flatnonzero(of == each)
        masks.append(of == each)
        masks += [(of == each) & (np.arange(n) >= i) for i in own[1:]]
    if len(np.unique(of)) <= _FEW:
        for mask in product((False, True), repeat=len(np.unique(of)) - 1):
            masks.append(np.isin(of, np.unique(of)[1:][np.array(mask, dtype=np.bool_)]))
    kept: dict[bytes, BoolArray] = {}
    for mask in masks:
        folded = mask if not mask[0] else ~mask  # a split has two sides
        if folded.any():
            kept.setdefault(folded.tobytes(), folded)
    return tuple(kept.values())
