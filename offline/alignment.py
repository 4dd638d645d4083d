"""How one local map lies in another, from the tags they share; or that this cannot be told, and why.

Hypotheses compare by their evidence: how much better they explain the shared tags than chance does. The best one is
sure if nothing else explains the tags almost as well.
"""

from dataclasses import dataclass
from math import lgamma, log, pi
from typing import Final

import numpy as np
from scipy.stats import chi2

from calib import se2
from calib.arrays import BoolArray, FloatArray
from offline.alignment_search import Explanation, explanations, settled
from offline.condensed import CondensedMap, quarter_turned
from offline.joint_fit import FALSE_ALARM, REACH_M, JointFit, hold
from offline.measured import Placement
from offline.run import TagKey

# Sure is what explains the tags a hundred times better than anything else, chance included.
MARGIN_NATS: Final = log(100.0)
# Tags that moved together fit together, whichever of two groups they are: no likelihood tells which one stayed. The
# larger one did if it has this many times the tags of the other.
GROUP_MARGIN: Final = 2.0
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


def align(a: CondensedMap, b: CondensedMap, placement: Placement | None = None) -> Alignment | None:
    """The transform that explains the shared tags best, or None where no two of them fit together.

    Args:
        a: one map.
        b: the other.
        placement: what somebody measured of T_a_b, where the starts of both are.
    """
    shared = tuple(sorted(set(a.tags) & set(b.tags)))
    if len(shared) < 2:
        return None
    return _Judge(a, b, shared, placement).verdict()


class _Judge:
    """Weighs what the shared tags of two maps say."""

    def __init__(
        self, a: CondensedMap, b: CondensedMap, shared: tuple[TagKey, ...], placement: Placement | None
    ) -> None:
        self.fit = JointFit(a.tree(shared), b.tree(shared))
        self.shared = shared
        self.placement = placement
        self.frames = a.frame_covariance, b.frame_covariance

    def verdict(self) -> Alignment | None:
        explained = explanations(self.fit)
        if not explained:
            return None
        if not any(self._agrees(each) for each in explained):
            self.placement = None  # a slip of the tape or of the pen: it tells none of them from the others
        found = sorted(((self.evidence(each), each) for each in explained), key=lambda f: -f[0])
        evidence, best = self._united(found)
        rivals = [each for its, each in found if self._is_rival(its, each, evidence, best)]
        told = tuple(self._told(rival, (), is_sure=False) for rival in rivals)
        beats_chance = best.n == len(self.shared) or evidence > MARGIN_NATS
        return self._told(best, told, is_sure=beats_chance and not rivals)

    def _united(self, found: list[tuple[float, Explanation]]) -> tuple[float, Explanation]:
        """The best, joined by others that have map b at the same place: groups of tags far from each other."""
        evidence, best = found[0]
        for _, other in found[1:]:
            if self._is_same_place(other, best) and (other.members & ~best.members).any():
                together = settled(self.fit, best.linear.at, best.members | other.members)
                if together is not None and self.evidence(together) > evidence:
                    evidence, best = self.evidence(together), together
        return evidence, best

    def evidence(self, explanation: Explanation) -> float:
        """Log of the likelihood of the shared tags over that of all being wrong.

        A wrong tag is anywhere in reach, and so is map b where no tag fits, its heading anything; how many tags fit may
        be any number, and which of them any choice.
        """
        held, n, k = explanation.held, len(self.shared), explanation.n
        log_likelihood = -0.5 * (held.rise + held.log_determinant + 2 * k * log(2.0 * pi))
        # Over all transforms, each as likely as any other.
        log_likelihood += 0.5 * (3.0 * log(2.0 * pi) - float(np.linalg.slogdet(held.information)[1]))
        log_likelihood -= log(2.0 * pi * _AREA_M2)
        log_choices = lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)
        return log_likelihood + k * log(_AREA_M2) - log_choices + self._evidence_of_placement(explanation)

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
        covariance = placement.covariance + self._covariance(explanation)
        covariance = covariance + back @ self.frames[0] @ back.T + self.frames[1]
        return se2.log(se2.between(placement.T_a_b, explanation.T_a_b)), covariance

    def _is_rival(self, evidence: float, other: Explanation, best_evidence: float, best: Explanation) -> bool:
        if evidence > best_evidence - MARGIN_NATS and not self._is_same_place(other, best):
            return True
        own, best_own = other.members & ~best.fits, best.members & ~other.fits
        if own.sum() < 2 or best_own.sum() >= GROUP_MARGIN * own.sum():
            return False
        # A group that fits together better than chance would have it moved as one, whatever the numbers say.
        return self.evidence(Explanation(own, other.linear, hold(other.linear, own))) > MARGIN_NATS

    def _is_same_place(self, one: Explanation, other: Explanation) -> bool:
        off = se2.log(se2.between(one.T_a_b, other.T_a_b))
        covariance = self._covariance(one) + self._covariance(other)
        return float(off @ np.linalg.solve(covariance, off)) < chi2.isf(FALSE_ALARM, 3)

    def _covariance(self, explanation: Explanation) -> FloatArray:
        """(3, 3) of the right tangent of T_a_b."""
        by_motion = np.eye(3)
        by_motion[:2, 2] = -quarter_turned(explanation.linear.centre)
        by_motion = se2.adjoint(se2.inverse(explanation.T_a_b)) @ by_motion
        covariance: FloatArray = by_motion @ explanation.held.motion_covariance() @ by_motion.T
        return covariance

    def _told(self, explanation: Explanation, rivals: tuple[Alignment, ...], *, is_sure: bool) -> Alignment:
        off_m, squares = explanation.differences
        inlier = explanation.fits
        apart = self.fit.places_a[inlier] - se2.apply(explanation.T_a_b, self.fit.places_b[inlier])
        return Alignment(
            T_a_b=explanation.T_a_b,
            covariance=self._covariance(explanation),
            shared=self.shared,
            inlier=inlier,
            off_m=np.where(inlier, 0.0, np.linalg.norm(off_m, axis=1)),
            off_sigmas=np.where(inlier, 0.0, np.sqrt(squares)),
            rmse_m=float(np.sqrt((apart**2).sum(axis=1).mean())),
            rise=explanation.held.rise,
            evidence_nats=self.evidence(explanation),
            is_sure=is_sure,
            rivals=rivals,
        )


def fit_transform(a: FloatArray, b: FloatArray) -> FloatArray:
    """T_a_b (3,) that brings points b (n, 2) onto a (n, 2) in least squares, without scale.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns" (1991), in the plane.
    """
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    from_a, from_b = a - centre_a, b - centre_b
    dot = (from_a * from_b).sum()
    cross = (from_b[:, 0] * from_a[:, 1] - from_b[:, 1] * from_a[:, 0]).sum()
    turn = np.array([0.0, 0.0, np.arctan2(cross, dot)])
    translation = centre_a - se2.apply(turn, centre_b)
    return np.array([translation[0], translation[1], turn[2]])
