"""The covariance of each pose given tags and calibration is that of dense algebra, segment by segment."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.offline.sam.chain_covariances import chain_covariances
from groundsbot.offline.sam.factors.odometry_and_observations import Columns, State, stack
from groundsbot.offline.sam.linearisation.robust_losses import losses_and_weights
from groundsbot.offline.sam.solver import DEFAULT_LOSSES, Problem
from tests.support.data.problems import SEGMENTS, make_problem


def dense_information(problem: Problem, state: State, is_free: BoolArray) -> FloatArray:
    """Information (n, n) of the n free pose variables alone, with the weights of robust losses."""
    _, weights = losses_and_weights(DEFAULT_LOSSES.observations, problem.observations.residual(state))
    whitening = problem.observations.whitening * np.sqrt(weights)[:, None, None]
    poses = np.where(is_free, np.cumsum(is_free).reshape(is_free.shape) - 1, -1)
    columns = Columns(poses, np.full(state.tags.shape, -1), np.full(len(state.calibration), -1), int(is_free.sum()))
    kinds = (problem.odometry, replace(problem.observations, whitening=whitening))
    jacobian = stack(tuple(each.linearise(state, columns) for each in kinds), columns.n)[0].toarray()
    return np.asarray(jacobian.T @ jacobian)


@pytest.mark.parametrize("seed", range(3))
def test_covariances_are_those_of_dense_algebra_and_zero_where_poses_are_fixed(seed: int) -> None:
    made = make_problem(seed, n_outliers=3)
    problem, truth = made.problem, made.truth
    is_free = np.random.default_rng(seed).random(truth.poses.shape) < 0.8
    found = chain_covariances(problem.arrowhead, truth, DEFAULT_LOSSES.observations, is_free)
    expected = np.zeros((is_free.size, is_free.size))
    free = np.flatnonzero(is_free)
    expected[np.ix_(free, free)] = np.linalg.inv(dense_information(problem, truth, is_free))
    for pose, covariance in enumerate(found):
        own = slice(3 * pose, 3 * pose + 3)
        np.testing.assert_allclose(covariance, expected[own, own], rtol=1e-8, atol=1e-15)
    assert np.abs(found).max() > 0.0


def test_a_segment_without_observations_leaves_the_others_as_they_are() -> None:
    made = make_problem(1)
    problem, truth = made.problem, made.truth
    is_free = np.ones(truth.poses.shape, dtype=np.bool_)
    whole = chain_covariances(problem.arrowhead, truth, DEFAULT_LOSSES.observations, is_free)
    of_first = problem.observations.part(problem.observations.pose < SEGMENTS[0])
    partly = replace(problem, observations=of_first)
    found = chain_covariances(partly.arrowhead, truth, DEFAULT_LOSSES.observations, is_free)
    np.testing.assert_array_equal(found[: SEGMENTS[0]], whole[: SEGMENTS[0]])
    assert np.isfinite(found).all()
    assert found[SEGMENTS[0] :, 0, 0].min() > 1e3 * whole[SEGMENTS[0] :, 0, 0].max()
