"""Least squares on tag corners: Gauss-Newton steps while they work, less of one or damped ones else."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.factors import SpatialState
from groundsbot.offline.corners.multifrontal.fronts import FrontFactor, NotPositiveError
from groundsbot.offline.corners.multifrontal.kernels import FrontalSystem
from groundsbot.offline.corners.picture_tilt import Pictures, pictures_at
from groundsbot.offline.corners.problem import CornerProblem
from groundsbot.offline.sam import Damping

_MOST_STEPS: Final = 40
# What is tried of a step, the most first. What hangs loose is swung by metres on an arc that a whole step overshoots;
# damping that holds it back lets it only creep from then on.
_SHARES: Final = (1.0, 0.5, 0.2)
# In squared sigmas: a step that brings less is 1e-4 sigma long. It is taken, and what it leaves over is
# smaller still by far.
_COST_TOLERANCE: Final = 1e-8
# A step that brings so little is taken for one of the last. H hardly changes any more: its factor is kept while each
# step promises at most so much of the one before.
_NEAR: Final = 1e-2
_CLOSING: Final = 0.1


@dataclass(frozen=True)
class CornerSolution:
    """Where the solve ended and why.

    Attributes:
        factor: of H where the last steps were made, 0.1 sigma from the end at most; None where it did not converge.
        costs: one an accepted step, the first before all of them.
    """

    state: SpatialState
    costs: tuple[float, ...]
    reason: str
    problem: CornerProblem = field(repr=False)
    factor: FrontFactor | None = field(repr=False, default=None)

    @property
    def converged(self) -> bool:
        """Whether it did."""
        return self.factor is not None

    @property
    def cost(self) -> float:
        """At the end."""
        return self.costs[-1]

    @cached_property
    def pictures(self) -> Pictures:
        """What the looks say of how pictures stand at the end."""
        return pictures_at(self.problem, self.state)

    def covariance(self, columns: IntArray) -> FloatArray:
        """Joint covariance (k, k) of k columns of the tangent vector; 0 where held (-1).

        Raises:
            ValueError: something is not tied down, or the solve did not converge.
        """
        if self.factor is None:
            raise ValueError(f"no covariance: {self.reason}")
        return self.factor.covariance(columns)


class _Step(NamedTuple):
    """By a factor of H; (n,) in the tangent vector; what it promises of the cost, and by the slope alone; its end."""

    factor: FrontFactor
    by: FloatArray
    expected: float
    by_slope: float
    state: SpatialState

    def predicted_decrease(self, share: float) -> float:
        """By how much the cost falls with a share of it, by the linear model: evenly, but for a square."""
        return share * self.by_slope - share**2 * (self.by_slope - self.expected)


class _StepResult(NamedTuple):
    """What came of a step: where it led, and what it brought as a share of what it promised."""

    state: SpatialState
    system: FrontalSystem
    cost: float
    gain: float


class _LastSteps(NamedTuple):
    """Where the last steps end, and the cost after each but the last."""

    state: SpatialState
    costs: list[float]


def solve_corners(problem: CornerProblem, start: SpatialState) -> CornerSolution:
    """Minimises the cost from a start near the solution.

    It stops, and `reason` says which of these it was: "converged", "no step lowers the cost", "stopped after N steps",
    "something is not tied down", "the cost is no number at the start".
    """
    state, damping = start, Damping()
    system, cost = problem.system(state)
    costs = [cost]

    def finish(reason: str, factor: FrontFactor | None = None) -> CornerSolution:
        return CornerSolution(state, tuple(costs), reason, problem, factor)

    if not np.isfinite(cost):
        return finish("the cost is no number at the start")
    while len(costs) <= _MOST_STEPS:
        try:
            step = _step(problem, system, state, damping.share)
        except NotPositiveError:
            return finish("something is not tied down")
        if step.expected <= _COST_TOLERANCE:
            state = step.state
            return finish("converged", step.factor if damping.is_least else problem.factor(state))
        if step.expected <= _NEAR and damping.is_least:
            closed_in = _last_steps(problem, step, cost)
            if closed_in is not None:
                state = closed_in.state
                costs += closed_in.costs
                return finish("converged", step.factor)
        taken = _take_step(problem, state, step, cost)
        if taken is not None:
            damping.accept_step(taken.gain)
            state, system, cost = taken.state, taken.system, taken.cost
            costs.append(cost)
            continue
        damping.reject_step()
        if damping.is_exhausted:
            return finish("no step lowers the cost")
        system, _ = problem.system(state)  # its entries became the factor
    return finish(f"stopped after {_MOST_STEPS} steps")


def _step(problem: CornerProblem, system: FrontalSystem, state: SpatialState, share: float) -> _Step:
    """Gauss-Newton's, the diagonal raised by a share; the factor takes the system's entries."""
    raised = share * problem.order.diagonal_of(system) if share else None
    factor = problem.order.factorise(system, raised)
    step = -factor.solve(system.gradient)
    by_slope = -float(system.gradient @ step)
    expected = 0.5 * by_slope
    if raised is not None:
        expected += 0.5 * float((raised * step**2).sum())
    return _Step(factor, step, expected, by_slope, problem.retract(state, step))


def _take_step(problem: CornerProblem, state: SpatialState, step: _Step, cost: float) -> _StepResult | None:
    """The step, or less of it; None where none of that goes down."""
    for share in _SHARES:
        there = step.state if share == 1.0 else problem.retract(state, share * step.by)
        system, found = problem.system(there)
        if found < cost:
            return _StepResult(there, system, found, (cost - found) / step.predicted_decrease(share))
    return None


def _last_steps(problem: CornerProblem, step: _Step, cost: float) -> _LastSteps | None:
    """The last steps, by one factor, as H hardly changes any more; None where it takes more than a few."""
    state, costs, before = step.state, list[float](), step.expected
    while True:
        system, now = problem.system(state, is_whole=False)
        by = -step.factor.solve(system.gradient)
        expected = -0.5 * float(system.gradient @ by)
        if not (now < cost and expected < _CLOSING * before):
            return None
        costs.append(now)
        state, cost, before = problem.retract(state, by), now, expected
        if expected <= _COST_TOLERANCE:
            return _LastSteps(state, costs)
