"""Variance components of a problem under its whitening: quadratic forms, products and random errors of each."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy import sparse

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.noise.components import Components, regular
from groundsbot.offline.sam import Problem

# Random signs are one bit each of random bytes.
_BITS: Final = 8


class WhitenedComponents:
    """The K own components of factors, then two of each kind of persistent errors, each with a variance of one.

    Whitened rows (R, n) are three for each motion, then two for each observation.

    Attributes:
        n: number of components C.
        n_rows: R.
    """

    def __init__(self, problem: Problem, components: Components) -> None:
        self._by_motions = [_whiten(problem.odometry.whitening, each) for each in components.odometry_roots]
        self._by_observations = [_whiten(problem.observations.whitening, each) for each in components.observation_roots]
        self._n_motion_rows = 3 * len(problem.odometry.whitening)
        self.n_rows = self._n_motion_rows + 2 * len(problem.observations.whitening)
        self._forms = (
            _quadratic_forms(self._by_motions[:-1], len(problem.odometry.whitening), 3),
            _quadratic_forms(self._by_observations[:-1], len(problem.observations.whitening), 2),
        )
        self._n_own = len(components.odometry)
        self._lasting = components.lasting
        if components.lasting_root is not None:
            self._by_lasting = problem.observations.whitening @ components.lasting_root
        self._common = components.common
        if components.common_root is not None:
            self._by_stamp = np.einsum("mij,mj->mi", problem.observations.whitening, components.common_root)
        self._by_jitter = None
        if components.jitter_root is not None:
            self._by_jitter = np.einsum("mij,mj->mi", problem.observations.whitening, components.jitter_root)
        picture = components.picture
        if picture is not None and len(picture):
            ones = np.ones(len(picture))
            self._pictures: sparse.csr_array = sparse.csr_array((ones, (picture, np.arange(len(picture)))))
        self.n = self._n_own + components.n_lasting

    def squares(self, rows: FloatArray) -> FloatArray:
        """Return the quadratic forms r' V_i r (C, n) of rows (R, n)."""
        motions, observations = self._by_factor(rows)
        own = [*(self._forms[0] @ _products(motions) + self._forms[1] @ _products(observations))]
        if self._common is not None:
            along = np.einsum("mi,min->mn", self._by_stamp, observations)
            own[self._common] = (np.asarray(self._pictures @ along) ** 2).sum(axis=0)
        lasting = [
            errors.squares(np.einsum("mi,min->mn", self._by_lasting[..., axis], observations))
            for errors in self._lasting
            for axis in (0, 1)
        ]
        return np.array(own + lasting).reshape(self.n, rows.shape[1])

    def times(self, rows: FloatArray) -> FloatArray:
        """Return the products V_i r (C, R, n) with rows (R, n)."""
        found = np.zeros((self.n, *rows.shape))
        motions, observations = self._by_factor(rows)
        for i in range(self._n_own):
            in_motions, in_observations = self._by_factor(found[i])
            for by, of, out in (
                (self._by_motions[i], motions, in_motions),
                (self._by_observations[i], observations, in_observations),
            ):
                if by is not None:
                    np.matmul(by, by.swapaxes(-1, -2) @ of, out=out)
        if self._common is not None:
            along = self._pictures @ np.einsum("mi,min->mn", self._by_stamp, observations)
            in_picture: FloatArray = np.asarray(self._pictures.T @ along)
            in_observations = self._by_factor(found[self._common])[1]
            in_observations[:] = self._by_stamp[..., None] * in_picture[:, None]
        for k, (errors, axis) in enumerate((errors, axis) for errors in self._lasting for axis in (0, 1)):
            by = self._by_lasting[..., axis]
            product = errors.times(np.einsum("mi,min->mn", by, observations))
            self._by_factor(found[self._n_own + k])[1][:] = by[..., None] * product[:, None]
        return found

    def random_errors(self, variances: FloatArray, n: int, rng: np.random.Generator) -> FloatArray:
        """Return random errors (R, n) by all components together, from random signs.

        Args:
            variances: (C,) variances of the components.
            n: number of errors.
            rng: source of signs.
        """
        rows = np.zeros((self.n_rows, n))
        in_motions, in_observations = self._by_factor(rows)
        sigma = np.sqrt(variances)
        of_each = np.append(variances[: self._n_own], 1.0)
        alone = [None if i == self._common else by for i, by in enumerate(self._by_observations)]
        for by, out in ((self._by_motions, in_motions), (alone, in_observations)):
            if len(out):
                np.matmul(_root_of_sum(by, of_each), random_signs(out.shape, rng), out=out)
        if self._common is not None:
            in_observations += self._by_picture(sigma[self._common] * self._by_stamp, n, rng)
        if self._by_jitter is not None:
            in_observations += self._by_picture(self._by_jitter, n, rng)
        for k, (errors, axis) in enumerate((errors, axis) for errors in self._lasting for axis in (0, 1)):
            drawn = errors.correlate(random_signs((len(self._by_lasting), n), rng))
            root = sigma[self._n_own + k] * self._by_lasting[..., axis, None]
            in_observations += root * drawn[:, None]
        return rows

    def _by_picture(self, root: FloatArray, n: int, rng: np.random.Generator) -> FloatArray:
        """Return random errors (N, 2, n) that all observations of a picture share, of one root (N, 2) each."""
        signs = self._pictures.T @ random_signs((self._pictures.shape[0], n), rng)
        return np.asarray(root[..., None] * signs[:, None, :])

    def _by_factor(self, rows: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return views (M, 3, n) and (N, 2, n) of rows (R, n)."""
        n = rows.shape[1]
        return rows[: self._n_motion_rows].reshape(-1, 3, n), rows[self._n_motion_rows :].reshape(-1, 2, n)


def random_signs(shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
    """Return random signs of a shape."""
    n = int(np.prod(shape))
    bits = np.unpackbits(np.frombuffer(rng.bytes(-(-n // _BITS)), dtype=np.uint8), count=n)
    return np.asarray(2.0 * bits - 1.0).reshape(shape)


def _root_of_sum(roots: Sequence[FloatArray | None], variances: FloatArray) -> FloatArray:
    """Return the lower triangular root (M, n, n) of the sum of covariances, of which these are roots."""
    terms = (v * root @ root.swapaxes(-1, -2) for root, v in zip(roots, variances, strict=True) if root is not None)
    return np.asarray(np.linalg.cholesky(regular(sum(terms))))


def _whiten(whitenings: FloatArray, root: FloatArray | None) -> FloatArray | None:
    return None if root is None else np.asarray(whitenings @ root)


def _quadratic_forms(roots: Sequence[FloatArray | None], m: int, n: int) -> FloatArray:
    """Return quadratic forms (K, M n (n + 1) / 2), which map `_products` of rows to sums of |root' r|^2.

    Args:
        roots: K times (M, n, n), or None for zero.
        m: M.
        n: components of a row.
    """
    i, j = np.triu_indices(n)
    forms = np.zeros((len(roots), m, len(i)))
    for form, root in zip(forms, roots, strict=True):
        if root is not None:
            form[:] = np.where(i == j, 1.0, 2.0) * (root @ root.swapaxes(-1, -2))[:, i, j]
    return forms.reshape(len(roots), -1)


def _products(rows: FloatArray) -> FloatArray:
    """Return the products (M n (n + 1) / 2, k) of each two components of rows (M, n, k)."""
    pairs = np.transpose(np.triu_indices(rows.shape[1]))
    products = np.empty((len(rows), len(pairs), rows.shape[2]))
    for k, (i, j) in enumerate(pairs):
        np.multiply(rows[:, i], rows[:, j], out=products[:, k])
    return products.reshape(-1, rows.shape[2])
