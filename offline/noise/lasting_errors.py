"""Persistent errors: series of observations whose errors are correlated from one observation to the next.

The errors are a stationary Gauss-Markov process of variance one: two observations at a distance d have the correlation
exp(-d / length) (a sampled Ornstein-Uhlenbeck process: Rasmussen and Williams, "Gaussian Processes for Machine
Learning", 2006, appendix B). The covariance is B B', where B computes errors from independent innovations in one pass
over a series.
"""

from dataclasses import dataclass

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import FloatBlocks, FloatMatrix, FloatVector, IntVector, njit


@dataclass(frozen=True)
class LastingErrors:
    """Series of N observations with correlated errors.

    Attributes:
        order: (N,) indices of observations, series after series, each in order of time.
        correlation: (N,) of each observation in that order with the one before; 0 where a series begins.
    """

    order: IntArray
    correlation: FloatArray

    def correlation_sums(self) -> FloatArray:
        """Return the sum (N,) of each observation's correlations with its whole series, itself included.

        If observations count as independent, each with its variance times this sum, the mean of a series gets the
        variance that the correlations give it.
        """
        before, after = np.ones(len(self.order)), np.ones(len(self.order))
        _add_neighbours(before, after, self.correlation)
        found = np.empty(len(self.order))
        found[self.order] = before + after - 1.0
        return found

    def correlate(self, innovations: FloatArray) -> FloatArray:
        """Return the errors B e (N, n) of independent innovations e (N, n)."""
        series = innovations * np.sqrt(1.0 - self.correlation**2)[:, None]
        _accumulate(series, self.correlation)
        errors = np.empty_like(series)
        errors[self.order] = series
        return errors

    def squares(self, root: FloatArray, rows: FloatArray) -> FloatArray:
        """Return the quadratic forms r' B B' r with r = root' rows.

        Args:
            root: (N, 2) derivative of each observation with respect to its error.
            rows: (N, 2, n)

        Returns:
            (n,) sums of squares of B' r.
        """
        sums = np.zeros(rows.shape[2])
        _add_squares(self.order, self.correlation, np.ascontiguousarray(root), np.ascontiguousarray(rows), sums)
        return sums


@njit
def _add_neighbours(before: FloatVector, after: FloatVector, correlation: FloatVector) -> None:
    for k in range(1, len(correlation)):
        before[k] += correlation[k] * before[k - 1]
    for k in range(len(correlation) - 1, 0, -1):
        after[k - 1] += correlation[k] * after[k]


@njit
def _accumulate(series: FloatMatrix, correlation: FloatVector) -> None:
    for k in range(1, len(correlation)):
        for j in range(series.shape[1]):
            series[k, j] += correlation[k] * series[k - 1, j]


@njit
def _add_squares(
    order: IntVector, correlation: FloatVector, root: FloatMatrix, rows: FloatBlocks, sums: FloatVector
) -> None:
    n = rows.shape[2]
    series = np.zeros(n)  # unscaled B' r of the next observation of the series
    for k in range(len(order) - 1, -1, -1):
        i = order[k]
        from_next = correlation[k + 1] if k + 1 < len(order) else 0.0
        scale = 1.0 - correlation[k] ** 2
        for j in range(n):
            series[j] = root[i, 0] * rows[i, 0, j] + root[i, 1] * rows[i, 1, j] + from_next * series[j]
            sums[j] += scale * series[j] ** 2
