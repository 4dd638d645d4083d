"""Maps of drives with a gyro: the heading of a whole drive is known, and a kept map goes on from there."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import Truth
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.foundation.workers import Workers
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.localization.localization import localize
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.graph import build_graph
from groundsbot.offline.sam.solver import PLAIN_SQUARES
from groundsbot.offline.self_calibration.self_calibration import free_parameters
from tests.support.data.gyros import SimulatedGyro, gyro_runs


@pytest.fixture(scope="module")
def drives() -> tuple[list[Run], Truth]:
    """Two drives of nsh with a gyro."""
    return gyro_runs("nsh", 1, SimulatedGyro())


@pytest.fixture(scope="module")
def mapped(drives: tuple[list[Run], Truth]) -> MapResult:
    """The map of both."""
    return build_map(drives[0])


@pytest.fixture(scope="module")
def kept(drives: tuple[list[Run], Truth], tmp_path_factory: pytest.TempPathFactory) -> MapResult:
    """The map of the first, read back."""
    folder = tmp_path_factory.mktemp("kept")
    write_map(build_map(drives[0][:1]), folder)
    return read_map(folder)


def test_tags_are_known_as_they_stand(drives: tuple[list[Run], Truth], mapped: MapResult) -> None:
    """Without a gyro a typical tag of this floor is off by a metre."""
    errors = evaluate(mapped, drives[1]).components[0]
    assert len(mapped.components) == 1
    assert errors.tags_rmse_m is not None
    assert errors.tags_rmse_m < 0.4
    assert errors.nees_tags_per_dim is not None
    assert 0.3 < errors.nees_tags_per_dim < 2.0
    names = {each.name for each in mapped.calibration}
    assert {"gyro_scale", "gyro_time_offset_s", "gyro_bias_rad_s_0"} <= names


@pytest.fixture(scope="module")
def with_late_camera() -> Run:
    """A drive of nsh with a gyro whose camera is 1.7 ms late; robot.yaml has it within a sigma of 1 ms."""
    runs, _ = gyro_runs("nsh", 64, SimulatedGyro())
    return next(run for run in runs if run.robot_id == "loop")


def test_the_gyros_time_offset_does_not_take_the_cameras(with_late_camera: Run) -> None:
    """With the wheels' yaw rates for the camera the gyro was 1.8 ms off, 20 of its sigmas."""
    found = {each.name: each for each in build_map([with_late_camera]).calibration}
    camera, gyro = found["time_offset_s"], found["gyro_time_offset_s"]
    assert abs(gyro.value) < 3.0 * gyro.sigma
    assert camera.value - gyro.value == pytest.approx(0.0017, abs=0.0004)


def test_no_number_that_is_right_is_freed(with_late_camera: Run) -> None:
    """The gyro's bias is unknown to each section; taken as known, it freed the place of the camera and the track."""
    freed = free_parameters([with_late_camera], NoiseParameters(), (), Stages(), Workers(), corners=False)
    assert [each.name for each in freed.choices if each.is_freed] == []


def test_observations_have_the_jitter_of_their_headings(drives: tuple[list[Run], Truth]) -> None:
    (segment,) = segments_of(drives[0][0], NoiseParameters())
    (plain,) = segments_of(replace(drives[0][0], gyro=None), NoiseParameters())
    observations = segment.with_noise(NoiseParameters()).observations
    assert np.median(observations.heading_jitter_rad) == pytest.approx(3e-4, rel=0.3)
    # Of (range, bearing) only the bearing gets it.
    added = observations.covariance - plain.observations.covariance
    assert added[:, 1, 1] == pytest.approx(observations.heading_jitter_rad**2, rel=1e-6, abs=1e-15)
    assert np.abs(added[:, 0]).max() == 0.0


def test_the_joint_factor_of_the_calibration_has_the_gradient_of_its_cost(drives: tuple[list[Run], Truth]) -> None:
    (segment,) = segments_of(drives[0][0], NoiseParameters())
    problem = build_graph([segment]).problem
    state = solve_local_map(segment).solution.state
    state = State(state.poses, state.tags, state.calibration + 1e-4)
    system, cost = problem.arrowhead.linearise(state)
    assert cost == pytest.approx(problem.cost(state, PLAIN_SQUARES), rel=1e-9)
    free = np.flatnonzero(problem.columns.calibration >= 0)
    for k, index in enumerate(free):
        step = np.zeros(len(state.calibration))
        step[index] = 1e-7
        up, down = (
            problem.cost(State(state.poses, state.tags, state.calibration + sign * step), PLAIN_SQUARES)
            for sign in (1.0, -1.0)
        )
        gradient = system.gradient[len(system.gradient) - len(free) + k]
        assert gradient == pytest.approx((up - down) / 2e-7, rel=2e-3, abs=2e-2)


def test_a_drive_is_localized_in_a_kept_map(
    drives: tuple[list[Run], Truth], mapped: MapResult, kept: MapResult
) -> None:
    runs, _ = drives
    found = localize(runs[1], kept)
    (located,) = found.runs
    first, second = (next(each for each in mapped.runs if each.run == run.name) for run in runs)
    there = se2.between(first.T_map_start, second.T_map_start)
    sigma_m = float(np.sqrt(np.trace(located.covariance[0, :2, :2])))
    assert np.hypot(*(located.T_map_base[0] - there)[:2]) < 3.0 * sigma_m


def test_a_kept_map_is_extended_as_if_all_drives_were_mapped_at_once(
    drives: tuple[list[Run], Truth], mapped: MapResult, kept: MapResult
) -> None:
    extended = build_map(drives[0][1:], extending=kept)
    (one,), (whole,) = extended.components, mapped.components
    assert {tag.tag_id for tag in one.tags} == {tag.tag_id for tag in whole.tags}
    found = {tag.tag_id: tag for tag in one.tags}
    for tag in whole.tags:
        sigma_m = float(np.sqrt(np.trace(tag.covariance)))
        assert np.hypot(*(found[tag.tag_id].position_m - tag.position_m)) < sigma_m
