"""Robust losses, applied by iteratively reweighted least squares.

With s the squared length of a whitened residual, a loss rho(s) has the weight rho'(s) in the normal equations.
Huber, "Robust estimation of a location parameter" (1964).
"""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import FloatMatrix, inline, inner, njit

_SQUARES: Final = 0
_HUBER: Final = 1


class Loss(NamedTuple):
    """A loss function of the length of a whitened residual.

    Attributes:
        form: quadratic or Huber.
        threshold: length above which the loss is not quadratic.
        least_curvature: curvature along the residual beyond the threshold, relative to the weight, in the matrix of a
            step. The second derivative of Huber's loss is zero there (Triggs, McLauchlan, Hartley and Fitzgibbon,
            "Bundle adjustment: a modern synthesis", 2000, section 4.3). At 1 the matrix is that of weighted squares.
    """

    form: int
    threshold: float
    least_curvature: float = 1.0


SQUARES: Final = Loss(_SQUARES, 1.0)


def huber(threshold: float) -> Loss:
    """Return Huber's loss: quadratic up to the threshold, linear beyond."""
    return Loss(_HUBER, threshold)


@inner
def loss_and_weight(loss: Loss, square: float) -> tuple[float, float]:
    """Return loss rho and weight rho' of a squared length."""
    c2 = loss.threshold * loss.threshold
    if loss.form == _SQUARES or square <= c2:
        return square, 1.0
    length = np.sqrt(square)
    return loss.threshold * (2.0 * length - loss.threshold), loss.threshold / length


@inline
def bend(loss: Loss, square: float, r: FloatArray, J: FloatArray) -> None:
    """Scale r (2,) up and J (2, n) down along r to the curvature of the loss; J^T r is unchanged."""
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
def losses_and_weights(loss: Loss, residual: FloatMatrix) -> tuple[FloatArray, FloatArray]:
    """Return losses (M,) and weights (M,) of whitened residuals (M, n)."""
    losses, weights = np.empty(len(residual)), np.empty(len(residual))
    for m in range(len(residual)):
        square = 0.0
        for i in range(residual.shape[1]):
            square += residual[m, i] * residual[m, i]
        losses[m], weights[m] = loss_and_weight(loss, square)
    return losses, weights
