"""Covariances of the factors of a problem as sums of known matrices, each times a variance that many factors share."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.noise.lasting_errors import LastingErrors

_ROUNDING: Final = 1e-9


@dataclass(frozen=True)
class Components:
    """Covariances of the factors of one problem as functions of K variances, and of those of shared errors.

    Attributes:
        odometry: (K, M, 3, 3) covariance of each motion for a variance of one.
        odometry_rest: (M, 3, 3) covariance that does not depend on the variances.
        observations: (K, N, 2, 2) as `odometry`.
        observations_rest: (N, 2, 2) as `odometry_rest`.
        lasting: L kinds of persistent errors, which observations of a tag share in part or in full.
        lasting_root: (N, 2, 2) its columns are the errors of each observation for a persistent component of one.
        common: index of the variance whose error all observations of a picture share, as that of its stamp; None: none.
            In the weights it counts as independent for each observation.
        common_root: (N, 2) change of each observation for such an error of one.
        jitter_root: (N, 2) change of each observation for one sigma of an error that all observations of a picture
            share, in `observations_rest` as if it were independent for each; None: there is none.
        picture: (N,) index of the picture of each observation, from 0 without gaps.
    """

    odometry: FloatArray
    odometry_rest: FloatArray
    observations: FloatArray
    observations_rest: FloatArray
    lasting: tuple[LastingErrors, ...] = ()
    lasting_root: FloatArray | None = None
    common: int | None = None
    common_root: FloatArray | None = None
    jitter_root: FloatArray | None = None
    picture: IntArray | None = None

    @property
    def n_lasting(self) -> int:
        """Number of variances of persistent errors: two for each kind."""
        return 2 * len(self.lasting)

    @cached_property
    def odometry_roots(self) -> list[FloatArray | None]:
        """Square roots (M, 3, 3) of `odometry`, component by component, then of `odometry_rest`; None where zero."""
        return [_root(each) for each in (*self.odometry, self.odometry_rest)]

    @cached_property
    def observation_roots(self) -> list[FloatArray | None]:
        """Square roots (N, 2, 2) of `observations` by component, then of the independent rest; None where zero."""
        rest = self.observations_rest
        if self.jitter_root is not None:
            rest = rest - self.jitter_root[:, :, None] * self.jitter_root[:, None, :]
        return [_root(each) for each in (*self.observations, rest)]

    def covariances(self, variances: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return covariances (M, 3, 3) of motions and (N, 2, 2) of observations under K + 2 L variances.

        Observations are made independent by larger variances: a shared error of variance s adds as much to the variance
        of the mean of n observations as n independent errors of variance n s.
        """
        own, lasting = variances[: len(self.odometry)], variances[len(self.odometry) :].reshape(-1, 2)
        odometry: FloatArray = np.tensordot(own, self.odometry, 1) + self.odometry_rest
        observations: FloatArray = np.tensordot(own, self.observations, 1) + self.observations_rest
        return regular(odometry), regular(observations + self._covariance_lasting(lasting))

    def _covariance_lasting(self, lasting: FloatArray) -> FloatArray:
        """Return the part (N, 2, 2) of the observations' covariances by the variances (L, 2) of persistent errors."""
        added = np.zeros_like(self.observations_rest)
        for errors, both in zip(self.lasting, lasting, strict=True):
            assert self.lasting_root is not None
            column = self.lasting_root * np.sqrt(both)
            added += errors.correlation_sums()[:, None, None] * (column @ column.swapaxes(-1, -2))
        return added


def regular(covariances: FloatArray) -> FloatArray:
    """Return covariances (M, n, n) regularised against rounding errors, so that they are positive definite."""
    n = covariances.shape[-1]
    level = np.trace(covariances, axis1=-2, axis2=-1) / n
    return np.asarray(covariances + (_ROUNDING * level)[:, None, None] * np.eye(n))


def _root(covariances: FloatArray) -> FloatArray | None:
    """Return square roots (M, n, n) of covariances (M, n, n), as matrices B with B B'; None if all are zero."""
    if not covariances.any():
        return None
    values, vectors = np.linalg.eigh(covariances)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :])
