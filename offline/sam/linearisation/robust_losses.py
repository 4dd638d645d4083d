"""Losses that bound what one wrong measurement can do, as weights of plain squares.

With s the squared length of a whitened residual, a loss rho(s) has the weight rho'(s) in the normal equations.
Huber, "Robust estimation of a location parameter" (1964).
"""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import inline, inner, njit

_SQUARES: Final = 0
_HUBER: Final = 1

# None at all would leave a tag that is only read beyond the threshold without a place to go to.
_LEAST_CURVATURE: Final = 0.01


class Loss(NamedTuple):
    """Which loss, and from what length of the whitened residual on it differs from the square.

    Attributes:
        least_curvature: for the matrix of a step only: a loss that bends away from the square curves less along the
            residual than across, Huber's not at all beyond its threshold (Triggs, McLauchlan, Hartley and Fitzgibbon,
            "Bundle adjustment: a modern synthesis", 2000, section 4.3). So many times the weight is left there. At 1
            the matrix is that of weighted squares.
    """

    form: int
    threshold: float
    least_curvature: float = 1.0


SQUARES: Final = Loss(_SQUARES, 1.0)


def huber(threshold: float) -> Loss:
    """Squares up to the threshold, then linear: constant force."""
    return Loss(_HUBER, threshold)


def with_curvature(loss: Loss) -> Loss:
    """The same loss with the matrix of its steps as near to its second derivative as leaves it a square root.

    By weights alone each step leaves over a share of the way, nearly all of it where many observations lie beyond the
    threshold.
    """
    return loss._replace(least_curvature=_LEAST_CURVATURE) if loss.form == _HUBER else loss


@inner
def loss_and_weight(loss: Loss, square: float) -> tuple[float, float]:
    """Loss rho and weight rho' of a squared length."""
    c2 = loss.threshold * loss.threshold
    if loss.form == _SQUARES or square <= c2:
        return square, 1.0
    length = np.sqrt(square)
    return loss.threshold * (2.0 * length - loss.threshold), loss.threshold / length


@inline
def bend(loss: Loss, square: float, r: FloatArray, J: FloatArray) -> None:
    """Scales (2,) r up and (2, n) J down along r where the loss curves less there, so that J' r stays the same."""
    if loss.least_curvature == 1.0 or square <= loss.threshold * loss.threshold:
        return
    share = np.sqrt(loss.least_curvature)
    taken = (1.0 - share) / square
    for k in range(J.shape[1]):
        along = taken * (r[0] * J[0, k] + r[1] * J[1, k])
        J[0, k] -= along * r[0]
        J[1, k] -= along * r[1]
    r[0] /= share
    r[1] /= share


@njit
def losses_and_weights(loss: Loss, residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(M,) losses and (M,) weights of whitened residuals (M, n)."""
    losses, weights = np.empty(len(residual)), np.empty(len(residual))
    for m in range(len(residual)):
        square = 0.0
        for i in range(residual.shape[1]):
            square += residual[m, i] * residual[m, i]
        losses[m], weights[m] = loss_and_weight(loss, square)
    return losses, weights
