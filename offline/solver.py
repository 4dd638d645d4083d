"""Square-root smoothing and mapping: Gauss-Newton and Levenberg-Marquardt on the sparse normal equations.

Linearise all factors of a kind at once, add up H = J^T J and g = J^T r, factorise, substitute. Dellaert and Kaess,
"Square Root SAM" (2006); step rule after Madsen, Nielsen and Tingleff, "Methods for non-linear least squares problems"
(2004). Readings carry Huber's loss by reweighting, so that a tag which moved bends the map with bounded force only.
"""

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from calib import se2
from calib.arrays import FloatArray, IntArray
from offline.factors import CalibrationPrior, Columns, Linearised, OdometryFactors, ReadingFactors, State

# Whitened readings beyond this pull with constant force; 1.1 % of good ones lie there (chi-square, two dimensions).
HUBER_THRESHOLD: Final = 3.0

_MAX_ITERATIONS: Final = 100
_MAX_REJECTED: Final = 12
# The cost is in squared sigmas: a step that would lower it by this much less is some 1e-5 sigma long.
COST_TOLERANCE: Final = 1e-10
_COST_ROUNDING: Final = 1e-14  # relative
# Shares of the diagonal. Between keyframes a few centimetres apart that is a million times what holds the far end of a
# drive, so the first damping must be tiny to leave such modes free.
_FIRST_DAMPING: Final = 1e-9
_LEAST_DAMPING: Final = 1e-10  # below it a step is Gauss-Newton's


@dataclass(frozen=True)
class Problem:
    """All factors of one estimate, and where the variables sit.

    Attributes:
        anchor: (T,) a pose from which each tag was read.
    """

    odometry: OdometryFactors
    readings: ReadingFactors
    prior: CalibrationPrior
    columns: Columns
    anchor: IntArray

    def cost(self, state: State) -> float:
        """Half the sum of squared whitened residuals, Huber's loss on the readings."""
        return 0.5 * float(
            (self.odometry.residual(state) ** 2).sum()
            + huber_loss(self.readings.residual(state)).sum()
            + (self.prior.residual(state) ** 2).sum()
        )

    @property
    def n_residuals(self) -> int:
        """How many measured numbers there are, priors apart."""
        return self.odometry.motion.size + self.readings.value.size

    def linearise(self, state: State) -> tuple[sparse.csc_array, FloatArray]:
        """H = J^T J (n, n) and g = J^T r (n,) at a state."""
        kinds = (
            self.odometry.linearise(state, self.columns),
            _reweighted(self.readings.linearise(state, self.columns)),
            self.prior.linearise(state, self.columns),
        )
        jacobian, residual = _stacked(kinds, self.columns.n)
        return sparse.csc_array(jacobian.T @ jacobian), jacobian.T @ residual

    def moved(self, state: State, step: FloatArray) -> State:
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
    """Where the solve ended and why."""

    state: State
    costs: tuple[float, ...]  # one an accepted step, the start's first
    reason: str
    converged: bool
    problem: Problem = field(repr=False)

    @property
    def cost(self) -> float:
        """At the end."""
        return self.costs[-1]

    def covariance(self, columns: IntArray) -> FloatArray:
        """Joint covariance (k, k) of k columns of the tangent vector, exact to first order; 0 where held (-1)."""
        hessian, _ = self.problem.linearise(self.state)
        factor = _factorised(hessian)
        free = np.flatnonzero(columns >= 0)
        unit = np.zeros((self.problem.columns.n, len(free)))
        unit[columns[free], np.arange(len(free))] = 1.0
        covariance = np.zeros((len(columns), len(columns)))
        covariance[np.ix_(free, free)] = factor.solve(unit)[columns[free]]
        return 0.5 * (covariance + covariance.T)


def solve(problem: Problem, start: State, cost_tolerance: float = COST_TOLERANCE) -> Solution:
    """Minimises the cost: Gauss-Newton steps while they work, damped where one would go up.

    Args:
        problem: the factors.
        start: values to begin from.
        cost_tolerance: stop where the next step would lower the cost by less.
    """
    state, cost = start, problem.cost(start)
    costs = [cost]
    damping, growth, rejected = 0.0, 2.0, 0
    hessian, gradient = problem.linearise(state)
    for _ in range(_MAX_ITERATIONS):
        step = _damped_step(hessian, gradient, damping)
        expected = -float(gradient @ step) - 0.5 * float(step @ (hessian @ step))
        if expected <= cost_tolerance + _COST_ROUNDING * cost:
            return Solution(state, tuple(costs), "converged", converged=True, problem=problem)
        candidate = problem.moved(state, step)
        candidate_cost = problem.cost(candidate)
        if candidate_cost < cost:
            gain = (cost - candidate_cost) / expected
            state, cost, rejected, growth = candidate, candidate_cost, 0, 2.0
            costs.append(cost)
            damping *= max(0.1, 1.0 - (2.0 * gain - 1.0) ** 3)
            damping = damping if damping > _LEAST_DAMPING else 0.0
            hessian, gradient = problem.linearise(state)
            continue
        rejected += 1
        if rejected > _MAX_REJECTED:
            return Solution(state, tuple(costs), "no step lowers the cost", converged=False, problem=problem)
        damping = max(damping * growth, _FIRST_DAMPING)
        growth *= 2.0
    return Solution(state, tuple(costs), f"stopped after {_MAX_ITERATIONS} steps", converged=False, problem=problem)


def huber_loss(residual: FloatArray) -> FloatArray:
    """(M,) loss of whitened residuals (M, n) by their length: its square up to the threshold, then linear."""
    length: FloatArray = np.linalg.norm(residual, axis=-1)
    return np.where(length <= HUBER_THRESHOLD, length**2, HUBER_THRESHOLD * (2.0 * length - HUBER_THRESHOLD))


def huber_weight(residual: FloatArray) -> FloatArray:
    """(M,) weight of each residual (M, n) in the normal equations."""
    length: FloatArray = np.linalg.norm(residual, axis=-1)
    weight: FloatArray = HUBER_THRESHOLD / np.maximum(length, HUBER_THRESHOLD)
    return weight


def _reweighted(kind: Linearised) -> Linearised:
    """Readings under Huber's loss as plain squares with the same gradient.

    The weight's own change is left out. Putting part of it in (Triggs and others, "Bundle adjustment - a modern
    synthesis", 2000, section 4.3) was tried: on recordings with many outliers it took more steps, not fewer.
    """
    root = np.sqrt(huber_weight(kind.residual))
    return Linearised(
        kind.residual * root[:, None],
        tuple((columns, derivative * root[:, None, None]) for columns, derivative in kind.blocks),
    )


def _stacked(kinds: tuple[Linearised, ...], n_columns: int) -> tuple[sparse.csr_array, FloatArray]:
    """One sparse Jacobian (m, n) and its residuals (m,)."""
    rows, columns, values, residuals = [], [], [], []
    first_row = 0
    for kind in kinds:
        m, n = kind.residual.shape
        row = first_row + np.arange(m * n).reshape(m, n, 1)
        for block_columns, derivative in kind.blocks:
            full = np.broadcast_to(block_columns[:, None, :], derivative.shape)
            free = full >= 0
            rows.append(np.broadcast_to(row, derivative.shape)[free])
            columns.append(full[free])
            values.append(derivative[free])
        residuals.append(kind.residual.reshape(-1))
        first_row += m * n
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return sparse.csr_array(entries, shape=(first_row, n_columns)), np.concatenate(residuals)


def _damped_step(hessian: sparse.csc_array, gradient: FloatArray, damping: float) -> FloatArray:
    if not len(gradient):
        return gradient
    damped = hessian + sparse.diags_array(damping * hessian.diagonal(), format="csc") if damping else hessian
    step: FloatArray = -_factorised(damped).solve(gradient)
    return step


def _factorised(hessian: sparse.csc_array) -> sparse_linalg.SuperLU:
    """H is symmetric and positive definite: the diagonal is a good pivot."""
    return sparse_linalg.splu(
        sparse.csc_matrix(hessian),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
