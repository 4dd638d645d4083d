"""How uneven a floor is: sigmas of how pictures stand off level, fitted to their corners.

They minimise the restricted likelihood in Laplace's approximation: the cost at the solution, half the logarithm of the
determinant of the corners' marginal covariance, and half that of the estimate's information (Harville, "Maximum
likelihood approaches to variance component estimation", 1977). A floor rolls and pitches alike.
"""

from dataclasses import replace
from typing import Any, Final

import numpy as np
from scipy.optimize import minimize
from scipy.stats import chi2

from calib.arrays import FloatArray
from offline.corner_factors import SpatialState
from offline.corner_problem import CornerProblem
from offline.fronts import NotPositiveError

LEVEL: Final = np.zeros(3)
# rad and m: a floor between a hall's and a lawn's; first looked for about here, and ten times nearer to level.
_USUAL: Final = np.array([0.005, 0.005, 0.002])
_NEARER: Final = 0.1
# A level floor is said to be uneven once in a thousand times.
_BETTER: Final = 0.5 * float(chi2.isf(1e-3, 2))
_TOLERANCE: Final = 0.05  # of a sigma, as a share
_UNLIKELINESS_TOLERANCE: Final = 0.1  # chance moves it by more
_MOST_LOOKS: Final = 40


def guessed_wobble(problem: CornerProblem, state: SpatialState) -> FloatArray:
    """(3,) sigmas in WOBBLE to begin with, zeros where a level floor explains the corners as well.

    Args:
        problem: of a level floor.
        state: its solution.
    """
    guesses = [scale * _USUAL for scale in (1.0, _NEARER)]
    unlikely = [_unlikeliness(with_wobble(problem, sigma), state) for sigma in (LEVEL, *guesses)]
    best = int(np.argmin(unlikely[1:]))
    return guesses[best] if unlikely[1 + best] < unlikely[0] - _BETTER else LEVEL


def fitted_wobble(problem: CornerProblem, state: SpatialState) -> FloatArray:
    """(3,) sigmas in WOBBLE of an uneven floor, looked for from the problem's own.

    Args:
        problem: of some floor that is not level.
        state: its solution.
    """

    def unlikely(logarithm: FloatArray) -> float:
        return _unlikeliness(with_wobble(problem, np.exp(logarithm)[[0, 0, 1]]), state)

    start: FloatArray = np.log(problem.wobble_sigma[1:])
    options: Any = {"xatol": _TOLERANCE, "fatol": _UNLIKELINESS_TOLERANCE, "maxfev": _MOST_LOOKS}  # typed without fatol
    found = minimize(unlikely, start, method="Nelder-Mead", options=options)
    best: FloatArray = np.exp(found.x)[[0, 0, 1]]
    return best


def with_wobble(problem: CornerProblem, sigma: FloatArray) -> CornerProblem:
    """The problem with pictures that stand off level by other sigmas."""
    other = replace(problem, wobble_sigma=sigma)
    if problem.wobble_sigma.any() == sigma.any():
        # Settled once for all sigmas but zero, which couple the same columns.
        vars(other).update(
            {name: value for name, value in vars(problem).items() if name in ("order", "pictures", "pairs")}
        )
    return other


def _unlikeliness(problem: CornerProblem, state: SpatialState) -> float:
    """The negative logarithm of the restricted likelihood, up to a constant."""
    normals, cost = problem.linearise(state)
    try:
        factor = problem.order.factorise(problem.order.assembled([normal.matrix for normal in normals]))
    except NotPositiveError:
        return np.inf
    return cost + 0.5 * (problem.log_spread(state) + factor.log_determinant())
