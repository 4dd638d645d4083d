"""Test of goodness of fit without ground truth, for solves that may have converged to a wrong local minimum.

The segments are cut into windows of a few metres, each with its own start and tag positions. Whichever minimum the
whole converged to, windows converge correctly, and their residuals determine the noise of wheels and observations. The
whole is the same problem under conditions: windows join, and a tag has one position. The cost of these conditions, in
squared sigmas of the fitted noise, is chi-square with as many degrees of freedom as there are conditions (the test of
nested linear models: Seber and Lee, "Linear Regression Analysis", 2003, chapter 4), and F since the noise is fitted. A
single wrong observation costs the same on either side. Windows know an uncertain calibration less well, and it is more
biased in them (`sam.bias`); what this costs does not count. Correlated errors of neighbouring observations of a
tag do not show one by one, but do where a tag is observed again; `correlated_errors` fits their size.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.special import fdtri

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.local_map.correlated_errors import fit_correlated_errors
from groundsbot.offline.local_map.windows import (
    WINDOW_M,
    camera_numbers,
    dead_reckon,
    in_windows,
    track_numbers,
    window_of_pose,
)
from groundsbot.offline.sam import (
    DEFAULT_LOSSES,
    MAX_TRIES,
    NO_PRIORS,
    Budget,
    Losses,
    Problem,
    Solution,
    State,
    cost_of_bias,
    losses_and_weights,
    solve,
    stack,
)

# Length over which observations of a tag have correlated errors; a window has several such cells to compare.
_CELL_M: Final = WINDOW_M / 4.0
# False alarm rate for a good map.
FALSE_ALARM: Final = 1e-3
# The prior sigmas count as this many measurements of each kind, unless the data contradict them by a factor of ten: the
# prior mean is first drawn to the data in the same proportion (a prior with uncertain scale: Gelman et al., "Bayesian
# Data Analysis", 2013, chapter 5).
_PRIOR_COUNT: Final = 4.0
# The fit ends when a factor changes by less than this share; far below the effect of its own uncertainty.
_FACTOR_TOLERANCE: Final = 0.02
_MAX_FITS: Final = 20
# Tolerance of the solves whose residuals are used: the relative error of the squares is its root.
_COST_TOLERANCE: Final = 1e-4
_RELATIVE_TOLERANCE: Final = 1e-8
# Least progress of these solves: sigmas are then off by half of it, a fortieth of the tolerance of the fit.
_PROGRESS: Final = 1e-3
# Tolerance of the solves whose costs are compared: far below the standard deviation of a chi-square.
_CHI_SQUARE_TOLERANCE: Final = 1e-3
# A chi-square that is larger than this shows another minimum, also of a drive in a single window: slow convergence may
# leave several times the tolerance on either side.
_SAME_MINIMUM: Final = 0.05
_WORST_SHARE: Final = 0.2
_MOST_MISFIT: Final = 100.0
_FEWEST_WINDOWS: Final = 3
_N_SIGNS: Final = 8
_AT_ONCE: Final = 4096  # motions: a Jacobian of all of them takes as much memory as the solve
_SEED: Final = 7


@dataclass(frozen=True)
class GoodnessOfFit:
    """Cost of the condition that all windows are one map.

    Attributes:
        chi_square: chi-square in squared sigmas of the fitted noise.
        expected: its expectation: the number of conditions.
        bound: exceeded by a good map once in a thousand times.
        odometry_factor: fitted noise of the wheels as a multiple of the given sigmas.
        observation_factor: that of the observations.
    """

    chi_square: float
    expected: int
    bound: float
    odometry_factor: float
    observation_factor: float

    @property
    def fits(self) -> bool:
        """Whether noise explains the cost."""
        return self.chi_square <= self.bound + _SAME_MINIMUM

    def warnings(self, name: str) -> list[str]:
        """Return a warning if it does not fit; `name` is the run's or the component's."""
        if self.fits:
            return []
        sentence = (
            f"{name}: its observations contradict each other by more than their noise allows (chi-square "
            f"{self.chi_square:.0f}, expected {self.expected}, at most {self.bound:.0f}): the solve may have converged "
            "to a wrong place, tags may have been moved, or wheels or tag observations have unmodelled errors. Check "
            "the map before you use it, and drive past known tags more often"
        )
        return [sentence]


@dataclass(frozen=True)
class Windows:
    """Noise and cost of a problem's windows, independent of the minimum that the whole converges to.

    Attributes:
        problem: the whole, under the given sigmas.
        losses: losses of wheels and observations.
        factors: (2,) noise of wheels and of observations as a multiple of the given sigmas.
        trimmed_factors: (2,) the same without the windows of largest cost, since a tag that moves or a robot that is
            carried corrupts a few of them. 0 where there are too few windows.
        correlated_error_factors: (M, 2) further factors on each observation's sigmas, for errors in common with its
            neighbours.
        degrees_of_freedom: effective degrees of freedom of the noise estimate.
        apart: the separate windows solved under that noise.
        n_conditions: number of parameters by which the windows exceed the whole.
        budget: solve budget of the logs, None if unlimited, and the share of it for a solve of the whole.
    """

    problem: Problem
    losses: Losses
    factors: FloatArray
    trimmed_factors: FloatArray
    correlated_error_factors: FloatArray
    degrees_of_freedom: float
    apart: Solution
    n_conditions: int
    budget: Budget | None = None
    share: float = 1.0

    def goodness_of_fit(self, state: State) -> GoodnessOfFit:
        """Return the cost of joining the windows at the minimum near a state."""
        problem = _scale_noise(self.problem, self.factors[0], self.factors[1] * self.correlated_error_factors)
        most_tries = self.budget.max_linearisations(problem, self.share) if self.budget else MAX_TRIES
        together = solve(problem, state, _CHI_SQUARE_TOLERANCE, self.losses, most_tries=most_tries)
        if self.budget:
            self.budget.spend(together)
        n = self.n_conditions
        bound = float(n * fdtri(n, self.degrees_of_freedom, 1.0 - FALSE_ALARM)) if n else 0.0
        chi_square = max(0.0, 2.0 * (together.cost - self.apart.cost))
        if n and chi_square > bound and self.apart.converged and together.converged:
            chi_square = max(0.0, chi_square - cost_of_bias(self.apart, together))
        return GoodnessOfFit(
            chi_square=chi_square,
            expected=n,
            bound=bound,
            odometry_factor=float(self.factors[0]),
            observation_factor=float(self.factors[1]),
        )


def fit_windows(
    problem: Problem,
    losses: Losses = DEFAULT_LOSSES,
    budget: Budget | None = None,
    share: float = 1.0,
    least_shared: FloatArray | float = 0.0,
    *,
    least_factor: float = 0.0,
    noise_is_open: bool = False,
) -> Windows:
    """Solve the windows of a problem separately, from dead reckoning, and fit the noise to their residuals.

    Measurements by a person are left out on both sides: they are tested on their own.

    Args:
        problem: the whole.
        losses: losses of wheels and observations.
        budget: solve budget of the logs, of which a share is for this; None: unlimited. Where it does not suffice
            windows are longer, or not solved to convergence: the whole then seems to fit better than it does.
        share: share of the budget.
        least_shared: (M, 2) lower bound on the variance that an observation has in common with its neighbours, as a
            multiple of the given one, by component.
        least_factor: lower bound on the noise factors. Windows underestimate errors that persist; the noise fitted to
            whole drives is then a lower bound.
        noise_is_open: the given noise is a first guess. The first fit then takes the wheels to be as noisy as dead
            reckoning shows.
    """
    problem = replace(problem, measured=NO_PRIORS) if len(problem.measured) else problem
    apart = _affordable_windows(problem, budget)
    state = dead_reckon(problem, apart)
    left = budget.max_linearisations(apart, share, _MAX_FITS * MAX_TRIES) if budget else _MAX_FITS * MAX_TRIES
    factors, redundancy = np.ones(2), np.zeros(2)
    if noise_is_open:
        factors[0] = _misfit_of_dead_reckoning(apart, state)
    last = factors
    for _ in range(_MAX_FITS):
        solution = _solve_roughly(_scale_noise(apart, *factors), state, losses, min(left, MAX_TRIES))
        left -= solution.n_linearised
        if budget:
            budget.spend(solution)
        squares, redundancy = _losses_and_redundancies(solution)
        squares = squares * factors**2
        believed = (squares + _PRIOR_COUNT) / (redundancy + _PRIOR_COUNT)
        found = np.maximum(np.sqrt((squares + _PRIOR_COUNT * believed) / (redundancy + _PRIOR_COUNT)), least_factor)
        # Wheels and observations compete for the residuals: a factor that reverses had overshot, so half a step is
        # taken.
        turns_back = (found / factors - 1.0) * (factors / last - 1.0) < 0.0
        last, factors = factors, np.where(turns_back, np.sqrt(found * factors), found)
        state = solution.state
        del solution  # frees its memory before the next one
        if left <= 0 or np.abs(factors / last - 1.0).max() < _FACTOR_TOLERANCE:
            break
    # Drives that only a tape measurement joins have more unknowns together than apart.
    n_conditions = max(0, degrees_of_freedom(problem) - degrees_of_freedom(apart))
    sharing, freedom = np.ones_like(problem.observations.value), float((redundancy + _PRIOR_COUNT).min())
    most_tries = max(1, min(left, MAX_TRIES))
    if not n_conditions:
        solution = solve(_scale_noise(apart, *factors), state, _CHI_SQUARE_TOLERANCE, losses, most_tries=most_tries)
    else:
        solution = _solve_roughly(_scale_noise(apart, *factors), state, losses, most_tries)
        if budget:
            budget.spend(solution)
        sharing, known_like = _correlated_error_factors(problem, solution, least_shared / factors[1] ** 2)
        sharing = np.maximum(sharing, least_factor / factors[1])
        freedom, state = min(freedom, known_like), solution.state
        del solution
        shared = _scale_noise(apart, factors[0], factors[1] * sharing)
        solution = solve(shared, state, _CHI_SQUARE_TOLERANCE, losses, most_tries=most_tries)
    if budget:
        budget.spend(solution)
    usual = factors * _trimmed_factors(solution)
    return Windows(problem, losses, factors, usual, sharing, freedom, replace(solution), n_conditions, budget, share)


def _misfit_of_dead_reckoning(apart: Problem, state: State) -> float:
    """Return the RMS of the observations' residuals in sigmas, between 1 and `_MOST_MISFIT`.

    The noise of the wheels is first taken as so many times the given one. If wheels are far worse than given, the first
    solve would otherwise move tags to where the wheels have the robot, and some windows would stay there.
    """
    residual = apart.observations.residual(state)
    return float(np.clip(np.sqrt((residual**2).mean()), 1.0, _MOST_MISFIT)) if len(residual) else 1.0


def _trimmed_factors(solution: Solution) -> FloatArray:
    """Return (2,) factors on the noise of wheels and of observations when the fifth of worst windows is left out."""
    problem, state = solution.problem, solution.state
    begins = np.ones(len(state.poses), dtype=np.bool_)
    begins[problem.odometry.first + 1] = False
    window = np.cumsum(begins) - 1
    found = np.ones(2)
    of_wheels = solution.losses.odometry, problem.odometry.residual(state), problem.odometry.first
    of_observations = solution.losses.observations, problem.observations.residual(state), problem.observations.pose
    for kind, (loss, residual, pose) in enumerate((of_wheels, of_observations)):
        losses, _ = losses_and_weights(loss, residual)
        n = np.bincount(window[pose], minlength=int(begins.sum())).astype(np.float64)
        left = np.bincount(window[pose], losses, len(n))[n > 0.0]
        n = n[n > 0.0]
        kept = np.argsort(left / n, kind="stable")[: len(n) - math.ceil(_WORST_SHARE * len(n))]
        if len(n) < _FEWEST_WINDOWS:
            found[kind] = 0.0  # too few windows
        elif left.sum() > 0.0:
            found[kind] = np.sqrt(left[kept].sum() / n[kept].sum() * n.sum() / left.sum())
    return found


def _correlated_error_factors(
    problem: Problem, solution: Solution, least_shared: FloatArray | float
) -> tuple[FloatArray, float]:
    """Return factors on the sigmas of observations for correlated errors, and their effective degrees of freedom."""
    observations = problem.observations
    camera = camera_numbers(observations)
    of_camera = observations.tag * (1 + int(camera.max(initial=0))) + camera
    cell = track_numbers(window_of_pose(problem, _CELL_M)[observations.pose], of_camera)
    errors = fit_correlated_errors(solution, cell)
    return errors.factors(cell, least_shared), errors.degrees_of_freedom(cell)


def _solve_roughly(problem: Problem, state: State, losses: Losses, most_tries: int) -> Solution:
    """Solve until the squares of the residuals have converged, not yet the cost."""
    solution = solve(
        problem, state, _COST_TOLERANCE, losses, _RELATIVE_TOLERANCE, most_tries=most_tries, least_progress=_PROGRESS
    )
    problem.arrowhead.without_scratch()  # using the residuals needs as much memory again
    return solution


def _affordable_windows(problem: Problem, budget: Budget | None) -> Problem:
    """Return the problem in windows, longer ones where the budget does not suffice for so many separate tags."""
    window_m = WINDOW_M
    apart = in_windows(problem)
    driven_m = float(np.hypot(problem.odometry.motion[:, 0], problem.odometry.motion[:, 1]).sum())
    while budget and window_m < driven_m and not budget.suffices(apart):
        window_m *= 2.0
        apart = in_windows(problem, window_m)
    return apart


def _scale_noise(problem: Problem, odometry_factor: float, observation_factor: float | FloatArray) -> Problem:
    """Return the problem with the noise of wheels and observations scaled; (M, 2) where observations differ."""
    by_row = np.broadcast_to(observation_factor, problem.observations.value.shape)[..., None]
    odometry, observations = problem.odometry.whitening / odometry_factor, problem.observations.whitening / by_row
    return problem.reweigh(odometry, observations)


def degrees_of_freedom(problem: Problem) -> int:
    """Return the number of measurements, priors included, less the number of unknowns."""
    return problem.n_residuals + int((problem.columns.calibration >= 0).sum()) - problem.columns.n


def _losses_and_redundancies(solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Return losses (2,) of wheels and observations at the solution, and their redundancies (2,).

    The redundancy is the number of residuals less the trace of J H^-1 J^T, an average over random signs z of z^T J H^-1
    J^T z (Hutchinson, "A stochastic estimator of the trace of the influence matrix", 1989).
    """
    problem, state = solution.problem, solution.state
    odometry, _ = losses_and_weights(solution.losses.odometry, problem.odometry.residual(state))
    observations, _ = losses_and_weights(solution.losses.observations, problem.observations.residual(state))
    columns, n_columns = problem.columns, problem.columns.n
    signs = np.random.default_rng(_SEED).choice([-1.0, 1.0], (_N_SIGNS, problem.odometry.motion.size))
    pulled = np.zeros((_N_SIGNS, n_columns))
    for begin in range(0, len(problem.odometry.first), _AT_ONCE):
        some = slice(begin, begin + _AT_ONCE)
        jacobian, _ = stack((problem.odometry.part(some).linearise(state, columns),), n_columns)
        pulled += (jacobian.T @ signs[:, 3 * begin : 3 * begin + jacobian.shape[0]].T).T
    taken = float((pulled.T * solution.factorisation.solve_many(pulled.T)).sum()) / _N_SIGNS
    free = max(0.0, problem.odometry.motion.size - taken)
    whole = max(0, degrees_of_freedom(problem))
    return np.array([odometry.sum(), observations.sum()]), np.array([min(free, whole), max(0.0, whole - free)])
