"""Sigmas of attitude and height of images on an uneven floor, fitted to tag corners.

They maximise the restricted likelihood in Laplace's approximation. Its negative logarithm is the sum of the cost at the
solution, half the log determinant of the corners' marginal covariance, and half that of the estimate's information
(Harville, "Maximum likelihood approaches to variance component estimation", 1977). Roll and pitch have the same sigma.
"""

from dataclasses import replace
from typing import Any, Final

import numpy as np
from scipy.optimize import minimize
from scipy.special import chdtri

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.corners.factors import SpatialState
from groundsbot.offline.corners.picture_tilt import Pictures, pictures_at
from groundsbot.offline.corners.problem import DETECTIONS, CornerProblem
from groundsbot.offline.sam import FrontFactor, NotPositiveError, add_vectors

LEVEL: Final = np.zeros(3)
# Initial sigmas in rad and m, between those of a hall and of a lawn; a tenth of them is tried too.
_INITIAL: Final = np.array([0.005, 0.005, 0.002])
_SMALLER: Final = 0.1
# In sigmas of the score; where the likelihood ratio is significant, the score is 3.7 or more.
_SIGNIFICANT: Final = 2.0
_PROBES: Final = 2
# False alarm rate of 0.001 for a level floor.
_LEAST_LOG_RATIO: Final = 0.5 * float(chdtri(2, 1e-3))
_TOLERANCE: Final = 0.05  # relative tolerance of a sigma
_LIKELIHOOD_TOLERANCE: Final = 0.1  # well below its random variation
_MAX_EVALUATIONS: Final = 40


def initial_attitude_sigmas(
    problem: CornerProblem, state: SpatialState, factor: FrontFactor | None = None, pictures: Pictures | None = None
) -> FloatArray:
    """Return initial sigmas (3,) of ATTITUDE; zeros if a level floor explains the corners as well.

    Args:
        problem: problem with a level floor.
        state: its solution.
        factor: factor of H at the solution, if available.
        pictures: result of `pictures_at` at the solution, if available.
    """
    try:
        is_uneven = _is_uneven(problem, pictures or pictures_at(problem, state), factor or problem.factor(state))
    except NotPositiveError:  # not all variables are observable
        return LEVEL
    if not is_uneven:
        return LEVEL
    guesses = [scale * _INITIAL for scale in (1.0, _SMALLER)]
    values = [_negative_log_likelihood(with_attitude_sigmas(problem, sigma), state) for sigma in (LEVEL, *guesses)]
    best = int(np.argmin(values[1:]))
    return guesses[best] if values[1 + best] < values[0] - _LEAST_LOG_RATIO else LEVEL


def _is_uneven(problem: CornerProblem, pictures: Pictures, factor: FrontFactor) -> bool:
    """Test a level floor against an uneven one by the score of the restricted likelihood.

    The derivative of its logarithm with respect to the square of a sigma is half of sum f^2 - tr(B^T P B) over images,
    with f = B^T W r and P = W - W J H^-1 J^T W. The part of the trace with H^-1 is estimated with random signs
    (Hutchinson, "A stochastic estimator of the trace of the influence matrix", 1990). The test takes a quarter of the
    time of one evaluation of the likelihood, and saves three of them.
    """
    picture, _, own, force, coupled = pictures
    kind, random = problem.order.kinds[DETECTIONS], np.random.default_rng(0)
    for of in (slice(0, 2), slice(2, 3)):
        whole = float(np.trace(own[:, of, of], axis1=1, axis2=2).sum())
        probes = np.zeros((_PROBES, problem.columns.n))
        for probe in probes:
            signs = random.choice([-1.0, 1.0], size=force[:, of].shape)
            add_vectors(kind, np.einsum("mk,mkc->mc", signs[picture], coupled[:, of]), probe)
        trace = whole - float((factor.whiten(probes) ** 2).sum()) / _PROBES
        sigma = float(np.sqrt(2.0 * (own[:, of, of] ** 2).sum())) * trace / whole
        if (force[:, of] ** 2).sum() - trace > _SIGNIFICANT * sigma:
            return True
    return False


def fit_attitude_sigmas(problem: CornerProblem, state: SpatialState) -> FloatArray:
    """Fit the sigmas (3,) of roll, pitch (rad) and height (m) on an uneven floor, starting at those of the problem.

    Args:
        problem: problem with nonzero sigmas.
        state: its solution.
    """

    def objective(logarithm: FloatArray) -> float:
        return _negative_log_likelihood(with_attitude_sigmas(problem, np.exp(logarithm)[[0, 0, 1]]), state)

    start: FloatArray = np.log(problem.attitude_sigmas[1:])
    options: Any = {  # the stub of scipy does not have fatol
        "xatol": _TOLERANCE,
        "fatol": _LIKELIHOOD_TOLERANCE,
        "maxfev": _MAX_EVALUATIONS,
    }
    found = minimize(objective, start, method="Nelder-Mead", options=options)
    best: FloatArray = np.exp(found.x)[[0, 0, 1]]
    return best


def with_attitude_sigmas(problem: CornerProblem, sigma: FloatArray) -> CornerProblem:
    """Return the problem with other sigmas (3,) of roll, pitch (rad) and height (m) of each image."""
    other = replace(problem, attitude_sigmas=sigma)
    if problem.attitude_sigmas.any() == sigma.any():
        # The order of elimination is the same for all nonzero sigmas.
        vars(other).update(
            {name: value for name, value in vars(problem).items() if name in ("order", "motions", "pictures", "pairs")}
        )
    return other


def _negative_log_likelihood(problem: CornerProblem, state: SpatialState) -> float:
    """Return the negative logarithm of the restricted likelihood, up to a constant."""
    system, cost = problem.system(state)
    try:
        factor = problem.order.factorise(system)
    except NotPositiveError:
        return np.inf
    return cost + 0.5 * (problem.log_determinant(state) + factor.log_determinant())
