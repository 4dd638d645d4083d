"""Search for the tracks of an id that are of one tag: splits that lower the cost significantly, the largest gain first.

A split of a place in two adds two parameters. If no tag moved, the decrease of the cost in squared sigmas, the gain, is
chi-square with two degrees of freedom. The false alarm rate of a map is divided among all tested splits (Bonferroni;
the later steps of Holm's procedure are hardly less strict). A tag that moved also raises the gains of its neighbours.
So the largest gain is split first, and the others are tested with it freed. Wrong splits of this search, or of an
earlier one, are joined again where that costs less than the bound.
"""

from functools import lru_cache
from itertools import product
from typing import Final

import numpy as np
from scipy.special import chdtri, fdtri

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.outliers.evidence import Evidence
from groundsbot.offline.outliers.joint_information import rows_of
from groundsbot.offline.outliers.places import NOWHERE, Places, minimise_places
from groundsbot.offline.outliers.tracks import Tracks

# Share of maps that name a tag that did not move.
FALSE_ALARM: Final = 0.01
# Up to this many tracks every split is tested; of more, those that a move, a duplicate id or a slip causes.
_FEW: Final = 4
_MOST_SPLITS: Final = 200
# Of fewer tags, the one with the median ratio may itself have moved.
_MANY: Final = 5


def cost_bound(tracks: Tracks, evidence: Evidence, false_alarm: float = FALSE_ALARM, freedom: float = np.inf) -> float:
    """Return the least significant gain of a split, in squared sigmas, given the number of possible splits.

    Args:
        tracks: S tracks.
        evidence: evidence of some of the tracks.
        false_alarm: probability that a map without moved tags gets a split.
        freedom: degrees of freedom of the estimate of the noise; infinite for known noise. The gain is chi-square for
            known noise, else F.
    """
    n_tests = sum(len(_splits_of(tracks, own)) for own in _by_label(tracks.id[evidence.which], evidence.which))
    share = false_alarm / max(n_tests, 1)
    return float(chdtri(2, share) if np.isinf(freedom) else 2.0 * fdtri(2, max(freedom, 1.0), 1.0 - share))


def freedom_of_places(places: Places) -> int:
    """Return the degrees of freedom of noise that was fitted to the differences between the tracks of a place."""
    return sum(2 * len(each.members) - 2 for each in places.tracks)


def excess(places: Places) -> float:
    """Return the ratio of the gain of splitting a place into its tracks to the median by chance; 1 at least.

    The median over all places is returned. A tag that moved contradicts itself, but most other tags do not. If these do
    too, an unmodelled error distorts the map, and a significant gain must be larger by this ratio.
    """
    ratios = []
    for each in places.tracks:
        n = 2 * len(each.members) - 2  # at the minimum the gradients of a place's tracks sum to zero
        if n:
            inner, gradient = each.stiffness[2:, 2:] + NOWHERE * np.eye(n), each.gradient[1:].reshape(-1)
            ratios.append(float(gradient @ np.linalg.solve(inner, gradient)) / chdtri(n, 0.5))
    return max(1.0, float(np.median(ratios))) if len(ratios) >= _MANY else 1.0


def search(
    evidence: Evidence, tracks: Tracks, begin: Places, least_gain: float, most_ids: int | None = None
) -> IntArray | None:
    """Find tag ids whose tracks do not agree on one position, and assign their tracks to several places.

    A track is one pass of a robot by a tag; a place is a position that tracks of one id share. Greedy search: the split
    that lowers the cost most is made first, then the others are tested again (see the top of this module).

    Args:
        evidence: cost as a function of the positions of K tracks.
        tracks: all tracks; `evidence.which` selects the K among them.
        begin: initial places, usually one for each id, from `minimise_places`.
        least_gain: decrease of the cost, in squared sigmas, that a split needs (`cost_bound`).
        most_ids: give up if more ids than this are split; None: no limit.

    Returns:
        The place (K,) of each track, as an index; None if more than `most_ids` ids were split.
    """
    id_of = tracks.id[evidence.which]
    split_ids: set[int] = set()
    labels, groups = begin.place.copy(), list(begin.tracks)
    masks = [_masks(tracks, evidence.which[each.members]) for each in groups]
    freed: list[tuple[FloatArray, FloatArray]] = []  # places freed so far: coupling with all tracks, information
    for _ in range(_MOST_SPLITS):
        best_gain, best = least_gain, None
        for label, (group, choices) in enumerate(zip(groups, masks, strict=True)):
            gains = group.gains(choices)
            if len(gains) and gains.max() > best_gain:
                best_gain, best = float(gains.max()), (label, choices[int(np.argmax(gains))] > 0.0)
        if best is None:
            break
        label, which = best
        own = groups[label].of(which)
        members = own.members
        split_ids.add(int(id_of[members[0]]))
        if most_ids is not None and len(split_ids) > most_ids:
            return None
        labels[members] = len(groups)
        coupling = begin.stiffness.against(members)
        for earlier, inner in freed:
            across = earlier.reshape(-1, 2, 2)[members].sum(axis=0)
            coupling = coupling - earlier @ np.linalg.solve(inner, across.T)
        inner = coupling.reshape(-1, 2, 2)[members].sum(axis=0) + NOWHERE * np.eye(2)
        freed.append((coupling, inner))
        groups[label] = groups[label].of(~which)
        groups = [each.eliminate(coupling, inner, own.gradient.sum(axis=0)) for each in [*groups, own]]
        masks.append(_masks(tracks, evidence.which[own.members]))
        masks[label] = _masks(tracks, evidence.which[groups[label].members])
    # The places are held there alone, since they take hundreds of MiB.
    if freed:
        del begin
        labels = _undo_chance_splits(evidence, tracks, minimise_places(evidence, labels), least_gain)
    else:
        labels = _undo_chance_splits(evidence, tracks, begin, least_gain)
    return _simplify(evidence, tracks, labels, least_gain)


def _undo_chance_splits(evidence: Evidence, tracks: Tracks, found: Places, least_gain: float) -> IntArray:
    """Join places of an id whose distance chance explains, the most certain join first; return labels (K,)."""
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
                    offset_m, covariance = found.apart(evidence, int(p), int(q))
                    cost = float(offset_m @ np.linalg.solve(covariance, offset_m))
                    if cost < least:
                        least, pair = cost, (int(p), int(q))
        if pair is None:
            return labels
        del found
        found = minimise_places(evidence, np.where(labels == pair[1], pair[0], labels))


def _simplify(evidence: Evidence, tracks: Tracks, labels: IntArray, least_gain: float) -> IntArray:
    """Replace a move there and back by a single move where chance explains the difference in cost; return labels (K,).

    A tag that moved by little looks like two tags if an error of a track is in the direction of its first place.
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
    """Return the cost of each single move of a tag, and its gain over no move; all other variables are re-estimated.

    Args:
        evidence: evidence of K tracks.
        labels: (K,) the place of each track.
        members: (m,) the tracks of the tag, in order of time.

    Returns:
        (m - 1,) costs with the first 1, ..., m - 1 tracks in one place and the rest in another, and (m - 1,) squared
        distances of these two places in sigmas.
    """
    m = len(members)
    split = labels.copy()
    split[members] = labels.max() + 1 + np.arange(m)
    found = minimise_places(evidence, split)
    place = found.place[members]
    rows = rows_of(place)
    at = np.stack([found.at(evidence, int(p)) for p in place]).reshape(-1)
    weight = np.linalg.inv(found.covariance[np.ix_(rows, rows)])
    weighted = (weight @ at).reshape(m, 2)
    # Sums over the first i tracks, over the rest, and between these.
    before, total = np.cumsum(weighted, axis=0)[:-1], weighted.sum(axis=0)
    blocks = np.cumsum(np.cumsum(weight.reshape(m, 2, m, 2), axis=0), axis=2)
    n = np.arange(1, m)
    first, across, whole = blocks[n - 1, :, n - 1, :], blocks[n - 1, :, m - 1, :], blocks[m - 1, :, m - 1, :]
    across = across - first
    rest = whole - first - across - across.swapaxes(-1, -2)
    information = np.block([[first, across], [across.swapaxes(-1, -2), rest]])
    score = np.concatenate([before, total - before], axis=-1)
    covariance = np.linalg.inv(information)
    both = (covariance @ score[..., None])[..., 0]
    cost = _cost(evidence, found) + float(at @ weight @ at) - (both * score).sum(axis=-1)
    difference = np.hstack([-np.eye(2), np.eye(2)])
    offset_m = both @ difference.T
    weighted_offset = np.linalg.solve(difference @ covariance @ difference.T, offset_m[..., None])[..., 0]
    return cost, (offset_m * weighted_offset).sum(axis=-1)


def _cost(evidence: Evidence, found: Places) -> float:
    """Return the cost of places in squared sigmas, relative to the linearisation point of the evidence."""
    at = np.stack([found.at(evidence, p) for p in range(int(found.place.max()) + 1)])
    step = (at[found.place] - evidence.places_m).reshape(-1, 1)
    return float((step * (evidence.information.times(step) + 2.0 * evidence.score[:, None])).sum())


def _by_label(label: IntArray, values: IntArray) -> list[IntArray]:
    """Return the values (n,) of each label (n,), in their order."""
    order = np.argsort(label, kind="stable")
    return np.split(values[order], np.flatnonzero(np.diff(label[order])) + 1) if len(order) else []


def _masks(tracks: Tracks, own: IntArray) -> FloatArray:
    """Return the tested splits of a place as masks (n, m): 1 for each of its tracks (m,) that would get another."""
    order = np.argsort(tracks.rank[own])
    splits = _splits_of(tracks, own[order])
    masks = np.zeros((len(splits), len(own)))
    masks[:, order] = splits
    return masks


def _in_time(tracks: Tracks, which: IntArray, members: IntArray) -> IntArray:
    """Return the members of the evidence in order of time."""
    return members[np.argsort(tracks.rank[which[members]])]


def _splits_of(tracks: Tracks, members: IntArray) -> BoolArray:
    """Return the tested splits of a place (n, m): whether each of its tracks (m,), in order of time, gets another."""
    _, segment = np.unique(tracks.segment[members], return_inverse=True)
    return _splits(tuple(segment.tolist()))


@lru_cache(maxsize=4096)
def _splits(segment: tuple[int, ...]) -> BoolArray:
    """Return the tested splits (n, m) of tracks by the segment (m,) of each.

    Of few tracks these are all splits. Of more tracks they are each track alone, the tracks before and after each time,
    each segment alone, the end of a segment, and all splits of few segments.
    """
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
    unique: dict[bytes, BoolArray] = {}
    for mask in masks:
        folded = mask if not mask[0] else ~mask  # a mask and its complement are the same split
        if folded.any():
            unique.setdefault(folded.tobytes(), folded)
    return np.array(list(unique.values()))
