"""How one local map lies in another, from the tags they share; or that this cannot be told, and why.

Hypotheses compare by their evidence: how much better they explain the shared tags than chance does. The best one is
sure if nothing else explains the tags almost as well.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import log, pi
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment.budget import UNLIMITED, AlignmentBudget
from groundsbot.offline.alignment.condensed_map import CondensedMap
from groundsbot.offline.alignment.joint_fit import JointFit
from groundsbot.offline.alignment.model_selection import CHANCE_NATS, HypothesisTest
from groundsbot.offline.alignment.ransac import Explanation, explanations, halves, refine_inliers, without
from groundsbot.offline.alignment.tag_gate import FALSE_ALARM
from groundsbot.offline.measurements import REACH_M, Placement, TagKey

# An alignment's covariance holds for other choices of tags as well, down to this much less likely: that costs width
# only, and a claim is wrong where the truth is beyond it.
_DOUBT_NATS: Final = log(1e4)
# Such choices are of so many tags fewer at most, and of each number so many.
_MOST_DOUBTED: Final = 6
_BEAM: Final = 12
_ROUNDING_NATS: Final = 1e-3
_AREA_M2: Final = REACH_M**2


@dataclass(frozen=True)
class Alignment:
    """Pose of frame b in frame a.

    Attributes:
        T_a_b: (3,)
        covariance: (3, 3) of its right tangent; each frame lies as its map's root has it.
        shared: the tags in both, sorted.
        inlier: (n_shared,) which of them lie where the others foretell them.
        off_m: (n_shared,) how far from there those lie that do not; off_sigmas: in sigmas.
        rmse_m: of the inliers, the maps taken as rigid.
        rise: by which the inliers raise the cost of a joint solve over the local ones, in squared sigmas: what chance
            explains, chi-square with 2 n - 3 degrees of freedom.
        evidence_nats: log of how much better it explains the tags than chance does.
        is_sure: it closes, nothing else explains the tags almost as well, and chance does not.
        rivals: what explains them almost as well.
    """

    T_a_b: FloatArray
    covariance: FloatArray
    shared: tuple[TagKey, ...]
    inlier: BoolArray
    off_m: FloatArray
    off_sigmas: FloatArray
    rmse_m: float
    rise: float
    evidence_nats: float
    is_sure: bool = False
    rivals: tuple["Alignment", ...] = ()

    @property
    def n_inliers(self) -> int:
        """How many shared tags fit."""
        return int(self.inlier.sum())

    @property
    def inliers(self) -> tuple[TagKey, ...]:
        """The tags that fit."""
        return tuple(tag for tag, fits in zip(self.shared, self.inlier, strict=True) if fits)

    @property
    def outliers(self) -> tuple[TagKey, ...]:
        """The tags that do not."""
        return tuple(tag for tag, fits in zip(self.shared, self.inlier, strict=True) if not fits)


def align(
    a: CondensedMap,
    b: CondensedMap,
    placement: Placement | None = None,
    effort: AlignmentBudget = UNLIMITED,
) -> Alignment | None:
    """The transform that explains the shared tags best, or None where no two of them fit together.

    Args:
        a: one map.
        b: the other.
        placement: what somebody measured of T_a_b, where the starts of both are.
        effort: what it may take.

    Raises:
        AlignmentTooLongError: it takes more.
    """
    shared = tuple(sorted(set(a.tags) & set(b.tags)))
    if len(shared) < 2:
        return None
    effort.begin()
    return _AlignmentChoice(a, b, shared, placement, effort).verdict()


class _AlignmentChoice(HypothesisTest):
    """Weighs what the shared tags of two maps say."""

    def __init__(
        self,
        a: CondensedMap,
        b: CondensedMap,
        shared: tuple[TagKey, ...],
        placement: Placement | None,
        effort: AlignmentBudget,
    ) -> None:
        self.fit = JointFit(a.tree(shared), b.tree(shared), effort=effort)
        super().__init__(self.fit.places_a, self.fit.places_b)
        self.shared = shared
        self.placement = placement
        self.frames = a.frame_covariance, b.frame_covariance

    def verdict(self) -> Alignment | None:
        explained = explanations(self.fit)
        if not explained:
            return None
        if not any(self._agrees(each) for each in explained):
            self.placement = None  # a slip of the tape or of the pen: it tells none of them from the others
        found = self._unite_groups(explained)
        evidence, best = found[0]
        groups = [each for _, each in found]
        found += self._drop_unneeded(evidence, best)
        for each in halves(self.fit, best):
            found.append((self.evidence(each), each))
            each.held.without_root()
        each_once = {each.members.tobytes(): (its, each) for its, each in found}
        found = sorted(each_once.values(), key=lambda f: -f[0])
        rivals: list[Explanation] = []
        for each in self.alternatives(best, found, groups):
            if not any(self.is_same_place(each, other) for other in rivals):
                rivals.append(each)
        told = tuple(self._alignment(rival, found, groups, (), is_sure=False) for rival in rivals)
        beats_chance = best.n == len(self.shared) or evidence > CHANCE_NATS
        return self._alignment(best, found, groups, told, is_sure=beats_chance and not rivals)

    def _drop_unneeded(self, evidence: float, best: Explanation) -> list[tuple[float, Explanation]]:
        """The best without tags that it gains little from, and with others that fit then.

        Several together too, as two wrong ones bear each other out.
        """
        found = last = [(evidence, best)]
        for _ in range(_MOST_DOUBTED):
            fewer: list[tuple[float, Explanation]] = []
            seen: set[bytes] = set()
            for its, each in last:
                if each.n < 3:
                    continue
                held = np.flatnonzero(each.members)
                most_nats = its - evidence + _DOUBT_NATS
                if each.n == len(self.shared) and self.placement is None:
                    # Nothing can join instead, and of what is left there are so many choices more.
                    most_nats -= log(each.n) - _ROUNDING_NATS
                for tag in held[each.held.log_likelihood_ratio() < most_nats]:
                    less = without(each, tag)
                    instead = less.joining & ~each.members
                    for other in (less, less.with_more(instead)) if instead.any() else (less,):
                        if (key := other.members.tobytes()) not in seen:
                            seen.add(key)
                            fewer.append((self.evidence(other), other))
                    fewer = self._likeliest(fewer, evidence - _DOUBT_NATS)
                each.held.without_root()
            last = fewer
            found = found + last
        for _, each in found:
            each.held.without_root()
        return found

    @staticmethod
    def _likeliest(found: list[tuple[float, Explanation]], least_nats: float) -> list[tuple[float, Explanation]]:
        return sorted((f for f in found if f[0] > least_nats), key=lambda f: -f[0])[:_BEAM]

    def _unite_groups(self, explained: Sequence[Explanation]) -> list[tuple[float, Explanation]]:
        """Best first: what was found, and what becomes of groups of tags far from each other that agree on the place.

        From two tags in one corner a tag in another is foretold too ill to be counted; with two there it is told.
        """
        found = {each.members.tobytes(): (self.evidence(each), each) for each in explained}
        tried: set[bytes] = set()
        while True:
            ranked = sorted(found.values(), key=lambda f: -f[0])
            for (its, one), (others, other) in combinations(ranked, 2):
                members = one.members | other.members
                if members.tobytes() in tried or members.tobytes() in found or not self.is_same_place(one, other):
                    continue
                tried.add(members.tobytes())
                together = refine_inliers(self.fit, one.linear.at, members)
                if together is None or together.members.tobytes() in found:
                    continue
                if (evidence := self.evidence(together)) > max(its, others):
                    found[together.members.tobytes()] = evidence, together
                    break
            else:
                return ranked

    def evidence(self, explanation: Explanation) -> float:
        """Log of the likelihood of the shared tags over that by chance, with what was measured."""
        return super().evidence(explanation) + self._evidence_of_placement(explanation)

    def _evidence_of_placement(self, explanation: Explanation) -> float:
        """Log likelihood of the measured placement over that of it being anywhere."""
        if self.placement is None:
            return 0.0
        off, covariance = self._from_placement(self.placement, explanation)
        square = float(off @ np.linalg.solve(covariance, off))
        log_determinant = float(np.linalg.slogdet(2.0 * pi * covariance)[1])
        return -0.5 * (square + log_determinant) + log(2.0 * pi * _AREA_M2)

    def _agrees(self, explanation: Explanation) -> bool:
        """Whether chance explains how far from the measured placement it puts map b."""
        if self.placement is None:
            return True
        off, covariance = self._from_placement(self.placement, explanation)
        return float(off @ np.linalg.solve(covariance, off)) < chi2.isf(FALSE_ALARM, 3)

    def _from_placement(self, placement: Placement, explanation: Explanation) -> tuple[FloatArray, FloatArray]:
        """How far off an explanation is (3,), and the covariance of that."""
        back = se2.adjoint(se2.inverse(placement.T_a_b))
        covariance = placement.covariance + self.covariance(explanation)
        covariance = covariance + back @ self.frames[0] @ back.T + self.frames[1]
        return se2.log(se2.between(placement.T_a_b, explanation.T_a_b)), covariance

    def _covering_covariance(
        self, explanation: Explanation, found: Sequence[tuple[float, Explanation]], groups: Sequence[Explanation]
    ) -> FloatArray:
        """(3, 3) of the right tangent of T_a_b, with the doubt of which tags fit.

        True whichever choice of tags is that puts the map in the same place, of those that are not 10,000 times less
        likely, tags that it leaves out as a group included; second moments about this one. A union of unions depends on
        their order, so this is that of the tags.
        """
        near = [(its, each) for its, each in found if self.is_same_place(each, explanation)]
        worth = [its + self.of_groups(each, [explanation, *groups], 0.0) for its, each in near]
        covering = self.covariance(explanation)
        for its, (_, each) in sorted(zip(worth, near, strict=True), key=lambda w: w[1][1].members.tobytes()):
            if its > max(worth) - _DOUBT_NATS:
                off = se2.log(se2.between(explanation.T_a_b, each.T_a_b))
                covering = covariance_union(covering, self.covariance(each) + np.outer(off, off))
        return covering

    def _alignment(
        self,
        explanation: Explanation,
        found: Sequence[tuple[float, Explanation]],
        groups: Sequence[Explanation],
        rivals: tuple[Alignment, ...],
        *,
        is_sure: bool,
    ) -> Alignment:
        off_m, squares = explanation.differences
        inlier = explanation.fits
        apart = self.fit.places_a[inlier] - se2.apply(explanation.T_a_b, self.fit.places_b[inlier])
        return Alignment(
            T_a_b=explanation.T_a_b,
            covariance=self._covering_covariance(explanation, found, groups),
            shared=self.shared,
            inlier=inlier,
            off_m=np.where(inlier, 0.0, np.linalg.norm(off_m, axis=1)),
            off_sigmas=np.where(inlier, 0.0, np.sqrt(squares)),
            rmse_m=float(np.sqrt((apart**2).sum(axis=1).mean())),
            rise=explanation.held.cost_increase,
            evidence_nats=self.evidence(explanation),
            is_sure=is_sure,
            rivals=rivals,
        )


def covariance_union(one: FloatArray, other: FloatArray) -> FloatArray:
    """The least covariance (n, n) that is no less than either, in axes in which both are diagonal.

    Uhlmann, "Covariance consistency methods for fault-tolerant distributed data fusion" (2003).
    """
    root = np.linalg.cholesky(one)
    back = np.linalg.inv(root)
    times, axes = np.linalg.eigh(back @ other @ back.T)
    axes = root @ axes
    union: FloatArray = (axes * np.maximum(times, 1.0)) @ axes.T
    return union
