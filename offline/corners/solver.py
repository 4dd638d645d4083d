"""Nonlinear least squares on tag corners: Gauss-Newton steps with step shortening and Levenberg-Marquardt damping."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.factors import SpatialState
from groundsbot.offline.corners.picture_tilt import Pictures, pictures_at
from groundsbot.offline.corners.problem import CornerProblem
from groundsbot.offline.sam import Damping, FrontalSystem, FrontFactor, NotPositiveError

_MOST_STEPS: Final = 100  # where residuals are large, a step may gain only a quarter of what is left
# Shares of a step that are tried. Weakly determined parts of the map move by metres on arcs, which a full step
# overshoots. Damping would slow them down in all later steps.
_SHARES: Final = (1.0, 0.5, 0.2)
# Beyond this gain ratio a quadratic cost is still lower at twice the step. Where most detections are outliers, their
# weights make the steps of Gauss-Newton far too short, and near a saddle point they stay short for dozens of steps.
_TOO_SHORT: Final = 1.5
# In squared sigmas: a step with a smaller predicted decrease is 1e-4 sigma long. It is applied without evaluation.
_COST_TOLERANCE: Final = 1e-8
# Below this predicted decrease H is nearly constant, and its factor is reused while each predicted decrease is at most
# the given share of the one before.
_NEAR: Final = 1e-2
_CLOSING: Final = 0.1


@dataclass(frozen=True)
class CornerSolution:
    """The result of a solve.

    Attributes:
        costs: initial cost, then the cost after each accepted step.
        reason: why the solve stopped; see `solve_corners`.
        factor: factor of H at most 0.1 sigma from the solution; None if the solve did not converge.
    """

    state: SpatialState
    costs: tuple[float, ...]
    reason: str
    problem: CornerProblem = field(repr=False)
    factor: FrontFactor | None = field(repr=False, default=None)

    @property
    def converged(self) -> bool:
        """Whether the solve converged."""
        return self.factor is not None

    @property
    def cost(self) -> float:
        """Final cost."""
        return self.costs[-1]

    @cached_property
    def pictures(self) -> Pictures:
        """Normal equations of all images for roll, pitch and height at the solution."""
        return pictures_at(self.problem, self.state)

    def covariance(self, columns: IntArray) -> FloatArray:
        """Return the joint covariance (k, k) of k columns of the tangent vector; 0 where fixed (-1).

        Raises:
            ValueError: the solve did not converge.
        """
        if self.factor is None:
            raise ValueError(f"no covariance: {self.reason}")
        return self.factor.covariance(columns)


class _Step(NamedTuple):
    """A step (n,) and the state after it.

    Attributes:
        factor: factor of H.
        by: (n,) step in the tangent space.
        expected: predicted decrease of the cost.
        by_slope: part of it that is linear in the step.
        state: state after the step.
    """

    factor: FrontFactor
    by: FloatArray
    expected: float
    by_slope: float
    state: SpatialState

    def predicted_decrease(self, share: float) -> float:
        """Return the predicted decrease of the cost for a share of the step."""
        return share * self.by_slope - share**2 * (self.by_slope - self.expected)


class _StepResult(NamedTuple):
    """The state, system and cost after a step, and the gain ratio: actual over predicted decrease of the cost."""

    state: SpatialState
    system: FrontalSystem
    cost: float
    gain: float


class _LastSteps(NamedTuple):
    """The final state, and the costs after each of the last steps but the very last."""

    state: SpatialState
    costs: list[float]


def solve_corners(problem: CornerProblem, start: SpatialState) -> CornerSolution:
    """Minimise the cost from a start near the solution.

    `CornerSolution.reason` is one of "converged", "no step lowers the cost", "stopped after N steps",
    "not all variables are observable" and "the cost is not a number at the start".
    """
    state, damping = start, Damping()
    system, cost = problem.system(state)
    costs = [cost]

    def finish(reason: str, factor: FrontFactor | None = None) -> CornerSolution:
        return CornerSolution(state, tuple(costs), reason, problem, factor)

    if not np.isfinite(cost):
        return finish("the cost is not a number at the start")
    while len(costs) <= _MOST_STEPS:
        try:
            step = _step(problem, system, state, damping.share)
        except NotPositiveError:
            return finish("not all variables are observable")
        if step.expected <= _COST_TOLERANCE:
            state = step.state
            return finish("converged", step.factor if damping.is_least else problem.factor(state))
        if step.expected <= _NEAR and damping.is_least:
            last = _last_steps(problem, step, cost)
            if last is not None:
                state = last.state
                costs += last.costs
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
        system, _ = problem.system(state)  # the factor overwrote its entries
    return finish(f"stopped after {_MOST_STEPS} steps")


def _step(problem: CornerProblem, system: FrontalSystem, state: SpatialState, share: float) -> _Step:
    """Compute a step with the diagonal raised by a share; the factor replaces the system's entries."""
    raised = share * problem.order.diagonal_of(system) if share else None
    factor = problem.order.factorise(system, raised)
    step = -factor.solve(system.gradient)
    by_slope = -float(system.gradient @ step)
    expected = 0.5 * by_slope
    if raised is not None:
        expected += 0.5 * float((raised * step**2).sum())
    return _Step(factor, step, expected, by_slope, problem.retract(state, step))


def _take_step(problem: CornerProblem, state: SpatialState, step: _Step, cost: float) -> _StepResult | None:
    """Apply the step, a share or a multiple of it; return None if none lowers the cost."""
    for share in _SHARES:
        there = step.state if share == 1.0 else problem.retract(state, share * step.by)
        system, found = problem.system(there)
        if found < cost:
            gain = (cost - found) / step.predicted_decrease(share)
            taken = _StepResult(there, system, found, gain)
            return _lengthen(problem, state, step, taken) if share == 1.0 and gain > _TOO_SHORT else taken
    return None


def _lengthen(problem: CornerProblem, state: SpatialState, step: _Step, taken: _StepResult) -> _StepResult:
    """Double a step that was taken while that lowers the cost further."""
    share = 2.0
    while True:
        there = problem.retract(state, share * step.by)
        system, found = problem.system(there)
        if not found < taken.cost:
            return taken
        taken, share = taken._replace(state=there, system=system, cost=found), 2.0 * share


def _last_steps(problem: CornerProblem, step: _Step, cost: float) -> _LastSteps | None:
    """Compute the last steps with one factor of H; return None if they do not converge quickly."""
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
