"""How much of their errors do neighbouring readings of a tag share?

A detector's bias depends on how a tag looks, and so repeats from picture to picture: the mean of m readings is then
less certain than one reading over sqrt(m). Readings of one tag within a cell, a metre or two of the way, are taken to
err by a part of each one's own and by a part that the cell shares. The variances of the parts follow from two squares
of what a solve leaves over: reading by reading, and summed over cells. Each square's expectation is linear in the
variances, with traces as coefficients, and what the estimate takes is in the traces (the minimum norm quadratic
unbiased estimator: Rao, "Estimation of variance and covariance components", 1971). So errors that are independent give
a shared part of zero in the mean.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import sparse

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam import Solution, losses_and_weights, stack

# What was assumed before, that readings share nothing, counts like this many cells.
_TOLD: Final = 4.0
_TINY: Final = 1e-9
_N_SIGNS: Final = 8
_FEW: Final = 2**20  # numbers: more vectors at once take more memory than a solve
_SEED: Final = 7


@dataclass(frozen=True)
class SharedErrors:
    """Variances of whitened readings, by component.

    Attributes:
        own: (2,) of each reading's own part, and own_redundancy: (2,) how many measurements it rests on.
        shared: (2,) of the part that a cell shares, and shared_redundancy: (2,) how many cells it rests on.
    """

    own: FloatArray
    own_redundancy: FloatArray
    shared: FloatArray
    shared_redundancy: FloatArray

    def factors(self, cell: IntArray, least_shared: FloatArray | float = 0.0) -> FloatArray:
        """(M, 2) factors on the sigmas of readings in cells (M,), with which they tell as much as independent ones.

        Args:
            cell: of each reading.
            least_shared: (M, 2) variance that they are known to share, whatever was fitted.
        """
        return np.sqrt(self.own + _n_in_cell(cell)[:, None] * np.maximum(self.shared, least_shared))

    def freedom(self, cell: IntArray) -> float:
        """What chi-square's degrees of freedom the variance of readings so weighed is known like.

        Welch and Satterthwaite's sum: Satterthwaite, "An approximate distribution of estimates of variance components"
        (1946).
        """
        parts = np.concatenate([len(cell) * self.own, _n_in_cell(cell).sum() * self.shared])
        redundancy = np.concatenate([self.own_redundancy, self.shared_redundancy])
        return float(parts.sum() ** 2 / (parts**2 / redundancy).sum())


def fit_shared_errors(solution: Solution, cell: IntArray) -> SharedErrors:
    """Fits both parts to what a solve left over of its readings, the noise of all else being as the solve was told.

    Args:
        solution: its readings weighed as independent.
        cell: (M,) of each reading; numbers from 0 without gaps.
    """
    read = _Readings(solution)
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
    """(M, 2, n) random signs in one component, four times: reading by reading twice, then cell by cell."""
    rng = np.random.default_rng(_SEED)
    for part in range(4):
        component, by_cell = part % 2, part >= 2
        signs = rng.choice([-1.0, 1.0], (int(cell.max()) + 1 if by_cell else len(cell), _N_SIGNS))
        drawn = np.zeros((len(cell), 2, _N_SIGNS))
        drawn[:, component] = signs[cell] if by_cell else signs
        yield drawn


class _Readings:
    """The rows of a solve that are readings, weighted as it weighed them.

    Attributes:
        residual: (2 M,)
    """

    def __init__(self, solution: Solution) -> None:
        problem = solution.problem
        readings = problem.readings.linearise(solution.state, problem.columns)
        jacobian, residual = stack((readings,), problem.columns.n)
        root = np.repeat(np.sqrt(losses_and_weights(solution.losses.readings, readings.residual)[1]), 2)
        self._jacobian = jacobian * root[:, None]
        self._factorisation = solution.factorisation
        self.residual = residual * root

    def residuals(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What remains of rows (2 M, k) once the estimate has taken its share, v - J H^-1 J^T v, and (k,) the squares.

        The squares are those of all that is measured, not of readings alone: as v - J H^-1 J^T v is a projection they
        are its product with v.
        """
        inner = self._jacobian.T @ rows
        solved = self._factorisation.solve_many(inner)
        return rows - self._jacobian @ solved, (rows**2).sum(axis=0) - (inner * solved).sum(axis=0)


def _squares(readings: FloatArray, cells: sparse.csr_array) -> FloatArray:
    """(4, k) sums of squares of readings (M, 2, k): of both components one by one, then of their sums over cells."""
    sums = [cells @ readings[:, component] for component in (0, 1)]
    return np.stack([*(readings**2).sum(axis=0), *((each**2).sum(axis=0) for each in sums)])


def _solve_variances(traces: FloatArray, squares: FloatArray, length: FloatArray, size: float) -> SharedErrors:
    """Variances (own twice, shared twice), none below zero, of traces @ variances = squares.

    Args:
        traces: (4, 4)
        squares: (4,)
        length: (4,) what each of the squares would be by own parts of variance 1.
        size: of a cell, as the mean reading has it: the trace of a cell of which the estimate takes nothing. Where it
            takes much, sums over cells say little, and what was assumed stands.
    """
    told = _TOLD * np.array([1.0, 1.0, size, size]) ** 2
    weighed = traces + np.diag(told)
    aimed = squares + told * np.array([1.0, 1.0, 0.0, 0.0])
    shared = np.maximum(np.linalg.solve(weighed, aimed)[2:], 0.0)
    own = np.linalg.solve(weighed[:2, :2], aimed[:2] - weighed[:2, 2:] @ shared)
    redundancy = length**2 / np.maximum(traces.diagonal(), _TINY) + _TOLD
    return SharedErrors(np.maximum(own, _TINY), redundancy[:2], shared, redundancy[2:])


def _n_in_cell(cell: IntArray) -> FloatArray:
    """(M,) how many readings share the cell of each."""
    return np.asarray(np.bincount(cell)[cell], dtype=np.float64)
