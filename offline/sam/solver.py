"""Square-root smoothing and mapping: Gauss-Newton and Levenberg-Marquardt on the arrowhead system.

Each iteration (`minimisation`) linearises all factors and solves the normal equations by elimination
(`arrowhead.system`), after Dellaert and Kaess, "Square Root SAM" (2006). `step` applies the step and `damping` controls
its length. Observations
have Huber's loss by iterative reweighting, which bounds the influence of a tag that was moved.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam.arrowhead.build import build_arrowhead, reweigh
from groundsbot.offline.sam.arrowhead.system import Arrowhead, Factorisation
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    Columns,
    ObservationFactors,
    OdometryFactors,
    State,
)
from groundsbot.offline.sam.factors.priors import NO_PRIORS, Priors
from groundsbot.offline.sam.linearisation.robust_losses import SQUARES, Loss, huber, losses_and_weights
from groundsbot.offline.sam.minimisation import (
    COST_ROUNDING,
    COST_TOLERANCE,
    MAX_STEPS,
    MAX_TRIES,
    Stopping,
    factorise,
    minimise,
)
from groundsbot.offline.sam.observability import UnobservableDirections, find_unobservable

# A relative error of 0.01 in a covariance is a tenth of the error in the sigmas of a good noise model.
MAX_RELATIVE_ERROR: Final = 0.01

# In sigmas; 1.1 % of observations with the assumed noise exceed it (chi-square, two degrees of freedom).
HUBER_THRESHOLD: Final = 3.0


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
        self.columns.check(state)

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

    def without_factors(self) -> "Problem":
        """Return the problem without odometry and observations, most of its memory."""
        none = np.zeros(0, dtype=np.int64)
        return replace(self, odometry=self.odometry.part(none), observations=self.observations.part(none))

    def without_arrowhead(self) -> None:
        """Release the order of elimination, which is computed again where it is needed."""
        vars(self).pop("arrowhead", None)

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

    def covariance(self, columns: IntArray, first: int = 0) -> FloatArray:
        """Return the joint covariance (k, k) of k columns of the tangent vector, to first order; 0 where fixed (-1).

        Columns of the covariance before `first` are left out and not computed.
        """
        return self.factorisation.covariance(columns, first)

    def tag_covariances(self) -> FloatArray:
        """Return the covariances (T, 2, 2) of all tags, without those between them; 0 where fixed."""
        return self.factorisation.tag_covariances()

    def tag_covariance_times(self, vectors: FloatArray) -> FloatArray:
        """Return the product (2 T, n) of the joint covariance (2 T, 2 T) of all tags, 0 where fixed, with vectors."""
        tags, products = self.problem.columns.tags.reshape(-1), np.empty(vectors.shape)
        for i, vector in enumerate(vectors.T):
            whole = np.zeros(self.problem.columns.n + 1)  # the last entry is that of fixed columns
            whole[tags] = vector
            products[:, i] = np.append(self.factorisation.solve(whole[:-1]), 0.0)[tags]
        return products

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
    relative_tolerance: float = COST_ROUNDING,
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
    stopping = Stopping(cost_tolerance, relative_tolerance, most_steps, most_tries, least_progress)
    found = minimise(problem.arrowhead, problem.anchor, start, losses, stopping)
    solution = Solution(
        found.state, found.costs, found.reason, found.converged, problem, losses, n_linearised=found.n_linearised
    )
    return _with_factorisation(solution, found.factorisation if keep_factorisation else None)


def _with_factorisation(solution: Solution, factorisation: Factorisation | None) -> Solution:
    """Return the solution with its factorisation, if known, which no later solve may then overwrite."""
    if factorisation is not None:
        factorisation.arrowhead.without_scratch()
        vars(solution)["_factorisation_and_floor"] = factorisation, 0.0  # cached property
    return solution
