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
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy.linalg import hadamard
from scipy.special import chdtri

from calib.arrays import BoolArray, FloatArray
from offline.factors import State, stacked, whitening
from offline.solver import Problem, solve

# Of a logarithm of sigma: a factor of ten either way is one such sigma.
PRIOR_SIGMA: Final = float(np.log(10.0))
# A residual beyond this is no noise but a fault, and says nothing of the noise; of good ones 0.1 % lie there.
_FAULT: Final = 1e-3
_MAX_FAULTS: Final = 0.1
_N_SIGNS: Final = 16  # a power of two
_SEED: Final = 11
_MAX_ITERATIONS: Final = 12
# As many squares as that leave a sigma uncertain by a third.
LEAST_REDUNDANCY: Final = 5.0
_CONTRADICTED: Final = 3.0  # sigmas of the score
_LONGEST_STEP: Final = 1.2  # of a logarithm of sigma, by the information
_FAR: Final = 0.4  # of a logarithm of sigma: from there the information shows the way
_SMALL_STEP: Final = 0.05  # of its own standard deviation
_STEPS_AFRESH: Final = 4
# Of the solves in between. The cost as a whole is level where a solve ends, but its parts are not: what they are off by
# is its root.
_COST_TOLERANCE: Final = 1e-4

_Good = tuple[BoolArray, BoolArray]  # which motions and which readings are no faults


@dataclass(frozen=True)
class Components:
    """How the covariances of one problem's factors follow from K variances.

    Attributes:
        odometry: (K, M, 3, 3) of each motion, for a variance of one; zero where a variance has no part in it.
        odometry_rest: (M, 3, 3) what is added whatever the variances.
        readings: (K, N, 2, 2) and readings_rest: (N, 2, 2) likewise.
    """

    odometry: FloatArray
    odometry_rest: FloatArray
    readings: FloatArray
    readings_rest: FloatArray

    def weighed(self, problem: Problem, variances: FloatArray) -> Problem:
        """The problem under variances (K,)."""
        odometry = np.tensordot(variances, self.odometry, 1) + self.odometry_rest
        readings = np.tensordot(variances, self.readings, 1) + self.readings_rest
        return replace(
            problem,
            odometry=replace(problem.odometry, whitening=whitening(odometry)),
            readings=replace(problem.readings, whitening=whitening(readings)),
        )


@dataclass(frozen=True)
class Part:
    """A problem, where its solve begins, and what its covariances are made of."""

    problem: Problem
    start: State
    components: Components


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
        states: of the parts, solved under these sigmas.
    """

    sigma: FloatArray
    log_covariance: FloatArray
    redundancy: FloatArray
    told: BoolArray
    states: tuple[State, ...]
    converged: bool

    def interval(self, quantile: float) -> tuple[FloatArray, FloatArray]:
        """Bounds (K,) between which each sigma lies, `quantile` normal deviations of its logarithm either way."""
        spread = np.exp(quantile * np.sqrt(np.diag(self.log_covariance)))
        return self.sigma / spread, self.sigma * spread


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
        np.exp(search.log_sigma), search.covariance(), search.redundancy(), told, tuple(search.states), converged
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
        self._parts = parts
        self._least = least
        self.middle = log_sigma
        self.log_sigma = np.maximum(log_sigma, least)
        self.states = [part.start for part in parts]
        self.score = np.zeros(len(log_sigma))
        self.squares = np.zeros(len(log_sigma))
        self.expected = np.zeros(len(log_sigma))
        self.at_most = np.zeros(len(log_sigma))
        self.information = np.zeros((len(log_sigma), len(log_sigma)))
        self._good: list[_Good] | None = None

    def look(self, *, afresh: bool = True) -> None:
        """Solves all parts under the sigmas as they are; what is a fault is looked at afresh or stays as it was."""
        good = self._good if self._good is not None and not afresh else [None] * len(self._parts)
        seen = [
            _look(part, state, np.exp(2.0 * self.log_sigma), each)
            for part, state, each in zip(self._parts, self.states, good, strict=True)
        ]
        self._good = [each.good for each in seen]
        self.states = [each.state for each in seen]
        self.squares = np.sum([each.squares for each in seen], axis=0)
        self.expected = np.sum([each.expected for each in seen], axis=0)
        self.at_most = np.sum([each.at_most for each in seen], axis=0)
        self.score = self.squares - self.expected
        self.information = np.sum([each.information for each in seen], axis=0)

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

        False where they did not come to stand.
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


class _Seen(NamedTuple):
    """What one part says at given variances, by the logarithms of sigma.

    Attributes:
        squares: (K,) weighted squares of residuals that each sigma answers for; expected: (K,) what they should be;
            at_most: (K,) what they would be if the estimate took nothing.
        information: (K, K) average information.
        good: what took part.
    """

    state: State
    squares: FloatArray
    expected: FloatArray
    at_most: FloatArray
    information: FloatArray
    good: _Good


def _look(part: Part, start: State, variances: FloatArray, good: _Good | None) -> _Seen:
    """Solves one part under variances (K,); `good` are no faults, where that is settled."""
    problem = part.components.weighed(part.problem, variances)
    solution = solve(problem, start, cost_tolerance=_COST_TOLERANCE)
    odometry = problem.odometry.linearise(solution.state, problem.columns)
    readings = problem.readings.linearise(solution.state, problem.columns)
    jacobian, residual = stacked((odometry, readings), problem.columns.n)
    good = good or (_no_fault(odometry.residual), _no_fault(readings.residual))
    shares = (
        _whitened(problem.odometry.whitening, part.components.odometry, variances, good[0]),
        _whitened(problem.readings.whitening, part.components.readings, variances, good[1]),
    )

    def taken(vectors: FloatArray) -> FloatArray:
        """What the estimate explains of whitened residuals (rows, n): J H^-1 J' vectors."""
        inner = jacobian.T @ vectors
        solved = np.stack([solution.factorisation.solve(column) for column in inner.T], axis=-1)
        product: FloatArray = jacobian @ solved
        return product

    signs = _signs(len(residual))
    left = _own_blocks_left(signs, taken(signs), odometry.residual.size)
    expected = np.sum([np.einsum("kmij,mij->k", share, own) for share, own in zip(shares, left, strict=True)], axis=0)
    force = np.concatenate(
        [
            (share @ kind.residual[..., None]).reshape(len(variances), -1)
            for share, kind in zip(shares, (odometry, readings), strict=True)
        ],
        axis=1,
    )
    at_most = np.sum([np.einsum("kmii->k", share) for share in shares], axis=0)
    information = _positive(2.0 * force @ (force.T - taken(force.T)))
    return _Seen(solution.state, force @ residual, expected, at_most, information, good)


def _signs(n: int) -> FloatArray:
    """(n, _N_SIGNS) random, and such that the products of two rows nearer than _N_SIGNS sum to nothing."""
    random = np.random.default_rng(_SEED).choice([-1.0, 1.0], (n, 1))
    signs: FloatArray = random * hadamard(_N_SIGNS)[np.arange(n) % _N_SIGNS]
    return signs


def _own_blocks_left(signs: FloatArray, explained: FloatArray, n_odometry: int) -> tuple[FloatArray, FloatArray]:
    """Estimates (M, 3, 3) and (N, 2, 2) of what the estimate leaves of each factor's whitened covariance.

    Args:
        signs: (rows, n) as `_signs` has them.
        explained: (rows, n) what the estimate explains of them.
        n_odometry: how many of the rows belong to motions.
    """
    blocks = []
    for rows, size in ((slice(0, n_odometry), 3), (slice(n_odometry, None), 2)):
        before, after = (each[rows].reshape(-1, size, _N_SIGNS) for each in (signs, explained))
        blocks.append(np.eye(size) - np.einsum("mid,mjd->mij", before, after) / _N_SIGNS)
    return blocks[0], blocks[1]


def _positive(matrix: FloatArray) -> FloatArray:
    """The nearest symmetric matrix without negative eigenvalues; faults left out of a few terms can cause them."""
    values, vectors = np.linalg.eigh(0.5 * (matrix + matrix.T))
    nearest: FloatArray = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return nearest


def _whitened(whitening: FloatArray, unit: FloatArray, variances: FloatArray, good: BoolArray) -> FloatArray:
    """Shares (K, M, n, n) from unit covariances (K, M, n, n); zero for factors that are faults."""
    matrices = np.where(good[:, None, None], whitening, 0.0)
    turned = np.ascontiguousarray(matrices.swapaxes(-1, -2))
    shares = np.zeros_like(unit)
    for share, each, variance in zip(shares, unit, variances.tolist(), strict=True):
        if each.any():
            np.multiply(variance, matrices @ each @ turned, out=share)
    return shares


def _no_fault(residual: FloatArray) -> BoolArray:
    """(M,) which whitened residuals (M, n) may be noise; all, where the sigmas are so far off that many look bad."""
    if not len(residual):
        return np.zeros(0, dtype=np.bool_)
    n = residual.shape[1]
    square = (residual**2).sum(axis=1)
    level = max(1.0, float(np.median(square)) / float(chdtri(n, 0.5)))
    good: BoolArray = square <= level * chdtri(n, _FAULT)
    return good if good.mean() > 1.0 - _MAX_FAULTS else np.ones(len(good), dtype=np.bool_)
