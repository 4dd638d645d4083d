"""The smaller problem for starting values: what is composed is what was driven, and what is laid out is likeliest."""

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.sam.arrowhead.system import Skeleton
from groundsbot.offline.sam.factors.odometry_and_readings import State
from groundsbot.offline.sam.solver import PLAIN_SQUARES, Problem, solve
from tests.benchmarks.speed.plain_solver import plain_normal_equations
from tests.benchmarks.speed.solver_world import make_fleet
from tests.support.data.graphs import make_graph


def make_skeleton(seed: int, *, calibrated: bool = True) -> tuple[Problem, State, Skeleton]:
    """Segments of which most poses read nothing, one of them none at all, one of a single pose."""
    problem, truth = make_graph(seed, [60, 1, 25], 3, calibrated=calibrated, reach=0.1)
    return problem, truth, problem.skeleton


def adjoint(pose: FloatArray) -> FloatArray:
    """Ad of a pose, written out: exp(Ad d) = T o exp(d) o T^-1."""
    x, y, theta = pose
    return np.array([[np.cos(theta), -np.sin(theta), y], [np.sin(theta), np.cos(theta), -x], [0.0, 0.0, 1.0]])


def test_motions_are_composed_with_their_covariances_and_derivatives() -> None:
    problem, _, skeleton = make_skeleton(1)
    kept, composed = np.flatnonzero(skeleton.index >= 0), skeleton.arrowhead.odometry
    parts = problem.odometry
    assert np.diff(kept).max() > 5
    for m, first in enumerate(composed.first):
        motion, C, K = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
        for part in np.flatnonzero((parts.first >= kept[first]) & (parts.first < kept[first + 1])):
            A = adjoint(se2.inverse(parts.motion[part]))
            motion = se2.compose(motion, parts.motion[part])
            C = A @ C @ A.T + np.linalg.inv(parts.whitening[part].T @ parts.whitening[part])
            K = A @ K + parts.jacobian[part]
        np.testing.assert_allclose(composed.motion[m, :3], motion, atol=1e-12)
        np.testing.assert_allclose(composed.covariance[m], C, rtol=1e-9, atol=1e-9 * np.abs(C).max())
        np.testing.assert_allclose(composed.information[m] @ C, np.eye(3), atol=1e-6)
        np.testing.assert_allclose(composed.jacobian[m], K, atol=1e-12)


def test_poses_between_are_laid_where_they_are_likeliest() -> None:
    """Moving them alone would gain next to nothing, where dead reckoning would leave all of it to the last motion."""
    fleet = make_fleet(3, 2, 400, 12)
    problem, skeleton = fleet.problem, fleet.problem.skeleton
    state = skeleton.solve(skeleton.starting_values(fleet.dead_reckoned, np.full((2, 3), 0.1)), problem.anchor, 2)
    between = problem.columns.poses[skeleton.index < 0].reshape(-1)

    def gain(poses: FloatArray) -> float:
        H, g = plain_normal_equations(problem, State(poses, state.tags, state.calibration), PLAIN_SQUARES)
        own = H.toarray()[np.ix_(between, between)]
        return 0.5 * float(g[between] @ np.linalg.solve(own, g[between]))

    straight = state.poses.copy()
    for pose in np.flatnonzero(skeleton.index < 0):
        motion = problem.odometry.motion[np.searchsorted(problem.odometry.first, pose - 1)]
        straight[pose] = se2.compose(straight[pose - 1], motion)
    assert gain(state.poses) < 1e-3 * gain(straight)


@pytest.mark.parametrize("calibrated", [True, False])
def test_what_is_kept_stays_where_it_is(calibrated: bool) -> None:
    problem, truth, skeleton = make_skeleton(2, calibrated=calibrated)
    same = skeleton.solve(truth, problem.anchor, 0)
    kept = skeleton.index >= 0
    np.testing.assert_array_equal(same.poses[kept], truth.poses[kept])
    assert np.isfinite(same.poses).all()
    assert kept[[0, 60, 61]].all()  # where segments begin
    assert kept[problem.readings.pose].all()
    assert not kept.all()


@pytest.mark.parametrize("seed", range(3))
def test_relaxed_steps_lead_to_the_same_optimum_with_calibration_free(seed: int) -> None:
    problem, truth = make_graph(seed, [80, 60], 6, reach=0.3)
    start = problem.retract(truth, 0.02 * np.random.default_rng(seed).standard_normal(problem.columns.n))
    one, other = solve(problem, start, relaxed_steps=2), solve(problem, truth)
    assert one.converged
    assert one.cost == pytest.approx(other.cost, rel=1e-9)
    relaxed = problem.skeleton.solve(start, problem.anchor, 2)
    assert problem.cost(relaxed) - other.cost < 0.05 * (problem.cost(start) - other.cost)
