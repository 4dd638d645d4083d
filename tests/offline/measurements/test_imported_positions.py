"""Imported positions become observations, with what late stamps and ranges too long do to them."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.parameters import CAMERA_PARAMETERS, RANGE_OFFSET, TIME_OFFSET
from groundsbot.calib.robot.robot_yaml import Robot
from groundsbot.offline.measurements.sensor_model.imported_positions import POSITION_NOISE, STAMP_NOISE, read_positions
from groundsbot.offline.measurements.sensor_model.observations import Observations
from groundsbot.offline.measurements.tags import Positions
from tests.support.data.drives import make_positions, make_robot

NOISE = NoiseParameters()
NO_TWIST = np.zeros((2, 3))  # velocity of base at the keyframes
TWIST = np.array([[0.4, 0.15, -0.7]])
ROBOT = make_robot(mount={"x_m": 0.2, "y_m": 0.05, "yaw_rad": 0.4})
TAG_M = np.array([2.5, -1.2])  # on the map, where the robot stands at the origin
COVARIANCE = [[0.04, 0.01], [0.01, 0.09]]
TIME, RANGE = (CAMERA_PARAMETERS.index(name) for name in (TIME_OFFSET, RANGE_OFFSET))
forms = pytest.mark.parametrize("polar", [True, False], ids=["polar", "cartesian"])
frames = pytest.mark.parametrize("in_camera", [True, False], ids=["camera", "base"])


def positions(value: list[list[float]], *, polar: bool, covariance: object = np.nan) -> Positions:
    n = len(value)
    made = make_positions(np.arange(n, dtype=np.int64), np.zeros(n, dtype=np.int64), np.array(value))
    whole = np.broadcast_to(np.asarray(covariance, dtype=np.float64), (n, 2, 2)).copy()
    return replace(made, polar=np.full(n, polar), covariance=whole)


def test_imported_positions_without_covariance_get_that_of_the_noise_model() -> None:
    sigma = np.array([np.hypot(NOISE.sigma_range_m, NOISE.sigma_range_per_m * 5.0), NOISE.sigma_bearing_rad])
    for given in (positions([[3.0, -4.0]], polar=False), positions([[5.0, np.arctan2(-4, 3)]], polar=True)):
        observations, _ = read_positions(ROBOT, given, np.array([0]), NO_TWIST, NOISE)
        assert observations.polar.all()
        np.testing.assert_allclose(observations.value, [[5.0, np.arctan2(-4, 3)]])
        np.testing.assert_allclose(observations.covariance[0], np.diag(sigma**2))


def test_imported_covariances_are_kept() -> None:
    covariance = [[0.04, 0.01], [0.01, 0.09]]
    given = positions([[3.0, -4.0]], polar=False, covariance=covariance)
    observations, warnings = read_positions(ROBOT, given, np.array([0]), NO_TWIST, NOISE)
    assert not observations.polar.any()
    np.testing.assert_array_equal(observations.value, [[3.0, -4.0]])
    np.testing.assert_array_equal(observations.covariance[0], covariance)
    assert warnings == []


@pytest.mark.parametrize("value", [[np.nan, 1.0], [1.0, np.inf], [0.01, 0.02], [1e300, 1.0], [1e200, -1e200]])
@pytest.mark.parametrize("covariance", [np.nan, 0.01 * np.eye(2)])
def test_imported_positions_that_cannot_be_are_left_out(value: list[float], covariance: object) -> None:
    given = positions([value, [3.0, 1.0]], polar=False, covariance=covariance)
    observations, warnings = read_positions(ROBOT, given, np.array([0, 1]), NO_TWIST, NOISE)
    assert observations.keyframe.tolist() == [1]
    assert "1 of 2 tag positions left out" in warnings[0]
    assert np.isfinite(observations.covariance).all()


@pytest.mark.parametrize(
    "covariance",
    [[[0.0, 0.0], [0.0, 0.0]], [[-1.0, 0.0], [0.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]], [[1e300, 0], [0, 1e300]]],
)
def test_imported_covariances_that_are_none_are_left_out(covariance: object) -> None:
    observations, warnings = read_positions(
        ROBOT, positions([[3.0, 1.0]], polar=False, covariance=covariance), np.array([0]), NO_TWIST, NOISE
    )
    assert len(observations) == 0
    assert len(warnings) == 1


def observe_from(T_map_base: FloatArray, *, polar: bool, in_camera: bool) -> list[float]:
    """The tag as a perfect sensor has it: range and bearing, or place."""
    mount = [ROBOT.mount.x_m, ROBOT.mount.y_m, ROBOT.mount.yaw_rad] if in_camera else [0.0, 0.0, 0.0]
    x, y = se2.apply(se2.inverse(se2.compose(T_map_base, np.array(mount))), TAG_M)
    return [float(np.hypot(x, y)), float(np.arctan2(y, x))] if polar else [float(x), float(y)]


def read_one(
    value: list[float], *, polar: bool, in_camera: bool, robot: Robot = ROBOT, covariance: object = COVARIANCE
) -> Observations:
    given = replace(positions([value], polar=polar, covariance=covariance), in_camera=np.array([in_camera]))
    observations, _ = read_positions(robot, given, np.array([0]), TWIST, NOISE)
    assert len(observations) == 1
    return observations


@forms
@frames
@pytest.mark.parametrize("covariance", [COVARIANCE, np.nan], ids=["own covariance", "none"])
def test_a_late_stamp_shows_what_is_seen_farther_along_the_drive(
    polar: bool, in_camera: bool, covariance: object
) -> None:
    """By moving the robot along its twist, before and after."""
    step_s = 1e-4
    earlier, here, later = (
        read_one(
            observe_from(se2.exp(t_s * TWIST[0]), polar=polar, in_camera=in_camera),
            polar=polar,
            in_camera=in_camera,
            covariance=covariance,
        )
        for t_s in (-step_s, 0.0, step_s)
    )
    by_hand = (later.value - earlier.value)[0] / (2.0 * step_s)
    assert (np.abs(by_hand) > 0.1).all()
    np.testing.assert_allclose(here.by_camera[0, :, TIME], by_hand, rtol=1e-6)


@forms
@frames
def test_a_range_offset_is_taken_off_and_its_derivative_is_that(polar: bool, in_camera: bool) -> None:
    value = observe_from(np.zeros(3), polar=polar, in_camera=in_camera)
    shorter = ROBOT.model_copy(update={"range_offset_m": 0.125})
    plain = read_one(value, polar=polar, in_camera=in_camera)
    less = read_one(value, polar=polar, in_camera=in_camera, robot=shorter)
    change = (less.value - plain.value)[0]
    if polar:
        np.testing.assert_allclose(change, [-0.125, 0.0])
    else:
        long_m, short_m = np.array(value), less.value[0]
        assert np.linalg.norm(short_m) == pytest.approx(np.linalg.norm(long_m) - 0.125)
        np.testing.assert_allclose(short_m / np.linalg.norm(short_m), long_m / np.linalg.norm(long_m))
    np.testing.assert_allclose(plain.by_camera[0, :, RANGE], change / 0.125, atol=1e-12)


@forms
def test_all_else_of_a_camera_is_nothing_to_a_position(polar: bool) -> None:
    observations = read_one([3.0, 0.5], polar=polar, in_camera=True)
    others = np.setdiff1d(np.arange(len(CAMERA_PARAMETERS)), [TIME, RANGE])
    assert not observations.by_camera[..., others].any()


def test_a_moving_robot_reads_less_well_by_what_stamps_scatter() -> None:
    """Errors of one stamp move range and bearing together; a covariance of the log's own is taken as it is."""
    value = observe_from(np.zeros(3), polar=True, in_camera=True)
    observations = read_one(value, polar=True, in_camera=True, covariance=np.nan)
    by_stamp = NOISE.sigma_stamp_s * observations.by_camera[0, :, TIME]
    still = np.diag([NOISE.sigma_range_m**2 + (NOISE.sigma_range_per_m * value[0]) ** 2, NOISE.sigma_bearing_rad**2])
    np.testing.assert_allclose(observations.covariance[0], still + np.outer(by_stamp, by_stamp))
    assert observations.parts.names == POSITION_NOISE
    noisier = NOISE.model_copy(update={STAMP_NOISE: 0.05})
    np.testing.assert_allclose(
        observations.with_noise(noisier).covariance[0], still + 25.0 * np.outer(by_stamp, by_stamp), rtol=1e-9
    )
    own = read_one(value, polar=True, in_camera=True)
    np.testing.assert_array_equal(own.covariance[0], COVARIANCE)
    np.testing.assert_array_equal(own.with_noise(noisier).covariance[0], COVARIANCE)
