"""A plain solver to compare with: the same factors as one sparse matrix, factorised by scipy's SuperLU."""

import numpy as np
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.sam.factors.odometry_and_observations import Linearised, State, stack
from groundsbot.offline.sam.linearisation.robust_losses import SQUARES, Loss, losses_and_weights
from groundsbot.offline.sam.solver import PLAIN_SQUARES, Losses, Problem

_MAX_ITERATIONS = 100


def plain_solve(problem: Problem, start: State, relative_tolerance: float) -> tuple[State, int]:
    """Gauss-Newton, damped tenfold more where the cost goes up and tenfold less where it goes down."""
    state, cost, damping = start, problem.cost(start, PLAIN_SQUARES), 0.0
    hessian, gradient = plain_normal_equations(problem, state)
    for iteration in range(1, _MAX_ITERATIONS + 1):
        step = plain_step(hessian, gradient, damping)
        expected = -0.5 * float(gradient @ step)
        if expected <= relative_tolerance * cost:
            return state, iteration
        candidate = problem.retract(state, step)
        candidate_cost = problem.cost(candidate, PLAIN_SQUARES)
        if candidate_cost < cost:
            state, cost, damping = candidate, candidate_cost, 0.1 * damping if damping > 1e-9 else 0.0
            hessian, gradient = plain_normal_equations(problem, state)
        else:
            damping = max(10.0 * damping, 1e-8)
    return state, _MAX_ITERATIONS


def plain_step(hessian: sparse.csc_array, gradient: FloatArray, damping: float) -> FloatArray:
    """-(H + damping diag(H))^-1 g."""
    damped = hessian + sparse.diags_array(damping * hessian.diagonal(), format="csc") if damping else hessian
    factor = sparse_linalg.splu(
        sparse.csc_matrix(damped),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return np.asarray(-factor.solve(gradient))


def plain_normal_equations(
    problem: Problem, state: State, losses: Losses = PLAIN_SQUARES
) -> tuple[sparse.csc_array, FloatArray]:
    """H = J^T J (n, n) and g = J^T r (n,) at a state, robust weights included, from the factors' classes alone."""
    kinds = (
        _reweight(problem.odometry.linearise(state, problem.columns), losses.odometry),
        _reweight(problem.observations.linearise(state, problem.columns), losses.observations),
        problem.prior.linearise(state, problem.columns),
        *problem.measured.linearise(state, problem.columns),
    )
    jacobian, residual = stack(kinds, problem.columns.n)
    return sparse.csc_array(jacobian.T @ jacobian), jacobian.T @ residual


def _reweight(kind: Linearised, loss: Loss) -> Linearised:
    """Factors under a robust loss as plain squares with the same gradient."""
    if loss == SQUARES:
        return kind
    root = np.sqrt(losses_and_weights(loss, kind.residual)[1])
    return Linearised(
        kind.residual * root[:, None],
        tuple((columns, derivative * root[:, None, None]) for columns, derivative in kind.blocks),
    )
