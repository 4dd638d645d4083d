"""The plain way, as a yardstick: the same factors as one sparse matrix, factorised by scipy's SuperLU."""

import numpy as np
from scipy import sparse
from scipy.sparse import linalg as sparse_linalg

from calib.arrays import FloatArray
from offline.factors import State
from offline.solver import Problem

_MAX_ITERATIONS = 100


def plain_solve(problem: Problem, start: State, relative_tolerance: float) -> tuple[State, int]:
    """Gauss-Newton, damped tenfold more where the cost goes up and tenfold less where it goes down."""
    state, cost, damping = start, problem.cost(start, robust=False), 0.0
    hessian, gradient = problem.linearise(state, robust=False)
    for iteration in range(1, _MAX_ITERATIONS + 1):
        step = plain_step(hessian, gradient, damping)
        expected = -0.5 * float(gradient @ step)
        if expected <= relative_tolerance * cost:
            return state, iteration
        candidate = problem.moved(state, step)
        candidate_cost = problem.cost(candidate, robust=False)
        if candidate_cost < cost:
            state, cost, damping = candidate, candidate_cost, 0.1 * damping if damping > 1e-9 else 0.0
            hessian, gradient = problem.linearise(state, robust=False)
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
