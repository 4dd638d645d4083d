"""Elimination in nested pieces: steps, covariances and costs are those of plain dense algebra."""

import tracemalloc
from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.foundation.kernel_types import argument_types
from groundsbot.offline.sam.arrowhead import build, dissection
from groundsbot.offline.sam.arrowhead import covariance as arrowhead_covariance
from groundsbot.offline.sam.arrowhead.build import build_arrowhead
from groundsbot.offline.sam.arrowhead.elimination import eliminate
from groundsbot.offline.sam.arrowhead.system import Arrowhead, UnderDeterminedError
from groundsbot.offline.sam.factors.odometry_and_observations import Linearised, State
from groundsbot.offline.sam.linearisation.kernels import Values
from groundsbot.offline.sam.linearisation.observations import add_observations
from groundsbot.offline.sam.linearisation.odometry import add_odometry
from groundsbot.offline.sam.linearisation.robust_losses import SQUARES, Loss, huber
from groundsbot.offline.sam.solver import DEFAULT_LOSSES, PLAIN_SQUARES, Problem
from tests.benchmarks.speed.plain_solver import plain_normal_equations
from tests.support.data.graphs import make_graph, with_measured

LOSSES = (SQUARES, huber(1.5))


def arrowhead_of(problem: Problem) -> Arrowhead:
    return build_arrowhead(problem.odometry, problem.observations, problem.prior, problem.columns, problem.measured)


def weights(loss: Loss, residual: FloatArray) -> FloatArray:
    """rho'(s), written out once more."""
    s, c2 = (residual**2).sum(axis=1), loss.threshold**2
    by_form = (
        np.ones_like(s),
        np.minimum(1.0, loss.threshold / np.sqrt(s)),
        c2 / (c2 + s),
        (c2 / (c2 + s)) ** 2,
        np.where(s > c2, 1e-6, 1.0),
    )
    return np.asarray(by_form[loss.form])


def dense(problem: Problem, state: State, odometry_loss: Loss, observation_loss: Loss) -> tuple[FloatArray, FloatArray]:
    """H (n, n) and g (n,), one factor at a time, with the robust weights of the state."""
    columns, n = problem.columns, problem.columns.n
    hessian, gradient = np.zeros((n, n)), np.zeros(n)

    def add(kind: Linearised, weight: FloatArray) -> None:
        for m, residual in enumerate(kind.residual):
            jacobian = np.zeros((len(residual), n + 1))
            for block_columns, derivative in kind.blocks:
                for k, column in enumerate(block_columns[m]):
                    jacobian[:, column] += derivative[m][:, k]  # -1, held: the last one
            J = jacobian[:, :n]
            hessian[:] += weight[m] * J.T @ J
            gradient[:] += weight[m] * J.T @ residual

    odometry, observations = problem.odometry.linearise(state, columns), problem.observations.linearise(state, columns)
    prior = problem.prior.linearise(state, columns)
    add(odometry, weights(odometry_loss, odometry.residual))
    add(observations, weights(observation_loss, observations.residual))
    for kind in (prior, *problem.measured.linearise(state, columns)):
        add(kind, np.ones(len(kind.residual)))
    return hessian, gradient


def condition_of(H: FloatArray) -> float:
    """Return the condition of a symmetric matrix; a fifth of the time of `numpy.linalg.cond`."""
    sizes = np.abs(np.linalg.eigvalsh(H))
    return float(sizes.max() / sizes.min())


def tolerance(condition: float) -> float:
    return 1e-9 if condition < 1e6 else 100.0 * np.finfo(float).eps * condition


@pytest.mark.parametrize("has_own_nodes", [False, True], ids=["few segments", "nodes of segments"])
@pytest.mark.parametrize("observation_loss", LOSSES, ids=repr)
@given(
    seed=st.integers(0, 10**6),
    lengths=st.lists(st.integers(1, 130), min_size=1, max_size=3),
    n_tags=st.integers(1, 8),
    calibrated=st.booleans(),
    held=st.sampled_from([0.0, 0.1, 0.5]),
    reach=st.sampled_from([0.05, 0.3, 1.0]),
    odometry_loss=st.sampled_from(LOSSES),
    damping=st.sampled_from([0.0, 1e-3]),
    n_measured=st.integers(0, 4),
    n_robots=st.integers(1, 3),
)
@settings(max_examples=6, deadline=None)
def test_steps_and_covariances_equal_dense_algebra(
    seed: int,
    lengths: list[int],
    n_tags: int,
    calibrated: bool,
    held: float,
    reach: float,
    odometry_loss: Loss,
    observation_loss: Loss,
    damping: float,
    n_measured: int,
    n_robots: int,
    has_own_nodes: bool,
) -> None:
    problem, truth = make_graph(seed, lengths, n_tags, calibrated=calibrated, reach=reach, held=held, n_robots=n_robots)
    problem = with_measured(problem, truth, seed, n_measured)
    H, g = dense(problem, truth, odometry_loss, observation_loss)
    H += damping * np.diag(H.diagonal())
    if not len(g):
        return
    condition = condition_of(H)
    if condition > 1e12:
        return
    with pytest.MonkeyPatch.context() as patch:
        for module in (dissection, build) if has_own_nodes else ():
            patch.setattr(module, "MOST_WITHOUT_OWN", 0)
        arrowhead = arrowhead_of(problem)
    system, _ = arrowhead.linearise(truth, odometry_loss, observation_loss)
    factorisation = arrowhead.factorise(system, damping)
    step, expected = factorisation.solve(g), np.linalg.solve(H, g)
    assert np.linalg.norm(step - expected) <= tolerance(condition) * np.linalg.norm(expected)
    several = factorisation.solve_many(np.column_stack([g, np.roll(g, 1), -g]))
    for one, column in zip(several.T, (g, np.roll(g, 1), -g), strict=True):
        alone = factorisation.solve(column)
        assert np.linalg.norm(one - alone) <= tolerance(condition) * np.linalg.norm(alone)
    wanted = np.random.default_rng(seed).permutation(len(g))[:40]
    inverse = np.linalg.inv(H)
    covariance = inverse[np.ix_(wanted, wanted)]
    sigma = np.sqrt(covariance.diagonal())
    found = factorisation.covariance(wanted)
    assert (np.abs(found - covariance) / np.outer(sigma, sigma)).max() <= tolerance(condition)
    columns = problem.columns.poses
    for own, marginal in zip(columns, factorisation.pose_covariances(np.arange(len(columns))), strict=True):
        expected = np.where(np.minimum.outer(own, own) >= 0, inverse[np.ix_(own, own)], 0.0)
        sigma = np.sqrt(np.where(own >= 0, expected.diagonal(), 1.0))
        assert (np.abs(marginal - expected) / np.outer(sigma, sigma)).max() <= tolerance(condition)


@pytest.mark.parametrize(("n_more", "levels"), [(0, {1, 2, 4}), (7, {1, 2, 3, 4})])
def test_long_segments_pass_through_all_levels(n_more: int, levels: set[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """Of more than eight segments each has a node of its own below the top."""
    monkeypatch.setattr(dissection, "_JOINED", (31, 4, 2))
    problem, truth = make_graph(4, [700, 40, *[5] * n_more], 30, reach=0.04)
    H, g = plain_normal_equations(problem, truth, DEFAULT_LOSSES)
    arrowhead = arrowhead_of(problem)
    assert set(arrowhead.tree.level[arrowhead.tree.n_eliminated > 0]) == levels
    system, cost = arrowhead.linearise(truth, observation_loss=huber(3.0))
    step = arrowhead.factorise(system).solve(g)
    assert cost == pytest.approx(problem.cost(truth), rel=1e-13)
    assert np.linalg.norm(H @ step - g) <= 1e-9 * np.linalg.norm(g)
    # A joint covariance of what is eliminated in leaves, between them and at the top.
    wanted = np.r_[-1, 5:9, 91:99, 1500:1503, len(g) - 30 : len(g) : 3]
    unit = np.zeros((len(g), len(wanted)))
    unit[wanted[1:], np.arange(1, len(wanted))] = 1.0
    expected = np.linalg.solve(H.toarray(), unit)[wanted] * (wanted >= 0)[:, None]
    sigma = np.sqrt(np.where(wanted >= 0, expected.diagonal(), 1.0))
    factorisation, condition = arrowhead.factorise(system), condition_of(H.toarray())
    found = factorisation.covariance(wanted)
    assert (np.abs(found - expected) / np.outer(sigma, sigma)).max() <= tolerance(condition)
    # Of poses alone, all at once or some: in leaves, between them, at a cut of each level, in either segment.
    poses = np.r_[739:0:-7, 0]
    inverse = np.linalg.inv(H.toarray())
    some = factorisation.pose_covariances(poses)
    np.testing.assert_array_equal(some, factorisation.pose_covariances(np.arange(740))[poses])
    for pose, marginal in zip(poses[:-1], some, strict=False):
        own = problem.columns.poses[pose]
        sigma = np.sqrt(inverse[own, own])
        assert (np.abs(marginal - inverse[np.ix_(own, own)]) / np.outer(sigma, sigma)).max() <= tolerance(condition)
    assert not some[-1].any()


@given(seed=st.integers(0, 10**6), loss=st.sampled_from(LOSSES))
@settings(max_examples=20, deadline=None)
def test_gradient_is_the_costs_derivative(seed: int, loss: Loss) -> None:
    """Far from the optimum too: residuals, Jacobians and losses belong together."""
    problem, truth = make_graph(seed, [20, 9], 4)
    rng = np.random.default_rng(seed)
    start = problem.retract(truth, 0.1 * rng.standard_normal(problem.columns.n))
    arrowhead = arrowhead_of(problem)
    system, _ = arrowhead.linearise(start, loss, loss)
    way = rng.standard_normal(problem.columns.n)
    way /= np.linalg.norm(way)
    ahead, behind = (arrowhead.linearise(problem.retract(start, h * way), loss, loss)[1] for h in (1e-6, -1e-6))
    slope = float(system.gradient[arrowhead.tangent] @ way)
    assert (ahead - behind) / 2e-6 == pytest.approx(slope, rel=1e-4, abs=1e-4 * float(np.linalg.norm(system.gradient)))


@given(seed=st.integers(0, 1000), lengths=st.lists(st.integers(1, 2000), min_size=1, max_size=4))
@settings(max_examples=10, deadline=None)
def test_every_column_is_eliminated_once(seed: int, lengths: list[int]) -> None:
    problem, _ = make_graph(seed, lengths, 5, reach=0.02)
    tree = arrowhead_of(problem).tree
    in_leaves = [
        np.arange(3 * tree.first[node], 3 * tree.end[node]) for node in np.flatnonzero(tree.level == 0).tolist()
    ]
    in_fronts = [tree.front[s : s + n] for s, n in zip(tree.front_start, tree.n_eliminated, strict=False)]
    eliminated = np.sort(np.concatenate([*in_leaves, *in_fronts]))
    np.testing.assert_array_equal(eliminated, np.arange(3 * tree.n_poses + 2 * tree.n_tags + tree.n_calibration))


def test_a_joint_covariance_takes_no_other_matrix_of_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arrowhead_covariance, "_AT_ONCE", 16)
    monkeypatch.setattr(arrowhead_covariance, "_COLUMNS", 16)
    problem, truth = make_graph(3, [60, 60], 400)
    arrowhead = problem.arrowhead
    factorisation = arrowhead.factorise(arrowhead.linearise(truth, *DEFAULT_LOSSES)[0])
    columns = np.append(np.flatnonzero(np.isin(arrowhead.tangent, arrowhead.top_columns)), -1)
    factorisation.covariance(columns)
    tracemalloc.start()
    covariance = factorisation.covariance(columns)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(covariance) > 400
    assert not covariance[-1].any()
    assert peak < 1.4 * covariance.nbytes


def test_parts_of_a_covariance_equal_the_whole() -> None:
    problem, truth = make_graph(3, [60, 60], 40, held=0.2)
    factorisation = problem.arrowhead.factorise(problem.arrowhead.linearise(truth, *DEFAULT_LOSSES)[0])
    tags, poses = problem.columns.tags.reshape(-1), problem.columns.poses.reshape(-1)
    wanted = np.concatenate([tags, poses[::7], tags[:5]])
    whole = factorisation.covariance(wanted)
    np.testing.assert_allclose(factorisation.covariance(wanted, 50), whole[:, 50:], rtol=1e-9, atol=1e-15)
    own = whole[: len(tags), : len(tags)].reshape(40, 2, 40, 2)[np.arange(40), :, np.arange(40)]
    np.testing.assert_allclose(factorisation.tag_covariances(), own, rtol=1e-9, atol=1e-15)


def test_what_nothing_ties_down_is_named() -> None:
    problem, truth = make_graph(1, [50, 50], 3)
    loose = problem.columns.tags[2, 0]
    arrowhead = arrowhead_of(problem)
    system, _ = arrowhead.linearise(truth)
    system.pose_tag[arrowhead.observations.tag == 2] = 0.0
    system.tag[2] = 0.0
    system.tag_calibration[arrowhead.tree.tag_segment_start[2] : arrowhead.tree.tag_segment_start[3]] = 0.0
    with pytest.raises(UnderDeterminedError) as raised:
        arrowhead.factorise(system)
    assert raised.value.column == loose


@given(seed=st.integers(0, 10**6), lengths=st.lists(st.integers(1, 40), min_size=1, max_size=4))
@settings(max_examples=10, deadline=None)
def test_products_hold_what_was_measured(seed: int, lengths: list[int]) -> None:
    problem, truth = make_graph(seed, lengths, 4)
    problem = with_measured(problem, truth, seed, 3)
    H, g = dense(problem, truth, SQUARES, SQUARES)
    arrowhead = arrowhead_of(problem)
    system, cost = arrowhead.linearise(truth)
    # Places of 50 m are rounded to 1e-14 m, which a tape of millimetres weighs a thousandfold.
    assert cost == pytest.approx(problem.cost(truth, PLAIN_SQUARES), rel=1e-10)
    assert np.linalg.norm(system.gradient[arrowhead.tangent] - g) <= 1e-9 * np.linalg.norm(g)
    x = np.random.default_rng(seed).standard_normal(len(g))
    product = arrowhead.product(system, arrowhead.in_order(x))[arrowhead.tangent]
    assert np.linalg.norm(product - H @ x) <= 1e-9 * np.linalg.norm(H @ x)


def test_a_distance_from_the_middle_of_a_segment_is_refused() -> None:
    problem, truth = make_graph(3, [20], 3)
    problem = with_measured(problem, truth, 3, 1)
    distances = replace(problem.measured.distances, pose_a=np.array([5]), tag_a=np.array([-1]))
    with pytest.raises(ValueError, match="first pose of a segment"):
        arrowhead_of(replace(problem, measured=replace(problem.measured, distances=distances)))


def test_arrays_are_of_the_layout_that_kernels_are_compiled_for() -> None:
    """Another one, as that of a strided view, would have them compiled once more."""
    problem, state = make_graph(4, [50, 20], 6)
    arrowhead = arrowhead_of(problem)
    values, system = Values(state.poses, state.tags, state.calibration), arrowhead.empty_system()
    calls: dict[Any, tuple[object, ...]] = {
        eliminate: (arrowhead.tree, system, 0.0, arrowhead.empty_rows()),
        add_odometry: (arrowhead.odometry, SQUARES, values, arrowhead.free, system),
        add_observations: (arrowhead.observations, SQUARES, values, arrowhead.free, system),
    }
    type_of: Any = numba.typeof
    for kernel, arguments in calls.items():
        assert argument_types(kernel.py_func) == tuple(map(type_of, arguments))


def test_the_calibration_of_a_robot_with_one_drive_of_many_is_not_in_the_top() -> None:
    """The top, a dense matrix, would grow with the number of robots."""
    problem, _ = make_graph(1, [20] * 9, 30, n_robots=9)
    arrowhead = arrowhead_of(problem)
    tree = arrowhead.tree
    in_top = arrowhead.top_columns[arrowhead.top_columns >= 3 * tree.n_poses + 2 * tree.n_tags]
    np.testing.assert_array_equal(in_top, np.arange(-2, 0) + 3 * tree.n_poses + 2 * tree.n_tags + tree.n_calibration)
