"""What a map holds of tags and calibration, all coupled with all, is eliminated as plain dense algebra would."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.sam.factors.odometry_and_observations import Columns, Linearised, State, stack, whitening
from groundsbot.offline.sam.factors.priors import JointPrior
from groundsbot.offline.sam.solver import PLAIN_SQUARES, Problem, solve
from tests.support.data.graphs import make_graph, with_measured


def with_known(problem: Problem, truth: State, seed: int, tags: list[int], numbers: list[int]) -> Problem:
    """The same, with some tags and calibration known beforehand, and every pose free."""
    rng = np.random.default_rng(seed)
    n = 2 * len(tags) + len(numbers)
    root = 0.02 * (np.eye(n) + 0.4 * rng.standard_normal((n, n)))
    mean = np.concatenate([truth.tags[tags].reshape(-1), truth.calibration[numbers]]) + root @ rng.standard_normal(n)
    known = JointPrior(np.array(tags), np.array(numbers), mean, whitening(root @ root.T))
    columns = problem.columns
    poses, places, calibration = (
        np.where(each >= 0, each + 3, -1) for each in (columns.poses, columns.tags, columns.calibration)
    )
    poses[0] = np.arange(3)
    return replace(
        problem,
        columns=Columns(poses, places, calibration, columns.n + 3),
        measured=replace(problem.measured, known=known),
    )


def dense(problem: Problem, state: State) -> tuple[FloatArray, FloatArray]:
    """H and g of plain squares, every factor a row of one matrix."""
    columns, known = problem.columns, problem.measured.known
    block = Linearised(known.residual(state)[None], ((known.columns(columns)[None], known.whitening[None]),))
    kinds = (
        problem.odometry,
        problem.observations,
        problem.prior,
        *(problem.measured.starts, problem.measured.distances),
    )
    jacobian, residual = stack((*(kind.linearise(state, columns) for kind in kinds), block), columns.n)
    whole = jacobian.toarray()
    return whole.T @ whole, whole.T @ residual


@pytest.mark.parametrize("n_measured", [0, 2])
def test_steps_covariances_and_costs_are_those_of_dense_algebra(n_measured: int) -> None:
    problem, truth = make_graph(3, [70, 40], 6)
    problem = with_known(with_measured(problem, truth, 3, n_measured), truth, 5, [0, 2, 3, 5], [1, 4, 19])
    arrowhead = problem.arrowhead
    system, cost = arrowhead.linearise(truth)
    factorisation = arrowhead.factorise(system)
    hessian, gradient = dense(problem, truth)
    np.testing.assert_allclose(system.gradient[arrowhead.tangent], gradient, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(factorisation.solve(gradient), np.linalg.solve(hessian, gradient), rtol=1e-7, atol=1e-12)
    columns = problem.measured.known.columns(problem.columns)
    expected = np.linalg.inv(hessian)[np.ix_(columns, columns)]
    np.testing.assert_allclose(factorisation.covariance(columns), expected, rtol=1e-7, atol=1e-15)
    vector = np.random.default_rng(1).standard_normal(len(gradient))
    product = arrowhead.product(system, arrowhead.in_order(vector))[arrowhead.tangent]
    np.testing.assert_allclose(product, hessian @ vector, rtol=1e-9, atol=1e-6)
    assert cost == pytest.approx(problem.cost(truth, PLAIN_SQUARES), rel=1e-12)


def test_a_solve_ends_where_its_gradient_is_nothing() -> None:
    problem, truth = make_graph(4, [30], 4)
    problem = with_known(problem, truth, 6, [0, 1, 3], [2, 5])
    solution = solve(problem, truth, losses=PLAIN_SQUARES)
    assert solution.converged
    hessian, gradient = dense(problem, solution.state)
    assert float(gradient @ np.linalg.solve(hessian, gradient)) < 1e-9
