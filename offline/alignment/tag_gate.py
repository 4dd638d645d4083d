"""Test whether a tag fits its prediction or is wrong: moved, or another tag with the same id.

The displacement of a wrong tag is unknown even roughly: aside on its door, or in another house. So its log distance is
uniform, and the density per square metre falls with the square of the distance. A density that is uniform up to some
radius would make a tag 50 m off impossible, and a prediction of a dozen tags to within metres no better than chance.
"""

from math import log, log1p, pi
from typing import Final

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import FloatArray

# Rate at which an unchanged tag is rejected.
FALSE_ALARM: Final = 1e-4
TAG_GATE: Final = float(chdtri(2, FALSE_ALARM))  # squared Mahalanobis distance
# From a displaced door to the next house. A factor of ten changes the log density by 0.4.
OUTLIER_SCALE_M: Final = 0.5
_WRONG_TO_M: Final = 100.0
_LOG_NORM: Final = log(pi * log1p((_WRONG_TO_M / OUTLIER_SCALE_M) ** 2))


def log_outlier_density(square_m2: FloatArray) -> FloatArray:
    """Return the log density (...), per square metre, of a wrong tag at squared distances (...) from its prediction.

    1 / (r^2 + r_0^2), which is flat below the least distance r_0; normalised up to the largest.
    """
    density: FloatArray = -_LOG_NORM - np.log(square_m2 + OUTLIER_SCALE_M**2)
    return density


def log_outlier_density_at(off_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return (m,) `log_outlier_density` of differences (m, 2) with covariances (m, 2, 2), at their mean square."""
    return log_outlier_density((off_m**2).sum(axis=1) + np.trace(covariance, axis1=1, axis2=2))


def gate_ratio(off_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return (m,) squared sigmas of differences (m, 2) with covariances (m, 2, 2), over the gate; below 1 a tag fits.

    It fits if the difference passes the chi-square test with 2 degrees of freedom, and is more likely than for a wrong
    tag. So a tag predicted only to a few metres proves little.
    """
    squares = squared_sigmas(off_m, covariance)
    ratio: FloatArray = squares / np.clip(squares + 2.0 * log_likelihood_ratio(off_m, covariance), 1e-6, TAG_GATE)
    return ratio


def log_likelihood_ratio(off_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return (m,) log likelihood ratios of fitting over wrong, of differences (m, 2) with covariances (m, 2, 2)."""
    log_fits = -0.5 * (squared_sigmas(off_m, covariance) + np.log(_determinants(covariance))) - log(2.0 * pi)
    worth: FloatArray = log_fits - log_outlier_density_at(off_m, covariance)
    return worth


def squared_sigmas(off_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return (m,) squared Mahalanobis distances v' C^-1 v of differences (m, 2) with covariances (m, 2, 2)."""
    a, b, d = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    x, y = off_m[:, 0], off_m[:, 1]
    squares: FloatArray = (d * x * x - 2.0 * b * x * y + a * y * y) / _determinants(covariance)
    return squares


def _determinants(matrices: FloatArray) -> FloatArray:
    """Return (m,) determinants of (m, 2, 2), positive despite rounding."""
    determinants: FloatArray = matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0]
    return np.maximum(determinants, 1e-300)
