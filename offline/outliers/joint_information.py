"""Joint information about the places of all tracks, of which only the needed blocks are computed.

With a prior of sigma s (the slack) on each place, the covariance of the places is S = (L + s^-2)^-1 = Z^T Z. L is the
information of the observations. The sparse Z follows from the factorisation of the arrowhead system. With an
independent error of sigma s in each place, the information is (L^-1 + s^2)^-1 = s^-2 (1 - s^-2 S) (Woodbury identity).
Blocks for the tracks of a tag, sums over places and products with a few vectors are cheap. The whole matrix, which
takes gigabytes for a fleet, is never formed.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam import SquareRoot


@dataclass(frozen=True)
class Information:
    """Joint information matrix (2 K, 2 K) of K places, in 1/m^2.

    Attributes:
        root: Z.
        slack_sigma_m: s.
    """

    root: SquareRoot
    slack_sigma_m: float

    def times(self, vectors: FloatArray) -> FloatArray:
        """Return the product (2 K, n) with vectors (2 K, n)."""
        weight = self.slack_sigma_m**-2
        return weight * (vectors - weight * self.root.times(vectors))

    def among(self, rows: IntArray) -> FloatArray:
        """Return the block (r, r) of some coordinates."""
        own = self.root.of(rows)
        return self._of(np.eye(len(rows)), own.against(own))

    def gather(self, label: IntArray, n: int) -> "PlaceInformation":
        """Return the information with tracks of equal label (K,), 0 to n - 1, joined into one place."""
        column = rows_of(label)
        ones = np.ones(len(column))
        gather = sparse.csc_array((ones, (np.arange(len(column)), column)), shape=(len(column), 2 * n))
        return PlaceInformation(self, column, self.root.sum_columns(gather), np.bincount(label, minlength=n).repeat(2))

    def _of(self, ones: FloatArray, covariance: FloatArray) -> FloatArray:
        weight = self.slack_sigma_m**-2
        return weight * (ones - weight * covariance)


@dataclass(frozen=True)
class PlaceInformation:
    """Joint information matrix (2 P, 2 P) of P places that several tracks share.

    Attributes:
        single: information about the tracks, each with its own place.
        column: (2 K,) coordinate among the places for each coordinate among the tracks.
        root: (n, 2 P) Z with its columns summed by place.
        count: (2 P,) number of tracks for each coordinate.
    """

    single: Information
    column: IntArray
    root: SquareRoot
    count: IntArray

    def whole(self) -> FloatArray:
        """Return the whole matrix (2 P, 2 P)."""
        weight = self.single.slack_sigma_m**-2
        whole = self.root.against(self.root)
        whole *= -weight  # in place: of thousands of places a copy takes hundreds of MiB
        whole[np.diag_indices(len(whole))] += self.count
        whole *= weight
        return whole

    def across(self, rows: IntArray) -> FloatArray:
        """Return the block (r, 2 P) between some coordinates of tracks and all places."""
        ones = np.zeros((len(rows), len(self.count)))
        ones[np.arange(len(rows)), self.column[rows]] = 1.0
        return self.single._of(ones, self.single.root.of(rows).against(self.root))

    def sum_by_place(self, vectors: FloatArray) -> FloatArray:
        """Return vectors (2 K, n) of the tracks summed by place (2 P, n)."""
        sums = np.zeros((len(self.count), vectors.shape[1]))
        np.add.at(sums, self.column, vectors)
        return sums


def no_information(slack_sigma_m: float) -> Information:
    """Return the information about no places."""
    return Information(SquareRoot(np.zeros((0, 0)), sparse.csc_array((0, 0))), slack_sigma_m)


def rows_of(members: IntArray) -> IntArray:
    """Return the indices (2 m,) of both coordinates of m places."""
    return np.asarray((2 * members[:, None] + np.arange(2)).reshape(-1))
