"""Variances of the measurements, from what the estimate leaves over of them: restricted maximum likelihood.

The covariance of each factor is a sum of known matrices, each times a variance that many factors share. With P the
information that the residuals keep once the estimate has taken its share (P = S^-1 - S^-1 J H^-1 J^T S^-1), the
likelihood of the residuals has the score (r' S^-1 A S^-1 r - tr(P A)) / 2 and the average information f' P f / 2 with
f = A S^-1 r. Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal" (1971);
Gilmour, Thompson and Cullis, "Average information REML" (1995). The trace is an average over signs of its smaller part,
that of the share taken (Hutchinson, 1989); signs that cancel between neighbours, where most of the share is (Bekas,
Kokiopoulou and Saad, "An estimator for the diagonal of a matrix", 2007), need to be no more than sixteen.

Sigmas are searched by their logarithm, each with a wide prior about where it began: what the data cannot tell stays.
From afar the information says little; there each variance is multiplied by what is left over for it, as a share of what
should be (Helmert's method of 1907, as in Förstner and Wrobel, "Photogrammetric Computer Vision", 2016, 4.2.4).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.offline.noise.likelihood import Good, Looker, Part
from groundsbot.offline.sam import Solution

# Of a logarithm of sigma: a factor of ten either way is one such sigma.
PRIOR_SIGMA: Final = float(np.log(10.0))
_MAX_ITERATIONS: Final = 12
# As many squares as that leave a sigma uncertain by a third.
LEAST_REDUNDANCY: Final = 5.0
_CONTRADICTED: Final = 3.0  # sigmas of the score
_LONGEST_STEP: Final = 1.2  # of a logarithm of sigma, by the information
_FAR: Final = 0.4  # of a logarithm of sigma: from there the information shows the way
_SMALL_STEP: Final = 0.05  # of its own standard deviation
_ENOUGH: Final = 0.1  # of that as well: what may be left after the last step
_STEPS_AFRESH: Final = 4


@dataclass(frozen=True)
class FittedVariances:
    """What the residuals say of K sigmas.

    Attributes:
        sigma: (K,)
        log_covariance: (K, K) of the logarithms, the prior included.
        redundancy: (K,) of how many squares of its own each sigma is the mean: one over twice the variance of its
            logarithm, the prior's share taken off.
        told: (K,) whether the data say enough of it; else it stands where it began, or where they are more content
            with if that is more, unless they speak against that.
        solutions: of the parts under these sigmas.
    """

    sigma: FloatArray
    log_covariance: FloatArray
    redundancy: FloatArray
    told: BoolArray
    solutions: tuple[Solution, ...]
    converged: bool

    def interval(self, quantile: float) -> tuple[FloatArray, FloatArray]:
        """Bounds (K,) between which each sigma lies, `quantile` normal deviations either way.

        Upwards of its logarithm, downwards of its square: beside other noise the square is what is estimated without
        bias and with an error that hardly depends on it, and only what comes out large is believed. By the logarithm
        nothing could come out too large by much.
        """
        spread = quantile * np.sqrt(np.diag(self.log_covariance))
        return self.sigma * np.sqrt(np.maximum(1.0 - 2.0 * spread, 0.0)), self.sigma * np.exp(spread)


def fit_variances(parts: Sequence[Part], sigma: FloatArray, least: FloatArray | None = None) -> FittedVariances:
    """Fits K sigmas to all parts at once, from `sigma` (K,), which is also the middle of the prior.

    Sigmas of which the data say next to nothing are put back up to where they began, unless the data speak against it.

    Args:
        parts: what the residuals are of.
        sigma: (K,) where to begin.
        least: (K,) below which no sigma is looked for.

    Raises:
        UnderDeterminedError: a part has something that nothing ties down.
    """
    search = _Search(parts, np.log(sigma), np.full(len(sigma), -np.inf) if least is None else np.log(least))
    search.look()
    converged = search.run(np.ones(len(sigma), dtype=np.bool_))
    fitted = search.log_sigma.copy()
    told = search.redundancy() >= LEAST_REDUNDANCY
    if not told.all():
        # Little is said of noise that is small beside other noise, so the larger of two values does no harm.
        search.log_sigma = np.where(told, fitted, np.maximum(fitted, search.middle))
        search.look()
        contradicted = -search.score > _CONTRADICTED * np.sqrt(2.0 * np.maximum(search.expected, 1e-300))
        if contradicted.any():
            search.log_sigma = np.where(contradicted, fitted, search.log_sigma)
            search.look()
        converged &= search.run(told)
    return FittedVariances(
        np.exp(search.log_sigma), search.covariance(), search.redundancy(), told, search.solutions, converged
    )


class _Search:
    """Newton's method on the logarithms of sigma.

    Attributes:
        score: (K,) and information: (K, K) of the likelihood where `look` looked last.
        squares: (K,) weighted squares that each sigma answers for there; expected: (K,) what they should be; at_most:
            (K,) what they would be if the estimate had taken nothing. Where sigmas are far too large, residuals that
            are far too small make the information far too small; what is expected does not depend on them.
    """

    def __init__(self, parts: Sequence[Part], log_sigma: FloatArray, least: FloatArray) -> None:
        self._parts = [Looker(part) for part in parts]
        self._least = least
        self.middle = log_sigma
        self.log_sigma = np.maximum(log_sigma, least)
        self.score = np.zeros(len(log_sigma))
        self.squares = np.zeros(len(log_sigma))
        self.expected = np.zeros(len(log_sigma))
        self.at_most = np.zeros(len(log_sigma))
        self.information = np.zeros((len(log_sigma), len(log_sigma)))
        self._good: list[Good] | None = None

    def look(self, *, afresh: bool = True) -> None:
        """Solves all parts under the sigmas as they are; what is a fault is looked at afresh or stays as it was."""
        good = self._good if self._good is not None and not afresh else [None] * len(self._parts)
        variances = np.exp(2.0 * self.log_sigma)
        seen = [part.look(variances, each) for part, each in zip(self._parts, good, strict=True)]
        self._good = [each.good for each in seen]
        self.squares = np.sum([each.squares for each in seen], axis=0)
        self.expected = np.sum([each.expected for each in seen], axis=0)
        self.at_most = np.sum([each.at_most for each in seen], axis=0)
        self.score = self.squares - self.expected
        self.information = np.sum([each.information for each in seen], axis=0)

    @property
    def solutions(self) -> tuple[Solution, ...]:
        """Of the parts, where `look` looked last."""
        return tuple(part.solution for part in self._parts)

    def covariance(self) -> FloatArray:
        """(K, K) of the logarithms, prior included."""
        prior = np.eye(len(self.middle)) / PRIOR_SIGMA**2
        inverse: FloatArray = np.asarray(np.linalg.inv(self.information + prior), dtype=np.float64)
        return inverse

    def redundancy(self) -> FloatArray:
        """(K,) see `FittedVariances`."""
        return 0.5 * np.maximum(1.0 / np.diag(self.covariance()) - 1.0 / PRIOR_SIGMA**2, 0.0)

    def run(self, free: BoolArray) -> bool:
        """Moves the sigmas that are free (K,) on from where `look` looked until those stand of which the data tell.

        The last step is not looked at. False where they did not come to stand.
        """
        longest, before = np.full(len(free), _LONGEST_STEP), np.zeros(len(free))
        for n_steps in range(_MAX_ITERATIONS):
            by_share = np.where(free, self._step_by_share(), 0.0)
            if np.abs(by_share).max(initial=0.0) > _FAR:
                self._move(by_share)
                continue
            step = self._step_by_information(free)
            told = self.redundancy() >= LEAST_REDUNDANCY
            if (np.abs(step) < _SMALL_STEP * np.sqrt(np.diag(self.covariance())))[free & told].all():
                return True
            # Where a sigma is next to nothing its curvature says nothing of what lies beyond: steps that turn back
            # shrink.
            longest = np.where(step * before < 0.0, 0.5 * longest, longest)
            before = np.clip(step, -longest, longest)
            if (_left_by(before, np.sqrt(np.diag(self.covariance())))[free & told] < _ENOUGH).all():
                self.log_sigma = np.maximum(self.log_sigma + before, self._least)
                return True
            # A residual that is a fault at one step and none at the next would keep the search from coming to an end.
            self._move(before, afresh=n_steps < _STEPS_AFRESH)
        return False

    def _step_by_share(self) -> FloatArray:
        """(K,) to where what is left over is as much as should be, were that each one's own; none where that is little.

        Where more is left over than there was, sigmas are so far too small that the loss cuts off good readings, and
        what is expected means nothing.
        """
        too_small = self.squares > self.at_most
        expected = np.where(too_small, self.at_most, self.expected)
        share = np.maximum(self.squares, 1e-6 * expected) / np.where(expected > 0.0, expected, 1.0)
        return np.where(expected >= LEAST_REDUNDANCY, 0.5 * np.log(np.maximum(share, 1e-6)), 0.0)

    def _step_by_information(self, free: BoolArray) -> FloatArray:
        """(K,) Newton's; none for those that are not free (K,)."""
        total = self.information + np.eye(len(free)) / PRIOR_SIGMA**2
        pull = self.score - (self.log_sigma - self.middle) / PRIOR_SIGMA**2
        step = np.zeros(len(free))
        step[free] = np.linalg.solve(total[np.ix_(free, free)], pull[free])
        return np.maximum(step, self._least - self.log_sigma)

    def _move(self, step: FloatArray, *, afresh: bool = True) -> None:
        self.log_sigma = np.maximum(self.log_sigma + step, self._least)
        self.look(afresh=afresh)


def _left_by(step: FloatArray, deviation: FloatArray) -> FloatArray:
    """(K,) how far steps (K,) of a logarithm end from where they should, in its standard deviations.

    By their square, as the likelihood is no parabola; and since the average information differs from its curvature by
    chance, as a share by some two deviations.
    """
    return step**2 / deviation + 2.0 * np.abs(step)
