"""The covariances that factors need are those of the dense inverse."""

import numpy as np

from groundsbot.offline.estimate.kernels import selected_inverse
from tests.offline.estimate.made_problems import dense, make_problem


def test_the_entries_of_all_fronts_are_those_of_the_inverse() -> None:
    problem, values = make_problem()
    system, _ = problem.system(values)
    H = dense(system)
    factor = problem.order.factorise(system)
    nodes = problem.order.nodes
    Z = selected_inverse(nodes, factor.entries)
    scale = 1.0 / np.sqrt(np.diag(H))
    inverse = scale[:, None] * np.linalg.inv(scale[:, None] * H * scale) * scale
    sigma = np.sqrt(np.diag(inverse))
    assert len(nodes.parent) > 10  # a tree, not one dense block
    for i in range(len(nodes.parent)):
        columns = nodes.columns[nodes.start[i] : nodes.start[i + 1]]
        found = Z[nodes.offset[i] : nodes.offset[i + 1]].reshape(len(columns), len(columns))
        own = sigma[columns][:, None] * sigma[columns]
        np.testing.assert_allclose(found / own, inverse[np.ix_(columns, columns)] / own, atol=1e-7)


def test_each_factors_columns_are_in_one_front() -> None:
    """Where its covariance is read."""
    problem, _ = make_problem(with_tape=True)
    nodes = problem.order.nodes
    for kind in problem.order.kinds:
        assert len(kind.columns) > 0
        for columns, node, place in zip(kind.columns, kind.node, kind.place, strict=True):
            own = nodes.columns[nodes.start[node] : nodes.start[node + 1]]
            np.testing.assert_array_equal(own[place[columns >= 0]], columns[columns >= 0])
