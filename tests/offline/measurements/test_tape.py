"""What a person measured: read from the command line, as evidence, and as factors."""

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.measurements.tape import (
    MeasuredDistance,
    Measurements,
    TapeOptions,
    parse_distance,
    parse_measurements,
    parse_start,
)
from groundsbot.offline.sam.factors.odometry_and_observations import Columns, State, whitening
from groundsbot.offline.sam.factors.priors import DistanceFactors, StartFactors

RUNS = ("a_one", "b_one", "c=d_one")
TAGS = (TagKey("tag36h11", 7), TagKey("tag25h9", 7), TagKey("tag36h11", 8))


def test_a_start_is_read_with_its_sigmas() -> None:
    start = parse_start("b_one=38.05, -1.5,3.1,0.05,0.02,0.1", RUNS)
    assert start.run == "b_one"
    np.testing.assert_array_equal(start.T_map_start, [38.05, -1.5, 3.1])
    np.testing.assert_array_equal(start.sigma, [0.05, 0.02, 0.1])
    assert parse_start("c=d_one=1,2,3,1,1,1", RUNS).run == "c=d_one"


def test_sigmas_are_along_the_axes_of_the_map() -> None:
    start = parse_start(f"b_one=5,5,{np.pi / 2},0.3,0.1,0.02", RUNS)
    np.testing.assert_allclose(start.placement.covariance, np.diag([0.1, 0.3, 0.02]) ** 2, atol=1e-12)
    (pair,) = Measurements("a_one", (start,)).placements(RUNS).items()
    assert pair[0] == (0, 1)
    back = pair[1].inverse().inverse()
    np.testing.assert_allclose(back.covariance, start.placement.covariance, atol=1e-12)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("b_one=1,2,3", "3 numbers given, 6 needed"),
        ("1,2,3,4,5,6", "write RUN=x_m"),
        ("b_one=1,2,x,1,1,1", "'x' is not a number"),
        ("b_one=1,2,nan,1,1,1", "'nan' is not a number"),
        ("b_one=1,2,3,0.1,0,0.1", "sigma_y_m is 0, must be from 1e-05 to 1000"),
        ("b_one=1,2,3,1,1,1e200", "sigma_theta_rad is 1e+200, must be from 1e-05 to 1000"),
        ("z=1,2,3,1,1,1", "the logs hold no run 'z'; use one of a_one, b_one"),
        ("a_one=1,2,3,1,1,1", "a_one is the first run, whose start is the frame"),
    ],
)
def test_a_start_that_cannot_be_is_refused_in_one_line(text: str, told: str) -> None:
    with pytest.raises(OfflineError, match=r"^--start") as caught:
        parse_start(text, RUNS)
    assert told in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_start_given_twice_is_refused() -> None:
    with pytest.raises(OfflineError, match="given twice"):
        parse_measurements(TapeOptions(["b_one=1,2,3,1,1,1"] * 2), RUNS, TAGS)


def test_distances_are_between_starts_or_tags() -> None:
    assert parse_distance("a_one,b_one=38.05,0.05", RUNS, TAGS) == MeasuredDistance("a_one", "b_one", 38.05, 0.05)
    assert parse_distance("8, tag25h9:7=2,0.01", RUNS, TAGS) == MeasuredDistance(TAGS[2], TAGS[1], 2.0, 0.01)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("a_one,b_one=1", "1 numbers given, 2 needed"),
        ("a_one=1,0.1", "must name two different"),
        ("8,8=1,0.1", "must name two different"),
        ("a_one,7=1,0.1", "tag id 7 occurs in several tag families; write one of tag36h11:7, tag25h9:7"),
        ("a_one,9=1,0.1", "'9' is neither a run"),
        ("a_one,8=-1,0.1", "the distance is -1 m, must be from 0 to 100000"),
        ("a_one,8=1e300,1", "the distance is 1e+300 m, must be from 0 to 100000"),
        ("a_one,8=1,1e-200", "sigma_m is 1e-200, must be from 1e-05 to 1000"),
        ("a_one,8=1,-0.1", "sigma_m is -0.1, must be from 1e-05 to 1000"),
    ],
)
def test_a_distance_that_cannot_be_is_refused_in_one_line(text: str, told: str) -> None:
    with pytest.raises(OfflineError, match=r"^--distance") as caught:
        parse_distance(text, RUNS, TAGS)
    assert told in str(caught.value)


def _state(seed: int) -> tuple[State, Columns]:
    rng = np.random.default_rng(seed)
    poses = np.column_stack([rng.uniform(-5.0, 5.0, (3, 2)), rng.uniform(-3.0, 3.0, 3)])
    columns = Columns(np.arange(9).reshape(3, 3) - 3, 6 + np.arange(4).reshape(2, 2), np.zeros(0, dtype=np.int64), 10)
    columns.poses[0] = -1
    return State(poses, rng.uniform(-5.0, 5.0, (2, 2)), np.zeros(0)), columns


def _starts() -> StartFactors:
    rng = np.random.default_rng(1)
    root = rng.standard_normal((2, 3, 3)) + 2.0 * np.eye(3)
    measured = np.column_stack([rng.uniform(-5.0, 5.0, (2, 2)), [1.0, -2.0]])
    return StartFactors(np.array([1, 2]), measured, whitening(root @ root.swapaxes(1, 2)))


def _distances() -> DistanceFactors:
    ends = np.array([[0, -1, 2, -1], [1, -1, -1, 0], [-1, 1, -1, 0], [-1, 1, 2, -1]]).T
    return DistanceFactors(
        ends[0], ends[1], ends[2], ends[3], np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.1, 0.2, 0.3, 0.4])
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("factors", [_starts(), _distances()])
def test_jacobians_are_the_finite_differences(factors: StartFactors | DistanceFactors, seed: int) -> None:
    state, columns = _state(seed)
    linearised = factors.linearise(state, columns)
    rows, n = linearised.residual.shape
    dense = np.zeros((rows, n, columns.n + 1))  # the last column takes what is held
    for block_columns, block in linearised.blocks:
        for row in range(rows):
            dense[row][:, block_columns[row]] += block[row]
    np.testing.assert_array_equal(linearised.residual, factors.residual(state))
    for column in range(columns.n):
        step = 1e-6
        slope = (factors.residual(_move(state, column, step)) - factors.residual(_move(state, column, -step))) / 2e-6
        np.testing.assert_allclose(dense[..., column], slope, atol=1e-5)


def _move(state: State, column: int, step: float) -> State:
    tangent = np.zeros(10)
    tangent[column] = step
    poses: FloatArray = state.poses.copy()
    poses[1:] = se2.compose(poses[1:], se2.exp(tangent[:6].reshape(2, 3)))
    return State(poses, state.tags + tangent[6:].reshape(2, 2), state.calibration)


def test_nothing_pulls_where_what_was_measured_is_so() -> None:
    state, _ = _state(5)
    apart = float(np.linalg.norm(state.tags[0] - state.poses[2, :2]))
    at = np.array([2]), np.array([-1]), np.array([-1]), np.array([0])
    assert DistanceFactors(*at, np.array([apart]), np.array([0.01])).residual(state)[0, 0] == pytest.approx(0.0)
    start = StartFactors(np.array([1]), state.poses[1:2], np.eye(3)[None])
    np.testing.assert_allclose(start.residual(state), 0.0, atol=1e-12)
