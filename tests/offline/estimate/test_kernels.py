"""The gradient is that of the cost along every variable, and the matrix is what the residuals' derivatives make."""

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.robot.parameters import TIME_OFFSET
from groundsbot.offline.estimate.parameters import DISTANCE, RATIO, TURN_LEFT, TURN_RIGHT, Owned
from groundsbot.offline.estimate.problem import JointProblem
from tests.offline.estimate.made_problems import (
    dense,
    derivatives,
    information,
    make_problem,
    power_of_spread,
    residuals,
)


def gradients(late_s: float, *, with_tape: bool = False) -> tuple[JointProblem, FloatArray, FloatArray]:
    """That of the system and that of the cost, in units of the variables' information."""
    problem, values = make_problem(late_s, with_tape=with_tape)
    system, _ = problem.system(values)
    scale = 1.0 / np.sqrt(np.diag(dense(system)))
    expected = derivatives(
        lambda step: np.array(problem.system(problem.move(values, step), is_whole=False)[1]), problem.columns[3]
    )
    return problem, scale * system.gradient, scale * expected


def test_the_problem_has_every_kind_of_factor_and_parameter() -> None:
    """Else what follows says nothing."""
    problem, values = make_problem(with_tape=True)
    names = {each.name for each in problem.calibration.names}
    assert {DISTANCE, TURN_LEFT, TURN_RIGHT, RATIO, "range_scale", "depth_exponent", "tag_scale"} < names
    assert {"mount_x_m", "mount_y_m", "mount_yaw_rad", "mount_roll_rad", "mount_pitch_rad", "edge_shift_px"} < names
    assert {TIME_OFFSET, "range_offset_m"} < names
    assert 0.0 < problem.readings.polar.mean() < 1.0
    assert min(len(e) for _, e in residuals(problem, values)) > 0
    both = {problem.calibration.index(Owned(robot, DISTANCE)) for robot in "ab"}
    assert set(problem.distance_of_poses.tolist()) == both
    assert problem.map_scale in both


@pytest.mark.parametrize("with_tape", [False, True])
def test_the_gradient_is_that_of_the_cost(*, with_tape: bool) -> None:
    _, gradient, expected = gradients(0.0, with_tape=with_tape)
    np.testing.assert_allclose(gradient, expected, atol=1e-6 * np.abs(expected).max())


def test_at_another_delay_than_the_motions_have_only_headings_and_delays_neglect_the_velocitys_own_turn() -> None:
    problem, gradient, expected = gradients(0.1)
    poses, _, calibration, n = problem.columns
    neglected = [calibration[problem.calibration.index(Owned(robot, TIME_OFFSET))] for robot in "ab"]
    others = np.setdiff1d(np.arange(n), np.append(poses[:, 2], neglected))
    atol = 1e-6 * np.abs(expected).max()
    np.testing.assert_allclose(gradient[others], expected[others], atol=atol)
    rest = np.setdiff1d(np.arange(n), others)
    assert np.linalg.norm(gradient[rest] - expected[rest]) < 0.05 * np.linalg.norm(expected[rest])


def test_the_cost_is_that_of_the_residuals_and_of_the_places_spread() -> None:
    """The density of the places is a power of their sum of squares: the same power wherever they are."""
    problem, values = make_problem()
    powers = [power_of_spread(problem, values, by) for by in (0.5, 1.3)]
    assert powers[0] == pytest.approx(powers[1], rel=1e-8)
    assert powers[0] == pytest.approx(round(powers[0]), rel=1e-8)
    assert powers[0] >= len(problem.in_map) - 1


@pytest.mark.parametrize("with_tape", [False, True])
def test_the_matrix_is_the_weighted_product_of_the_residuals_derivatives(*, with_tape: bool) -> None:
    problem, values = make_problem(seconds=6.0, with_tape=with_tape)
    system, _ = problem.system(values)
    expected = information(problem, values)
    scale = 1.0 / np.sqrt(np.diag(expected))
    scale = scale[:, None] * scale
    np.testing.assert_allclose(scale * dense(system), scale * expected, atol=1e-6)


def test_only_the_gradient_is_the_same_gradient() -> None:
    problem, values = make_problem()
    (whole, cost), (bare, same) = problem.system(values), problem.system(values, is_whole=False)
    assert len(bare.entries) == 0
    assert same == cost
    np.testing.assert_array_equal(bare.gradient, whole.gradient)


@pytest.mark.parametrize("robot", ["a", "b"])
def test_a_longer_distance_stretches_what_is_the_robots_and_the_first_ones_all(robot: str) -> None:
    problem, values = make_problem()
    step = np.zeros(problem.columns[3])
    step[problem.columns[2][problem.calibration.index(Owned(robot, DISTANCE))]] = 0.1
    moved = problem.move(values, step)
    is_all = problem.calibration.index(Owned(robot, DISTANCE)) == problem.map_scale
    grown = {name: np.exp(0.1) if is_all or name == robot else 1.0 for name in "ab"}
    lengths = np.diff(problem.layout.first_pose)
    of_poses = np.repeat([grown[each.segment.run.robot_id] for each in problem.drives], lengths)
    np.testing.assert_allclose(moved.poses[:, :2], of_poses[:, None] * values.poses[:, :2])
    np.testing.assert_array_equal(moved.poses[:, 2], values.poses[:, 2])
    n_own = len(problem.layout.own)
    of_own = [grown[problem.drives[each.drive].segment.run.robot_id] for each in problem.layout.own]
    np.testing.assert_allclose(moved.points[:n_own], np.array(of_own)[:, None] * values.points[:n_own])
    joint = slice(n_own, problem.layout.n_places)
    np.testing.assert_allclose(moved.points[joint], (np.exp(0.1) if is_all else 1.0) * values.points[joint])
    change = {name: moved.calibration[problem.calibration.index(Owned(name, DISTANCE))] for name in "ab"}
    for name in "ab":
        before = values.calibration[problem.calibration.index(Owned(name, DISTANCE))]
        assert change[name] - before == pytest.approx(np.log(grown[name]))
