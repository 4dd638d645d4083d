"""The bias of a calibration that is estimated together with poses, against dense algebra and simulated drives."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import BoolArray, FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import CAMERA_PARAMETERS, TIME_OFFSET
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.fixtures.drives.harsh import Harsh
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.sam import bias
from groundsbot.offline.sam.factors.odometry_and_observations import Columns, ObservationFactors, State, stack
from groundsbot.offline.sam.solver import PLAIN_SQUARES, Problem, Solution, solve
from groundsbot.offline.self_calibration.robot import with_unknown_calibration
from tests.support.data.problems import make_problem, random_state
from tests.support.data.simulated_runs import simulated_runs

TIME = CAMERA_PARAMETERS.index(TIME_OFFSET)


def log_determinant(problem: Problem, is_free: BoolArray, state: State, odometry_at: State) -> float:
    """1/2 log det of the information of the free poses, with the odometry's part as it is at another state."""
    poses = np.arange(problem.columns.poses.size).reshape(-1, 3)
    tags, calibration = np.full_like(problem.columns.tags, -1), np.full_like(problem.columns.calibration, -1)
    columns = Columns(poses, tags, calibration, poses.size)
    kinds = (
        problem.odometry.linearise(odometry_at, columns),
        problem.observations.linearise(state, columns),
    )
    jacobian = stack(kinds, columns.n)[0].toarray()[:, is_free.reshape(-1)]
    return 0.5 * float(np.linalg.slogdet(jacobian.T @ jacobian)[1])


def numeric(problem: Problem, is_free: BoolArray, state: State) -> FloatArray:
    h = 1e-5
    steps = h * np.eye(problem.columns.n)
    ends = [
        [log_determinant(problem, is_free, problem.retract(state, s * step), state) for s in (1, -1)] for step in steps
    ]
    return np.array([(high - low) / (2 * h) for high, low in ends])


@pytest.mark.parametrize("frame_is_free", [True, False])
@pytest.mark.parametrize("polar", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_the_gradient_is_that_of_dense_algebra(seed: int, polar: bool, frame_is_free: bool) -> None:
    made = make_problem(seed)
    observations = replace(made.problem.observations, polar=np.full(len(made.problem.observations.tag), polar))
    problem = replace(made.problem, observations=observations)
    state = random_state(seed, made.truth, spread=0.02)
    solution = Solution(state, (0.0,), "", converged=True, problem=problem, losses=PLAIN_SQUARES)
    weights = np.ones(len(observations.tag))
    is_free = (problem.columns.poses >= 0) | frame_is_free
    found = bias._gradient(problem, state, bias._conditional_covariances(solution, weights, is_free), weights)
    expected = numeric(problem, is_free, state)
    calibration = problem.columns.calibration
    times = calibration[observations.camera_parameters[:, TIME]]
    rest = np.setdiff1d(np.arange(problem.columns.n), [*calibration[problem.odometry.parameters[:, 0]], *times])
    np.testing.assert_allclose(found[rest], expected[rest], atol=1e-6 * float(np.abs(expected).max()))
    assert np.abs(expected[rest]).max() > 0.0


def rates(observations: ObservationFactors, state: State, base_m_s: FloatArray) -> FloatArray:
    """Change (M, 2) of observations by motion of base at (M, 2) m/s and the turning rates of the observations."""
    step_s = 1e-5
    ahead = [se2.exp(sign * step_s * np.column_stack([base_m_s, observations.turning_rad_s])) for sign in (1, -1)]
    ends = []
    for moved in ahead:
        poses = se2.compose(state.poses[observations.pose], moved)
        each = replace(observations, pose=np.arange(len(poses)), by_camera=np.zeros_like(observations.by_camera))
        identity = np.tile(np.eye(2), (len(poses), 1, 1))
        ends.append(replace(each, whitening=identity).residual(State(poses, state.tags, state.calibration)))
    return (ends[0] - ends[1]) / (2 * step_s)


@pytest.mark.parametrize("polar", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_the_derivative_by_the_time_offset_changes_with_the_pose(seed: int, polar: bool) -> None:
    made = make_problem(seed)
    columns, n = made.problem.columns, len(made.problem.observations.tag)
    state = random_state(seed, made.truth, spread=0.02)
    base_m_s = np.random.default_rng(seed).standard_normal((n, 2))
    observations = replace(made.problem.observations, polar=np.full(n, polar))
    by_camera = observations.by_camera.copy()
    by_camera[..., TIME] = rates(observations, state, base_m_s)
    observations = replace(observations, by_camera=by_camera)
    problem = replace(made.problem, observations=observations)
    is_free, weights = columns.poses >= 0, np.ones(n)
    solution = Solution(state, (0.0,), "", converged=True, problem=problem, losses=PLAIN_SQUARES)
    covariances = bias._conditional_covariances(solution, weights, is_free)
    found = bias._gradient(problem, state, covariances, weights)

    # tr(C J' dJ/dt), with J the derivative of the residuals by the pose, which the time offset shifts by their rates.
    h, by_pose = 1e-5, np.empty((n, 2, 3))
    for k, step in enumerate(h * np.eye(3)):
        ends = [replace(state, poses=se2.compose(state.poses, se2.exp(s * step))) for s in (1, -1)]
        by_pose[..., k] = (rates(observations, ends[0], base_m_s) - rates(observations, ends[1], base_m_s)) / (2 * h)
    jacobian = problem.observations.linearise(state, columns).blocks[0][1]
    change = -observations.whitening @ by_pose
    expected = np.einsum("mij,mki,mkj->m", covariances[observations.pose], jacobian, change)
    times = columns.calibration[observations.camera_parameters[:, TIME]]
    for column in np.unique(times[times >= 0]):
        assert found[column] == pytest.approx(expected[times == column].sum(), rel=1e-4)
        assert found[column] != 0.0


def test_all_of_a_difference_along_the_bias_is_explained_and_nothing_against_it() -> None:
    made = make_problem(1)
    together = solve(made.problem, made.truth)
    apart = replace(
        together,
        problem=replace(
            made.problem,
            observations=replace(made.problem.observations, whitening=0.1 * made.problem.observations.whitening),
        ),
    )
    free = made.problem.columns.calibration >= 0
    columns = made.problem.columns.calibration[free]
    information = np.linalg.inv(apart.covariance(columns))
    towards = np.zeros(len(free))
    towards[free] = (bias.bias_of(apart) - bias.bias_of(together))[columns]

    def explained(times: float) -> float:
        moved = together.state.calibration - times * towards
        state = State(together.state.poses, together.state.tags, moved)
        return bias.cost_of_bias(replace(apart, state=state), together)

    whole = float(towards[free] @ information @ towards[free])
    assert whole > 0.0
    assert explained(-0.5) == 0.0
    assert explained(0.0) == 0.0
    assert explained(0.5) == pytest.approx(0.25 * whole, rel=0.2)


def test_a_corrected_calibration_is_moved_by_half_of_the_bias_whose_share_remains_in_its_covariance() -> None:
    made = make_problem(1)
    solution = solve(made.problem, made.truth)
    corrected = bias.correct_bias(solution, 1.0)
    columns = made.problem.columns.calibration
    free = columns >= 0
    moved = (corrected.state.calibration - solution.state.calibration)[free]
    shift = bias._bias_of_calibration(solution)
    np.testing.assert_allclose(moved, 0.5 * shift, rtol=1e-9)
    assert np.abs(shift).max() > 0.0
    # Poses and tags are at the optimum for the corrected calibration, whose cost grows as its information says.
    growth = made.problem.cost(corrected.state) - made.problem.cost(solution.state)
    information = np.linalg.inv(solution.covariance(columns[free]))
    assert growth == pytest.approx(0.5 * moved @ information @ moved, rel=0.05)
    added = bias.covariance_with_bias(corrected, columns[free]) - corrected.covariance(columns[free])
    share = bias.bias_of(corrected)[columns[free]]
    np.testing.assert_allclose(added, np.outer(share, share) / 12.0, atol=1e-12 * np.abs(added).max())


def test_measurements_that_scatter_less_than_assumed_are_corrected_by_less() -> None:
    made = make_problem(1)
    solution = solve(made.problem, made.truth)

    def moved(scatter: float) -> FloatArray:
        return bias.correct_bias(solution, scatter).state.calibration - solution.state.calibration

    np.testing.assert_allclose(moved(0.25), 0.25 * moved(1.0), rtol=1e-9)
    np.testing.assert_array_equal(moved(3.0), moved(1.0))
    assert bias.correct_bias(solution, 0.0) is solution


def test_a_bias_that_its_own_correction_changes_stays_in_the_covariance(monkeypatch: pytest.MonkeyPatch) -> None:
    made = make_problem(1)
    solution = solve(made.problem, made.truth)
    columns = made.problem.columns.calibration
    free = columns[columns >= 0]
    first, of_calibration = bias.bias_of(solution), bias._bias_of_calibration(solution)
    monkeypatch.setattr(
        bias, "_bias_of_calibration", lambda each: of_calibration if each.bias_share == 0.0 else 0.7 * of_calibration
    )
    assert bias.correct_bias(solution, 1.0) is solution
    added = bias.covariance_with_bias(solution, free) - solution.covariance(free)
    np.testing.assert_allclose(added, np.outer(first[free], first[free]) / 3.0, atol=1e-12 * np.abs(added).max())


def test_a_correction_whose_solve_does_not_converge_is_not_made(monkeypatch: pytest.MonkeyPatch) -> None:
    made = make_problem(1)
    solution = solve(made.problem, made.truth)
    monkeypatch.setattr(bias, "solve", lambda *args, **kwargs: replace(solve(*args, **kwargs), converged=False))
    assert bias.correct_bias(solution, 1.0) is solution


@pytest.mark.parametrize("seed", [12, 21, 22])
def test_good_drives_fit_with_an_unknown_camera_mount(seed: int) -> None:
    """Windows put it up to 0.2 m ahead of where it is; the test once took that for a wrong map."""
    for run in simulated_runs("nsh", seed, harsh={Harsh.MOUNT})[0]:
        (segment,) = segments_of(replace(run, robot=with_unknown_calibration(run.robot)), NoiseParameters())
        assert solve_local_map(segment, noise_is_open=True).goodness.fits
