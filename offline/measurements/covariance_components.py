"""Covariances that are linear in the squares of the noise parameters."""

from dataclasses import dataclass

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.robot import NoiseParameters


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
    propagated: FloatArray = jacobian @ covariance @ jacobian.swapaxes(-1, -2)
    return propagated


def concatenate(a: CovarianceParts, b: CovarianceParts) -> CovarianceParts:
    """Concatenate along the measurements; the result has the names of both."""
    names = tuple(dict.fromkeys(a.names + b.names))
    return CovarianceParts(names, np.concatenate([a.of(names), b.of(names)], axis=1), np.concatenate([a.rest, b.rest]))
