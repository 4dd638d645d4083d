"""The joint information of the places of all tracks, of which only what is asked for is ever worked out.

With a prior of the slack's sigma s on each place the covariance of the places is S = (L + s^-2)^-1 = Z^T Z, where L is
what the observations tell and Z comes from the arrowhead's factorisation, most of it zero. Places that may each be off
by s have the information (L^-1 + s^2)^-1 = s^-2 (1 - s^-2 S) (Woodbury). So blocks of it among the tracks of a tag,
sums over tags and products with a few vectors are cheap, and the whole matrix, gigabytes for a fleet, is never there.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam import SquareRoot


@dataclass(frozen=True)
class Information:
    """(2 K, 2 K) of K places.

    Attributes:
        root: Z.
        slack_sigma_m: s.
    """

    root: SquareRoot
    slack_sigma_m: float

    def times(self, vectors: FloatArray) -> FloatArray:
        """The product with vectors (2 K, n)."""
        weight = self.slack_sigma_m**-2
        return weight * (vectors - weight * self.root.times(vectors))

    def among(self, rows: IntArray) -> FloatArray:
        """(r, r) between some coordinates."""
        own = self.root.of(rows)
        return self._of(np.eye(len(rows)), own.against(own))

    def gather(self, label: IntArray, n: int) -> "PlaceInformation":
        """With tracks (K,) of one label, 0 to n - 1, in one place."""
        column = rows_of(label)
        ones = np.ones(len(column))
        gather = sparse.csc_array((ones, (np.arange(len(column)), column)), shape=(len(column), 2 * n))
        return PlaceInformation(self, column, self.root.sum_columns(gather), np.bincount(label, minlength=n).repeat(2))

    def _of(self, ones: FloatArray, covariance: FloatArray) -> FloatArray:
        weight = self.slack_sigma_m**-2
        return weight * (ones - weight * covariance)


@dataclass(frozen=True)
class PlaceInformation:
    """The same of P places that several tracks share.

    Attributes:
        single: of the tracks.
        column: (2 K,) coordinate of the places for each of the tracks'.
        root: (n, 2 P) Z, columns summed up.
        count: (2 P,) of how many tracks each is.
    """

    single: Information
    column: IntArray
    root: SquareRoot
    count: IntArray

    def whole(self) -> FloatArray:
        """(2 P, 2 P)."""
        return self.single._of(np.diag(self.count.astype(np.float64)), self.root.against(self.root))

    def across(self, rows: IntArray) -> FloatArray:
        """(r, 2 P) between coordinates of tracks and all places."""
        ones = np.zeros((len(rows), len(self.count)))
        ones[np.arange(len(rows)), self.column[rows]] = 1.0
        return self.single._of(ones, self.single.root.of(rows).against(self.root))

    def sum_by_place(self, vectors: FloatArray) -> FloatArray:
        """(2 P, n) vectors (2 K, n) of the tracks, summed up by places."""
        sums = np.zeros((len(self.count), vectors.shape[1]))
        np.add.at(sums, self.column, vectors)
        return sums


def no_information(slack_sigma_m: float) -> Information:
    """Of no places."""
    return Information(SquareRoot(np.zeros((0, 0)), sparse.csc_array((0, 0))), slack_sigma_m)


def rows_of(members: IntArray) -> IntArray:
    """(2 m,) both coordinates of each of m places."""
    return np.asarray((2 * members[:, None] + np.arange(2)).reshape(-1))
