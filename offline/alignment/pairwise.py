"""Align one local map with another by the tags they share, or find that the alignment is ambiguous, and why.

Hypotheses are compared by the log of their Bayes factor over chance. The best one is accepted if no alternative
explains the tags almost as well.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import log, pi
from typing import Final

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment.condensed_map import CondensedMap
from groundsbot.offline.alignment.joint_fit import JointFit
from groundsbot.offline.alignment.model_selection import CHANCE_NATS, HypothesisTest
from groundsbot.offline.alignment.ransac import (
    Hypothesis,
    find_hypotheses,
    refine_inliers,
    remove_tags,
    split_at_weak_links,
)
from groundsbot.offline.alignment.tag_gate import FALSE_ALARM
from groundsbot.offline.measurements import REACH_M, Placement, TagKey
from groundsbot.offline.sam import Budget

# The covariance of an alignment covers other choices of tags too, down to this much less likely: too wide a covariance
# is harmless, one that does not cover the truth is wrong.
_COVERED_NATS: Final = log(1e4)
# Such choices drop at most this many tags, and of each number this many are kept (beam search).
_MAX_DROPPED: Final = 6
_BEAM: Final = 12
_ROUNDING_NATS: Final = 1e-3
_AREA_M2: Final = REACH_M**2
# A pair takes at least 10 ms, whatever its tags; in units of the budget.
_A_PAIR: Final = 100e6


@dataclass(frozen=True)
class Alignment:
    """Pose of frame b in frame a.

    Attributes:
        T_a_b: (3,)
        covariance: (3, 3) of its right tangent; each frame is the one that its map's root carries.
        shared: the tags in both, sorted.
        inlier: (n_shared,) which of them are consistent with the prediction from the others.
        off_m: (n_shared,) distance of outliers from the prediction; off_sigmas: in sigmas.
        rmse_m: RMSE of the inliers, with rigid maps.
        cost_increase: of a joint solve over the local ones due to the inliers, in squared sigmas: chi-square with
            2 n - 3 degrees of freedom under the model.
        log_bayes_factor: log of its Bayes factor over chance.
        is_accepted: consistent, no alternative almost as likely, and more likely than chance.
        alternatives: others that explain the tags almost as well.
    """

    T_a_b: FloatArray
    covariance: FloatArray
    shared: tuple[TagKey, ...]
    inlier: BoolArray
    off_m: FloatArray
    off_sigmas: FloatArray
    rmse_m: float
    cost_increase: float
    log_bayes_factor: float
    is_accepted: bool = False
    alternatives: tuple["Alignment", ...] = ()

    @property
    def n_inliers(self) -> int:
        """Number of shared tags that fit."""
        return int(self.inlier.sum())

    @property
    def inliers(self) -> tuple[TagKey, ...]:
        """Tags that fit."""
        return tuple(tag for tag, fits in zip(self.shared, self.inlier, strict=True) if fits)

    @property
    def outliers(self) -> tuple[TagKey, ...]:
        """Tags that do not fit."""
        return tuple(tag for tag, fits in zip(self.shared, self.inlier, strict=True) if not fits)


def align(
    a: CondensedMap,
    b: CondensedMap,
    placement: Placement | None = None,
    budget: Budget | None = None,
) -> Alignment | None:
    """Return the most likely transform from the shared tags, or None where no two of them fit together.

    Args:
        a: one map.
        b: the other.
        placement: measured T_a_b between the starts.
        budget: computing budget of the alignment, shared by all pairs of maps; None: unlimited.

    Raises:
        BudgetSpentError: no work is left.
    """
    shared = tuple(sorted(set(a.tags) & set(b.tags)))
    if len(shared) < 2:
        return None
    budget = budget or Budget()
    budget.charge(_A_PAIR)
    return _AlignmentChoice(a, b, shared, placement, budget).align()


class _AlignmentChoice(HypothesisTest):
    """Compares hypotheses about the shared tags of two maps."""

    def __init__(
        self,
        a: CondensedMap,
        b: CondensedMap,
        shared: tuple[TagKey, ...],
        placement: Placement | None,
        budget: Budget,
    ) -> None:
        self.fit = JointFit(a.tree(shared), b.tree(shared), budget=budget)
        super().__init__(self.fit.places_a, self.fit.places_b)
        self.shared = shared
        self.placement = placement
        self.frames = a.frame_covariance, b.frame_covariance

    def align(self) -> Alignment | None:
        explained = find_hypotheses(self.fit)
        if not explained:
            return None
        if not any(self._agrees(each) for each in explained):
            self.placement = None  # a wrong measurement: it does not discriminate between hypotheses
        found = self._unite_groups(explained)
        evidence, best = found[0]
        groups = [each for _, each in found]
        found += self._drop_unneeded(evidence, best)
        for each in split_at_weak_links(self.fit, best):
            found.append((self.log_bayes_factor(each), each))
            each.solution.free_root()
        each_once = {each.members.tobytes(): (its, each) for its, each in found}
        found = sorted(each_once.values(), key=lambda f: -f[0])
        rivals: list[Hypothesis] = []
        for each in self.alternatives(best, found, groups):
            if not any(self.is_same_place(each, other) for other in rivals):
                rivals.append(each)
        alternatives = tuple(self._alignment(rival, found, groups, (), is_sure=False) for rival in rivals)
        beats_chance = best.n_members == len(self.shared) or evidence > CHANCE_NATS
        return self._alignment(best, found, groups, alternatives, is_sure=beats_chance and not rivals)

    def _drop_unneeded(self, evidence: float, best: Hypothesis) -> list[tuple[float, Hypothesis]]:
        """Return the best hypothesis with weakly supported tags dropped, and others that then fit.

        Several tags are dropped together too, since two wrong ones support each other.
        """
        found = last = [(evidence, best)]
        for _ in range(_MAX_DROPPED):
            fewer: list[tuple[float, Hypothesis]] = []
            seen: set[bytes] = set()
            for its, each in last:
                if each.n_members < 3:
                    continue
                held = np.flatnonzero(each.members)
                most_nats = its - evidence + _COVERED_NATS
                if each.n_members == len(self.shared) and self.placement is None:
                    # No other tag can join, and the prior over choices of the remaining tags is lower.
                    most_nats -= log(each.n_members) - _ROUNDING_NATS
                for tag in held[each.solution.log_likelihood_ratio() < most_nats]:
                    less = remove_tags(each, tag)
                    instead = less.candidates & ~each.members
                    for other in (less, less.add_tags(instead)) if instead.any() else (less,):
                        if (key := other.members.tobytes()) not in seen:
                            seen.add(key)
                            fewer.append((self.log_bayes_factor(other), other))
                    fewer = self._most_likely(fewer, evidence - _COVERED_NATS)
                each.solution.free_root()
            last = fewer
            found = found + last
        for _, each in found:
            each.solution.free_root()
        return found

    @staticmethod
    def _most_likely(found: list[tuple[float, Hypothesis]], least_nats: float) -> list[tuple[float, Hypothesis]]:
        return sorted((f for f in found if f[0] > least_nats), key=lambda f: -f[0])[:_BEAM]

    def _unite_groups(self, explained: Sequence[Hypothesis]) -> list[tuple[float, Hypothesis]]:
        """Return hypotheses, best first, with unions of those that agree on the pose.

        From two tags in one corner a far tag is predicted too uncertainly to join; two tags there determine it.
        """
        found = {each.members.tobytes(): (self.log_bayes_factor(each), each) for each in explained}
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
                if (evidence := self.log_bayes_factor(together)) > max(its, others):
                    found[together.members.tobytes()] = evidence, together
                    break
            else:
                return ranked

    def log_bayes_factor(self, explanation: Hypothesis) -> float:
        """Return the log Bayes factor over chance, with the measured placement."""
        return super().log_bayes_factor(explanation) + self._placement_log_bayes_factor(explanation)

    def _placement_log_bayes_factor(self, explanation: Hypothesis) -> float:
        """Return the log likelihood of the measured placement over that of a uniform one."""
        if self.placement is None:
            return 0.0
        off, covariance = self._from_placement(self.placement, explanation)
        square = float(off @ np.linalg.solve(covariance, off))
        log_determinant = float(np.linalg.slogdet(2.0 * pi * covariance)[1])
        return -0.5 * (square + log_determinant) + log(2.0 * pi * _AREA_M2)

    def _agrees(self, explanation: Hypothesis) -> bool:
        """Return whether the hypothesis is consistent with the measured placement."""
        if self.placement is None:
            return True
        off, covariance = self._from_placement(self.placement, explanation)
        return float(off @ np.linalg.solve(covariance, off)) < float(chdtri(3, FALSE_ALARM))

    def _from_placement(self, placement: Placement, explanation: Hypothesis) -> tuple[FloatArray, FloatArray]:
        """Return the deviation (3,) of a hypothesis from the measured placement, and its covariance."""
        back = se2.adjoint(se2.inverse(placement.T_a_b))
        covariance = placement.covariance + self.covariance(explanation)
        covariance = covariance + back @ self.frames[0] @ back.T + self.frames[1]
        return se2.log(se2.between(placement.T_a_b, explanation.T_a_b)), covariance

    def _covering_covariance(
        self, explanation: Hypothesis, found: Sequence[tuple[float, Hypothesis]], groups: Sequence[Hypothesis]
    ) -> FloatArray:
        """Return the covariance (3, 3) of the right tangent of T_a_b, with the uncertainty of which tags fit.

        It covers every choice of tags with the same pose that is at most 10,000 times less likely, also choices that
        leave tags out as a group; second moments are about this one. Repeated covariance unions depend on their order,
        so they are taken in the order of the tags.
        """
        near = [(its, each) for its, each in found if self.is_same_place(each, explanation)]
        worth = [its + self.log_bayes_factor_of_groups(each, [explanation, *groups], 0.0) for its, each in near]
        covering = self.covariance(explanation)
        for its, (_, each) in sorted(zip(worth, near, strict=True), key=lambda w: w[1][1].members.tobytes()):
            if its > max(worth) - _COVERED_NATS:
                off = se2.log(se2.between(explanation.T_a_b, each.T_a_b))
                covering = covariance_union(covering, self.covariance(each) + np.outer(off, off))
        return covering

    def _alignment(
        self,
        explanation: Hypothesis,
        found: Sequence[tuple[float, Hypothesis]],
        groups: Sequence[Hypothesis],
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
            cost_increase=explanation.solution.cost_increase,
            log_bayes_factor=self.log_bayes_factor(explanation),
            is_accepted=is_sure,
            alternatives=rivals,
        )


def covariance_union(one: FloatArray, other: FloatArray) -> FloatArray:
    """Return the least covariance (n, n) that is no less than either, in axes in which both are diagonal.

    Uhlmann, "Covariance consistency methods for fault-tolerant distributed data fusion" (2003).
    """
    root = np.linalg.cholesky(one)
    back = np.linalg.inv(root)
    times, axes = np.linalg.eigh(back @ other @ back.T)
    axes = root @ axes
    union: FloatArray = (axes * np.maximum(times, 1.0)) @ axes.T
    return union
