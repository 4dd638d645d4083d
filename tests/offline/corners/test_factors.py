"""Corner factors against numbers: Jacobians, pictures that stand off level, fronts against a dense solve."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.corners.factors import columns_of
from groundsbot.offline.corners.floor_noise import initial_attitude_sigmas
from groundsbot.offline.corners.picture_tilt import pictures_at
from groundsbot.offline.corners.problem import CornerProblem
from groundsbot.offline.corners.solver import solve_corners
from groundsbot.offline.sam.multifrontal.fronts import (
    EliminationFronts,
    Normal,
    NotPositiveError,
    build_fronts,
    common_ancestor,
)
from groundsbot.offline.sam.multifrontal.kernels import FrontalSystem
from tests.offline.corners.made_problems import (
    CAMERAS,
    N_LOOKS,
    N_POSES,
    N_TAGS,
    SIGMAS,
    dense,
    make_factors,
    make_problem,
    make_state,
    perturb,
    plain_residual,
)


@pytest.mark.parametrize("model", CAMERAS)
def test_derivatives_are_those_of_the_residuals(model: str) -> None:
    rng = np.random.default_rng(1)
    state, factors = make_state(rng), make_factors(rng, model)
    columns = columns_of(N_POSES, np.ones(N_TAGS, dtype=bool), SIGMAS)
    linearised, _ = factors.linearise(state, columns)
    ((own, jacobian),) = linearised.blocks
    np.testing.assert_allclose(linearised.residual, plain_residual(factors, state), rtol=1e-12, atol=1e-10)
    step = 1e-6
    numeric = np.empty((N_LOOKS, 8, columns.n))
    for i, e in enumerate(step * np.eye(columns.n)):
        up, down = (plain_residual(factors, perturb(state, columns, way * e)) for way in (1.0, -1.0))
        numeric[..., i] = (up - down) / (2 * step)
    np.testing.assert_allclose(dense(columns, own, jacobian), numeric, rtol=1e-7, atol=1e-5)


def test_a_picture_that_stands_off_level_is_seen_as_its_derivative_says() -> None:
    """Roll, pitch and height of base, put into the mount: the camera rises and turns about base's axes, not its own."""
    rng = np.random.default_rng(2)
    state, factors = make_state(rng), make_factors(rng)
    looks = factors.observations._replace(moved=np.zeros((N_LOOKS, 4, 3)), twist=np.zeros((N_LOOKS, 3)))
    factors = replace(factors, observations=looks)
    _, by_attitude = factors.linearise(state, columns_of(N_POSES, np.ones(N_TAGS, dtype=bool), SIGMAS))
    step = 1e-6

    def stood(off: FloatArray) -> FloatArray:
        mount = looks.mount + state.calibration[looks.mount_parameters]
        level = Rotation.from_euler("ZYX", mount[0, [5, 4, 3]])
        tilt = Rotation.from_rotvec([off[0], off[1], 0.0])
        risen = tilt.apply(mount[0, :3]) + np.array([0.0, 0.0, off[2]])
        tilted = np.concatenate([risen, (tilt * level).as_euler("ZYX")[::-1]]) - state.calibration[1:7]
        shifted = replace(factors, observations=looks._replace(mount=np.tile(tilted, (N_LOOKS, 1))))
        return plain_residual(shifted, state)

    numeric = np.stack([(stood(e) - stood(-e)) / (2 * step) for e in step * np.eye(3)], axis=-1)
    np.testing.assert_allclose(by_attitude, numeric, atol=1e-5)


def test_eliminating_how_pictures_stand_is_whitening_by_the_marginal_covariance() -> None:
    """R + J S J^T for all corners of a picture together, by a plain inverse, against the low-rank elimination."""
    problem, state = make_problem(3, attitude_sigma_rad=(0.004, 0.006, 0.003))
    normals, cost = problem.linearise(state)
    H, g = as_dense(problem, normals)
    linearised, by_attitude = problem.corners.linearise(state, problem.columns)
    ((own, blocks),) = linearised.blocks
    jacobian = dense(problem.columns, own, blocks)
    level, _ = replace(problem, attitude_sigmas=np.zeros(3)).linearise(state)
    expected, gradient = as_dense(problem, level[:-2])
    looks_cost = 0.0
    for pose in np.unique(problem.corners.observations.pose):
        of = problem.corners.observations.pose == pose
        J, W, r = (np.concatenate(list(each[of])) for each in (jacobian, by_attitude, linearised.residual))
        whole = np.linalg.inv(np.eye(len(r)) + W @ np.diag(problem.attitude_sigmas**2) @ W.T)
        expected += J.T @ whole @ J
        gradient += J.T @ whole @ r
        looks_cost += float(r @ whole @ r)
    assert len(problem.pairs) > 3
    np.testing.assert_allclose(H, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(g, gradient, rtol=1e-8, atol=1e-9 * np.abs(gradient).max())
    others = replace(problem, attitude_sigmas=np.zeros(3)).linearise(state)[1] - 0.5 * (linearised.residual**2).sum()
    assert cost == pytest.approx(others + 0.5 * looks_cost)


def as_dense(problem: CornerProblem, normals: list[Normal]) -> tuple[FloatArray, FloatArray]:
    """H (n, n) and gradient (n,) of the first kinds."""
    n = problem.columns.n
    H, g = np.zeros((n + 1, n + 1)), np.zeros(n + 1)
    for columns, (matrix, gradient) in zip(problem.kinds(), normals, strict=False):
        np.add.at(H, (columns[:, :, None], columns[:, None, :]), matrix)
        np.add.at(g, columns, gradient)
    return H[:n, :n], g[:n]


def as_built(problem: CornerProblem, system: FrontalSystem) -> FloatArray:
    """H (n, n) from the fronts."""
    nodes, H = problem.order.nodes, np.zeros((problem.columns.n, problem.columns.n))
    for i in range(len(nodes.parent)):
        columns = nodes.columns[nodes.start[i] : nodes.start[i + 1]]
        upper = np.triu(system.entries[nodes.offset[i] : nodes.offset[i + 1]].reshape(len(columns), -1))
        H[np.ix_(columns, columns)] += upper + np.triu(upper, 1).T
    return H


@pytest.mark.parametrize("model", CAMERAS)
@pytest.mark.parametrize("sigma_rad", [0.0, 0.004])
def test_compiled_loops_build_what_arrays_over_all_factors_build(model: str, sigma_rad: float) -> None:
    """In the fronts and by gradients alone; with looks so far off that they count for less."""
    problem, state = make_problem(6, attitude_sigma_rad=(sigma_rad, sigma_rad, sigma_rad), model=model)
    state = replace(state, tags=state.tags + np.array([[0.02], [0.0], [0.0]]))
    normals, cost = problem.linearise(state)
    H, g = as_dense(problem, normals)
    system, same_cost = problem.system(state)
    scale = np.sqrt(np.diag(H))
    np.testing.assert_allclose(
        as_built(problem, system) / np.outer(scale, scale), H / np.outer(scale, scale), atol=1e-12
    )
    np.testing.assert_allclose(problem.order.diagonal_of(system), np.diag(H), rtol=1e-12)
    only, also_same_cost = problem.system(state, is_whole=False)
    for each in (system.gradient, only.gradient):
        np.testing.assert_allclose(each / scale, g / scale, atol=1e-10 * np.abs(g / scale).max())
    assert (same_cost, also_same_cost) == pytest.approx((cost, cost), rel=1e-12)
    linearised, by_standing = problem.corners.linearise(state, problem.columns)
    share = (problem.weigh(linearised.residual, by_standing).weight < 1.0).mean()
    assert pictures_at(problem, state).outliers == pytest.approx(share)
    assert 0.0 < share < 1.0


def test_after_a_step_tags_have_gone_along_with_their_anchors_and_by_their_own_step() -> None:
    """Written with arrays; one tag is held, as it was not seen."""
    problem, state = make_problem(8)
    free = np.arange(N_TAGS) > 0
    columns = columns_of(N_POSES, free, SIGMAS)
    problem = replace(problem, columns=columns, anchor=1 + np.arange(N_TAGS))
    step = 0.3 * np.random.default_rng(9).standard_normal(columns.n)
    after, padded = problem.retract(state, step), np.append(step, 0.0)
    np.testing.assert_allclose(after.poses, perturb(state, columns, step).poses, atol=1e-14)
    before, way = state.poses[problem.anchor], padded[columns.poses][problem.anchor]
    seen = se2.apply(se2.inverse(before), state.tags)
    own = se2.apply(before * [0.0, 0.0, -1.0], padded[columns.tags])
    seen += own - way[:, :2] - way[:, 2:] * np.stack([-seen[:, 1], seen[:, 0]], axis=-1)
    np.testing.assert_allclose(after.tags, se2.apply(after.poses[problem.anchor], seen), atol=1e-14)
    up = way[:, 2:] * [0.0, 0.0, 1.0]
    rest = padded[columns.turns] - (state.turns.swapaxes(-1, -2) @ up[..., None])[..., 0]
    turned = Rotation.from_rotvec(up).as_matrix() @ state.turns @ Rotation.from_rotvec(rest).as_matrix()
    np.testing.assert_allclose(after.turns, np.where(free[:, None, None], turned, state.turns), atol=1e-14)
    np.testing.assert_allclose(after.heights_m, state.heights_m + padded[columns.heights], atol=1e-15)
    np.testing.assert_array_equal(after.calibration, state.calibration + padded[columns.calibration])


def test_a_lens_without_an_image_of_a_corner_makes_the_cost_no_number() -> None:
    problem, state = make_problem(6)
    behind = replace(state, tags=-state.tags)
    assert problem.linearise(behind)[1] == problem.system(behind)[1] == np.inf


def test_with_unobservable_directions_no_floor_is_reported_as_uneven() -> None:
    problem, state = make_problem(6)
    without = replace(problem.odometry, whitening=np.zeros_like(problem.odometry.whitening))
    few = problem.corners.observations.where(problem.corners.observations.pose < N_POSES - 1)
    found = solve_corners(replace(problem, odometry=without, corners=replace(problem.corners, observations=few)), state)
    assert (found.reason, found.factor) == ("not all variables are observable", None)
    assert not initial_attitude_sigmas(found.problem, found.state, found.factor, found.pictures).any()


def assemble(order: EliminationFronts, matrices: list[FloatArray]) -> FrontalSystem:
    system = order.empty()
    order.add(system, 0, [Normal(each, np.zeros(each.shape[:2])) for each in matrices])
    return system


def test_fronts_solve_as_a_dense_matrix_does() -> None:
    """Along a segment of 40 poses with tags seen here and there, nodes without a column of their own among them."""
    rng = np.random.default_rng(4)
    n_leaves, n_own = 5, 3
    parent = np.array([5, 5, 6, 6, 6, 7, 7, -1])
    node_of = np.concatenate([np.repeat(np.arange(n_leaves), n_own), [6, 7, 7]])
    n = len(node_of)
    kinds = [np.array([[3 * i, 3 * i + 1, 3 * i + 2, -1 if i == 2 else 15] for i in range(n_leaves)])]
    kinds.append(np.array([[3 * i + 2, 16, 17] for i in range(n_leaves)]))
    kinds[0][:2, 3] = 16  # tag 15 is in the branch of leaves 2 to 4 only
    roots = [rng.standard_normal((len(k), k.shape[1], k.shape[1] + 2)) for k in kinds]
    normals = [root @ root.swapaxes(-1, -2) for root in roots]
    H = np.zeros((n + 1, n + 1))
    for columns, normal in zip(kinds, normals, strict=True):
        np.add.at(H, (columns[:, :, None], columns[:, None, :]), normal)
    H = H[:n, :n]
    order = build_fronts(n, node_of, parent, kinds)
    assert order.nodes.n_own.min() == 0
    raised = rng.uniform(0, 1, n)
    for extra in (None, raised):
        whole = H if extra is None else H + np.diag(extra)
        factor = order.factorise(assemble(order, normals), extra)
        vector = rng.standard_normal(n)
        np.testing.assert_allclose(factor.solve(vector), np.linalg.solve(whole, vector), rtol=1e-8)
        some = rng.standard_normal((3, n))
        whitened = factor.whiten(some)
        np.testing.assert_allclose(whitened @ whitened.T, some @ np.linalg.solve(whole, some.T), rtol=1e-8)
        wanted = np.array([16, 0, -1, 7, 14])
        inverse = np.linalg.inv(whole)
        expected = inverse[np.ix_(wanted, wanted)] * ((wanted >= 0)[:, None] & (wanted >= 0))
        np.testing.assert_allclose(factor.covariance(wanted), expected, rtol=1e-8, atol=1e-12)
    with pytest.raises(NotPositiveError):
        order.factorise(assemble(order, [-normal for normal in normals]))
    assert common_ancestor([0, 1], parent) == 5
    assert common_ancestor([0, 2, 3], parent) == 7
