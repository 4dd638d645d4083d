"""Which tracks of an id are of one tag: splits that lower the cost by more than chance does, worst first.

To split a place in two frees two numbers, so what the cost falls by is chi-square with two degrees of freedom where
nothing was moved. Many splits are looked at, and the least likely of them must be less likely than one false alarm a
map shared out among all (Bonferroni; Holm's later steps are hardly milder). A tag that was moved pulls its neighbours
along: so the worst one is freed first, and the others are judged with it free. What was split wrongly on the way, or
beforehand, is joined again where it costs less than that.
"""

from functools import lru_cache
from itertools import product
from typing import Final

import numpy as np
from scipy import stats
from scipy.special import chdtri

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.outliers.evidence import Evidence
from groundsbot.offline.outliers.joint_information import rows_of
from groundsbot.offline.outliers.places import NOWHERE, Places, minimise_places
from groundsbot.offline.outliers.tracks import Tracks

# One map in a hundred names a tag that is where it was.
FALSE_ALARM: Final = 0.01
# Of so few tracks every split is looked at; of more, those that a move, a double or a slip brings about.
_FEW: Final = 4
_MOST_SPLITS: Final = 200
# Of fewer tags the one in the middle may well have been moved itself.
_MANY: Final = 5


def cost_bound(tracks: Tracks, evidence: Evidence, false_alarm: float = FALSE_ALARM, freedom: float = np.inf) -> float:
    """By how many squared sigmas a split must lower the cost, all that could be looked at counted.

    Args:
        tracks: S of them.
        evidence: of some.
        false_alarm: how rarely a good map has a split.
        freedom: what chi-square's degrees of freedom the noise is known like.
    """
    n_tests = sum(len(_splits_of(tracks, own)) for own in _by_label(tracks.id[evidence.which], evidence.which))
    share = false_alarm / max(n_tests, 1)
    return float(chdtri(2, share) if np.isinf(freedom) else 2.0 * stats.f.isf(share, 2, max(freedom, 1.0)))


def freedom_of_places(places: Places) -> int:
    """What chi-square's degrees of freedom noise is known like that was fitted to how tracks of tags differ."""
    return sum(2 * len(each.members) - 2 for each in places.tracks)


def excess(places: Places) -> float:
    """How many times what chance brings the places of one tag ask to be split by, in the middle of them; 1 at least.

    A tag that was moved contradicts itself, but not most of the others. Where these do too, something bends the map
    that no covariance knows, and a tag must stand out from that.
    """
    ratios = []
    for each in places.tracks:
        n = 2 * len(each.members) - 2  # the first follows from the others
        if n:
            inner, pull = each.stiffness[2:, 2:] + NOWHERE * np.eye(n), each.pull[1:].reshape(-1)
            ratios.append(float(pull @ np.linalg.solve(inner, pull)) / chdtri(n, 0.5))
    return max(1.0, float(np.median(ratios))) if len(ratios) >= _MANY else 1.0


def search(
    evidence: Evidence, tracks: Tracks, begin: Places, least_gain: float, most_ids: int | None = None
) -> IntArray | None:
    """(K,) the places that the evidence asks for; None where more ids than are plausible ask for several.

    Args:
        evidence: of K tracks.
        tracks: they are of these.
        begin: see `minimise_places`.
        least_gain: see `cost_bound`.
        most_ids: that are plausible; None: any number.
    """
    id_of = tracks.id[evidence.which]
    split: set[int] = set()
    labels, held = begin.place.copy(), list(begin.tracks)
    masks = [_masks(tracks, evidence.which[each.members]) for each in held]
    gone: list[tuple[FloatArray, FloatArray]] = []  # what is free already, felt by all
    for _ in range(_MOST_SPLITS):
        best_gain, best = least_gain, None
        for label, (own, choices) in enumerate(zip(held, masks, strict=True)):
            gains = own.gains(choices)
            if len(gains) and gains.max() > best_gain:
                best_gain, best = float(gains.max()), (label, choices[int(np.argmax(gains))] > 0.0)
        if best is None:
            break
        label, which = best
        own = held[label].of(which)
        members = own.members
        split.add(int(id_of[members[0]]))
        if most_ids is not None and len(split) > most_ids:
            return None
        labels[members] = len(held)
        freed = begin.stiffness.against(members)
        for against, inner in gone:
            moved = against.reshape(-1, 2, 2)[members].sum(axis=0)
            freed = freed - against @ np.linalg.solve(inner, moved.T)
        inner = freed.reshape(-1, 2, 2)[members].sum(axis=0) + NOWHERE * np.eye(2)
        gone.append((freed, inner))
        held[label : label + 1] = [held[label].of(~which)]
        held = [each.release(freed, inner, own.pull.sum(axis=0)) for each in [*held, own]]
        masks.append(_masks(tracks, evidence.which[own.members]))
        masks[label] = _masks(tracks, evidence.which[held[label].members])
    if not gone:
        return _simplest(evidence, tracks, _undo_chance_splits(evidence, tracks, begin, least_gain), least_gain)
    found = _undo_chance_splits(evidence, tracks, minimise_places(evidence, labels), least_gain)
    return _simplest(evidence, tracks, found, least_gain)


def _undo_chance_splits(evidence: Evidence, tracks: Tracks, found: Places, least_gain: float) -> IntArray:
    """Without the splits that chance explains, the least of them first."""
    own = tracks.id[evidence.which]
    while True:
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
        found = minimise_places(evidence, np.where(labels == pair[1], pair[0], labels))


def _simplest(evidence: Evidence, tracks: Tracks, labels: IntArray, least_gain: float) -> IntArray:
    """With one move instead of there and back, where chance explains what that costs more.

    A tag that was moved by little, one of whose tracks errs towards its first place, looks like two tags.
    """
    for members in _by_label(tracks.id[evidence.which], np.arange(len(labels))):
        if (labels[members] == labels[members[0]]).all():
            continue
        members = _in_time(tracks, evidence.which, members)
        if not tracks.came_back(evidence.which[members], labels[members]):
            continue
        most = least_gain + _cost(evidence, minimise_places(evidence, labels))
        cost, gain = _one_move(evidence, labels, members)
        cost = np.where(gain >= least_gain, cost, np.inf)
        best = int(np.argmin(cost))
        if cost[best] < most:
            labels = labels.copy()
            labels[members[: best + 1]], labels[members[best + 1 :]] = labels.max() + 1, labels.max() + 2
    return labels


def _one_move(evidence: Evidence, labels: IntArray, members: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return what it costs if a tag was moved once, and what it would cost more if it was not; all others give way.

    Args:
        evidence: of K tracks.
        labels: (K,) the place of each track.
        members: (m,) the tracks of the tag, in order of time.

    Returns:
        (m - 1,) costs with the first 1, ..., m - 1 tracks in one place and the rest in another, and (m - 1,) squared
        distances of these two places in sigmas.
    """
    m = len(members)
    apart = labels.copy()
    apart[members] = labels.max() + 1 + np.arange(m)
    found = minimise_places(evidence, apart)
    place = found.place[members]
    rows = rows_of(place)
    at = np.stack([found.at(evidence, int(p)) for p in place]).reshape(-1)
    weight = np.linalg.inv(found.covariance[np.ix_(rows, rows)])
    pull = (weight @ at).reshape(m, 2)
    # Sums over the first i tracks, over the rest, and across.
    before, total = np.cumsum(pull, axis=0)[:-1], pull.sum(axis=0)
    blocks = np.cumsum(np.cumsum(weight.reshape(m, 2, m, 2), axis=0), axis=2)
    n = np.arange(1, m)
    first, across, whole = blocks[n - 1, :, n - 1, :], blocks[n - 1, :, m - 1, :], blocks[m - 1, :, m - 1, :]
    across = across - first
    rest = whole - first - across - across.swapaxes(-1, -2)
    information = np.block([[first, across], [across.swapaxes(-1, -2), rest]])
    score = np.concatenate([before, total - before], axis=-1)
    covariance = np.linalg.inv(information)
    two = (covariance @ score[..., None])[..., 0]
    cost = _cost(evidence, found) + float(at @ weight @ at) - (two * score).sum(axis=-1)
    difference = np.hstack([-np.eye(2), np.eye(2)])
    off = two @ difference.T
    spread = np.linalg.solve(difference @ covariance @ difference.T, off[..., None])[..., 0]
    return cost, (off * spread).sum(axis=-1)


def _cost(evidence: Evidence, found: Places) -> float:
    """Of places, in squared sigmas over that of no step from where the evidence was linearised."""
    at = np.stack([found.at(evidence, p) for p in range(int(found.place.max()) + 1)])
    along = (at[found.place] - evidence.places_m).reshape(-1, 1)
    return float((along * (evidence.information.times(along) + 2.0 * evidence.score[:, None])).sum())


def _by_label(label: IntArray, values: IntArray) -> list[IntArray]:
    """Values (n,) of each label (n,), in their order."""
    order = np.argsort(label, kind="stable")
    return np.split(values[order], np.flatnonzero(np.diff(label[order])) + 1) if len(order) else []


def _masks(tracks: Tracks, own: IntArray) -> FloatArray:
    """(n, m) a one for each of the tracks (m,) of a place that might have another."""
    order = np.argsort(tracks.rank[own])
    splits = _splits_of(tracks, own[order])
    masks = np.zeros((len(splits), len(own)))
    masks[:, order] = splits
    return masks


def _in_time(tracks: Tracks, which: IntArray, members: IntArray) -> IntArray:
    """Members of the evidence in order of time."""
    return members[np.argsort(tracks.rank[which[members]])]


def _splits_of(tracks: Tracks, members: IntArray) -> BoolArray:
    """(n, m) which of the tracks (m,) of one place, in order of time, may have another."""
    _, segment = np.unique(tracks.segment[members], return_inverse=True)
    return _splits(tuple(segment.tolist()))


@lru_cache(maxsize=4096)
def _splits(segment: tuple[int, ...]) -> BoolArray:
    """Each split of few tracks; of more: each alone, each run alone, runs before and after, the end of a run."""
    n = len(segment)
    if n < 2:
        return np.zeros((0, n), dtype=np.bool_)
    if n <= _FEW:
        return np.array([(False, *mask) for mask in product((False, True), repeat=n - 1) if any(mask)])
    of = np.array(segment)
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
    return np.array(list(kept.values()))
