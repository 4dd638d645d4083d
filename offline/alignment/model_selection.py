"""Which explanations of some shared tags leave it open which of them is true: a comparison of models by evidence.

A shared tag is where it was, or it is of one group that moved as one (a shelf), or it was moved on its own. An
explanation names the tags that are where they were; what it is worth is its evidence, and that of groups among the
rest, where these rather moved as one than each alone. Whether a group moved or all the others did, no likelihood
tells: both say the same of every tag. There the larger group stayed, if it is so many times larger.

Evidence is held against chance: that one tag is where it was at most, and the others are wrong, each where it happens
to be. There map b may have any heading about the one tag, and of all headings the typical one counts (the geometric
mean): a heading about which others fit is an explanation of its own.
"""

from collections.abc import Sequence
from math import lgamma, log, pi
from typing import Final

import numpy as np
from scipy.special import logsumexp
from scipy.stats import chi2

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment.condensed_map import rotate_quarter
from groundsbot.offline.alignment.joint_fit import LinearisedFit, SubsetFit, hold
from groundsbot.offline.alignment.ransac import Explanation, without
from groundsbot.offline.alignment.tag_gate import FALSE_ALARM, log_wrong

# Sure is what explains the tags a hundred times better than anything else. Hardly any comes near: of 214 trials of
# `tests.benchmarks.trust.alignment_study` none was between this and 10,000 times.
MARGIN_NATS: Final = log(100.0)
# And so many times better than chance, of which less is known than of anything that tags say.
CHANCE_NATS: Final = log(1e4)
# Of two groups that may each have moved as one the larger one stayed if it has this many times the tags of the other.
GROUP_MARGIN: Final = 2.0
# For one group that moved as one there are so many cases in which each tag moved on its own.
_GROUP_PRIOR_NATS: Final = log(100.0)


class HypothesisTest:
    """Weighs explanations of some shared tags against each other."""

    def __init__(self, places_a: FloatArray, places_b: FloatArray) -> None:
        """Args: places_a, places_b: (n, 2) in each map's own frame."""
        self.n_shared = len(places_a)
        self._chance_nats = chance_nats(places_a, places_b)
        # By linearisation, which its explanation keeps alive, and tags.
        self._group_nats: dict[tuple[int, bytes], float] = {}

    def evidence(self, explanation: Explanation) -> float:
        """Log of the likelihood of the shared tags over that by chance; any number of them may fit alike."""
        log_wrong_ones = float(explanation.log_wrong[~explanation.members].sum())
        log_choices = _log_choices(self.n_shared, explanation.n)
        return _fits_nats(explanation.held) + log_wrong_ones - log_choices - self._chance_nats

    def alternatives(
        self, best: Explanation, found: Sequence[tuple[float, Explanation]], groups: Sequence[Explanation]
    ) -> list[Explanation]:
        """What leaves it open that the best is true.

        Args:
            best: explanation.
            found: others and their evidence, itself perhaps among them.
            groups: tags of these may have moved as one.
        """
        evidence = self.evidence(best)
        best_worth = self._log_likelihood_ratio(best, groups)
        rivals = []
        for its, other in found:
            is_alike = its > evidence - MARGIN_NATS
            # Outnumbered, it may explain them as well: then the tags of the best would have moved as one.
            if not is_alike and best.n >= GROUP_MARGIN * other.n:
                continue
            if self.is_same_place(other, best) and not self._has_separate_group(other, best):
                continue
            worth = self._log_likelihood_ratio(other, groups)
            # What fits both may be of either group, unless the rest is outnumbered: then those did not stay.
            n_own = int((other.members & ~best.members).sum())
            if n_own > 1 and best.n < GROUP_MARGIN * n_own:
                own = without(other, np.flatnonzero(other.members & best.members))
                worth = max(worth, self._log_likelihood_ratio(own, groups))
            if is_alike or worth > best_worth - MARGIN_NATS:
                rivals.append(other)
        return rivals

    def _log_likelihood_ratio(self, explanation: Explanation, groups: Sequence[Explanation]) -> float:
        """Its evidence, with that of groups among the rest where this is more than such a group is rare."""
        return self.evidence(explanation) + self.of_groups(explanation, groups, _GROUP_PRIOR_NATS)

    def _has_separate_group(self, other: Explanation, best: Explanation) -> bool:
        """Whether tags that do not fit the best rather moved as one than each alone: they may be what stayed."""
        own = other.members & ~best.members
        if (own & ~best.fits).sum() < 2:
            return False
        return self._as_group(best, other.linear, own, self.n_shared) > 0.0

    def of_groups(self, explanation: Explanation, groups: Sequence[Explanation], rare_nats: float) -> float:
        """Evidence that tags that it does not explain moved in groups, over that each did alone; 0 if less.

        One group after the other, the most telling first, less how rare a group is: taken for so many tags on their
        own, a second group would count by how far off it is as often as it has tags.
        """
        rest, evidence = ~explanation.members, 0.0
        while True:
            moved = [(each.linear, each.members & rest) for each in groups]
            worth = [
                (self._as_group(explanation, linear, tags, int(rest.sum())), i)
                for i, (linear, tags) in enumerate(moved)
                if tags.sum() > 1
            ]
            most, i = max(worth, default=(0.0, 0))
            if most <= rare_nats:
                return evidence
            evidence += most - rare_nats
            rest = rest & ~moved[i][1]

    def _as_group(self, explanation: Explanation, linear: LinearisedFit, tags: BoolArray, n: int) -> float:
        """Evidence that these tags, of n that may have moved, did so as one, over that each did alone.

        Any of them went somewhere as a tag alone does, and turned anyhow; the others went along.
        """
        key = id(linear), tags.tobytes()
        if key not in self._group_nats:
            self._group_nats[key] = _fits_nats(hold(linear, tags))
        log_alone = explanation.log_wrong[tags]
        log_motion = float(logsumexp(log_alone)) - log(len(log_alone)) - log(2.0 * pi)
        return self._group_nats[key] + log_motion - float(log_alone.sum()) - _log_choices(n, len(log_alone))

    def is_same_place(self, one: Explanation, other: Explanation) -> bool:
        """Whether chance explains how far apart they put the other map."""
        off = se2.log(se2.between(one.T_a_b, other.T_a_b))
        covariance = self.covariance(one) + self.covariance(other)
        return float(off @ np.linalg.solve(covariance, off)) < chi2.isf(FALSE_ALARM, 3)

    def covariance(self, explanation: Explanation) -> FloatArray:
        """(3, 3) of the right tangent of T_a_b."""
        by_motion = np.eye(3)
        by_motion[:2, 2] = -rotate_quarter(explanation.linear.centre)
        by_motion = se2.adjoint(se2.inverse(explanation.T_a_b)) @ by_motion
        covariance: FloatArray = by_motion @ explanation.held.motion_covariance() @ by_motion.T
        return covariance


def _fits_nats(held: SubsetFit) -> float:
    """Log likelihood of the tags held, over all transforms: the integral by m, m and rad."""
    log_likelihood = -0.5 * (held.cost_increase + held.log_determinant + len(held.rows) * log(2.0 * pi))
    return log_likelihood + 0.5 * (3.0 * log(2.0 * pi) - float(np.linalg.slogdet(held.information)[1]))


def _log_choices(n: int, k: int) -> float:
    return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)


def chance_nats(places_a: FloatArray, places_b: FloatArray) -> float:
    """Log likelihood of tags at these places (n, 2) where none fits, or one, over all transforms as in `_fits_nats`.

    With u and v how far another tag is from the one that fits, in both maps, it is off by r^2 = u^2 + v^2 - 2 u v
    cos(phi) at a heading phi, and the mean of log r^2 over all headings is log max(u^2, v^2) (Jensen's formula). That
    none fits is as likely as that one does: any tag is somewhere, and the others are about as far off as from there.
    """
    n = len(places_a)
    u2, v2 = (((p[:, None] - p) ** 2).sum(axis=2) for p in (places_a, places_b))
    log_each = log_wrong(np.maximum(u2, v2))
    np.fill_diagonal(log_each, 0.0)
    return float(logsumexp(log_each.sum(axis=1))) - log(n) + log(2.0 * pi) + log(2.0)
