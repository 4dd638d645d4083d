"""Persistent errors: series of observations whose errors are correlated from one observation to the next.

The errors are a stationary Gauss-Markov process of variance one: two observations at a distance d have the correlation
exp(-d / length) (a sampled Ornstein-Uhlenbeck process: Rasmussen and Williams, "Gaussian Processes for Machine
Learning", 2006, appendix B). The covariance is B B', where B computes errors from independent innovations in one pass
over a series.
"""

from dataclasses import dataclass

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import FloatMatrix, FloatVector, njit


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

    def times(self, rows: FloatArray) -> FloatArray:
        """Return the covariance times rows (N, n), B B' r."""
        series = self._backward(rows) * (1.0 - self.correlation**2)[:, None]
        _accumulate(series, self.correlation)
        product = np.empty_like(series)
        product[self.order] = series
        return product

    def squares(self, rows: FloatArray) -> FloatArray:
        """Return the quadratic forms r' B B' r (n,) of rows (N, n)."""
        return np.asarray((1.0 - self.correlation**2) @ self._backward(rows) ** 2)

    def _backward(self, rows: FloatArray) -> FloatArray:
        """Return B' r for rows (N, n), in order, before the scale by the sigmas of innovations."""
        series = rows[self.order]
        _accumulate_backward(series, self.correlation)
        return series


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
def _accumulate_backward(series: FloatMatrix, correlation: FloatVector) -> None:
    for k in range(len(correlation) - 1, 0, -1):
        for j in range(series.shape[1]):
            series[k - 1, j] += correlation[k] * series[k, j]
