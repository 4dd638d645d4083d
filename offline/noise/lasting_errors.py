"""Errors that last: series of readings, each with an error that it keeps in part from the one before.

A stationary Gauss-Markov process of variance one, of which two readings have the correlation exp(-d / length) (an
Ornstein-Uhlenbeck process seen at some places: Rasmussen and Williams, "Gaussian Processes for Machine Learning",
2006, appendix B). Its covariance is B B', where B takes independent innovations to errors in one pass over a series.
"""

from dataclasses import dataclass

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import njit


@dataclass(frozen=True)
class LastingErrors:
    """Which of N readings err alike.

    Attributes:
        order: (N,) indices of readings, series after series, each along the way.
        kept: (N,) in that order, the correlation with the reading before; 0 where a series begins.
    """

    order: IntArray
    kept: FloatArray

    def alike(self) -> FloatArray:
        """(N,) the sum of correlations with all readings of its series, itself included.

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

    def correlate_transpose(self, rows: FloatArray) -> FloatArray:
        """B' r of rows (N, n): the sum of their squares is r' B B' r."""
        series = rows[self.order]
        _keep_backwards(series, self.kept)
        return series * np.sqrt(1.0 - self.kept**2)[:, None]


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
def _keep_backwards(series: FloatArray, kept: FloatArray) -> None:
    for k in range(len(kept) - 1, 0, -1):
        series[k - 1] += kept[k] * series[k]
