"""Least squares on tag corners: Gauss-Newton steps while they work, damped where one would raise the cost."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from calib.arrays import FloatArray, IntArray
from offline.corner_factors import SpatialState
from offline.corner_problem import CornerProblem, Normal
from offline.damping import Damping
from offline.fronts import FrontFactor, NotPositiveError

_MOST_STEPS: Final = 40
# In squared sigmas: a step that brings less is 1e-4 sigma long. It is taken, and what it leaves over is
# smaller still by far.
_COST_TOLERANCE: Final = 1e-8


@dataclass(frozen=True)
class CornerSolution:
    """Where the solve ended and why.

    Attributes:
        factor: of H at the end; None where it has no square root.
        costs: one an accepted step, the first before all of them.
    """

    state: SpatialState
    costs: tuple[float, ...]
    reason: str
    converged: bool
    problem: CornerProblem = field(repr=False)
    factor: FrontFactor | None = field(repr=False, default=None)

    @property
    def cost(self) -> float:
        """At the end."""
        return self.costs[-1]

    def covariance(self, columns: IntArray) -> FloatArray:
        """Joint covariance (k, k) of k columns of the tangent vector; 0 where held (-1).

        Raises:
            ValueError: something is not tied down.
        """
        if self.factor is None:
            raise ValueError(f"no covariance: {self.reason}")
        return self.factor.covariance(columns)


def solve_corners(problem: CornerProblem, start: SpatialState) -> CornerSolution:
    """Minimises the cost from a start near the solution.

    It stops, and `reason` says which of these it was: "converged", "no step lowers the cost", "stopped after N steps",
    "something is not tied down", "the cost is no number at the start".
    """
    order, state = problem.order, start
    normals, cost = problem.linearise(state)
    costs, damping = [cost], Damping()

    def ended(reason: str, factor: FrontFactor | None = None) -> CornerSolution:
        return CornerSolution(state, tuple(costs), reason, factor is not None, problem, factor)

    if not np.isfinite(cost):
        return ended("the cost is no number at the start")
    for _ in range(_MOST_STEPS):
        entries, gradient = order.assembled([n.matrix for n in normals]), order.summed([n.gradient for n in normals])
        diagonal = _diagonal(problem, normals)
        while True:
            try:
                factor = order.factorise(entries, damping.share * diagonal)
            except NotPositiveError:
                return ended("something is not tied down")
            step = -factor.solve(gradient)
            expected = 0.5 * float(damping.share * (diagonal * step**2).sum() - gradient @ step)
            moved = problem.moved(state, step)
            if expected <= _COST_TOLERANCE:
                state = moved
                return ended("converged", factor if damping.is_least else order.factorise(entries))
            tried, tried_cost = problem.linearise(moved)
            if tried_cost < cost:
                break
            damping.step_rejected()
            if damping.exhausted:
                return ended("no step lowers the cost")
        damping.step_taken((cost - tried_cost) / expected)
        state, normals, cost = moved, tried, tried_cost
        costs.append(cost)
    return ended(f"stopped after {_MOST_STEPS} steps")


def _diagonal(problem: CornerProblem, normals: list[Normal]) -> FloatArray:
    """(n,) of H."""
    return problem.order.summed([np.einsum("mii->mi", normal.matrix) for normal in normals])
