"""Variance components of correlated errors between neighbouring observations of a tag.

A detector's bias depends on a tag's appearance, and so repeats from picture to picture: the mean of m observations is
then less certain than one observation over sqrt(m). The error of observations of one tag within a cell, one or two
metres of the path, is modelled as an independent part and a part common to the cell. The variances of the parts follow
from two sums of squared residuals: over single observations, and over the sums of cells. The expectation of each is
linear in the variances, with traces as coefficients that include the reduction by the estimate (the minimum norm
quadratic unbiased estimator: Rao, "Estimation of variance and covariance components", 1971). So independent errors give
a common part of zero in the mean.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import sparse

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam import Solution, losses_and_weights, stack

# Weight of the prior of independent errors, as a number of cells.
_PRIOR_CELLS: Final = 4.0
_TINY: Final = 1e-9
_N_SIGNS: Final = 8
_FEW: Final = 2**20  # numbers: more vectors at once take more memory than a solve
_SEED: Final = 7


@dataclass(frozen=True)
class CorrelatedErrors:
    """Variances of whitened observations, by component of the observation.

    Attributes:
        independent_variance: (2,) of the independent part.
        independent_redundancy: (2,) its number of measurements.
        common_variance: (2,) of the part common to a cell.
        common_redundancy: (2,) its number of cells.
    """

    independent_variance: FloatArray
    independent_redundancy: FloatArray
    common_variance: FloatArray
    common_redundancy: FloatArray

    def factors(self, cell: IntArray, least_shared: FloatArray | float = 0.0) -> FloatArray:
        """Return (M, 2) factors on sigmas that make observations equivalent to independent ones.

        Args:
            cell: (M,) of each observation.
            least_shared: (M, 2) lower bound on the common variance, known independently of the fit.
        """
        return np.sqrt(
            self.independent_variance + _n_in_cell(cell)[:, None] * np.maximum(self.common_variance, least_shared)
        )

    def degrees_of_freedom(self, cell: IntArray) -> float:
        """Return the effective degrees of freedom of the inflated variance of the observations.

        By Satterthwaite's sum: "An approximate distribution of estimates of variance components" (1946).
        """
        parts = np.concatenate([len(cell) * self.independent_variance, _n_in_cell(cell).sum() * self.common_variance])
        redundancy = np.concatenate([self.independent_redundancy, self.common_redundancy])
        return float(parts.sum() ** 2 / (parts**2 / redundancy).sum())


def fit_correlated_errors(solution: Solution, cell: IntArray) -> CorrelatedErrors:
    """Fit both variances to the residuals of a solve's observations, with all other noise as given to the solve.

    Args:
        solution: solution with observations weighted as independent.
        cell: (M,) of each observation; numbers from 0 without gaps.
    """
    read = _ResidualProjection(solution)
    cells = sparse.csr_array((np.ones(len(cell)), (cell, np.arange(len(cell)))))
    found, whole = np.empty((4, 4, _N_SIGNS)), np.empty((4, _N_SIGNS))
    drawn = _random_signs(cell)
    at_once = 4 if 4 * _N_SIGNS * solution.problem.columns.n <= _FEW else 1  # parts
    for part in range(0, 4, at_once):
        rows = np.stack([next(drawn) for _ in range(at_once)], axis=2).reshape(2 * len(cell), -1)
        kept, length = read.residuals(rows)
        own = slice(part, part + at_once)
        found[:, own] = _squares(kept.reshape(len(cell), 2, -1), cells).reshape(4, at_once, _N_SIGNS)
        whole[own] = length.reshape(at_once, _N_SIGNS)
    traces, lengths = found.mean(axis=2).T, whole.mean(axis=1)
    squares = _squares(read.residual.reshape(-1, 2, 1), cells)[:, 0] - (lengths - traces[:, :2].sum(axis=1))
    n_in_cell = np.bincount(cell)
    return _solve_variances(0.5 * (traces + traces.T), squares, lengths, float((n_in_cell**2).sum() / n_in_cell.sum()))


def _random_signs(cell: IntArray) -> Iterator[FloatArray]:
    """Yield (M, 2, n) random signs in one component, four times: twice by observation, then twice by cell."""
    rng = np.random.default_rng(_SEED)
    for part in range(4):
        component, by_cell = part % 2, part >= 2
        signs = rng.choice([-1.0, 1.0], (int(cell.max()) + 1 if by_cell else len(cell), _N_SIGNS))
        drawn = np.zeros((len(cell), 2, _N_SIGNS))
        drawn[:, component] = signs[cell] if by_cell else signs
        yield drawn


class _ResidualProjection:
    """Residual projection of the observations in a solve, with the weights of its loss.

    Attributes:
        residual: (2 M,)
    """

    def __init__(self, solution: Solution) -> None:
        problem = solution.problem
        observations = problem.observations.linearise(solution.state, problem.columns)
        jacobian, residual = stack((observations,), problem.columns.n)
        root = np.repeat(np.sqrt(losses_and_weights(solution.losses.observations, observations.residual)[1]), 2)
        self._jacobian = jacobian * root[:, None]
        self._factorisation = solution.factorisation
        self.residual = residual * root

    def residuals(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the residual projection v - J H^-1 J^T v of columns v (2 M, k), and (k,) their squared lengths.

        The lengths are those over all measurements, not of observations alone: since v - J H^-1 J^T v is a projection
        they are its product with v.
        """
        inner = self._jacobian.T @ rows
        solved = self._factorisation.solve_many(inner)
        return rows - self._jacobian @ solved, (rows**2).sum(axis=0) - (inner * solved).sum(axis=0)


def _squares(observations: FloatArray, cells: sparse.csr_array) -> FloatArray:
    """Return (4, k) sums of squares of observations (M, 2, k): of each component, then of its sums over cells."""
    sums = [cells @ observations[:, component] for component in (0, 1)]
    return np.stack([*(observations**2).sum(axis=0), *((each**2).sum(axis=0) for each in sums)])


def _solve_variances(traces: FloatArray, squares: FloatArray, length: FloatArray, size: float) -> CorrelatedErrors:
    """Return variances (independent twice, common twice), none negative, of traces @ variances = squares.

    Args:
        traces: (4, 4)
        squares: (4,)
        length: (4,) expectation of each of the squares for independent variances of 1.
        size: mean size of an observation's cell: the trace of a cell without reduction by the estimate. Where the
            reduction is large, sums over cells contain little information, and the prior dominates.
    """
    prior = _PRIOR_CELLS * np.array([1.0, 1.0, size, size]) ** 2
    weighed = traces + np.diag(prior)
    aimed = squares + prior * np.array([1.0, 1.0, 0.0, 0.0])
    shared = np.maximum(np.linalg.solve(weighed, aimed)[2:], 0.0)
    own = np.linalg.solve(weighed[:2, :2], aimed[:2] - weighed[:2, 2:] @ shared)
    redundancy = length**2 / np.maximum(traces.diagonal(), _TINY) + _PRIOR_CELLS
    return CorrelatedErrors(np.maximum(own, _TINY), redundancy[:2], shared, redundancy[2:])


def _n_in_cell(cell: IntArray) -> FloatArray:
    """Return (M,) the number of observations in the cell of each."""
    return np.asarray(np.bincount(cell)[cell], dtype=np.float64)
