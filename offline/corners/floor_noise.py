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

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.corners.factors import SpatialState
from groundsbot.offline.corners.multifrontal.fronts import FrontFactor, NotPositiveError
from groundsbot.offline.corners.multifrontal.kernels import add_vectors
from groundsbot.offline.corners.picture_tilt import Pictures, pictures_at
from groundsbot.offline.corners.problem import LOOKS, CornerProblem

LEVEL: Final = np.zeros(3)
# rad and m: a floor between a hall's and a lawn's; first looked for about here, and ten times nearer to level.
_USUAL: Final = np.array([0.005, 0.005, 0.002])
_NEARER: Final = 0.1
# In sigmas of the slope; where the likelihood says that a floor is uneven it is 3.7 or more.
_SHOWS: Final = 2.0
_PROBES: Final = 2
# A level floor is said to be uneven once in a thousand times.
_BETTER: Final = 0.5 * float(chi2.isf(1e-3, 2))
_TOLERANCE: Final = 0.05  # of a sigma, as a share
_UNLIKELINESS_TOLERANCE: Final = 0.1  # chance moves it by more
_MOST_LOOKS: Final = 40


def initial_attitude_sigmas(
    problem: CornerProblem, state: SpatialState, factor: FrontFactor | None = None, pictures: Pictures | None = None
) -> FloatArray:
    """(3,) sigmas in WOBBLE to begin with, zeros where a level floor explains the corners as well.

    Args:
        problem: of a level floor.
        state: its solution.
        factor: of H there, if it is at hand.
        pictures: as they stand there, if they are at hand.
    """
    try:
        shows = _shows(problem, pictures or pictures_at(problem, state), factor or problem.factor(state))
    except NotPositiveError:  # something is not tied down, and how a floor lies is the least of it
        return LEVEL
    if not shows:
        return LEVEL
    guesses = [scale * _USUAL for scale in (1.0, _NEARER)]
    unlikely = [_unlikeliness(with_attitude_sigmas(problem, sigma), state) for sigma in (LEVEL, *guesses)]
    best = int(np.argmin(unlikely[1:]))
    return guesses[best] if unlikely[1 + best] < unlikely[0] - _BETTER else LEVEL


def _shows(problem: CornerProblem, pictures: Pictures, factor: FrontFactor) -> bool:
    """Whether a level floor leaves over more than chance in how pictures stand, by the slope of the likelihood there.

    By the square of a sigma that is half of sum f^2 - tr(B^T P B) over pictures, with f = B^T W r what pulls at a
    picture and P = W - W J H^-1 J^T W. What the estimate takes of the trace is looked for with random signs
    (Hutchinson, "A stochastic estimator of the trace of the influence matrix", 1990). A quarter of the work of one look
    at the likelihood, of which three would be needed.
    """
    picture, _, own, force, coupled = pictures
    kind, random = problem.order.kinds[LOOKS], np.random.default_rng(0)
    for of in (slice(0, 2), slice(2, 3)):
        whole = float(np.trace(own[:, of, of], axis1=1, axis2=2).sum())
        probes = np.zeros((_PROBES, problem.columns.n))
        for probe in probes:
            signs = random.choice([-1.0, 1.0], size=force[:, of].shape)
            add_vectors(kind, np.einsum("mk,mkc->mc", signs[picture], coupled[:, of]), probe)
        left = whole - float((factor.whiten(probes) ** 2).sum()) / _PROBES
        spread = float(np.sqrt(2.0 * (own[:, of, of] ** 2).sum())) * left / whole
        if (force[:, of] ** 2).sum() - left > _SHOWS * spread:
            return True
    return False


def fit_attitude_sigmas(problem: CornerProblem, state: SpatialState) -> FloatArray:
    """(3,) sigmas in WOBBLE of an uneven floor, looked for from the problem's own.

    Args:
        problem: of some floor that is not level.
        state: its solution.
    """

    def unlikely(logarithm: FloatArray) -> float:
        return _unlikeliness(with_attitude_sigmas(problem, np.exp(logarithm)[[0, 0, 1]]), state)

    start: FloatArray = np.log(problem.attitude_sigmas[1:])
    options: Any = {"xatol": _TOLERANCE, "fatol": _UNLIKELINESS_TOLERANCE, "maxfev": _MOST_LOOKS}  # typed without fatol
    found = minimize(unlikely, start, method="Nelder-Mead", options=options)
    best: FloatArray = np.exp(found.x)[[0, 0, 1]]
    return best


def with_attitude_sigmas(problem: CornerProblem, sigma: FloatArray) -> CornerProblem:
    """The problem with pictures that stand off level by other sigmas."""
    other = replace(problem, attitude_sigmas=sigma)
    if problem.attitude_sigmas.any() == sigma.any():
        # Settled once for all sigmas but zero, which couple the same columns.
        vars(other).update(
            {name: value for name, value in vars(problem).items() if name in ("order", "motions", "pictures", "pairs")}
        )
    return other


def _unlikeliness(problem: CornerProblem, state: SpatialState) -> float:
    """The negative logarithm of the restricted likelihood, up to a constant."""
    system, cost = problem.system(state)
    try:
        factor = problem.order.factorise(system)
    except NotPositiveError:
        return np.inf
    return cost + 0.5 * (problem.log_determinant(state) + factor.log_determinant())
