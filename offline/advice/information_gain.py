"""Covariances of a solved map with hypothetical measurements added: a low-rank update each, without a solve.

Variables that only the new measurements have (the poses of a future drive, a tag not yet mounted) are marginalised: the
Schur complement of the normal equations gives their information S = W W^T on the variables of the map. It changes the
covariance P into

    P' = P - P W (I + W^T P W)^-1 W^T P,

of which only the 2x2 blocks of the tags are computed, projected onto the shape: S P' S, without the shift and rotation
of all tags together (S-transformation, as in `maps.shape`), which no further drive determines. Davison, "Active search
for real-time vision" (2005), and Ila, Porta and Andrade-Cetto, "Information-based compact pose SLAM" (2010), select
measurements by such information gain.
"""

from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from scipy import linalg, sparse

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam import Linearised, stack

# Eigenvalues of an information matrix below this share of the largest are rounding errors.
_LEAST_SHARE: Final = 1e-10
# Half bandwidth: each new pose has factors with the one before it and the one after, of three parameters each.
_HALF_BANDWIDTH: Final = 5


class InformationGain(NamedTuple):
    """Information W W^T of hypothetical measurements on some columns of the tangent space."""

    columns: IntArray  # (k,)
    root: FloatArray  # (k, r) W


@dataclass(frozen=True)
class JointCovariance:
    """What of the joint covariance of a map's T tags and of some columns of its tangent space advice needs.

    The whole takes hundreds of MiB for thousands of tags.

    Attributes:
        columns: (k,) in ascending order.
        among: (k, k) their covariance.
        with_tags: (2 T, k) covariance between all tags and them.
        shape: (T, 2, 2) covariance of each tag, projected onto the shape of all.
        common: (2 T, 3) orthonormal shift and rotation of all tags together; (2 T, 0) if tags determine no rotation.
    """

    columns: IntArray
    among: FloatArray
    with_tags: FloatArray
    shape: FloatArray
    common: FloatArray

    @property
    def has_shape(self) -> bool:
        """Whether sigmas are relative to the other tags; a single tag's are relative to the first start."""
        return bool(self.common.size)

    def marginal(self, columns: IntArray) -> FloatArray:
        """Return the covariance (k, k) of some of the columns; 0 for fixed ones (-1)."""
        own = self._rows(columns)
        joint = self.among[np.ix_(own, own)]
        held = columns < 0
        joint[held], joint[:, held] = 0.0, 0.0
        return joint

    def sigmas_m(self) -> FloatArray:
        """Return the sigma (T,) of each tag along its worst direction, relative to the other tags."""
        return _largest_sigmas(*self._blocks(np.zeros((0, len(self.common)))))

    def predicted_sigmas_m(self, gain: InformationGain) -> FloatArray:
        """Return `sigmas_m` as predicted with these measurements added, (T,)."""
        own = self._rows(gain.columns)
        square = np.eye(gain.root.shape[1]) + gain.root.T @ (self.among[np.ix_(own, own)] @ gain.root)
        lower = linalg.cholesky(0.5 * (square + square.T), lower=True)
        taken = linalg.solve_triangular(lower, (self.with_tags[:, own] @ gain.root).T, lower=True)
        return _largest_sigmas(*self._blocks(taken - (taken @ self.common) @ self.common.T))

    def _rows(self, columns: IntArray) -> IntArray:
        """Return the row (k,) of each column; an arbitrary one for fixed columns."""
        return np.asarray(np.searchsorted(self.columns, np.maximum(columns, self.columns[0])))

    def _blocks(self, taken: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return xx, xy and yy (T,) of each tag, less the squares of the columns of `taken` (r, 2 T)."""
        x, y = taken[:, ::2], taken[:, 1::2]
        of_x, of_y = self.shape[:, 0], self.shape[:, 1]
        return of_x[:, 0] - (x**2).sum(axis=0), of_x[:, 1] - (x * y).sum(axis=0), of_y[:, 1] - (y**2).sum(axis=0)


def marginal_information(kinds: tuple[Linearised, ...], n_own: int, columns: IntArray) -> InformationGain:
    """Return the information that measurements have on the map's columns once their own variables are marginalised.

    The own variables must be observable given those of the map. No prior may be added here to make them so, as it would
    constrain the map. Columns of the map that no measurement depends on are left out: in a fleet most calibrations.

    Args:
        kinds: linearised, their columns being the own variables, 0 to n_own - 1, then those of the map in order.
        n_own: number of own variables; factors couple each to at most _BAND on either side.
        columns: (k,) of the map.

    Raises:
        LinAlgError: own variables are not observable.
    """
    jacobian, _ = stack(kinds, n_own + len(columns))
    normal = sparse.coo_array(jacobian.T @ jacobian)
    row, column = normal.coords
    inner, outer = (row >= column) & (row < n_own), row >= n_own
    used = np.concatenate([np.arange(n_own), np.unique(row[outer])])
    columns = columns[used[n_own:] - n_own]
    band, rest = np.zeros((min(_HALF_BANDWIDTH, n_own - 1) + 1, n_own)), np.zeros((len(columns), len(used)))
    band[(row - column)[inner], column[inner]] = normal.data[inner]
    rest[np.searchsorted(used, row[outer]) - n_own, np.searchsorted(used, column[outer])] = normal.data[outer]
    across, own = rest[:, :n_own].T, rest[:, n_own:]
    solved = linalg.cho_solve_banded((linalg.cholesky_banded(band, lower=True), True), across)
    values, vectors = np.linalg.eigh(own - across.T @ solved)
    kept = values > _LEAST_SHARE * values.max(initial=0.0)
    return InformationGain(columns, vectors[:, kept] * np.sqrt(values[kept]))


def _largest_sigmas(xx: FloatArray, xy: FloatArray, yy: FloatArray) -> FloatArray:
    """Return the square roots of the larger eigenvalues of symmetric 2x2 matrices."""
    largest = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
    return np.sqrt(np.maximum(largest, 0.0))
