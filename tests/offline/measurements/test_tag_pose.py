"""Corners to range and bearing: no bias where an observation is used, and a scatter that agrees with its sigma."""

from collections.abc import Callable

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import BoolArray, FloatArray
from groundsbot.calib.robot.robot_yaml import Robot
from groundsbot.offline.measurements.sensor_model.sensor_model import MAX_RANGE_SIGMA_PER_M
from groundsbot.offline.measurements.sensor_model.tag_pose import (
    TagMeasurements,
    general_observations,
    upright_observations,
)
from tests.support.data.drives import CAMERA, MadeTag, make_robot, seen_corners_px

SIGMA_PX = 0.2
N = 500
SIZE_M = 0.15
LEVEL = make_robot(mount={"x_m": 0.0, "y_m": 0.0, "z_m": 0.4})
TIPPED = make_robot(mount={"x_m": 0.0, "y_m": 0.0, "z_m": 0.4, "yaw_rad": -0.2, "pitch_rad": 0.15, "roll_rad": 0.1})
FISHEYE = CameraModel("f", 1280, 720, 500.0, 500.0, 640.0, 360.0, "equidistant", (-0.02, 0.004, -0.001, 0.0))


def place(distance_m: float, turned_deg: float, bearing_deg: float, roll_deg: float, pitch_deg: float = 0.0) -> MadeTag:
    """A tag that far from the camera at the origin, turned away from facing it."""
    bearing, turned = np.radians([bearing_deg, turned_deg])
    x_m, y_m = distance_m * np.cos(bearing), distance_m * np.sin(bearing)
    yaw_rad = float(bearing + np.pi + turned)
    return MadeTag(1, (x_m, y_m, 0.45), yaw_rad, np.radians(pitch_deg), np.radians(roll_deg), SIZE_M)


def noisy(corners_px: FloatArray, seed: int) -> FloatArray:
    """(500, 4, 2): noise and its mirror image, so that a mean shows bias and not chance."""
    half = SIGMA_PX * np.random.default_rng(seed).standard_normal((N // 2, 4, 2))
    return np.asarray(corners_px + np.concatenate([half, -half]))


def exact_corners(tag: MadeTag, robot: Robot, camera: CameraModel) -> FloatArray:
    corners = seen_corners_px(tag, np.zeros(3), robot, camera)
    assert corners is not None
    return corners


def inputs(n: int, camera: CameraModel, rotation: FloatArray) -> tuple[FloatArray, CameraModel, FloatArray, FloatArray]:
    """The rest of what a reader of so many tags takes."""
    return np.full(n, SIZE_M), camera, rotation, np.full(n, SIGMA_PX)


def read(corners_px: FloatArray, robot: Robot = LEVEL, camera: CameraModel = CAMERA) -> TagMeasurements:
    rotation = robot.mount.T_base_camera.rotation.as_matrix()
    return upright_observations(corners_px, *inputs(len(corners_px), camera, rotation))


def used(found: TagMeasurements) -> BoolArray:
    """As groundsbot.offline.measurements.sensor_model.sensor_model gates the range."""
    gate = (MAX_RANGE_SIGMA_PER_M * found.range_bearing[:, 0]) ** 2
    return np.asarray(found.valid & (found.covariance[:, 0, 0] < gate))


def truth(tag: MadeTag) -> FloatArray:
    x_m, y_m, _ = tag.position_m
    return np.array([np.hypot(x_m, y_m), np.arctan2(y_m, x_m)])


GRID = [
    (distance_m, turned_deg, bearing_deg, roll_deg)
    for distance_m in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
    for turned_deg in (0.0, 15.0, 30.0, 45.0, 60.0)
    for bearing_deg in (0.0, 22.0, -15.0)
    for roll_deg in (0.0, 30.0)
]


@pytest.mark.parametrize(("robot", "camera"), [(LEVEL, CAMERA), (TIPPED, CAMERA), (LEVEL, FISHEYE)])
def test_the_mean_observation_is_true_wherever_observations_are_used(robot: Robot, camera: CameraModel) -> None:
    """The full pose of a planar tag is up to half a sigma off near frontal views; the upright model must not be."""
    n_used = 0
    squares: list[FloatArray] = []
    for seed, cell in enumerate(GRID):
        tag = place(*cell)
        corners_px = seen_corners_px(tag, np.zeros(3), robot, camera)
        if corners_px is None:  # partly beside the picture
            continue
        found = read(noisy(corners_px, seed), robot, camera)
        keep = used(found)
        if not keep.any():
            continue
        n_used += 1
        sigma = np.sqrt(np.einsum("mii->mi", found.covariance))
        in_sigmas = ((found.range_bearing - truth(tag)) / sigma)[keep]
        assert (np.abs(in_sigmas.mean(axis=0)) < 0.15).all(), (cell, in_sigmas.mean(axis=0))
        squares.append(in_sigmas**2)
    assert n_used > 150
    mean_square = np.concatenate(squares).mean(axis=0)
    # A mirror image says nothing new of the spread: half as many independent squares, of variance 2 each.
    np.testing.assert_allclose(mean_square, 1.0, atol=4.0 * np.sqrt(2.0 / (n_used * N / 2)))


@pytest.mark.parametrize("robot", [LEVEL, TIPPED])
def test_exact_corners_give_the_exact_place_and_height(robot: Robot) -> None:
    for cell in GRID[::7]:
        tag = place(*cell)
        corners_px = seen_corners_px(tag, np.zeros(3), robot, CAMERA)
        if corners_px is not None:
            found = read(corners_px[None], robot)
            np.testing.assert_allclose(found.range_bearing[0], truth(tag), atol=1e-8)
            assert found.height_m[0] == pytest.approx(0.05, abs=1e-8)
            assert found.chi2[0] < 1e-8


def test_residuals_have_the_two_degrees_of_freedom_that_test_the_model() -> None:
    corners_px = noisy(exact_corners(place(3.0, 30.0, 5.0, 10.0), LEVEL, CAMERA), 3)
    assert read(corners_px).chi2.mean() == pytest.approx(2.0, abs=0.4)


def test_a_tilted_tag_fails_the_upright_model() -> None:
    corners_px = noisy(exact_corners(place(3.0, 20.0, 5.0, 0.0, pitch_deg=40.0), LEVEL, CAMERA), 3)
    assert read(corners_px).chi2.mean() > 20.0


@pytest.mark.parametrize("pitch_deg", [-60.0, -25.0, 30.0, 55.0])
@pytest.mark.parametrize("distance_m", [1.0, 2.0, 4.0, 6.0])
def test_general_observations_of_tilted_tags_are_within_their_sigma(distance_m: float, pitch_deg: float) -> None:
    tag = place(distance_m, 20.0, 5.0, 0.0, pitch_deg)
    corners_px = noisy(exact_corners(tag, LEVEL, CAMERA), 5)
    _general_observation_is_honest(corners_px, truth(tag), LEVEL)


@pytest.mark.parametrize("x_m", [2.0, 3.0, 4.0])
def test_general_observations_of_tags_on_the_ceiling_are_within_their_sigma(x_m: float) -> None:
    upwards = make_robot(mount={"x_m": 0.0, "y_m": 0.0, "z_m": 0.4, "pitch_rad": -0.6})
    tag = MadeTag(1, (x_m, 0.4, 2.8), np.pi, -np.pi / 2, 0.0, SIZE_M)
    corners_px = noisy(exact_corners(tag, upwards, CAMERA), 5)
    _general_observation_is_honest(corners_px, truth(tag), upwards)


def _general_observation_is_honest(corners_px: FloatArray, true: FloatArray, robot: Robot) -> None:
    """Its sigma is meant to cover the pose's bias many times over, so there is no lower bound on the errors."""
    rotation = robot.mount.T_base_camera.rotation.as_matrix()
    found = general_observations(corners_px, *inputs(len(corners_px), CAMERA, rotation))
    assert found.valid.all()
    in_sigmas = (found.range_bearing - true) / np.sqrt(np.einsum("mii->mi", found.covariance))
    assert (np.abs(in_sigmas.mean(axis=0)) < 0.15).all(), in_sigmas.mean(axis=0)
    assert (in_sigmas.std(axis=0) < 1.1).all(), in_sigmas.std(axis=0)


@pytest.mark.parametrize("reader", [upright_observations, general_observations])
def test_corners_of_no_tag_are_no_observation_and_affect_no_other(reader: Callable[..., TagMeasurements]) -> None:
    good = exact_corners(place(3.0, 30.0, 5.0, 10.0), LEVEL, CAMERA)
    bad = [
        np.full((4, 2), np.nan),
        np.full((4, 2), np.inf),
        np.full((4, 2), 1e300),
        np.zeros((4, 2)),
        good[[0, 2, 1, 3]],
    ]
    rotation = LEVEL.mount.T_base_camera.rotation.as_matrix()
    found = reader(np.array([*bad, good]), *inputs(len(bad) + 1, CAMERA, rotation))
    assert not found.valid[: len(bad) - 1].any()
    assert found.valid[-1]
    alone = reader(good[None], *inputs(1, CAMERA, rotation))
    # All points are taken through the lens until the last is still, which may move a still one by its last bit.
    np.testing.assert_allclose(found.range_bearing[-1], alone.range_bearing[0], rtol=1e-14)
    assert not found.valid[len(bad) - 1] or found.chi2[len(bad) - 1] > 100.0


def test_no_observations_are_none() -> None:
    for reader in (upright_observations, general_observations):
        found = reader(np.zeros((0, 4, 2)), *inputs(0, CAMERA, np.eye(3)))
        assert found.range_bearing.shape == (0, 2)


@pytest.mark.parametrize("robot", [LEVEL, TIPPED])
@pytest.mark.parametrize("reader", [upright_observations, general_observations])
def test_derivatives_of_observations_by_the_mounts_rotation(
    robot: Robot, reader: Callable[..., TagMeasurements]
) -> None:
    rotation = robot.mount.T_base_camera.rotation.as_matrix()
    tags = [place(3.0, 20.0, 15.0, 5.0), place(2.0, -30.0, -12.0, 0.0), place(4.0, 40.0, 3.0, 30.0)]
    corners_px = np.stack([exact_corners(tag, robot, CAMERA) for tag in tags])

    def turned(w: FloatArray) -> TagMeasurements:
        R_base_camera = Rotation.from_rotvec(w).as_matrix() @ rotation
        return reader(corners_px, *inputs(3, CAMERA, R_base_camera))

    found = turned(np.zeros(3))
    for axis, turn in enumerate(1e-5 * np.eye(3)):
        by_turn = (turned(turn).range_bearing - turned(-turn).range_bearing) / 2e-5
        np.testing.assert_allclose(found.by_turn[..., axis], by_turn, rtol=1e-3, atol=1e-3)


def test_derivatives_of_the_misfit_by_the_mounts_rotation() -> None:
    rotation = LEVEL.mount.T_base_camera.rotation.as_matrix()
    corners_px = exact_corners(place(1.5, 35.0, 15.0, 5.0), LEVEL, CAMERA)[None]

    def turned(w: FloatArray) -> TagMeasurements:
        R_base_camera = Rotation.from_rotvec(w).as_matrix() @ rotation
        return upright_observations(corners_px, *inputs(1, CAMERA, R_base_camera))

    by_turn = turned(np.zeros(3)).misfit_by_turn[0]
    for axis, turn in enumerate(1e-5 * np.eye(3)):
        expected = (turned(turn).misfit[0] - turned(-turn).misfit[0]) / 2e-5
        np.testing.assert_allclose(by_turn[:, axis], expected, atol=1e-3 * np.abs(by_turn).max())
    assert np.abs(by_turn[:, 1]).max() > 50.0
