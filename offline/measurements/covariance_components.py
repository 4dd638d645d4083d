"""Covariances that are linear in the squares of the noise parameters."""

from dataclasses import dataclass

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.foundation import FloatBlocks, njit


@dataclass(frozen=True)
class CovarianceParts:
    """The components of M covariances: sum over k of sigma_k^2 unit[k], plus rest.

    Attributes:
        names: K noise parameters.
        unit: (K, M, n, n) covariances for a sigma of one; zero where a measurement does not depend on a parameter.
        rest: (M, n, n) the part that does not depend on the noise parameters.
    """

    names: tuple[str, ...]
    unit: FloatArray
    rest: FloatArray

    @staticmethod
    def constant(covariance: FloatArray) -> "CovarianceParts":
        """Return covariances (M, n, n) that depend on no noise parameter."""
        return CovarianceParts((), np.zeros((0, *covariance.shape)), covariance)

    def under(self, noise: NoiseParameters) -> FloatArray:
        """Return the covariances (M, n, n) for given noise parameters."""
        variances = np.array([getattr(noise, name) for name in self.names]) ** 2
        covariance: FloatArray = np.tensordot(variances, self.unit, 1) + self.rest
        return covariance

    def where(self, which: BoolArray | IntArray | slice) -> "CovarianceParts":
        """Return the components of the selected measurements."""
        return CovarianceParts(self.names, self.unit[:, which], self.rest[which])

    def propagate(self, jacobian: FloatArray) -> "CovarianceParts":
        """Return the components of J C J^T for Jacobians (M, n, n)."""
        return CovarianceParts(self.names, propagate(jacobian, self.unit), propagate(jacobian, self.rest))

    def of(self, names: tuple[str, ...]) -> FloatArray:
        """Return the unit matrices (len(names), M, n, n) in the order of `names`; zeros for parameters not in here."""
        own = dict(zip(self.names, self.unit, strict=True))
        none = np.zeros_like(self.rest)
        return np.stack([own.get(name, none) for name in names]) if names else np.zeros((0, *self.rest.shape))


def propagate(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return J C J^T (..., m, m) for Jacobians (..., m, n) and covariances (..., n, n)."""
    if jacobian.ndim == 3 and jacobian.shape[1:] == (3, 3) and covariance.shape[-3:] == jacobian.shape:
        propagated = np.empty(covariance.shape)
        of_motions = np.ascontiguousarray(covariance).reshape(-1, 3, 3)
        set_covariances(np.ascontiguousarray(jacobian), of_motions, propagated.reshape(-1, 3, 3))
        return propagated
    return np.asarray(jacobian @ covariance @ jacobian.swapaxes(-1, -2))


@njit
def set_covariances(jacobian: FloatBlocks, covariance: FloatBlocks, out: FloatBlocks) -> None:
    """Set out (K M, 3, 3) to J C J^T for Jacobians (M, 3, 3), repeated K times, and covariances (K M, 3, 3).

    numpy calls a matrix product for each, which takes six times as long.
    """
    n = max(len(jacobian), 1)
    for first in range(0, len(covariance), n):
        for m in range(n):
            J, C, own = jacobian[m], covariance[first + m], out[first + m]
            for i in range(3):
                a0 = J[i, 0] * C[0, 0] + J[i, 1] * C[1, 0] + J[i, 2] * C[2, 0]
                a1 = J[i, 0] * C[0, 1] + J[i, 1] * C[1, 1] + J[i, 2] * C[2, 1]
                a2 = J[i, 0] * C[0, 2] + J[i, 1] * C[1, 2] + J[i, 2] * C[2, 2]
                for j in range(3):
                    own[i, j] = a0 * J[j, 0] + a1 * J[j, 1] + a2 * J[j, 2]


def concatenate(a: CovarianceParts, b: CovarianceParts) -> CovarianceParts:
    """Concatenate along the measurements; the result has the names of both."""
    names = tuple(dict.fromkeys(a.names + b.names))
    return CovarianceParts(names, np.concatenate([a.of(names), b.of(names)], axis=1), np.concatenate([a.rest, b.rest]))
