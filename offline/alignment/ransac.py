"""Hypotheses of how one local map is placed in another: which of the shared tags fit together.

Fischler and Bolles, "Random sample consensus" (1981), with pairs as samples. Inliers of a sample are not counted with a
fixed gate. Instead the sample is extended, most certainly predicted tags first, and each tag is tested against its
prediction from the inliers so far. So a long map deformed by heading errors holds together, and a tag 1 m off is
detected among its neighbours even where the map as a whole may be off by more.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from math import log
from typing import Final

import numpy as np
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree
from scipy.special import chdtri

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment.joint_fit import FitState, JointFit, LinearisedFit, SubsetFit, fit_members
from groundsbot.offline.alignment.tag_gate import (
    FALSE_ALARM,
    OUTLIER_SCALE_M,
    TAG_GATE,
    gate_ratio,
    log_outlier_density_at,
    squared_sigmas,
)

# Probability of missing an alignment with half the tags of the best one.
MISS_PROBABILITY: Final = 1e-4

_DISTANCE_GATE: Final = float(chdtri(1, FALSE_ALARM))
# Two tags whose distance has a larger relative sigma give no useful heading.
_MOST_RELATIVE_SIGMA: Final = 0.1
_MOST_DRAWS: Final = 20_000
_SEED: Final = 20170501
# Of the tags not tried yet, those are next whose predicted variance is within this factor of the least.
_NEXT_VARIANCE: Final = 4.0
_MOST_CHANGES: Final = 100
# A more certain link keeps two groups of tags together: five sigmas are the least error of a wrong tag.
_LOOSE_SIGMA_M: Final = 0.2 * OUTLIER_SCALE_M


@dataclass(frozen=True)
class Hypothesis:
    """A hypothesis: shared tags that fit together (the consensus set), and the joint fit of them."""

    members: BoolArray  # (n,)
    linear: LinearisedFit
    solution: SubsetFit

    @property
    def T_a_b(self) -> FloatArray:
        """Pose (3,) of frame b in frame a."""
        return self.solution.T_a_b

    @cached_property
    def _predictions(self) -> tuple[FloatArray, FloatArray]:
        return self.solution.predict_others()

    @cached_property
    def differences(self) -> tuple[FloatArray, FloatArray]:
        """Residuals (n, 2) under the prediction from the members, and (n,) their squared sigmas; 0 for members."""
        off_m, spread = self._predictions
        return off_m, np.where(self.members, 0.0, squared_sigmas(off_m, spread))

    @cached_property
    def log_outlier_density(self) -> FloatArray:
        """Log density (n,) of each tag's position if it is wrong; meaningless for members."""
        return log_outlier_density_at(*self._predictions)

    @cached_property
    def candidates(self) -> BoolArray:
        """Which tags (n,) outside the members pass the gate."""
        return ~self.members & (gate_ratio(*self._predictions) < 1.0)

    def add_tags(self, tags: BoolArray) -> "Hypothesis":
        """Return the hypothesis with these tags (n,) added."""
        members = self.members | tags
        return Hypothesis(members, self.linear, fit_members(self.linear, members))

    @property
    def fits(self) -> BoolArray:
        """Which tags (n,) do not contradict it: members, and those predicted too uncertainly."""
        return self.differences[1] < TAG_GATE

    @property
    def n_members(self) -> int:
        """Number of members."""
        return int(self.members.sum())


def find_hypotheses(fit: JointFit) -> list[Hypothesis]:
    """Return all hypotheses found, each pair of shared tags in at most one of them; deterministic."""
    found: list[Hypothesis] = []
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
            most = max(most, explanation.n_members)
    return found


def remove_tags(explanation: Hypothesis, tags: IntArray) -> Hypothesis:
    """Return the hypothesis without some tags."""
    members = explanation.members.copy()
    members[tags] = False
    return Hypothesis(members, explanation.linear, fit_members(explanation.linear, members))


def split_at_weak_links(fit: JointFit, explanation: Hypothesis) -> Iterator[Hypothesis]:
    """Yield both parts of its tags at each weak link: where maps are deformed, a part may have moved as one.

    Each weak edge of the minimum spanning tree of distance variances is cut in turn. A part has at least two tags.
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
                yield remove_tags(explanation, held[part == which])


def _n_draws(share: float) -> float:
    """Return the number of draws after which a pair within this share is missed with probability MISSED."""
    return log(MISS_PROBABILITY) / log(1.0 - share**2) if share > 0.0 else float("inf")


def _random_pairs(fit: JointFit) -> Iterator[tuple[int, int, bool]]:
    """Yield distinct pairs of tags in random order, and whether their distance agrees between the maps."""
    first, second = np.triu_indices(fit.n, 1)
    order = np.random.default_rng(_SEED).permutation(len(first))[:_MOST_DRAWS]
    first, second = first[order], second[order]
    length_a, variance_a = distances(fit.places_a, fit.covariance_a, first, second)
    length_b, variance_b = distances(fit.places_b, fit.covariance_b, first, second)
    fits = is_same_distance(length_a, length_b, variance_a + variance_b + 2.0 * fit.unmodelled_m2)
    return zip(first.tolist(), second.tolist(), fits.tolist(), strict=True)


def is_same_distance(length_a: FloatArray, length_b: FloatArray, variance: FloatArray) -> BoolArray:
    """Return (P,) whether a difference of variance (P,) is within chance, and small enough to give a heading."""
    shorter = np.minimum(length_a, length_b)
    same = (length_a - length_b) ** 2 < _DISTANCE_GATE * variance
    return np.asarray(same & (variance < (_MOST_RELATIVE_SIGMA * shorter) ** 2))


def distances(
    places: FloatArray, covariance: FloatArray, first: IntArray, second: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return (P,) distances between tags, and (P,) their variances, which a rotation of the map does not change."""
    base = places[second] - places[first]
    length = np.linalg.norm(base, axis=1)
    along = base / np.maximum(length, 1e-12)[:, None]
    blocks = covariance.reshape(len(places), 2, len(places), 2).transpose(0, 2, 1, 3)
    spread = blocks[first, first] + blocks[second, second] - blocks[first, second] - blocks[second, first]
    return length, np.maximum(np.einsum("pi,pij,pj->p", along, spread, along), 0.0)


def _grow(fit: JointFit, i: int, j: int) -> Hypothesis | None:
    """Grow a hypothesis from two tags outward, then test all tags again until nothing changes."""
    members = np.zeros(fit.n, dtype=np.bool_)
    members[[i, j]] = True
    tried = members.copy()
    pair = [i, j]
    bend = fit.point_without_errors(transform_from_two_tags(fit.places_a[pair], fit.places_b[pair]))
    for _ in range(_MOST_CHANGES):
        linear = fit.linearise(bend)
        held = fit_members(linear, members)
        bend = fit.retract(linear, held)
        worst = _worst(held, members)
        if worst is not None:
            members[worst] = False
            if members.sum() < 2:
                return None
            continue
        if tried.all():
            break
        off, spread = held.predict_others()
        size = np.where(tried, np.inf, np.trace(spread, axis1=1, axis2=2))
        following = size <= _NEXT_VARIANCE * size.min()
        tried |= following
        members |= following & (gate_ratio(off, spread) < 1.0)
    return refine_inliers(fit, bend, members)


def refine_inliers(fit: JointFit, bend: FitState, members: BoolArray) -> Hypothesis | None:
    """Add tags that fit and drop those that do not, until nothing changes; dropped tags do not return."""
    banned = np.zeros_like(members)
    for _ in range(_MOST_CHANGES):
        linear, held = fit.solve(bend, members)
        bend = linear.at
        worst = _worst(held, members)
        if worst is None and not held.is_consistent:
            worst = int(np.flatnonzero(members)[np.argmax(held.gate_ratios())])
        if worst is not None:
            members[worst] = False
            banned[worst] = True
            if members.sum() < 2:
                return None
            continue
        off, spread = held.predict_others()
        joining = ~members & ~banned & (gate_ratio(off, spread) < 1.0)
        if not joining.any():
            return Hypothesis(members, linear, held)
        members |= joining
    return None


def _worst(held: SubsetFit, members: BoolArray) -> int | None:
    """Return the tag that the others contradict most, if any is beyond the gate."""
    which = np.flatnonzero(members)
    if len(which) == 2:
        return None if held.is_consistent else int(which[0])
    misfits = held.gate_ratios()
    worst = int(np.argmax(misfits))
    return int(which[worst]) if misfits[worst] > 1.0 else None


def transform_from_two_tags(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return T_a_b from two tags (2, 2) in both maps, by their midpoints and directions."""
    (ax, ay), (bx, by) = a[1] - a[0], b[1] - b[0]
    turn = np.arctan2(ay, ax) - np.arctan2(by, bx)
    middle = a.mean(axis=0) - se2.apply([0.0, 0.0, turn], b.mean(axis=0))
    return np.array([middle[0], middle[1], float(se2.wrap_angle(turn))])
