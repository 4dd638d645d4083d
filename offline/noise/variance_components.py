"""Variance components of the measurements from the residuals, by restricted maximum likelihood.

The covariance of all measurements is a sum of known matrices V_j, each times a variance that many factors share: the
variances of wheels and observations, and of errors that several observations of a tag share. The expectation of each
quadratic form q_i of the residuals (see `likelihood`) is linear in the variances: sum_j T_ij v_j = m_i. The solution of
T v = q is the minimum norm quadratic unbiased estimate at the weights of the solve (Rao, "Estimation of variance and
covariance components", 1971). Repeated with the resulting weights it is restricted maximum likelihood (Patterson and
Thompson, "Recovery of inter-block information when block sizes are unequal", 1971). Its information about the logarithm
of a sigma is 2 v_i T_ij v_j. The weights treat observations with shared errors as independent, with larger variances.
The expectations are of the true covariances, so this causes no bias.

Each variance has a wide prior about its initial value, where it stays if the residuals do not determine it. Variances
of shared errors have small initial values and may be fitted as zero. The number of repetitions is bounded, and the last
one is the result.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.offline.foundation import Workers
from groundsbot.offline.noise.likelihood import LikelihoodEvaluator, Part, PartLikelihood, evaluate_all

# Standard deviation of the prior of the logarithm of a sigma: a factor of ten.
PRIOR_SIGMA: Final = float(np.log(10.0))
_MAX_ITERATIONS: Final = 30
# With this redundancy the relative standard deviation of a sigma is a third.
LEAST_REDUNDANCY: Final = 5.0
# An undetermined sigma is reset to its prior unless its quadratic form is smaller than then predicted by this many
# sigmas. The bound is low: several sigmas that are only determined together raise the prediction too much by their sum,
# but each by little.
_CONTRADICTED: Final = 1.0
_LARGEST_STEP: Final = 10.0  # factor of a variance in one iteration
_STEADY: Final = 4  # a sigma that went back counts as settled for so many steps
_SHORTER: Final = 0.5  # bound of a step that goes back, as a share of the last one
_LARGE_STEP: Final = 0.5  # change of the logarithm of a sigma in one step
_SMALL_STEP: Final = 0.1  # share of its own standard deviation, or of that with the least redundancy
_DETERMINED: Final = float(np.sqrt(0.5 / LEAST_REDUNDANCY))
# Initial variance of shared errors as a share of the observations' variance, and its lower bound, which counts as zero.
_SHARED_START: Final = 0.05
_NONE_SHARED: Final = 1e-6
_NEGLIGIBLE_SHARED: Final = 0.02  # of the initial variance; adds 3 % to the variance of the mean of thirty observations
_MOST_TIMES: Final = 1e6  # upper bound of a variance relative to its prior, which stops undetermined ones


@dataclass(frozen=True)
class FittedVariances:
    """Fitted K sigmas, and variances of errors that observations share.

    Attributes:
        sigma: (K,)
        log_covariance: (K, K) of the logarithms of sigmas, prior included.
        redundancy: (K,) number of squared residuals whose mean is as uncertain as the sigma: the inverse of twice the
            variance of its logarithm, less the part of the prior.
        is_determined: (K,) whether the residuals determine it. Else it is the larger of prior and fitted value, or the
            fitted value if the residuals contradict the prior.
        converged: whether the last iteration changed all sigmas by little.
        shared: (L, 2) variances of shared errors, as multiples of the squares of `Components.lasting_root`.
        n_groups: (L, 2) effective number of cells, or tracks, that determine each of these.
    """

    sigma: FloatArray
    log_covariance: FloatArray
    redundancy: FloatArray
    is_determined: BoolArray
    converged: bool
    shared: FloatArray
    n_groups: FloatArray

    def interval(self, quantile: float) -> tuple[FloatArray, FloatArray]:
        """Return the lower and upper bounds (K,) of each sigma at `quantile` normal deviations.

        The upper bound is taken on the logarithm, the lower one on the square. Beside other noise, the estimate of the
        square is unbiased with an error that hardly depends on it, and only large values are accepted. On the logarithm
        the lower bound would exclude that a sigma was fitted much too large.
        """
        width = quantile * np.sqrt(np.diag(self.log_covariance))
        return self.sigma * np.sqrt(np.maximum(1.0 - 2.0 * width, 0.0)), self.sigma * np.exp(width)


def fit_variances(
    parts: Sequence[Part],
    sigma: FloatArray,
    least: FloatArray | None = None,
    start: FloatArray | None = None,
    workers: Workers | None = None,
) -> FittedVariances:
    """Fit K sigmas to the residuals of all parts together.

    Sigmas that the residuals do not determine are raised to the prior, unless the residuals contradict it.

    Args:
        parts: problems with their covariance components.
        sigma: (K,) center of the prior.
        least: (K,) lower bounds; None: zero.
        start: (K,) initial values; None: those of the prior.
        workers: processes that share the parts; None: this process.

    Raises:
        UnderDeterminedError: a part has an unobservable direction.
    """
    least = np.zeros(len(sigma)) if least is None else least
    search = _Search(parts, sigma, least, sigma if start is None else start, workers or Workers())
    n = len(sigma)
    search.grow()
    converged = search.run(np.ones(len(search.variances), dtype=np.bool_))
    is_determined = search.redundancy() >= LEAST_REDUNDANCY
    if not is_determined[:n].all():
        converged &= search.reset_to_prior(is_determined)
    search.evaluators.release()
    log_covariance = search.log_covariance()
    redundancy = search.redundancy()
    is_shared = (search.variances[n:] > 2.0 * _NONE_SHARED) & (search.likelihood.n_groups > 0.0)
    return FittedVariances(
        np.sqrt(search.variances[:n]),
        log_covariance[:n, :n],
        redundancy[:n],
        is_determined[:n],
        converged,
        np.where(is_shared, search.variances[n:], 0.0).reshape(-1, 2),
        search.likelihood.n_groups.reshape(-1, 2),
    )


def _own_by_shared_variance(parts: Sequence[Part], sigma: FloatArray) -> float:
    """Return the initial variance of the observations' independent errors relative to that of shared ones; at most one.

    With much larger shared errors the residuals would not determine the independent ones.
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
    """Iteration of the estimate under its own weights.

    Attributes:
        evaluators: evaluators of all parts.
        variances: (C,) squares of K sigmas, then variances of shared errors.
        likelihood: likelihood at these variances.
    """

    def __init__(
        self, parts: Sequence[Part], sigma: FloatArray, least: FloatArray, start: FloatArray, workers: Workers
    ) -> None:
        names, sizes = [part.name for part in parts], [part.problem.n_residuals for part in parts]
        self.evaluators = workers.hold([LikelihoodEvaluator(part) for part in parts], names, sizes)
        self._n = len(sigma)
        n_shared = parts[0].components.n_lasting if parts else 0
        self._prior = np.append(sigma**2, np.full(n_shared, _SHARED_START * _own_by_shared_variance(parts, sigma)))
        self._least = np.append(least**2, np.full(n_shared, _NONE_SHARED))
        self._negligible = np.append(2.0 * least**2, _NEGLIGIBLE_SHARED * self._prior[self._n :])
        self.variances = np.maximum(np.append(start**2, self._prior[self._n :]), self._least)
        self.likelihood: PartLikelihood = evaluate_all(self.evaluators, self.variances)

    def run(self, free: BoolArray) -> bool:
        """Iterate the estimate of the free variances (C,); return whether it converged."""
        bound, log_step = np.full(len(self.variances), np.inf), np.zeros(len(self.variances))
        n_ahead = np.full(len(self.variances), _STEADY + 1)
        for _ in range(_MAX_ITERATIONS):
            factors = np.where(free, self._estimate(free), 1.0)
            wanted = 0.5 * np.log(np.clip(factors, 1.0 / _LARGEST_STEP, _LARGEST_STEP))
            # Of a sigma that the residuals do not determine but contradict the prior of, steps would go to and fro.
            is_large = np.abs(wanted) > _LARGE_STEP
            is_back = is_large & (wanted * log_step < 0.0) & (self.redundancy() < LEAST_REDUNDANCY)
            n_ahead = np.where(is_back, 0, n_ahead + 1)
            bound = np.where(is_back, _SHORTER * np.abs(log_step), np.where(n_ahead > _STEADY, bound / _SHORTER, bound))
            log_step = np.clip(wanted, -bound, bound)
            self.variances = np.clip(self.variances * np.exp(2.0 * log_step), self._least, _MOST_TIMES * self._prior)
            self.likelihood = evaluate_all(self.evaluators, self.variances)
            deviation = np.minimum(np.sqrt(np.diag(self.log_covariance())), _DETERMINED)
            is_settled = ~free | (n_ahead <= _STEADY) | (self.variances <= self._negligible)
            if (is_settled | (np.abs(log_step) < _SMALL_STEP * deviation)).all():
                return True
        return False

    def grow(self) -> None:
        """Raise sigmas that are far too small, while variances of shared errors are fixed.

        Shared errors would otherwise absorb the errors of the wheels.
        """
        own = np.arange(len(self.variances)) < self._n
        for _ in range(_MAX_ITERATIONS):
            log_step = 0.5 * np.log(np.clip(np.where(own, self._estimate(own), 1.0), 1.0, _LARGEST_STEP))
            if not (log_step > _LARGE_STEP).any():
                return
            self.variances = np.minimum(self.variances * np.exp(2.0 * log_step), _MOST_TIMES * self._prior)
            self.likelihood = evaluate_all(self.evaluators, self.variances)

    def reset_to_prior(self, is_determined: BoolArray) -> bool:
        """Raise undetermined sigmas to the prior where the residuals do not contradict it, and fit the others again.

        Args:
            is_determined: (C,) of the sigmas and the variances of shared errors.

        Returns:
            Whether the others converged.
        """
        fitted, fitted_likelihood = self.variances, self.likelihood
        is_reset = ~is_determined & (np.arange(len(fitted)) < self._n)
        # Undetermined noise is small beside other noise, so the larger of two values does little harm.
        self.variances = np.where(is_reset, np.maximum(fitted, self._prior), fitted)
        self.likelihood = evaluate_all(self.evaluators, self.variances)
        missing = (self.likelihood.expected - self.likelihood.squares) * self.variances
        own = (self.likelihood.traces @ self.variances) * self.variances
        contradicts = is_reset & (missing > _CONTRADICTED * np.sqrt(2.0 * np.maximum(own, 1e-300)))
        self.variances = np.where(contradicts, fitted, self.variances)
        if (self.variances == fitted).all():
            self.likelihood = fitted_likelihood
            return True
        return self.run(~is_reset)

    def log_covariance(self) -> FloatArray:
        """Return the covariance (C, C) of the logarithms of the sigmas, prior included."""
        return np.asarray(np.linalg.inv(self._information() + np.eye(len(self.variances)) / PRIOR_SIGMA**2))

    def redundancy(self) -> FloatArray:
        """Return the redundancy (C,), see `FittedVariances`."""
        return 0.5 * np.maximum(1.0 / np.diag(self.log_covariance()) - 1.0 / PRIOR_SIGMA**2, 0.0)

    def _information(self) -> FloatArray:
        """Return the information (C, C) about the logarithms of the sigmas, 2 v_i T_ij v_j.

        Random traces and rounding make it slightly asymmetric and indefinite, which is corrected.
        """
        both = self.variances[:, None] * self.likelihood.traces * self.variances
        values, vectors = np.linalg.eigh(both + both.T)
        return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)

    def _estimate(self, free: BoolArray) -> FloatArray:
        """Return factors (C,) of the variances: the solution of T (v' - v) = q - m under the prior, non-negative.

        A quadratic form above its expectation without a fit shows a sigma so small that the losses reject good
        observations. Traces are then wrong, and the sigma grows by the ratio of the form to this expectation.
        """
        from scipy.optimize import nnls  # takes a tenth of a second to load

        v = self.variances
        expected = self.likelihood.traces * v * v[:, None]
        squares = self.likelihood.squares * v
        without_fit = self.likelihood.without_fit * v
        too_small = (squares > without_fit) & (without_fit > LEAST_REDUNDANCY)
        fixed = np.where(free, 0.0, 1.0)
        # The prior of the logarithm of a sigma, linearised in the factor of its variance.
        weight = np.full(len(v), 0.25 / PRIOR_SIGMA**2)
        middle = np.clip(self._prior / v, 1.0 / _LARGEST_STEP, _LARGEST_STEP)
        middle[self._n :] = 0.0
        symmetric = 0.25 * (expected + expected.T)
        left = symmetric + np.diag(weight + 1e9 * fixed)
        excess = (self.likelihood.squares - self.likelihood.expected) * v
        right = 0.5 * np.maximum(expected.sum(axis=1) + excess, 0.0) + weight * middle + 1e9 * fixed
        values, vectors = np.linalg.eigh(left)
        root = np.sqrt(np.maximum(values, 1e-9))
        found, _ = nnls((vectors * root).T, (vectors.T @ right) / root)
        ratio = squares / np.maximum(without_fit, 1e-300)
        return np.asarray(np.where(too_small, np.maximum(found, ratio), found))
