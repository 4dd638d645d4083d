"""Does a solve fit together? A check that knows no truth, for solves that may have ended in a wrong place.

The segments are cut into windows of a few metres, each with its own start and its own place for each tag. In whichever
valley the whole ended, a window is solved right, and what it leaves over shows how large the noise of wheels and
readings is. The whole is the same problem under conditions: windows join, and a tag has one place. What the conditions
cost, in squared sigmas of the noise so fitted, is chi-square with as many degrees of freedom as there are conditions
(the test of nested linear models: Seber and Lee, "Linear Regression Analysis", 2003, chapter 4), and F since the noise
is fitted. A reading that is simply wrong costs the same on either side. Errors that neighbouring readings of a tag
share are invisible one by one, but not where a tag is met again; `correlated_errors` fits how large they are.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy import stats

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import chain_motions
from groundsbot.offline.local_map.correlated_errors import fit_shared_errors
from groundsbot.offline.sam import (
    DEFAULT_LOSSES,
    MAX_TRIES,
    NO_PRIORS,
    Columns,
    Losses,
    OdometryFactors,
    Problem,
    Solution,
    SolveBudget,
    State,
    losses_and_weights,
    solve,
    stack,
)

# Long enough for a tag to pass by, short enough that dead reckoning is in the right basin.
WINDOW_M: Final = 10.0
# Over which readings of a tag share an error; a window has several to compare.
_CELL_M: Final = WINDOW_M / 4.0
# Once in a thousand good maps.
FALSE_ALARM: Final = 1e-3
# The sigmas that the estimate was told count like this many measurements of each kind, but not where measurements say
# that they are ten times off: what counts is drawn to the measurements first, in the same proportion (a prior of which
# the scale is uncertain too: Gelman et al., "Bayesian Data Analysis", 2013, chapter 5).
_TOLD: Final = 4.0
# Fits end where a factor changes by less than this share; far below what the factors' own uncertainty moves the bound.
_FACTOR_TOLERANCE: Final = 0.02
_MAX_FITS: Final = 20
# Of the solves whose residuals are asked for: what their squares are off by is the root of it.
_COST_TOLERANCE: Final = 1e-4
_RELATIVE_TOLERANCE: Final = 1e-8
_ROUNDING: Final = 1e-6
_WORST_SHARE: Final = 0.2
_FEWEST_WINDOWS: Final = 3
_N_SIGNS: Final = 8
_AT_ONCE: Final = 4096  # motions: a Jacobian of all of them takes as much memory as the solve
_SEED: Final = 7


@dataclass(frozen=True)
class GoodnessOfFit:
    """What it costs that all windows are one map.

    Attributes:
        chi_square: in squared sigmas of the fitted noise.
        expected: how much of it noise accounts for: the number of conditions.
        bound: what a good map exceeds once in a thousand times.
        odometry_factor: the wheels' noise as a multiple of the sigmas that the estimate was told.
        reading_factor: that of the readings.
    """

    chi_square: float
    expected: int
    bound: float
    odometry_factor: float
    reading_factor: float

    @property
    def fits(self) -> bool:
        """Whether noise accounts for it."""
        return self.chi_square <= self.bound + _ROUNDING

    def warnings(self, name: str) -> list[str]:
        """A sentence where it does not; `name` is the run's or the component's."""
        if self.fits:
            return []
        sentence = (
            f"{name}: its readings contradict each other by more than their noise allows (chi-square "
            f"{self.chi_square:.0f}, expected {self.expected}, at most {self.bound:.0f}): the solve may have ended in "
            "a wrong place, tags may have been moved, or wheels or readings err in ways of their own; look at the map "
            "before you trust it, and drive past known tags more often"
        )
        return [sentence]


@dataclass(frozen=True)
class Windows:
    """What the windows of a problem say, whichever valley the whole may end in.

    Attributes:
        problem: the whole, by the sigmas that the estimate was told.
        losses: of wheels and readings.
        factors: (2,) the noise of wheels and of readings as a multiple of those sigmas.
        usual_factors: (2,) the same in most windows, less those that leave most over: a tag that moves, or a robot that
            is carried, spoils a few of them. 0 where there are too few windows.
        sharing: (M, 2) what else multiplies each reading's sigmas, for errors that it shares with its neighbours.
        freedom: what chi-square's degrees of freedom the noise is known like.
        cost: of all windows apart, under that noise.
        n_conditions: how many numbers more the windows have to fit with than the whole.
        effort: what the logs are worth, without end where None, and the share of it that a solve of the whole may take.
    """

    problem: Problem
    losses: Losses
    factors: FloatArray
    usual_factors: FloatArray
    sharing: FloatArray
    freedom: float
    cost: float
    n_conditions: int
    effort: SolveBudget | None = None
    share: float = 1.0

    def judge(self, state: State) -> GoodnessOfFit:
        """What it costs to join them in the valley of a state."""
        problem = _scale_noise(self.problem, self.factors[0], self.factors[1] * self.sharing)
        most_tries = self.effort.max_linearisations(problem, self.share) if self.effort else MAX_TRIES
        together = solve(problem, state, losses=self.losses, most_tries=most_tries)
        if self.effort:
            self.effort.spend(together)
        n = self.n_conditions
        quantile = stats.f.isf(FALSE_ALARM, n, self.freedom) if n else 1.0
        return GoodnessOfFit(
            chi_square=max(0.0, 2.0 * (together.cost - self.cost)),
            expected=n,
            bound=float(n * quantile),
            odometry_factor=float(self.factors[0]),
            reading_factor=float(self.factors[1]),
        )


def fit_windows(
    problem: Problem,
    losses: Losses = DEFAULT_LOSSES,
    effort: SolveBudget | None = None,
    share: float = 1.0,
    least_shared: FloatArray | float = 0.0,
    *,
    least_factor: float = 0.0,
) -> Windows:
    """Solves the windows of a problem on their own, from dead reckoning, and fits the noise to what they leave over.

    What somebody measured is left out on both sides: it is held against the map on its own.

    Args:
        problem: the whole.
        losses: of wheels and readings.
        effort: what the logs are worth, of which a share is for this; without end where None. Where it does not suffice
            windows are longer, or not solved to their end: the whole then seems to fit better than it does.
        share: of it.
        least_shared: (M, 2) variance that a reading shares with its neighbours at least, as a multiple of the told one,
            by component.
        least_factor: the noise is taken to be so many times as large as told at least. Where errors last, windows show
            too little of them: what was fitted to whole drives is then the least.
    """
    problem = replace(problem, measured=NO_PRIORS) if len(problem.measured) else problem
    apart = _affordable_windows(problem, effort)
    state = _dead_reckon(problem, apart)
    left = effort.max_linearisations(apart, share, _MAX_FITS * MAX_TRIES) if effort else _MAX_FITS * MAX_TRIES
    factors, redundancy = np.ones(2), np.zeros(2)
    last = np.ones(2)
    for _ in range(_MAX_FITS):
        solution = _solve_roughly(_scale_noise(apart, *factors), state, losses, min(left, MAX_TRIES))
        left -= solution.n_linearised
        if effort:
            effort.spend(solution)
        squares, redundancy = _mean_squares(solution)
        squares = squares * factors**2
        believed = (squares + _TOLD) / (redundancy + _TOLD)
        found = np.maximum(np.sqrt((squares + _TOLD * believed) / (redundancy + _TOLD)), least_factor)
        # Wheels and readings share out what is left over: one that turns back had gone too far, and half is taken.
        turns_back = (found / factors - 1.0) * (factors / last - 1.0) < 0.0
        last, factors = factors, np.where(turns_back, np.sqrt(found * factors), found)
        state = solution.state
        del solution  # and what it takes, before the next one
        if left <= 0 or np.abs(factors / last - 1.0).max() < _FACTOR_TOLERANCE:
            break
    # Drives that only a tape joins have more unknowns together than apart.
    n_conditions = max(0, freedom_of(problem) - freedom_of(apart))
    sharing, freedom = np.ones_like(problem.readings.value), float((redundancy + _TOLD).min())
    most_tries = max(1, min(left, MAX_TRIES))
    if not n_conditions:
        solution = solve(_scale_noise(apart, *factors), state, losses=losses, most_tries=most_tries)
    else:
        solution = _solve_roughly(_scale_noise(apart, *factors), state, losses, most_tries)
        if effort:
            effort.spend(solution)
        sharing, known_like = _sharing(problem, solution, least_shared / factors[1] ** 2)
        sharing = np.maximum(sharing, least_factor / factors[1])
        freedom, state = min(freedom, known_like), solution.state
        del solution
        shared = _scale_noise(apart, factors[0], factors[1] * sharing)
        solution = solve(shared, state, losses=losses, most_tries=most_tries)
    if effort:
        effort.spend(solution)
    usual = factors * _without_the_worst(solution)
    return Windows(problem, losses, factors, usual, sharing, freedom, solution.cost, n_conditions, effort, share)


def _without_the_worst(solution: Solution) -> FloatArray:
    """(2,) how many times the sigmas of wheels and of readings what windows leave over has, the worst fifth aside."""
    problem, state = solution.problem, solution.state
    begins = np.ones(len(state.poses), dtype=np.bool_)
    begins[problem.odometry.first + 1] = False
    window = np.cumsum(begins) - 1
    found = np.ones(2)
    of_wheels = solution.losses.odometry, problem.odometry.residual(state), problem.odometry.first
    of_readings = solution.losses.readings, problem.readings.residual(state), problem.readings.pose
    for kind, (loss, residual, pose) in enumerate((of_wheels, of_readings)):
        losses, _ = losses_and_weights(loss, residual)
        n = np.bincount(window[pose], minlength=int(begins.sum())).astype(np.float64)
        left = np.bincount(window[pose], losses, len(n))[n > 0.0]
        n = n[n > 0.0]
        kept = np.argsort(left / n, kind="stable")[: len(n) - math.ceil(_WORST_SHARE * len(n))]
        if len(n) < _FEWEST_WINDOWS:
            found[kind] = 0.0  # nobody knows what is usual
        elif left.sum() > 0.0:
            found[kind] = np.sqrt(left[kept].sum() / n[kept].sum() * n.sum() / left.sum())
    return found


def _sharing(problem: Problem, solution: Solution, least_shared: FloatArray | float) -> tuple[FloatArray, float]:
    """Factors on the sigmas of readings, for what neighbours share, and what freedom their variance is known like."""
    cell = _track_numbers(_window_of_pose(problem, _CELL_M)[problem.readings.pose], problem.readings.tag)
    errors = fit_shared_errors(solution, cell)
    return errors.factors(cell, least_shared), errors.freedom(cell)


def _solve_roughly(problem: Problem, state: State, losses: Losses, most_tries: int) -> Solution:
    """To where its cost is not yet that of the end, but squares of what is left over are."""
    solution = solve(problem, state, _COST_TOLERANCE, losses, _RELATIVE_TOLERANCE, most_tries=most_tries)
    problem.arrowhead.without_scratch()  # who looks at what is left over needs as much room again
    return solution


def _affordable_windows(problem: Problem, effort: SolveBudget | None) -> Problem:
    """In windows, which are longer where there is not enough effort for so many tags of their own."""
    window_m = WINDOW_M
    apart = in_windows(problem)
    driven_m = float(np.hypot(problem.odometry.motion[:, 0], problem.odometry.motion[:, 1]).sum())
    while effort and window_m < driven_m and not effort.suffices(apart):
        window_m *= 2.0
        apart = in_windows(problem, window_m)
    return apart


def in_windows(problem: Problem, window_m: float = WINDOW_M) -> Problem:
    """The same poses cut into windows: no motion leads from one to the next, and each has tags of its own."""
    window = _window_of_pose(problem, window_m)
    odometry, readings = problem.odometry, problem.readings
    inside: BoolArray = window[odometry.first] == window[odometry.first + 1]
    tag = _track_numbers(window[readings.pose], readings.tag)
    _, first_reading = np.unique(tag, return_index=True)
    return Problem(
        odometry=_part(odometry, inside),
        readings=replace(readings, tag=tag),
        prior=problem.prior,
        columns=_columns(window, len(first_reading), problem.columns.calibration >= 0),
        anchor=readings.pose[first_reading],
    )


def _part(odometry: OdometryFactors, which: BoolArray | slice) -> OdometryFactors:
    return replace(
        odometry,
        first=odometry.first[which],
        motion=odometry.motion[which],
        whitening=odometry.whitening[which],
        jacobian=odometry.jacobian[which],
        parameters=odometry.parameters[which],
    )


def _window_of_pose(problem: Problem, window_m: float) -> IntArray:
    """(P,) rising numbers, a new one at each segment's start."""
    n_poses = len(problem.columns.poses)
    driven_m, follows = np.zeros(n_poses), np.zeros(n_poses, dtype=np.bool_)
    after = problem.odometry.first + 1
    driven_m[after] = np.hypot(problem.odometry.motion[:, 0], problem.odometry.motion[:, 1])
    follows[after] = True
    starts = np.flatnonzero(~follows)
    along_m = np.cumsum(driven_m)
    along_m -= np.repeat(along_m[starts], np.diff(np.append(starts, n_poses)))
    number = (along_m / window_m).astype(np.int64)
    begins = ~follows
    begins[1:] |= number[1:] != number[:-1]
    return np.cumsum(begins) - 1


def _track_numbers(part: IntArray, tag: IntArray) -> IntArray:
    """(M,) a number of its own for each tag in each part of the way, from 0 without gaps."""
    _, number = np.unique(part * (int(tag.max(initial=0)) + 1) + tag, return_inverse=True)
    return np.asarray(number, dtype=np.int64)


def _columns(window: IntArray, n_tags: int, calibrated: BoolArray) -> Columns:
    """Each window's first pose is held."""
    free = np.append(False, window[1:] == window[:-1])
    poses = np.where(free[:, None], 3 * (np.cumsum(free) - 1)[:, None] + np.arange(3), -1)
    n = 3 * int(free.sum())
    tags = n + np.arange(2 * n_tags).reshape(n_tags, 2)
    n += 2 * n_tags
    return Columns(poses, tags, np.where(calibrated, n + np.cumsum(calibrated) - 1, -1), n + int(calibrated.sum()))


def _dead_reckon(problem: Problem, windows: Problem) -> State:
    """Motions one after the other, by nominal calibration; tags where their readings put them on average."""
    first, motion = problem.odometry.first, problem.odometry.motion
    poses = np.zeros((len(problem.columns.poses), 3))
    for part in np.split(np.arange(len(first)), np.flatnonzero(np.diff(first) != 1) + 1):
        if len(part):
            poses[first[part[0]] : first[part[-1]] + 2] = chain_motions(motion[part], np.zeros(3))
    readings = windows.readings
    n_tags = len(windows.columns.tags)
    state = State(poses, np.zeros((n_tags, 2)), np.zeros(len(problem.prior.sigma)))
    places, n = readings.places_in_map(state), np.bincount(readings.tag, minlength=n_tags)
    mean = [np.bincount(readings.tag, places[:, axis], n_tags) / n for axis in (0, 1)]
    return State(poses, np.stack(mean, axis=-1), state.calibration)


def _scale_noise(problem: Problem, odometry_factor: float, reading_factor: float | FloatArray) -> Problem:
    """With the noise of wheels and readings so many times as large; (M, 2) where readings differ in that."""
    by_row = np.broadcast_to(reading_factor, problem.readings.value.shape)[..., None]
    odometry, readings = problem.odometry.whitening / odometry_factor, problem.readings.whitening / by_row
    return problem.reweigh(odometry, readings)


def freedom_of(problem: Problem) -> int:
    """Measured numbers, priors included, over unknowns."""
    return problem.n_residuals + int((problem.columns.calibration >= 0).sum()) - problem.columns.n


def _mean_squares(solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Losses (2,) of wheels and readings at the solution, and how much of them noise accounts for.

    The latter is the number of residuals less the trace of J H^-1 J^T, an average over random signs z of
    z^T J H^-1 J^T z (Hutchinson, "A stochastic estimator of the trace of the influence matrix", 1989).
    """
    problem, state = solution.problem, solution.state
    odometry, _ = losses_and_weights(solution.losses.odometry, problem.odometry.residual(state))
    readings, _ = losses_and_weights(solution.losses.readings, problem.readings.residual(state))
    columns, n_columns = problem.columns, problem.columns.n
    signs = np.random.default_rng(_SEED).choice([-1.0, 1.0], (_N_SIGNS, problem.odometry.motion.size))
    pulled = np.zeros((_N_SIGNS, n_columns))
    for begin in range(0, len(problem.odometry.first), _AT_ONCE):
        some = slice(begin, begin + _AT_ONCE)
        jacobian, _ = stack((_part(problem.odometry, some).linearise(state, columns),), n_columns)
        pulled += (jacobian.T @ signs[:, 3 * begin : 3 * begin + jacobian.shape[0]].T).T
    taken = float((pulled.T * solution.factorisation.solve_many(pulled.T)).sum()) / _N_SIGNS
    free = max(0.0, problem.odometry.motion.size - taken)
    whole = max(0, freedom_of(problem))
    return np.array([odometry.sum(), readings.sum()]), np.array([min(free, whole), max(0.0, whole - free)])
