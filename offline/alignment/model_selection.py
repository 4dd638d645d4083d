"""Bayesian comparison of alternative hypotheses of which shared tags are unchanged.

A shared tag is where it was, or it belongs to a group that moved as one (a shelf), or it was moved alone. A hypothesis
names the unchanged tags. It is compared by its marginal likelihood (evidence), including groups among the other tags
where they more likely moved as one than each alone. Whether a group moved or all others did is not observable: both
predict the same. There the larger group is taken as unchanged, if it is larger by a given factor.

The null hypothesis is chance: at most one tag is unchanged, and the others are wrong, each where it happens to be. Then
map b may have any heading about the one tag, and the typical heading counts (the geometric mean of the likelihood): a
heading at which others fit is a hypothesis of its own.
"""

from collections.abc import Sequence
from math import lgamma, log, pi
from typing import Final

import numpy as np
from scipy.special import chdtri, logsumexp

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment.condensed_map import rotate_quarter
from groundsbot.offline.alignment.joint_fit import LinearisedFit, SubsetFit, fit_members
from groundsbot.offline.alignment.ransac import Hypothesis, remove_tags
from groundsbot.offline.alignment.tag_gate import FALSE_ALARM, log_outlier_density

# A hypothesis is accepted if it is a hundred times as likely as any alternative. Few are near this bound: of 214 trials
# of `tests.benchmarks.trust.alignment_study` none was between this and 10,000 times.
MARGIN_NATS: Final = log(100.0)
# The factor over chance is larger, since the model of chance is cruder than that of tags.
CHANCE_NATS: Final = log(1e4)
# Of two groups that may each have moved as one, the larger is unchanged if it has this many times the other's tags.
GROUP_MARGIN: Final = 2.0
# Prior odds of tags that each moved alone over a group that moved as one.
_GROUP_PRIOR_NATS: Final = log(100.0)


class HypothesisTest:
    """Compares alternative hypotheses about some shared tags."""

    def __init__(self, places_a: FloatArray, places_b: FloatArray) -> None:
        """Args: places_a, places_b: (n, 2) tag positions in each map's own frame."""
        self.n_shared = len(places_a)
        self._chance_nats = log_chance_likelihood(places_a, places_b)
        # Key: id of the linearisation, which its hypothesis keeps alive, and the tags.
        self._group_nats: dict[tuple[int, bytes], float] = {}

    def log_bayes_factor(self, explanation: Hypothesis) -> float:
        """Return the log Bayes factor over chance; any number of tags is a priori equally likely to be unchanged."""
        log_wrong_ones = float(explanation.log_outlier_density[~explanation.members].sum())
        log_choices = _log_choices(self.n_shared, explanation.n_members)
        return _log_marginal_likelihood(explanation.solution) + log_wrong_ones - log_choices - self._chance_nats

    def alternatives(
        self, best: Hypothesis, found: Sequence[tuple[float, Hypothesis]], groups: Sequence[Hypothesis]
    ) -> list[Hypothesis]:
        """Return the alternatives that leave it open whether the best hypothesis is true.

        Args:
            best: hypothesis.
            found: hypotheses with their evidence; may include the best.
            groups: hypotheses whose tags may have moved as one.
        """
        evidence = self.log_bayes_factor(best)
        best_worth = self._log_likelihood_ratio(best, groups)
        rivals = []
        for its, other in found:
            is_alike = its > evidence - MARGIN_NATS
            # With far fewer tags it may explain them as well if the tags of the best moved as one.
            if not is_alike and best.n_members >= GROUP_MARGIN * other.n_members:
                continue
            if self.is_same_place(other, best) and not self._has_separate_group(other, best):
                continue
            worth = self._log_likelihood_ratio(other, groups)
            # Tags that fit both may be of either group, unless the rest is outnumbered: then those tags moved.
            n_own = int((other.members & ~best.members).sum())
            if n_own > 1 and best.n_members < GROUP_MARGIN * n_own:
                own = remove_tags(other, np.flatnonzero(other.members & best.members))
                worth = max(worth, self._log_likelihood_ratio(own, groups))
            if is_alike or worth > best_worth - MARGIN_NATS:
                rivals.append(other)
        return rivals

    def _log_likelihood_ratio(self, explanation: Hypothesis, groups: Sequence[Hypothesis]) -> float:
        """Return its evidence plus that of groups among the other tags, where it exceeds a group's prior odds."""
        return self.log_bayes_factor(explanation) + self.log_bayes_factor_of_groups(
            explanation, groups, _GROUP_PRIOR_NATS
        )

    def _has_separate_group(self, other: Hypothesis, best: Hypothesis) -> bool:
        """Return whether tags that contradict the best more likely moved as one than alone: they may be unchanged."""
        own = other.members & ~best.members
        if (own & ~best.fits).sum() < 2:
            return False
        return self._log_bayes_factor_of_group(best, other.linear, own, self.n_shared) > 0.0

    def log_bayes_factor_of_groups(
        self, explanation: Hypothesis, groups: Sequence[Hypothesis], rare_nats: float
    ) -> float:
        """Return the evidence that tags outside the hypothesis moved in groups rather than each alone; 0 if less.

        Groups are taken greedily, the strongest first, each less the prior odds against a group. Taken as tags on their
        own, a second group would count its distance once per tag.
        """
        rest, evidence = ~explanation.members, 0.0
        while True:
            moved = [(each.linear, each.members & rest) for each in groups]
            worth = [
                (self._log_bayes_factor_of_group(explanation, linear, tags, int(rest.sum())), i)
                for i, (linear, tags) in enumerate(moved)
                if tags.sum() > 1
            ]
            most, i = max(worth, default=(0.0, 0))
            if most <= rare_nats:
                return evidence
            evidence += most - rare_nats
            rest = rest & ~moved[i][1]

    def _log_bayes_factor_of_group(
        self, explanation: Hypothesis, linear: LinearisedFit, tags: BoolArray, n: int
    ) -> float:
        """Return the evidence that these tags, of n that may have moved, moved as one rather than each alone.

        One of them has the displacement of a tag moved alone and a uniform turn; the others follow.
        """
        key = id(linear), tags.tobytes()
        if key not in self._group_nats:
            self._group_nats[key] = _log_marginal_likelihood(fit_members(linear, tags))
        log_alone = explanation.log_outlier_density[tags]
        log_motion = float(logsumexp(log_alone)) - log(len(log_alone)) - log(2.0 * pi)
        return self._group_nats[key] + log_motion - float(log_alone.sum()) - _log_choices(n, len(log_alone))

    def is_same_place(self, one: Hypothesis, other: Hypothesis) -> bool:
        """Return whether two hypotheses place the other map within chance of each other."""
        off = se2.log(se2.between(one.T_a_b, other.T_a_b))
        covariance = self.covariance(one) + self.covariance(other)
        return float(off @ np.linalg.solve(covariance, off)) < float(chdtri(3, FALSE_ALARM))

    def covariance(self, explanation: Hypothesis) -> FloatArray:
        """Return the covariance (3, 3) of the right tangent of T_a_b."""
        by_motion = np.eye(3)
        by_motion[:2, 2] = -rotate_quarter(explanation.linear.centre)
        by_motion = se2.adjoint(se2.inverse(explanation.T_a_b)) @ by_motion
        covariance: FloatArray = by_motion @ explanation.solution.motion_covariance() @ by_motion.T
        return covariance


def _log_marginal_likelihood(held: SubsetFit) -> float:
    """Return the log marginal likelihood of the fitted tags, integrated over all transforms in m, m and rad."""
    log_likelihood = -0.5 * (held.cost_increase + held.log_determinant + len(held.rows) * log(2.0 * pi))
    return log_likelihood + 0.5 * (3.0 * log(2.0 * pi) - float(np.linalg.slogdet(held.information)[1]))


def _log_choices(n: int, k: int) -> float:
    return lgamma(n + 1) - lgamma(k + 1) - lgamma(n - k + 1)


def log_chance_likelihood(places_a: FloatArray, places_b: FloatArray) -> float:
    """Return the log likelihood of tags at positions (n, 2) under chance, over all transforms.

    With u and v the vectors from the unchanged tag to another in both maps, that tag is off by r^2 = u^2 + v^2 - 2 u v
    cos(phi) at a heading phi, and the mean of log r^2 over all headings is log max(u^2, v^2) (Jensen's formula). No
    unchanged tag is as likely as one: a tag is somewhere in any case, and the others are about as far off from there.
    """
    n = len(places_a)
    u2, v2 = (((p[:, None] - p) ** 2).sum(axis=2) for p in (places_a, places_b))
    log_each = log_outlier_density(np.maximum(u2, v2))
    np.fill_diagonal(log_each, 0.0)
    return float(logsumexp(log_each.sum(axis=1))) - log(n) + log(2.0 * pi) + log(2.0)
