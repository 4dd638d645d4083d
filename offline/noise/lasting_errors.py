"""Errors that last: series of observations, each with an error that it keeps in part from the one before.

A stationary Gauss-Markov process of variance one, of which two observations have the correlation exp(-d / length) (an
Ornstein-Uhlenbeck process seen at some places: Rasmussen and Williams, "Gaussian Processes for Machine Learning",
2006, appendix B). Its covariance is B B', where B takes independent innovations to errors in one pass over a series.
"""

from dataclasses import dataclass

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import njit


@dataclass(frozen=True)
class LastingErrors:
    """Which of N observations err alike.

    Attributes:
        order: (N,) indices of observations, series after series, each along the way.
        kept: (N,) in that order, the correlation with the observation before; 0 where a series begins.
    """

    order: IntArray
    kept: FloatArray

    def alike(self) -> FloatArray:
        """(N,) the sum of correlations with all observations of its series, itself included.

        As many independent errors the mean of its series would need to have the same variance.
        """
        before, after = np.ones(len(self.order)), np.ones(len(self.order))
        _add_neighbours(before, after, self.kept)
        found = np.empty(len(self.order))
        found[self.order] = before + after - 1.0
        return found

    def correlate(self, innovations: FloatArray) -> FloatArray:
        """(N, n) errors B e of independent innovations (N, n)."""
        series = innovations * np.sqrt(1.0 - self.kept**2)[:, None]
        _keep(series, self.kept)
        errors = np.empty_like(series)
        errors[self.order] = series
        return errors

    def squares(self, root: FloatArray, rows: FloatArray) -> FloatArray:
        """Return r' B B' r, with r = root' rows, of the observations' rows.

        Args:
            root: (N, 2) what an error of one adds to each observation.
            rows: (N, 2, n).

        Returns:
            (n,) sums of squares of B' r.
        """
        sums = np.zeros(rows.shape[2])
        _add_squares(self.order, self.kept, root, rows, sums)
        return sums


@njit
def _add_neighbours(before: FloatArray, after: FloatArray, kept: FloatArray) -> None:
    for k in range(1, len(kept)):
        before[k] += kept[k] * before[k - 1]
    for k in range(len(kept) - 1, 0, -1):
        after[k - 1] += kept[k] * after[k]


@njit
def _keep(series: FloatArray, kept: FloatArray) -> None:
    for k in range(1, len(kept)):
        series[k] += kept[k] * series[k - 1]


@njit
def _add_squares(order: IntArray, kept: FloatArray, root: FloatArray, rows: FloatArray, sums: FloatArray) -> None:
    n = rows.shape[2]
    series = np.zeros(n)  # B' r before its scale, of the observation after in the series
    for k in range(len(order) - 1, -1, -1):
        i = order[k]
        from_next = kept[k + 1] if k + 1 < len(order) else 0.0
        scale = 1.0 - kept[k] ** 2
        for j in range(n):
            series[j] = root[i, 0] * rows[i, 0, j] + root[i, 1] * rows[i, 1, j] + from_next * series[j]
            sums[j] += scale * series[j] ** 2
