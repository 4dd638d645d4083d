"""Square-root smoothing and mapping: Gauss-Newton and Levenberg-Marquardt on the arrowhead system.

Linearise all factors, eliminate the segments, meet in the border, substitute back: see `arrowhead.system`. Dellaert and
Kaess, "Square Root SAM" (2006). How a step is taken stands in `step`, what comes of it in `damping`. Observations carry
Huber's loss by reweighting, so that a tag which moved bends the map with bounded force only.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
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

# Rounding that changes a covariance by a hundredth is a tenth of what the sigma of a good noise model is off.
MAX_RELATIVE_ERROR: Final = 0.01


# Whitened observations beyond this pull with constant force; 1.1 % of good ones lie there (chi-square, two dimensions).
HUBER_THRESHOLD: Final = 3.0

MAX_STEPS: Final = 100
# A step linearises once where it goes down as it should, and seven times at most (`take_step`).
MAX_TRIES: Final = 7 * MAX_STEPS
# The cost is in squared sigmas: a step that would lower it by this much less is some 1e-5 sigma long.
COST_TOLERANCE: Final = 1e-10
_COST_ROUNDING: Final = 1e-14  # relative
# Where rounding leaves a matrix without a square root, its diagonal is raised by this share, then by ten times as much
# until it has one.
_LEAST_FLOOR: Final = 1e-16
_MOST_FLOOR: Final = 1e-3
_SURE: Final = 10.0
_N_SLOW: Final = 5  # steps in a row whose progress is compared with `least_progress`


class Losses(NamedTuple):
    """Of each kind of factor."""

    odometry: Loss
    observations: Loss


# Observations carry Huber's loss: a tag that moved, or a phantom, bends the map with bounded force only.
DEFAULT_LOSSES: Final = Losses(SQUARES, huber(HUBER_THRESHOLD))
PLAIN_SQUARES: Final = Losses(SQUARES, SQUARES)


@dataclass(frozen=True)
class Problem:
    """All factors of one estimate, and where the variables sit.

    Attributes:
        anchor: (T,) a pose from which each tag was read.
        measured: what somebody measured with a tape, if anything.
    """

    odometry: OdometryFactors
    observations: ObservationFactors
    prior: CalibrationPrior
    columns: Columns
    anchor: IntArray
    measured: Priors = NO_PRIORS

    def check(self, state: State) -> None:
        """Raises ValueError for a state of another problem, which compiled code would read beyond its end."""
        columns = self.columns
        wanted = len(columns.poses), len(columns.tags), len(columns.calibration)
        if (len(state.poses), len(state.tags), len(state.calibration)) != wanted:
            raise ValueError("the state has another number of poses, tags or calibration parameters than the problem")

    def cost(self, state: State, losses: Losses = DEFAULT_LOSSES) -> float:
        """Half the sum of all losses: rho(|r|^2) of odometry and observations, |r|^2 of priors and tape."""
        odometry, _ = losses_and_weights(losses.odometry, self.odometry.residual(state))
        observations, _ = losses_and_weights(losses.observations, self.observations.residual(state))
        prior = (self.prior.residual(state) ** 2).sum() + (self.prior.joint_residual(state) ** 2).sum()
        return 0.5 * float(odometry.sum() + observations.sum() + prior + self.measured.sum_of_squares(state))

    @cached_property
    def arrowhead(self) -> Arrowhead:
        """The order of elimination, settled once."""
        return build_arrowhead(self.odometry, self.observations, self.prior, self.columns, self.measured)

    def reweigh(self, odometry: FloatArray, observations: FloatArray) -> "Problem":
        """The same factors with other whitenings, (M, 3, 3) and (N, 2, 2); the order of elimination is kept."""
        other = replace(
            self,
            odometry=replace(self.odometry, whitening=odometry),
            observations=replace(self.observations, whitening=observations),
        )
        vars(other)["arrowhead"] = reweigh(
            self.arrowhead, other.odometry, other.observations
        )  # where the property has it
        return other

    @property
    def n_residuals(self) -> int:
        """How many measured numbers there are, priors apart."""
        return self.odometry.motion.size + self.observations.value.size + self.measured.n_residuals

    def retract(self, state: State, step: FloatArray) -> State:
        """The state after a step (n,) in the tangent space.

        A tag moves along with its anchor as on a rigid body, and by the rest of its step in the anchor's frame. To
        first order that is adding the step. But where a whole region turns, poses go round on arcs (T o exp(delta)),
        and so tags stay with them instead of leaving on the tangent: full steps work from farther away.
        """
        padded = np.append(step, 0.0)  # column -1: held
        by_pose = padded[self.columns.poses]
        poses = se2.compose(state.poses, se2.exp(by_pose))
        before, turned = state.poses[self.anchor], by_pose[self.anchor]
        from_anchor = se2.apply(se2.inverse(before), state.tags)
        moved_along = turned[:, :2] + turned[:, 2:] * np.stack([-from_anchor[:, 1], from_anchor[:, 0]], axis=-1)
        to_anchor_axes = np.column_stack([np.zeros((len(before), 2)), -before[:, 2]])
        own = se2.apply(to_anchor_axes, padded[self.columns.tags]) - moved_along
        return State(
            poses=poses,
            tags=se2.apply(poses[self.anchor], from_anchor + own),
            calibration=state.calibration + padded[self.columns.calibration],
        )


@dataclass(frozen=True)
class Solution:
    """Where the solve ended and why.

    Attributes:
        costs: one an accepted step, the first before all of them.
        n_linearised: how often all factors were linearised, rejected steps included.
    """

    state: State
    costs: tuple[float, ...]
    reason: str
    converged: bool
    problem: Problem = field(repr=False)
    losses: Losses = field(repr=False, default_factory=lambda: DEFAULT_LOSSES)
    n_linearised: int = 0

    @property
    def cost(self) -> float:
        """At the end."""
        return self.costs[-1]

    @cached_property
    def factorisation(self) -> Factorisation:
        """Of H at the end; with the floor added where H has no square root of its own.

        Raises:
            UnderDeterminedError: a variable is in no factor at all, or measurements are no numbers.
        """
        return self._factorisation_and_floor[0]

    @property
    def floor(self) -> float:
        """Share of H's diagonal that had to be added for a square root in double precision; 0 where all is well."""
        return self._factorisation_and_floor[1]

    @cached_property
    def _factorisation_and_floor(self) -> tuple[Factorisation, float]:
        system, _ = self.problem.arrowhead.linearise(self.state, *self.losses)
        return factorise(self.problem.arrowhead, system, 0.0)

    @cached_property
    def unobservable(self) -> UnobservableDirections:
        """What no factor ties down. Damping leaves it where it was; its covariance is as good as infinite."""
        problem = self.problem
        return find_unobservable(problem.odometry, problem.observations, problem.measured, problem.columns, self.state)

    @property
    def rank(self) -> int:
        """How many of the `problem.columns.n` directions are tied down."""
        return self.problem.columns.n - self.unobservable.n_directions

    def covariance(self, columns: IntArray) -> FloatArray:
        """Joint covariance (k, k) of k columns of the tangent vector, exact to first order; 0 where held (-1)."""
        return self.factorisation.covariance(columns)

    def pose_covariances(self, poses: IntArray) -> FloatArray:
        """Covariance (k, 3, 3) of each of k poses, in its own axes; as `covariance`, but quick for many."""
        return self.factorisation.pose_covariances(poses)

    def relative_error(self) -> float:
        """Estimate of what rounding, and the floor, do to covariances, as a share."""
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
) -> Solution:
    """Minimises the cost: Gauss-Newton steps while they work, damped where one would go up.

    It stops, and `Solution.reason` says which of these it was:

    - "converged": by its linear model the next step, Gauss-Newton's unless damping was needed up to here, would lower
      the cost by no more than the tolerance. At an optimum that is before the first step.
    - "no step lowers the cost": the damping was raised a dozen times in a row without any gain.
    - "steps bring little", where `least_progress` says so.
    - "stopped after N steps", where `most_steps` or `most_tries` says so.
    - "a variable is in no factor", "the cost is no number at the start".

    What nothing ties down stays where it was: damping holds it.

    Args:
        problem: the factors.
        start: values to begin from.
        cost_tolerance: stop where the next step would lower the cost by less.
        losses: of each kind of factor.
        relative_tolerance: or by less than this share.
        most_steps: how many to try.
        most_tries: once factors were linearised so often no further step begins.
        least_progress: stop where several steps in a row together lower the cost by less than this share of it,
            whatever the linear model says.
    """
    problem.check(start)
    arrowhead = problem.arrowhead
    curvature = Curvature(losses)
    system, spare, rows = arrowhead.scratch
    state, n_linearised = start, 1
    _, cost = arrowhead.linearise(state, *losses, out=system)
    costs = [cost]
    last, n_steps, damping, rolled = n_linearised + most_tries, 0, Damping(), False

    def finish(reason: str, *, converged: bool) -> Solution:
        return Solution(state, tuple(costs), reason, converged, problem, losses, n_linearised)

    if not np.isfinite(cost):
        return finish("the cost is no number at the start", converged=False)
    while n_steps < most_steps and n_linearised < last and not damping.is_exhausted:
        n_steps += 1
        try:
            step, expected = _step(arrowhead, system, damping, rows)
        except UnderDeterminedError:
            return finish("a variable is in no factor", converged=False)
        if expected <= cost_tolerance + relative_tolerance * cost:
            return finish("converged", converged=True)
        before = StepStart(state, cost, rolled)
        taken = take_step(arrowhead, curvature.losses, problem.anchor, before, step, expected, spare)
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
        state, cost, rolled = taken.state, taken.cost, taken.rolled
        system, spare = spare, system
        costs.append(cost)
        if curvature.is_due(costs[-2] - cost):
            arrowhead.linearise(state, *curvature.losses, out=system)
            n_linearised += 1
        is_near = damping.is_least and _is_near_enough(expected, gain, relative_tolerance, cost)
        if is_near or _is_slow(costs, least_progress):
            return finish("converged" if is_near else "steps bring little", converged=is_near)
        damping.accept_step(gain)
    reason = "no step lowers the cost" if damping.is_exhausted else f"stopped after {n_steps} steps"
    return finish(reason, converged=False)


def _step(
    arrowhead: Arrowhead, system: NormalEquations, damping: Damping, rows: SquareRootFactor
) -> tuple[FloatArray, float]:
    """The next step, damped as it has to be, and by how much the linear model says that the cost falls.

    Raises:
        UnderDeterminedError: no damping helps.
    """
    factorisation, used = factorise(arrowhead, system, damping.share, rows)
    damping.require(used)
    step = -factorisation.solve_in_order(system.gradient)
    return step, _expected_decrease(system, step, damping.share)


def _is_slow(costs: list[float], least_progress: float) -> bool:
    """Whether the last steps together lowered the cost by less than a share of it."""
    return len(costs) > _N_SLOW and costs[-1 - _N_SLOW] - costs[-1] < least_progress * costs[-1]


def _is_near_enough(expected: float, gain: float, relative_tolerance: float, cost: float) -> bool:
    """Whether what a step leaves over is less than the tolerance, for who does not want the last digit.

    Where the model is off by a share, the next gradient is that share of this one, what another step could bring its
    square. By chance a model is right too early: not for who wants all.
    """
    left = _SURE * expected * (1.0 - gain) ** 2
    return relative_tolerance > _COST_ROUNDING and left <= relative_tolerance * cost


def factorise(
    arrowhead: Arrowhead, system: NormalEquations, damping: float, out: SquareRootFactor | None = None
) -> tuple[Factorisation, float]:
    """R of H + damping diag(H), with as little more damping as it takes in double precision, and the damping used.

    Raises:
        UnderDeterminedError: no damping helps.
    """
    while True:
        try:
            return arrowhead.factorise(system, damping, out), damping
        except UnderDeterminedError:
            if damping > _MOST_FLOOR:
                raise
            damping = max(10.0 * damping, _LEAST_FLOOR)


def _expected_decrease(system: NormalEquations, step: FloatArray, damping: float) -> float:
    """-g s - s H s / 2 of a step with (H + damping D) s = -g."""
    along = -float(system.gradient @ step)
    return 0.5 * (along + damping * diagonal_square(system, step)) if damping else 0.5 * along
