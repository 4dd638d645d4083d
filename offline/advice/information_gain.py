"""What more measurements would do to the covariances of a solved map: a low-rank update each, and no solve.

Measurements with variables of their own (the poses of a drive not yet driven, a tag not yet hung) are condensed to what
they say of the variables that the map has: the Schur complement S = W W^T of their normal equations. Under them the
covariance P becomes

    P' = P - P W (I + W^T P W)^-1 W^T P,

of which only the 2x2 blocks of the tags are worked out. Davison, "Active search for real-time vision" (2005), and Ila,
Porta and Andrade-Cetto, "Information-based compact pose SLAM" (2010), choose measurements by what they tell.
"""

from typing import Final, NamedTuple

import numpy as np
from scipy import linalg, sparse

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam import Linearised, stack

# Directions of an information matrix that tell this much less than the best one are rounding.
_LEAST_SHARE: Final = 1e-10
# An own pose is tied to the one before it and the one after: three numbers each.
_BAND: Final = 5


class InformationGain(NamedTuple):
    """What measurements not yet made would tell: information W W^T about some columns of the tangent space."""

    columns: IntArray  # (k,)
    root: FloatArray  # (k, r) W


class JointCovariance(NamedTuple):
    """What a map knows: the joint covariance of some columns of its tangent space, those of its tags first."""

    columns: IntArray  # (n,) of the T tags first
    covariance: FloatArray  # (n, n)
    n_tags: int

    def of(self, columns: IntArray) -> FloatArray:
        """(k, k) of some of the columns; 0 where held (-1)."""
        own = self._rows(columns)
        joint = self.covariance[np.ix_(own, own)]
        held = columns < 0
        joint[held], joint[:, held] = 0.0, 0.0
        return joint

    def sigmas_m(self) -> FloatArray:
        """(T,) of each tag along its worst direction."""
        diagonal = self._blocks(np.zeros((0, 2 * self.n_tags)))
        return _largest_sigmas(*diagonal)

    def sigmas_with_m(self, gain: InformationGain) -> FloatArray:
        """(T,) as `sigmas_m`, were these measurements made too."""
        own = self._rows(gain.columns)
        told = self.covariance[:, own] @ gain.root
        square = np.eye(gain.root.shape[1]) + gain.root.T @ told[own]
        lower = linalg.cholesky(0.5 * (square + square.T), lower=True)
        taken = linalg.solve_triangular(lower, told[: 2 * self.n_tags].T, lower=True)
        return _largest_sigmas(*self._blocks(taken))

    def _rows(self, columns: IntArray) -> IntArray:
        """(k,) where columns are; anywhere for those that are held."""
        order = np.argsort(self.columns)
        return np.asarray(order[np.searchsorted(self.columns[order], np.maximum(columns, self.columns.min()))])

    def _blocks(self, taken: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(T,) xx, xy and yy of each tag, less the squares of the columns of `taken` (r, 2 T)."""
        n = 2 * self.n_tags
        diagonal = self.covariance.diagonal()[:n] - (taken**2).sum(axis=0)
        mixed = self.covariance.diagonal(1)[:n:2][: self.n_tags] - (taken[:, ::2] * taken[:, 1::2]).sum(axis=0)
        return diagonal[::2], mixed, diagonal[1::2]


def marginal_information(kinds: tuple[Linearised, ...], n_own: int, columns: IntArray) -> InformationGain:
    """What measurements tell of the map's columns when their own variables have given way.

    Own variables must be tied down where the map's are known; nothing may be added here to help that, which would hold
    the map in place.

    Args:
        kinds: linearised, their columns being the own variables, 0 to n_own - 1, then those of the map in order.
        n_own: how many; each is tied to at most _BAND on either side.
        columns: (k,) of the map.

    Raises:
        LinAlgError: own variables are not tied down.
    """
    jacobian, _ = stack(kinds, n_own + len(columns))
    normal = sparse.coo_array(jacobian.T @ jacobian)
    row, column = normal.coords
    band, rest = np.zeros((min(_BAND, n_own - 1) + 1, n_own)), np.zeros((len(columns), n_own + len(columns)))
    inner, outer = (row >= column) & (row < n_own), row >= n_own
    band[(row - column)[inner], column[inner]] = normal.data[inner]
    rest[row[outer] - n_own, column[outer]] = normal.data[outer]
    across, own = rest[:, :n_own].T, rest[:, n_own:]
    solved = linalg.cho_solve_banded((linalg.cholesky_banded(band, lower=True), True), across)
    values, vectors = np.linalg.eigh(own - across.T @ solved)
    kept = values > _LEAST_SHARE * values[-1]
    return InformationGain(columns, vectors[:, kept] * np.sqrt(values[kept]))


def _largest_sigmas(xx: FloatArray, xy: FloatArray, yy: FloatArray) -> FloatArray:
    """Roots of the larger eigenvalues of symmetric 2x2 matrices."""
    largest = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
    return np.sqrt(np.maximum(largest, 0.0))
