"""Covariances as sums of known matrices, each times the square of one of the noise parameters."""

from dataclasses import dataclass

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.robot import NoiseParameters


@dataclass(frozen=True)
class CovarianceParts:
    """What the covariances of M measurements are made of.

    Attributes:
        names: K noise parameters.
        unit: (K, M, n, n) for a sigma of one; zero where a parameter has no part in a measurement.
        rest: (M, n, n) what is there whatever the noise.
    """

    names: tuple[str, ...]
    unit: FloatArray
    rest: FloatArray

    def under(self, noise: NoiseParameters) -> FloatArray:
        """(M, n, n) under some noise."""
        variances = np.array([getattr(noise, name) for name in self.names]) ** 2
        covariance: FloatArray = np.tensordot(variances, self.unit, 1) + self.rest
        return covariance

    def where(self, which: BoolArray | IntArray | slice) -> "CovarianceParts":
        """Those of some measurements."""
        return CovarianceParts(self.names, self.unit[:, which], self.rest[which])

    def of(self, names: tuple[str, ...]) -> FloatArray:
        """(len(names), M, n, n) unit matrices by names in another order; zero for those that have no part."""
        own = dict(zip(self.names, self.unit, strict=True))
        none = np.zeros_like(self.rest)
        return np.stack([own.get(name, none) for name in names]) if names else np.zeros((0, *self.rest.shape))


def concatenate(a: CovarianceParts, b: CovarianceParts) -> CovarianceParts:
    """Both, one after the other, with the names of both."""
    names = tuple(dict.fromkeys(a.names + b.names))
    return CovarianceParts(names, np.concatenate([a.of(names), b.of(names)], axis=1), np.concatenate([a.rest, b.rest]))
