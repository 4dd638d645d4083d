"""Whether a solve fits together, tested without the truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.local_map import goodness_of_fit
from groundsbot.offline.local_map.goodness_of_fit import GoodnessOfFit, fit_windows
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.local_map.windows import in_windows
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.measurements.covariance_components import CovarianceParts
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.outliers import local_maps_without_outliers
from groundsbot.offline.sam.budget import Budget
from groundsbot.offline.sam.graph import build_graph
from groundsbot.offline.sam.solver import Solution, solve
from tests.support.data.drives import FAMILY, MadeTag, S, make_drive, make_positions, make_run, write_drive
from tests.support.data.long_drives import make_long_drive, with_a_moved_tag

LENGTH_M = 500.0


def judge(segment: Segment) -> GoodnessOfFit:
    return solve_local_map(segment).goodness


@pytest.mark.parametrize("seed", [0, 2])
def test_a_wrong_end_is_flagged_and_the_right_one_is_not(seed: int) -> None:
    """Plain Levenberg-Marquardt from dead reckoning ends in a wrong minimum here; the same windows judge both."""
    drive = make_long_drive(seed, LENGTH_M)
    graph = build_graph([drive.segment])
    right = solve(graph.problem, drive.true_state(graph))
    wrong = solve(graph.problem, graph.start(drive.segment.odometry.dead_reckon(), {}, {}))
    assert wrong.cost > 1.01 * right.cost
    windows = fit_windows(graph.problem)
    assert windows.goodness_of_fit(right.state).fits
    assert windows.goodness_of_fit(right.state).warnings("a_run") == []
    verdict = windows.goodness_of_fit(wrong.state)
    assert not verdict.fits
    (sentence,) = verdict.warnings("a_run")
    assert sentence.startswith("a_run: its observations contradict each other")
    assert f"chi-square {verdict.chi_square:.0f}, expected {verdict.expected}" in sentence


def test_noise_is_fitted_and_the_verdict_does_not_depend_on_the_given_noise() -> None:
    """Given twice the wheels' noise and half that of the observations, the check finds as much less and more."""
    segment = make_long_drive(5, LENGTH_M).segment
    odometry, observations = segment.odometry, segment.observations
    told_wrong = replace(
        segment,
        odometry=replace(odometry, covariance=4.0 * odometry.covariance),
        observations=replace(observations, covariance=0.25 * observations.covariance),
    )
    one, other = judge(segment), judge(told_wrong)
    # The given noise counts a little: like four measurements.
    assert other.odometry_factor == pytest.approx(0.5 * one.odometry_factor, rel=0.25)
    assert other.observation_factor == pytest.approx(2.0 * one.observation_factor, rel=0.05)
    assert other.expected == one.expected
    assert other.chi_square == pytest.approx(one.chi_square, rel=0.3)


def test_noise_is_found_in_a_few_rounds_where_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wheels and observations alternate in explaining rounding errors, without end."""
    drive = make_drive([0.0, 0.0, 0.0], [(0.4, 0.6, 60.0)], step_ns=S // 10)
    stamps_ns, tag = drive.stamps_ns[::5], np.arange(len(drive.stamps_ns[::5])) % 3
    places = np.array([[0.0, 3.0], [3.0, 1.0], [-3.0, 1.0]])[tag]
    positions = make_positions(stamps_ns, tag, se2.apply(se2.inverse(drive.at(stamps_ns)), places))
    tags = [TagKey(FAMILY, i) for i in range(3)]
    (segment,) = segments_of(make_run([drive.track], tags=tags, positions=positions), NoiseParameters())
    rounds = []
    left_over = goodness_of_fit._losses_and_redundancies

    def counted(solution: Solution) -> tuple[FloatArray, FloatArray]:
        rounds.append(solution)
        return left_over(solution)

    monkeypatch.setattr(goodness_of_fit, "_losses_and_redundancies", counted)
    windows = fit_windows(build_graph([segment]).problem)
    assert (windows.factors < 0.1).all()
    assert len(rounds) <= 8


def test_single_wrong_observations_do_not_count_against_a_map() -> None:
    segment = make_long_drive(5, LENGTH_M).segment
    observations = segment.observations
    value = observations.value.copy()
    value[::20] += [1.0, 0.5]
    assert judge(replace(segment, observations=replace(observations, value=value))).fits


@pytest.mark.parametrize("bias_px", [0.0, 5.0])
def test_correlated_errors_of_neighbouring_corners_are_no_contradiction(bias_px: float) -> None:
    """A tag that moved by as much as corners are said to err by alike, and by more than they scatter."""
    segment = with_a_moved_tag(make_long_drive(5, LENGTH_M))
    observations = segment.observations
    parts = CovarianceParts(
        ("sigma_corner_px",), observations.covariance[None] / 0.2**2, np.zeros_like(observations.covariance)
    )
    biased = replace(observations, parts=parts, corner_bias_px=np.full((len(observations), 2), bias_px))
    assert judge(replace(segment, observations=biased)).fits is (bias_px > 0.0)


def test_windows_share_neither_poses_nor_tags() -> None:
    problem = build_graph([make_long_drive(5, LENGTH_M).segment]).problem
    apart = in_windows(problem, 10.0)
    windows = np.cumsum(apart.columns.poses[:, 0] < 0)
    assert windows[-1] == pytest.approx(LENGTH_M / 10.0, abs=2)
    assert (windows[apart.odometry.first] == windows[apart.odometry.first + 1]).all()
    of_observation = windows[apart.observations.pose]
    for tag in range(len(apart.columns.tags)):
        assert len(set(of_observation[apart.observations.tag == tag])) == 1
    assert sorted(set(apart.columns.poses[apart.columns.poses >= 0])) == list(range(int(apart.columns.tags[0, 0])))


def test_what_no_condition_joins_fits() -> None:
    """A drive of one window has nothing to contradict."""
    drive = make_long_drive(5, LENGTH_M)
    verdict = judge(drive.segment.prefix(30))
    assert verdict.expected == 0
    assert verdict.fits


def test_a_bad_fit_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tags = [MadeTag(i, (4.0, 1.5 * i - 1.5, 0.5), np.pi) for i in range(3)]
    log = write_drive(tmp_path, make_drive([0.0, 0.0, 0.0], [(0.3, 0.3, 4.0), (0.2, -0.2, 3.0)]), tags)
    assert build_map(read_runs([log])).warnings == ()

    def contradictory(segment: Segment, _: Budget, *, noise_is_open: bool, start: None) -> LocalMap:
        assert noise_is_open
        return replace(solve_local_map(segment), goodness=GoodnessOfFit(300.0, 40, 80.0, 1.0, 1.0))

    monkeypatch.setattr(local_maps_without_outliers, "solve_local_map", contradictory)
    (warning,) = build_map(read_runs([log])).warnings
    assert warning.startswith("carl_one: its observations contradict each other")
    assert "(chi-square 300, expected 40, at most 80)" in warning
