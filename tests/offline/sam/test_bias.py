"""The bias of a calibration that is estimated together with poses, against dense algebra and simulated drives."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.fixtures.drives.harsh import Harsh
from groundsbot.fixtures.simulate import simulate
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.sam import bias
from groundsbot.offline.sam.factors.odometry_and_observations import State, stack
from groundsbot.offline.sam.solver import PLAIN_SQUARES, Problem, Solution, solve
from groundsbot.offline.self_calibration.robot import with_unknown_calibration
from groundsbot.onboard.log.reading.reader import find_logs
from tests.support.data.problems import make_problem, random_state


def log_determinant(problem: Problem, state: State, odometry_at: State) -> float:
    """1/2 log det of the information of the poses, with the odometry's part as it is at another state."""
    columns = problem.columns
    kinds = (
        problem.odometry.linearise(odometry_at, columns),
        problem.observations.linearise(state, columns),
    )
    jacobian = stack(kinds, columns.n)[0].toarray()
    poses = np.sort(columns.poses[columns.poses >= 0])
    return 0.5 * float(np.linalg.slogdet(jacobian[:, poses].T @ jacobian[:, poses])[1])


def numeric(problem: Problem, state: State) -> FloatArray:
    h = 1e-5
    steps = h * np.eye(problem.columns.n)
    ends = [[log_determinant(problem, problem.retract(state, s * step), state) for s in (1, -1)] for step in steps]
    return np.array([(high - low) / (2 * h) for high, low in ends])


@pytest.mark.parametrize("polar", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_the_gradient_is_that_of_dense_algebra(seed: int, polar: bool) -> None:
    made = make_problem(seed)
    observations = replace(made.problem.observations, polar=np.full(len(made.problem.observations.tag), polar))
    problem = replace(made.problem, observations=observations)
    state = random_state(seed, made.truth, spread=0.02)
    solution = Solution(state, (0.0,), "", converged=True, problem=problem, losses=PLAIN_SQUARES)
    weights = np.ones(len(observations.tag))
    found = bias._gradient(problem, state, bias._conditional_covariances(solution, weights), weights)
    expected = numeric(problem, state)
    wheel_scales = problem.columns.calibration[problem.odometry.parameters[:, 0]]
    rest = np.setdiff1d(np.arange(problem.columns.n), wheel_scales)
    np.testing.assert_allclose(found[rest], expected[rest], atol=1e-6 * float(np.abs(expected).max()))
    assert np.abs(expected[rest]).max() > 0.0


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


@pytest.mark.parametrize("seed", [12, 21, 22])
def test_good_drives_fit_though_nobody_knows_where_the_camera_is(tmp_path: Path, seed: int) -> None:
    """Windows put it up to 0.2 m ahead of where it is; the test once took that for a wrong map."""
    simulate("nsh", seed, tmp_path, render=False, harsh={Harsh.MOUNT})
    for run in read_runs(find_logs([tmp_path])):
        (segment,) = segments_of(replace(run, robot=with_unknown_calibration(run.robot)), NoiseParameters())
        assert solve_local_map(segment, noise_is_open=True).goodness.fits
