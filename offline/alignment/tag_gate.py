"""Whether a tag lies where others foretell it, or is wrong: moved, or another tag with its number.

Of a wrong tag it is not known how far off it lies, not even roughly: aside on its door, or in another house. So each
order of magnitude is taken to be as likely as any other, and the density per square metre falls with the square of
the distance. A density that is the same out to some reach would take a tag 50 m off for impossible, and hence what
foretells a dozen tags to within metres for hardly better than chance.
"""

from math import log, log1p, pi
from typing import Final

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import FloatArray

# What is as both maps have it is taken for wrong so rarely.
FALSE_ALARM: Final = 1e-4
TAG_GATE: Final = float(chi2.isf(FALSE_ALARM, 2))  # squared sigmas
# From what bends a door to the next house. Ten times less or more moves the log of the density by 0.4.
WRONG_FROM_M: Final = 0.5
_WRONG_TO_M: Final = 100.0
_LOG_NORM: Final = log(pi * log1p((_WRONG_TO_M / WRONG_FROM_M) ** 2))


def log_wrong(square_m2: FloatArray) -> FloatArray:
    """(...) log density, per square metre, of a wrong tag at squared distances (...) from where it should be.

    1 / (r^2 + r_0^2), which is flat below the least distance r_0; normalised up to the largest.
    """
    density: FloatArray = -_LOG_NORM - np.log(square_m2 + WRONG_FROM_M**2)
    return density


def log_wrong_there(off_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """(m,) `log_wrong` of differences (m, 2) known to covariances (m, 2, 2): at the mean square that they make."""
    return log_wrong((off_m**2).sum(axis=1) + np.trace(covariance, axis1=1, axis2=2))


def gate_ratio(off_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """(m,) squared sigmas of differences (m, 2) with covariances (m, 2, 2), over what a tag may have that fits.

    It fits if chance explains the difference, chi-square with 2 degrees, and explains it better than a wrong tag would.
    So a tag whose place is foretold to a few metres only proves little.
    """
    squares = squared_sigmas(off_m, covariance)
    ratio: FloatArray = squares / np.clip(squares + 2.0 * log_likelihood_ratio(off_m, covariance), 1e-6, TAG_GATE)
    return ratio


def log_likelihood_ratio(off_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """(m,) log of how much better differences (m, 2) with covariances (m, 2, 2) explain tags than being wrong does."""
    log_fits = -0.5 * (squared_sigmas(off_m, covariance) + np.log(_determinants(covariance))) - log(2.0 * pi)
    worth: FloatArray = log_fits - log_wrong_there(off_m, covariance)
    return worth


def squared_sigmas(off_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """(m,) v' C^-1 v of differences (m, 2) with covariances (m, 2, 2)."""
    a, b, d = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    x, y = off_m[:, 0], off_m[:, 1]
    squares: FloatArray = (d * x * x - 2.0 * b * x * y + a * y * y) / _determinants(covariance)
    return squares


def _determinants(matrices: FloatArray) -> FloatArray:
    """(m,) of (m, 2, 2), positive whatever the rounding."""
    determinants: FloatArray = matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0]
    return np.maximum(determinants, 1e-300)
