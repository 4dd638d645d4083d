"""Which explanations of some shared tags leave it open which of them is true: a comparison of models by evidence.

A shared tag is where it was, or it is of one group that moved as one (a shelf), or it was moved on its own. An
explanation names the tags that are where they were; what it is worth is its evidence, and that of the best group among
the rest, where these rather moved as one than each alone. Whether a group moved or all the others did, no likelihood
tells: both say the same of every tag. There the larger group stayed, if it is so many times larger.
"""

from collections.abc import Sequence
from math import lgamma, log, pi
from typing import Final

import numpy as np
from scipy.stats import chi2

from calib import se2
from calib.arrays import BoolArray, FloatArray
from offline.alignment_search import Explanation, without
from offline.condensed import quarter_turned
from offline.joint_fit import FALSE_ALARM, REACH_M, Held, hold

# Sure is what explains the tags a hundred times better than anything else, chance included.
MARGIN_NATS: Final = log(100.0)
# Of two groups that may each have moved as one the larger one stayed if it has this many times the tags of the other.
GROUP_MARGIN: Final = 2.0
# For one group that moved as one there are so many cases in which each tag moved on its own.
_GROUP_PRIOR_NATS: Final = log(100.0)
_AREA_M2: Final = REACH_M**2


class Rivalry:
    """Weighs explanations of some shared tags against each other."""

    def __init__(self, n_shared: int) -> None:
        """Of so many."""
        self.n_shared = n_shared

    def evidence(self, explanation: Explanation) -> float:
        """Log of the likelihood of the shared tags over that of all being wrong."""
        return evidence_nats(explanation.held, self.n_shared)

    def rivals(
        self, best: Explanation, found: Sequence[tuple[float, Explanation]], groups: Sequence[Explanation]
    ) -> list[Explanation]:
        """What leaves it open that the best is true.

        Args:
            best: explanation.
            found: others and their evidence, itself perhaps among them.
            groups: tags of these may have moved as one.
        """
        evidence = self.evidence(best)
        best_worth = evidence + self.of_group(best, groups)
        rivals = []
        for its, other in found:
            is_alike = its > evidence - MARGIN_NATS
            # Outnumbered, it may explain them as well: then the tags of the best would have moved as one.
            if not is_alike and best.n >= GROUP_MARGIN * other.n:
                continue
            if self.is_same_place(other, best) and not self._has_group_of_its_own(other, best):
                continue
            worth = its + self.of_group(other, groups)
            # What fits both may be of either group, unless the rest is outnumbered: then those did not stay.
            n_own = int((other.members & ~best.members).sum())
            if n_own > 1 and best.n < GROUP_MARGIN * n_own:
                own = without(other, np.flatnonzero(other.members & best.members))
                worth = max(worth, self.evidence(own) + self.of_group(own, groups))
            if is_alike or worth > best_worth - MARGIN_NATS:
                rivals.append(other)
        return rivals

    def _has_group_of_its_own(self, other: Explanation, best: Explanation) -> bool:
        """Whether tags that do not fit the best rather moved as one than each alone: they may be what stayed."""
        own = other.members & ~best.members
        if (own & ~best.fits).sum() < 2:
            return False
        return evidence_nats(hold(other.linear, own), self.n_shared) > 0.0

    def of_group(self, explanation: Explanation, groups: Sequence[Explanation]) -> float:
        """Evidence that some tags that it does not explain moved as one, over that each did alone; 0 if less."""
        rest = ~explanation.members
        return max([0.0, *(_as_group(each, each.members & rest, int(rest.sum())) for each in groups)])

    def is_same_place(self, one: Explanation, other: Explanation) -> bool:
        """Whether chance explains how far apart they put the other map."""
        off = se2.log(se2.between(one.T_a_b, other.T_a_b))
        covariance = self.covariance(one) + self.covariance(other)
        return float(off @ np.linalg.solve(covariance, off)) < chi2.isf(FALSE_ALARM, 3)

    def covariance(self, explanation: Explanation) -> FloatArray:
        """(3, 3) of the right tangent of T_a_b."""
        by_motion = np.eye(3)
        by_motion[:2, 2] = -quarter_turned(explanation.linear.centre)
        by_motion = se2.adjoint(se2.inverse(explanation.T_a_b)) @ by_motion
        covariance: FloatArray = by_motion @ explanation.held.motion_covariance() @ by_motion.T
        return covariance


def _as_group(explanation: Explanation, tags: BoolArray, n: int) -> float:
    """Evidence that these of its tags, of n that may have moved, did so as one, over that each did alone."""
    if tags.sum() < 2:
        return 0.0
    return evidence_nats(hold(explanation.linear, tags), n) - _GROUP_PRIOR_NATS


def evidence_nats(held: Held, n: int) -> float:
    """Log of the likelihood of n shared tags, of which some fit, over that of all being wrong.

    A wrong tag is anywhere in reach, and so is map b where no tag fits, its heading anything; how many tags fit may be
    any number, and which of them any choice.
    """
    k = len(held.rows) // 2
    log_likelihood = -0.5 * (held.rise + held.log_determinant + 2 * k * log(2.0 * pi))
    # Over all transforms, each as likely as any other.
    log_likelihood += 0.5 * (3.0 * log(2.0 * pi) - float(np.linalg.slogdet(held.information)[1]))
    log_likelihood -= log(2.0 * pi * _AREA_M2)
    log_choices = lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)
    return log_likelihood + k * log(_AREA_M2) - log_choices
