"""Square-root smoothing and mapping: Gauss-Newton and Levenberg-Marquardt on the arrowhead system.

Each iteration linearises all factors and solves the normal equations by elimination (`arrowhead.system`), after
Dellaert and Kaess, "Square Root SAM" (2006). `step` applies the step and `damping` controls its length. Observations
have Huber's loss by iterative reweighting, which bounds the influence of a tag that was moved.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam.arrowhead.build import build_arrowhead, reweigh
from groundsbot.offline.sam.arrowhead.system import Arrowhead, Factorisation, UnderDeterminedError
from groundsbot.offline.sam.curvature import Curvature
from groundsbot.offline.sam.damping import Damping
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    Columns,
    ObservationFactors,
    OdometryFactors,
    State,
)
from groundsbot.offline.sam.factors.priors import NO_PRIORS, Priors
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor
from groundsbot.offline.sam.linearisation.kernels import diagonal_square
from groundsbot.offline.sam.linearisation.robust_losses import SQUARES, Loss, huber, losses_and_weights
from groundsbot.offline.sam.observability import UnobservableDirections, find_unobservable
from groundsbot.offline.sam.step import StepStart, take_step

# A relative error of 0.01 in a covariance is a tenth of the error in the sigmas of a good noise model.
MAX_RELATIVE_ERROR: Final = 0.01

# In sigmas; 1.1 % of observations with the assumed noise exceed it (chi-square, two degrees of freedom).
HUBER_THRESHOLD: Final = 3.0

MAX_STEPS: Final = 100
# `take_step` linearises once if the cost decreases as predicted, and at most six times.
MAX_TRIES: Final = 7 * MAX_STEPS
# In squared sigmas; a step with this predicted decrease is about 1e-5 sigma long.
COST_TOLERANCE: Final = 1e-10
_COST_ROUNDING: Final = 1e-14  # relative
# If rounding makes H indefinite, the damping is raised from the first of these to the second in factors of ten.
_LEAST_FLOOR: Final = 1e-16
_MOST_FLOOR: Final = 1e-3
_SAFETY_FACTOR: Final = 10.0
_N_SLOW: Final = 5  # consecutive steps whose total decrease is compared with `least_progress`


class Losses(NamedTuple):
    """Losses of the two kinds of measurement factors."""

    odometry: Loss
    observations: Loss


# Huber's loss bounds the influence of moved tags and of false detections.
DEFAULT_LOSSES: Final = Losses(SQUARES, huber(HUBER_THRESHOLD))
PLAIN_SQUARES: Final = Losses(SQUARES, SQUARES)


@dataclass(frozen=True)
class Problem:
    """A nonlinear least-squares problem: all factors, and the columns of the variables in the tangent vector.

    Attributes:
        odometry: motions between consecutive poses.
        observations: relative positions of tags, each from one pose.
        prior: Gaussian priors of the calibration parameters.
        columns: where each of P poses, T tags and C calibration parameters stands in the tangent vector.
        anchor: (T,) index of the pose that each tag moves with when a step is applied (`retract`); it observed the tag.
        measured: tape measurements between starts or tags, and the joint prior of a finished map, if any.
    """

    odometry: OdometryFactors
    observations: ObservationFactors
    prior: CalibrationPrior
    columns: Columns
    anchor: IntArray
    measured: Priors = NO_PRIORS

    def check(self, state: State) -> None:
        """Check that the state has the sizes of this problem, since compiled loops do not check bounds.

        Raises:
            ValueError: the sizes differ.
        """
        columns = self.columns
        wanted = len(columns.poses), len(columns.tags), len(columns.calibration)
        if (len(state.poses), len(state.tags), len(state.calibration)) != wanted:
            raise ValueError("the state has another number of poses, tags or calibration parameters than the problem")

    def cost(self, state: State, losses: Losses = DEFAULT_LOSSES) -> float:
        """Return half the sum of all losses: rho(|r|^2) of odometry and observations, |r|^2 of priors and tape."""
        odometry, _ = losses_and_weights(losses.odometry, self.odometry.residual(state))
        observations, _ = losses_and_weights(losses.observations, self.observations.residual(state))
        prior = (self.prior.residual(state) ** 2).sum() + (self.prior.joint_residual(state) ** 2).sum()
        return 0.5 * float(odometry.sum() + observations.sum() + prior + self.measured.sum_of_squares(state))

    @cached_property
    def arrowhead(self) -> Arrowhead:
        """The arrowhead system, with the order of elimination computed once."""
        return build_arrowhead(self.odometry, self.observations, self.prior, self.columns, self.measured)

    def reweigh(self, odometry: FloatArray, observations: FloatArray) -> "Problem":
        """Return the problem with other whitenings, (M, 3, 3) and (N, 2, 2), and the same order of elimination."""
        other = replace(
            self,
            odometry=replace(self.odometry, whitening=odometry),
            observations=replace(self.observations, whitening=observations),
        )
        vars(other)["arrowhead"] = reweigh(self.arrowhead, other.odometry, other.observations)  # cached property
        return other

    @property
    def n_residuals(self) -> int:
        """Number of measured scalars, priors excluded."""
        return self.odometry.motion.size + self.observations.value.size + self.measured.n_residuals

    @property
    def n_factors(self) -> int:
        """Number of odometry factors and observations."""
        return len(self.odometry.first) + len(self.observations.tag)

    def retract(self, state: State, step: FloatArray) -> State:
        """Return the state after a step (n,) in the tangent space.

        A tag moves rigidly with its anchor pose, and by the remainder of its step in the anchor's frame. To first order
        this adds the step. If a whole region rotates, the poses move on arcs (T o exp(delta)), and the tags stay with
        them instead of moving on the tangent. Full steps then converge from larger initial errors.
        """
        return self.arrowhead.retract(state, self.arrowhead.in_order(step), self.anchor)


@dataclass(frozen=True)
class Solution:
    """The result of a solve.

    Attributes:
        costs: initial cost, then the cost after each accepted step, and after `bias.correct_bias` that of its state.
        reason: why the solve stopped; see `solve`.
        n_linearised: number of linearisations of all factors, including those of rejected steps.
        bias_share: share of its bias that the state was corrected by, see `bias.correct_bias`.
    """

    state: State
    costs: tuple[float, ...]
    reason: str
    converged: bool
    problem: Problem = field(repr=False)
    losses: Losses = field(repr=False, default_factory=lambda: DEFAULT_LOSSES)
    n_linearised: int = 0
    bias_share: float = 0.0

    @property
    def cost(self) -> float:
        """Final cost."""
        return self.costs[-1]

    @cached_property
    def factorisation(self) -> Factorisation:
        """Factorisation of H at the solution, damped by `floor` if H is not positive definite in double precision.

        Raises:
            UnderDeterminedError: a variable is in no factor, or measurements are not finite.
        """
        return self._factorisation_and_floor[0]

    @property
    def floor(self) -> float:
        """Damping that makes H positive definite in double precision, relative to its diagonal; normally 0."""
        return self._factorisation_and_floor[1]

    @cached_property
    def _factorisation_and_floor(self) -> tuple[Factorisation, float]:
        system, _ = self.problem.arrowhead.linearise(self.state, *self.losses)
        return factorise(self.problem.arrowhead, system, 0.0)

    @cached_property
    def unobservable(self) -> UnobservableDirections:
        """Directions that no factor observes. Damping keeps them at their start; their variance is unbounded."""
        problem = self.problem
        return find_unobservable(problem.odometry, problem.observations, problem.measured, problem.columns, self.state)

    @property
    def rank(self) -> int:
        """Number of observable directions among `problem.columns.n`."""
        return self.problem.columns.n - self.unobservable.n_directions

    def covariance(self, columns: IntArray) -> FloatArray:
        """Return the joint covariance (k, k) of k columns of the tangent vector, to first order; 0 where fixed (-1)."""
        return self.factorisation.covariance(columns)

    def pose_covariances(self, poses: IntArray) -> FloatArray:
        """Return the covariance (k, 3, 3) of each of k poses, in its own axes; faster than `covariance` for many."""
        return self.factorisation.pose_covariances(poses)

    def relative_error(self) -> float:
        """Estimate the relative error of covariances from rounding and from `floor`."""
        return self.factorisation.relative_error()


def solve(
    problem: Problem,
    start: State,
    cost_tolerance: float = COST_TOLERANCE,
    losses: Losses = DEFAULT_LOSSES,
    relative_tolerance: float = _COST_ROUNDING,
    most_steps: int = MAX_STEPS,
    most_tries: int = MAX_TRIES,
    least_progress: float = 0.0,
    *,
    keep_factorisation: bool = False,
) -> Solution:
    """Minimise the cost by Gauss-Newton steps, with Levenberg-Marquardt damping after a step that does not lower it.

    `Solution.reason` is one of:

    - "converged": the predicted decrease of the next step is within the tolerance. At an optimum this is the case
      before the first step.
    - "no step lowers the cost": the damping was raised a dozen times in a row without success.
    - "the last steps lowered the cost too little": see `least_progress`.
    - "stopped after N steps": see `most_steps` and `most_tries`.
    - "a variable is in no factor", "the cost is not a number at the start".

    Damping keeps unobservable directions at their starting values.

    Args:
        problem: factors and columns.
        start: initial state.
        cost_tolerance: bound on the predicted decrease at convergence, in squared sigmas.
        losses: losses of odometry and observations.
        relative_tolerance: bound on the predicted decrease at convergence, relative to the cost; added to the other.
        most_steps: maximum number of steps.
        most_tries: number of linearisations after which no further step begins.
        least_progress: stop when the last steps together lowered the cost by less than this share of it.
        keep_factorisation: keep that of the last step for `Solution`, where it is the same.
    """
    problem.check(start)
    arrowhead = problem.arrowhead
    curvature = Curvature(losses)
    system, spare, rows = arrowhead.scratch
    state, n_linearised, spares = start, 1, [spare]
    _, cost = arrowhead.linearise(state, *losses, out=system)
    costs = [cost]
    last, n_steps, damping, relative = n_linearised + most_tries, 0, Damping(), False

    def finish(reason: str, *, converged: bool) -> Solution:
        return Solution(state, tuple(costs), reason, converged, problem, losses, n_linearised)

    if not np.isfinite(cost):
        return finish("the cost is not a number at the start", converged=False)
    while n_steps < most_steps and n_linearised < last and not damping.is_exhausted:
        n_steps += 1
        try:
            step, expected, factorisation = _step(arrowhead, system, damping, rows)
        except UnderDeterminedError:
            return finish("a variable is in no factor", converged=False)
        if expected <= cost_tolerance + relative_tolerance * cost:
            is_kept = keep_factorisation and damping.share == 0.0 and curvature.losses == losses
            return _with_factorisation(finish("converged", converged=True), factorisation if is_kept else None)
        before = StepStart(state, cost, relative)
        taken = take_step(arrowhead, curvature.losses, problem.anchor, before, step, expected, spares)
        n_linearised += taken.n_linearised
        if curvature.misleads(cost - taken.cost, expected):
            arrowhead.linearise(state, *curvature.losses, out=system)
            n_linearised += 1
            continue
        if not taken.cost < cost:
            damping.reject_step()
            continue
        expected *= taken.share * (2.0 - taken.share)
        gain = (cost - taken.cost) / expected
        state, cost, relative = taken.state, taken.cost, taken.relative
        system, spares[taken.spare] = spares[taken.spare], system
        costs.append(cost)
        if curvature.is_due(costs[-2] - cost):
            arrowhead.linearise(state, *curvature.losses, out=system)
            n_linearised += 1
        is_near = damping.is_least and _is_near_enough(expected, gain, relative_tolerance, cost)
        if is_near or _is_slow(costs, least_progress):
            return finish("converged" if is_near else "the last steps lowered the cost too little", converged=is_near)
        damping.accept_step(gain)
    reason = "no step lowers the cost" if damping.is_exhausted else f"stopped after {n_steps} steps"
    return finish(reason, converged=False)


def _step(
    arrowhead: Arrowhead, system: NormalEquations, damping: Damping, rows: SquareRootFactor
) -> tuple[FloatArray, float, Factorisation]:
    """Return the next step, in the arrowhead's order, its predicted decrease of the cost, and the factorisation.

    Raises:
        UnderDeterminedError: H is not positive definite at any damping.
    """
    factorisation, used = factorise(arrowhead, system, damping.share, rows)
    damping.require(used)
    step = -factorisation.solve_in_order(system.gradient)
    return step, _expected_decrease(system, step, damping.share), factorisation


def _with_factorisation(solution: Solution, factorisation: Factorisation | None) -> Solution:
    """Return the solution with its factorisation, if known, which no later solve may then overwrite."""
    if factorisation is not None:
        factorisation.arrowhead.without_scratch()
        vars(solution)["_factorisation_and_floor"] = factorisation, 0.0  # cached property
    return solution


def _is_slow(costs: list[float], least_progress: float) -> bool:
    """Return whether the last steps together lowered the cost by less than a share of it."""
    return len(costs) > _N_SLOW and costs[-1 - _N_SLOW] - costs[-1] < least_progress * costs[-1]


def _is_near_enough(expected: float, gain: float, relative_tolerance: float, cost: float) -> bool:
    """Return whether the predicted decrease after a step is within a relative tolerance above the default.

    If the linear model was off by a share, the next gradient is that share of this one, and its predicted decrease the
    square of it. The model can also agree by chance far from the optimum, so the default tolerance does not use this.
    """
    remaining = _SAFETY_FACTOR * expected * (1.0 - gain) ** 2
    return relative_tolerance > _COST_ROUNDING and remaining <= relative_tolerance * cost


def factorise(
    arrowhead: Arrowhead, system: NormalEquations, damping: float, out: SquareRootFactor | None = None
) -> tuple[Factorisation, float]:
    """Factorise H + damping diag(H), with more damping if double precision requires it.

    Returns:
        The factorisation and the damping used.

    Raises:
        UnderDeterminedError: H is not positive definite at any damping.
    """
    while True:
        try:
            return arrowhead.factorise(system, damping, out), damping
        except UnderDeterminedError:
            if damping > _MOST_FLOOR:
                raise
            damping = max(10.0 * damping, _LEAST_FLOOR)


def _expected_decrease(system: NormalEquations, step: FloatArray, damping: float) -> float:
    """Return the predicted decrease -g s - s H s / 2 of a step s with (H + damping D) s = -g."""
    along = -float(system.gradient @ step)
    return 0.5 * (along + damping * diagonal_square(system, step)) if damping else 0.5 * along
