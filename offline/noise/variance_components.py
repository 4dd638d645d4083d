"""Variances of the measurements, from what the estimate leaves over of them: restricted maximum likelihood.

The covariance of all measurements is a sum of known matrices V_j, each times a variance that many factors share: those
of wheels and observations, and of errors that the observations of a tag in one part of the way share. Each quadratic
form q_i of the residuals (see `likelihood`) has an expectation that is linear in the variances: sum_j T_ij v_j. To
solve T v = q is the minimum norm quadratic unbiased estimate at the weights of the solve (Rao, "Estimation of variance
and covariance components", 1971); repeated with the weights that follow from it, it is restricted maximum likelihood
(Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal", 1971), whose information on
the logarithm of a sigma is 2 v_i T_ij v_j. Observations that share errors are weighed as if they were independent with
larger variances; the expectations are of the true structure all the same, so this makes no bias.

Each variance has a wide prior about where it began: what the data do not tell stays there. Variances of shared errors
begin near none, and may come out as none. A fit always ends: with a number of repetitions, the last of which counts.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import nnls

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.offline.foundation import Workers
from groundsbot.offline.noise.likelihood import LikelihoodEvaluator, Part, PartLikelihood, evaluate_all

# Of a logarithm of sigma: a factor of ten either way is one such sigma.
PRIOR_SIGMA: Final = float(np.log(10.0))
_MOST_LOOKS: Final = 15
# As many squares as that leave a sigma uncertain by a third.
LEAST_REDUNDANCY: Final = 5.0
# In sigmas of the squares: by so much must there be less left over than what nobody could tell would bring, for it not
# to be put back. Several that are told together only would bring too much by their sum, each by little.
_CONTRADICTED: Final = 1.0
_LARGEST_STEP: Final = 10.0  # factor on a variance, from one look to the next
_GROWING: Final = 0.5  # of the logarithm of a sigma in one step
_SMALL_STEP: Final = 0.1  # of its own standard deviation
# Where shared errors begin, as a share of the observations' variance; and what is as good as none.
_SHARED_START: Final = 0.05
_NONE_SHARED: Final = 1e-6
_MOST_TIMES: Final = 1e6  # where it began, as a variance: what nothing tells of must not run away


@dataclass(frozen=True)
class FittedVariances:
    """What the residuals say of K sigmas, and of what observations share.

    Attributes:
        sigma: (K,)
        log_covariance: (K, K) of the logarithms, the prior included.
        redundancy: (K,) of how many squares of its own each sigma is the mean: one over twice the variance of its
            logarithm, the prior's share taken off.
        told: (K,) whether the data say enough of it; else it stands where it began, or where they are more content
            with if that is more, unless they speak against that.
        converged: whether the last repetition changed nothing that matters.
        shared: (L, 2) variances of shared errors, as multiples of the squares of `Components.lasting_root`.
        n_groups: (L, 2) of how many cells, or passes, each tells.
    """

    sigma: FloatArray
    log_covariance: FloatArray
    redundancy: FloatArray
    told: BoolArray
    converged: bool
    shared: FloatArray
    n_groups: FloatArray

    def interval(self, quantile: float) -> tuple[FloatArray, FloatArray]:
        """Bounds (K,) between which each sigma lies, `quantile` normal deviations either way.

        Upwards of its logarithm, downwards of its square: beside other noise the square is what is estimated without
        bias and with an error that hardly depends on it, and only what comes out large is believed. By the logarithm
        nothing could come out too large by much.
        """
        spread = quantile * np.sqrt(np.diag(self.log_covariance))
        return self.sigma * np.sqrt(np.maximum(1.0 - 2.0 * spread, 0.0)), self.sigma * np.exp(spread)


def fit_variances(
    parts: Sequence[Part],
    sigma: FloatArray,
    least: FloatArray | None = None,
    start: FloatArray | None = None,
    workers: Workers | None = None,
) -> FittedVariances:
    """Fits K sigmas to all parts at once.

    Sigmas of which the data say next to nothing are put back up to the prior's, unless the data speak against it.

    Args:
        parts: what the residuals are of.
        sigma: (K,) the middle of the prior.
        least: (K,) below which no sigma is looked for.
        start: (K,) where to begin; at the prior's where None.
        workers: share out the parts; None: this process.

    Raises:
        UnderDeterminedError: a part has something that nothing ties down.
    """
    least = np.zeros(len(sigma)) if least is None else least
    search = _Search(parts, sigma, least, sigma if start is None else start, workers or Workers())
    n = len(sigma)
    search.grow()
    converged = search.run(np.ones(len(search.variances), dtype=np.bool_))
    told = search.redundancy() >= LEAST_REDUNDANCY
    if not told[:n].all():
        converged &= search.hold_untold(told)
    search.evaluators.release()
    log_covariance = search.log_covariance()
    redundancy = search.redundancy()
    is_shared = (search.variances[n:] > 2.0 * _NONE_SHARED) & (search.seen.n_groups > 0.0)
    return FittedVariances(
        np.sqrt(search.variances[:n]),
        log_covariance[:n, :n],
        redundancy[:n],
        told[:n],
        converged,
        np.where(is_shared, search.variances[n:], 0.0).reshape(-1, 2),
        search.seen.n_groups.reshape(-1, 2),
    )


def _own_by_shared_variance(parts: Sequence[Part], sigma: FloatArray) -> float:
    """Return the initial variance of observations' own errors, in units of the shared ones; at most one.

    With far larger shared errors there would be no information about the own ones.
    """
    own, shared = 0.0, 0.0
    for each in parts:
        found = each.components
        if found.lasting_root is not None and len(found.observations_rest):
            observations = np.tensordot(sigma**2, found.observations, 1) + found.observations_rest
            own += float(np.trace(observations, axis1=-2, axis2=-1).sum())
            shared += float((found.lasting_root**2).sum())
    return min(1.0, own / shared) if shared > 0.0 else 1.0


class _Search:
    """Repeats the estimate under its own weights.

    Attributes:
        variances: (C,) K of the sigmas, then those of shared errors.
        seen: at these variances.
    """

    def __init__(
        self, parts: Sequence[Part], sigma: FloatArray, least: FloatArray, start: FloatArray, workers: Workers
    ) -> None:
        names = [part.name for part in parts]
        self.evaluators = workers.hold([LikelihoodEvaluator(part) for part in parts], names)
        self._n = len(sigma)
        n_shared = parts[0].components.n_lasting if parts else 0
        self._middle = np.append(sigma**2, np.full(n_shared, _SHARED_START * _own_by_shared_variance(parts, sigma)))
        self._least = np.append(least**2, np.full(n_shared, _NONE_SHARED))
        self.variances = np.maximum(np.append(start**2, self._middle[self._n :]), self._least)
        self.seen: PartLikelihood = evaluate_all(self.evaluators, self.variances)

    def run(self, free: BoolArray) -> bool:
        """Repeats the estimate of those that are free (C,) until what the data tell stands; False if it does not."""
        for _ in range(_MOST_LOOKS):
            times = np.where(free, self._estimate(free), 1.0)
            moved = 0.5 * np.log(np.clip(times, 1.0 / _LARGEST_STEP, _LARGEST_STEP))
            self.variances = np.clip(self.variances * np.exp(2.0 * moved), self._least, _MOST_TIMES * self._middle)
            self.seen = evaluate_all(self.evaluators, self.variances)
            deviation = np.sqrt(np.diag(self.log_covariance()))
            matters = free & (self.variances > 2.0 * self._least) & (self.redundancy() >= LEAST_REDUNDANCY)
            # Far too small, all observations are cut off as faults, and nothing is told until sigmas have grown.
            is_growing = bool((free & (moved > _GROWING)).any())
            if not is_growing and (np.abs(moved) < _SMALL_STEP * deviation)[matters].all():
                return True
        return False

    def grow(self) -> None:
        """Raises sigmas that are far too small, without lasting errors: else these would take what wheels err by."""
        own = np.arange(len(self.variances)) < self._n
        for _ in range(_MOST_LOOKS):
            moved = 0.5 * np.log(np.clip(np.where(own, self._estimate(own), 1.0), 1.0, _LARGEST_STEP))
            if not (moved > _GROWING).any():
                return
            self.variances = np.minimum(self.variances * np.exp(2.0 * moved), _MOST_TIMES * self._middle)
            self.seen = evaluate_all(self.evaluators, self.variances)

    def hold_untold(self, told: BoolArray) -> bool:
        """Puts sigmas of which little is told up to the prior's, where the data do not speak against it."""
        n = self._n
        fitted = self.variances.copy()
        untold = ~told & (np.arange(len(fitted)) < n)
        # Little is said of noise that is small beside other noise, so the larger of two values does no harm.
        self.variances = np.where(untold, np.maximum(fitted, self._middle), fitted)
        self.seen = evaluate_all(self.evaluators, self.variances)
        expected = self.seen.traces @ self.variances
        excess = (expected - self.seen.squares) * self.variances
        spread = np.sqrt(2.0 * np.maximum(expected * self.variances, 1e-300))
        self.variances = np.where(untold & (excess > _CONTRADICTED * spread), fitted, self.variances)
        return self.run(~untold)

    def log_covariance(self) -> FloatArray:
        """(C, C) of the logarithms of the sigmas, prior included."""
        return np.asarray(np.linalg.inv(self._information() + np.eye(len(self.variances)) / PRIOR_SIGMA**2))

    def redundancy(self) -> FloatArray:
        """(C,) see `FittedVariances`."""
        return 0.5 * np.maximum(1.0 / np.diag(self.log_covariance()) - 1.0 / PRIOR_SIGMA**2, 0.0)

    def _information(self) -> FloatArray:
        """(C, C) on the logarithms of the sigmas, 2 v_i T_ij v_j; rounding and chance may leave it a little askew."""
        both = self.variances[:, None] * self.seen.traces * self.variances
        values, vectors = np.linalg.eigh(both + both.T)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)

    def _estimate(self, free: BoolArray) -> FloatArray:
        """(C,) by what to multiply the variances: T v = q under the prior, none below zero.

        Where more is left over than there would be if the estimate had taken nothing, sigmas are so far too small that
        the losses cut off good observations, and expectations mean nothing: those grow by what is left over alone.
        """
        v = self.variances
        seen = self.seen
        expected = seen.traces * v * v[:, None]
        squares = np.maximum(seen.squares, 0.0) * v
        too_small = (squares > seen.at_most * v) & (seen.at_most * v > LEAST_REDUNDANCY)
        held = np.where(free, 0.0, 1.0)
        # A sigma's prior on its logarithm, as one on the multiple of its variance near the last one.
        weight = np.append(np.full(self._n, 0.25 / PRIOR_SIGMA**2), np.full(len(v) - self._n, 0.25 / PRIOR_SIGMA**2))
        middle = np.clip(self._middle / v, 1.0 / _LARGEST_STEP, _LARGEST_STEP)
        middle[self._n :] = 0.0
        symmetric = 0.25 * (expected + expected.T)
        left = symmetric + np.diag(weight + 1e9 * held)
        right = 0.5 * squares + weight * middle + 1e9 * held
        values, vectors = np.linalg.eigh(left)
        root = np.sqrt(np.maximum(values, 1e-9))
        found, _ = nnls((vectors * root).T, (vectors.T @ right) / root)
        share = squares / np.maximum(seen.at_most * v, 1e-300)
        return np.asarray(np.where(too_small, np.maximum(found, share), found))
