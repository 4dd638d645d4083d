"""Hypotheses of how one local map lies in another: which of the shared tags fit together.

Fischler and Bolles, "Random sample consensus" (1981), with pairs as samples. A sample is not counted through with a
fixed gate: it grows outward, nearest tags first, and each tag is judged by where those that fit so far foretell it. So
a long map that is bent holds together, and a tag one metre off is noticed among neighbours even where the map as a
whole may be off by more.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import log
from typing import Final

import numpy as np
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.stats import chi2

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment.joint_fit import FitState, JointFit, LinearisedFit, SubsetFit, hold
from groundsbot.offline.alignment.tag_gate import (
    FALSE_ALARM,
    TAG_GATE,
    WRONG_FROM_M,
    gate_ratio,
    log_wrong_there,
    squared_sigmas,
)

# Looked for until an alignment with half the tags of the best one would be missed so rarely.
MISSED: Final = 1e-4

_DISTANCE_GATE: Final = float(chi2.isf(FALSE_ALARM, 1))
# Two tags whose distance is not known better than by this share give a heading worth nothing.
_MOST_RELATIVE_SIGMA: Final = 0.1
_MOST_DRAWS: Final = 20_000
_SEED: Final = 20170501
# Of the tags not tried yet, those are next whose variance is foretold to within this factor of the least.
_NEXT_VARIANCE: Final = 4.0
_MOST_CHANGES: Final = 100
# What links two groups of tags this well keeps them together: five sigmas are as little as a wrong tag is off.
_LOOSE_SIGMA_M: Final = 0.2 * WRONG_FROM_M


@dataclass(frozen=True)
class Explanation:
    """Shared tags that fit together, and the joint fit over them."""

    members: BoolArray  # (n,)
    linear: LinearisedFit
    held: SubsetFit

    @property
    def T_a_b(self) -> FloatArray:
        """(3,) pose of frame b in frame a."""
        return self.held.T_a_b

    @cached_property
    def _others(self) -> tuple[FloatArray, FloatArray]:
        return self.held.others()

    @cached_property
    def differences(self) -> tuple[FloatArray, FloatArray]:
        """(n, 2) of each tag from where the members foretell it, and (n,) in squared sigmas; 0 for members."""
        off_m, spread = self._others
        return off_m, np.where(self.members, 0.0, squared_sigmas(off_m, spread))

    @cached_property
    def log_wrong(self) -> FloatArray:
        """(n,) log density of each tag, if it is wrong, where it is; of members it means nothing."""
        return log_wrong_there(*self._others)

    @cached_property
    def joining(self) -> BoolArray:
        """(n,) which tags it does not count that fit it and rather stayed than are wrong."""
        return ~self.members & (gate_ratio(*self._others) < 1.0)

    def with_more(self, tags: BoolArray) -> "Explanation":
        """The same tags and these (n,)."""
        members = self.members | tags
        return Explanation(members, self.linear, hold(self.linear, members))

    @property
    def fits(self) -> BoolArray:
        """(n,) which tags do not contradict it: members, and those of whom it foretells too little."""
        return self.differences[1] < TAG_GATE

    @property
    def n(self) -> int:
        """How many tags fit."""
        return int(self.members.sum())


def explanations(fit: JointFit) -> list[Explanation]:
    """All that was found, each pair of shared tags in one of them at most; the same for the same maps."""
    found: list[Explanation] = []
    together = np.zeros((fit.n, fit.n), dtype=np.bool_)
    most = 0
    for draw, (i, j, fits) in enumerate(_random_pairs(fit)):
        if draw >= _n_draws(0.5 * most / fit.n):
            break
        if not fits or together[i, j]:
            continue
        explanation = _grow(fit, i, j)
        if explanation is not None and not any((explanation.members == each.members).all() for each in found):
            found.append(explanation)
            together |= np.outer(explanation.members, explanation.members)
            most = max(most, explanation.n)
    return found


def without(explanation: Explanation, tags: IntArray) -> Explanation:
    """The same tags but for some."""
    members = explanation.members.copy()
    members[tags] = False
    return Explanation(members, explanation.linear, hold(explanation.linear, members))


def halves(fit: JointFit, explanation: Explanation) -> Iterator[Explanation]:
    """Both parts of its tags wherever these hang together loosely: where maps bend a part may have moved as one.

    By the distances of tags: each link of the tree of the best known ones is cut in turn. Two tags are a part at least.
    """
    held = np.flatnonzero(explanation.members)
    first, second = np.triu_indices(len(held), 1)
    tags = held[first], held[second]
    variance = distances(fit.places_a, fit.covariance_a, *tags)[1] + distances(fit.places_b, fit.covariance_b, *tags)[1]
    weight = np.zeros((len(held), len(held)))
    weight[first, second] = variance + fit.unmodelled_m2
    tree = minimum_spanning_tree(weight).toarray()
    for link in zip(*np.nonzero(tree > _LOOSE_SIGMA_M**2), strict=True):
        cut = tree.copy()
        cut[link] = 0.0
        _, part = connected_components(cut, directed=False)
        for which in (0, 1):
            if 2 <= (part == which).sum() <= len(held) - 2:
                yield without(explanation, held[part == which])


def _n_draws(share: float) -> float:
    """Draws of two tags until both belong to this share of all at least once, but for MISSED."""
    return log(MISSED) / log(1.0 - share**2) if share > 0.0 else float("inf")


def _random_pairs(fit: JointFit) -> Iterator[tuple[int, int, bool]]:
    """Pairs of tags in random order, none twice, and whether their distance is the same in both maps."""
    first, second = np.triu_indices(fit.n, 1)
    order = np.random.default_rng(_SEED).permutation(len(first))[:_MOST_DRAWS]
    first, second = first[order], second[order]
    length_a, variance_a = distances(fit.places_a, fit.covariance_a, first, second)
    length_b, variance_b = distances(fit.places_b, fit.covariance_b, first, second)
    fits = is_same_distance(length_a, length_b, variance_a + variance_b + 2.0 * fit.unmodelled_m2)
    return zip(first.tolist(), second.tolist(), fits.tolist(), strict=True)


def is_same_distance(length_a: FloatArray, length_b: FloatArray, variance: FloatArray) -> BoolArray:
    """(P,) whether chance explains the difference, its variance (P,), and tells a heading besides."""
    shorter = np.minimum(length_a, length_b)
    same = (length_a - length_b) ** 2 < _DISTANCE_GATE * variance
    return np.asarray(same & (variance < (_MOST_RELATIVE_SIGMA * shorter) ** 2))


def distances(
    places: FloatArray, covariance: FloatArray, first: IntArray, second: IntArray
) -> tuple[FloatArray, FloatArray]:
    """(P,) distances between tags, and (P,) their variances. A map that turns as a whole keeps them."""
    base = places[second] - places[first]
    length = np.linalg.norm(base, axis=1)
    along = base / np.maximum(length, 1e-12)[:, None]
    blocks = covariance.reshape(len(places), 2, len(places), 2).transpose(0, 2, 1, 3)
    spread = blocks[first, first] + blocks[second, second] - blocks[first, second] - blocks[second, first]
    return length, np.maximum(np.einsum("pi,pij,pj->p", along, spread, along), 0.0)


def _grow(fit: JointFit, i: int, j: int) -> Explanation | None:
    """From two tags outward, then once more over all tags until nothing changes."""
    members = np.zeros(fit.n, dtype=np.bool_)
    members[[i, j]] = True
    tried = members.copy()
    pair = [i, j]
    bend = fit.unbent(through(fit.places_a[pair], fit.places_b[pair]))
    for _ in range(_MOST_CHANGES):
        linear = fit.linearise(bend)
        held = hold(linear, members)
        bend = fit.retract(linear, held)
        worst = _worst(held, members)
        if worst is not None:
            members[worst] = False
            if members.sum() < 2:
                return None
            continue
        if tried.all():
            break
        off, spread = held.others()
        size = np.where(tried, np.inf, np.trace(spread, axis1=1, axis2=2))
        following = size <= _NEXT_VARIANCE * size.min()
        tried |= following
        members |= following & (gate_ratio(off, spread) < 1.0)
    return refine_inliers(fit, bend, members)


def refine_inliers(fit: JointFit, bend: FitState, members: BoolArray) -> Explanation | None:
    """Takes in all that fits and drops what does not; what was dropped does not come back."""
    banned = np.zeros_like(members)
    for _ in range(_MOST_CHANGES):
        linear, held = fit.solve(bend, members)
        bend = linear.at
        worst = _worst(held, members)
        if worst is None and not held.closes:
            worst = int(np.flatnonzero(members)[np.argmax(held.misfits())])
        if worst is not None:
            members[worst] = False
            banned[worst] = True
            if members.sum() < 2:
                return None
            continue
        off, spread = held.others()
        joining = ~members & ~banned & (gate_ratio(off, spread) < 1.0)
        if not joining.any():
            return Explanation(members, linear, held)
        members |= joining
    return None


def _worst(held: SubsetFit, members: BoolArray) -> int | None:
    """The tag that the others contradict most, if they do."""
    which = np.flatnonzero(members)
    if len(which) == 2:
        return None if held.closes else int(which[0])
    misfits = held.misfits()
    worst = int(np.argmax(misfits))
    return int(which[worst]) if misfits[worst] > 1.0 else None


def through(a: FloatArray, b: FloatArray) -> FloatArray:
    """T_a_b by two tags (2, 2) in both maps: their middles meet, and their directions."""
    (ax, ay), (bx, by) = a[1] - a[0], b[1] - b[0]
    turn = np.arctan2(ay, ax) - np.arctan2(by, bx)
    middle = a.mean(axis=0) - se2.apply([0.0, 0.0, turn], b.mean(axis=0))
    return np.array([middle[0], middle[1], float(se2.wrap_angle(turn))])
