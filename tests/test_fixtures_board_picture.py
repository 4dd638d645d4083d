"""Rendered calibration boards against OpenCV's own drawing and against geometry."""

import cv2
import numpy as np
import pytest

from groundsbot.calib.board.board import DEFAULT_BOARD
from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.fixtures.pictures.board_picture import (
    BoardPainter,
    Glare,
    View,
    between_rays,
    corners_of,
    drawn_views,
    second_differences,
)
from groundsbot.fixtures.pictures.textures import ByteArray
from groundsbot.fixtures.worlds.world import Pictures

NARROW = CameraModel("narrow", 640, 480, 800.0, 801.0, 318.0, 243.0, "plumb_bob", (-0.1, 0.05, 0.0005, -0.0003, 0.0))
FISHEYE = CameraModel("fisheye", 640, 480, 220.0, 220.5, 322.0, 237.0, "equidistant", (0.02, -0.005, 0.001, 0.0))
STRAIGHT = CameraModel("straight", 400, 480, 400.0, 400.0, 199.5, 239.5, "plumb_bob", (0.0,) * 5)
CLEAN = Pictures(
    defocus_px=0.0, gamma=1.0, vignetting=0.0, bloom=0.0, read_noise_electrons=0.0, full_well_electrons=1e9
)


def frontal(distance_m: float, columns_px: float = 0.0) -> FloatArray:
    """The board's middle on the axis, upright."""
    T = np.eye(4)
    width_mm, height_mm = DEFAULT_BOARD.size_mm
    T[:3, 3] = [-0.0005 * width_mm, -0.0005 * height_mm, distance_m]
    T[0, 3] += columns_px * distance_m / STRAIGHT.fx_px
    return T


def taken(view: View, settings: Pictures = CLEAN, flipped: bool = False) -> ByteArray:
    return BoardPainter(STRAIGHT, DEFAULT_BOARD, settings, flipped).picture(view, np.random.default_rng(0))


def test_the_print_is_what_opencv_draws() -> None:
    distance_m = 0.2  # one pixel is 0.5 mm
    picture = taken(View(frontal(distance_m)))
    width, height = (round(side / 0.5) for side in DEFAULT_BOARD.size_mm)
    drawn = DEFAULT_BOARD.charuco().generateImage((width, height), marginSize=0) > 127
    left, top = (STRAIGHT.width_px - width) // 2, (STRAIGHT.height_px - height) // 2
    differing = (picture[top : top + height, left : left + width] > 127) != drawn
    assert differing.mean() < 0.02  # OpenCV rounds the cells of markers to pixels


def test_a_flipped_print_is_the_mirror_image() -> None:
    picture, flipped = (taken(View(frontal(0.3)), flipped=flip)[90:390, 84:316] > 127 for flip in (False, True))
    assert (flipped[:, ::-1] != picture).mean() < 0.005


@pytest.mark.parametrize("camera", [NARROW, FISHEYE], ids=lambda camera: camera.name)
def test_corners_are_found_where_they_are_projected(camera: CameraModel) -> None:
    rng = np.random.default_rng(3)
    painter = BoardPainter(camera, DEFAULT_BOARD)
    detector = cv2.aruco.CharucoDetector(DEFAULT_BOARD.charuco())
    errors = []
    for view in drawn_views(camera, DEFAULT_BOARD, 6, rng):
        corners, ids, _, _ = detector.detectBoard(painter.picture(view, rng))
        errors.append(corners.reshape(-1, 2) - corners_of(view, camera, DEFAULT_BOARD)[ids.ravel()])
    all_errors = np.concatenate(errors)
    assert len(all_errors) > 120
    # OpenCV's refinement errs by tenths where squares are small; the middle of the crowd is the renderer's.
    assert np.abs(np.median(all_errors, axis=0)).max() < 0.02
    assert np.median(np.abs(all_errors)) < 0.05


@pytest.mark.parametrize("camera", [NARROW, FISHEYE], ids=lambda camera: camera.name)
def test_a_ray_between_the_corners_of_a_pixel_is_where_the_lens_has_it(camera: CameraModel) -> None:
    """Along straight lines it would be up to 0.0004 px off in a fisheye, and on one side."""
    columns, rows = np.meshgrid(np.arange(400, 412) - 0.5, np.arange(100, 110) - 0.5)
    rays = camera.unproject(np.stack([columns, rows], axis=-1))
    bent = np.stack([second_differences(rays, axis) for axis in (1, 0)], axis=-1)
    shares = (0.2, 0.5, 0.9)
    places = [(row, column, s, t) for row in (1, 7) for column in (1, 5, 9) for s in shares for t in shares]
    found = camera.project(np.array([between_rays(rays, bent, *place) for place in places]))
    true = np.array([(399.5 + column + s, 99.5 + row + t) for row, column, s, t in places])
    np.testing.assert_allclose(found, true, atol=1e-5)


def test_motion_smears_along_its_direction_and_keeps_the_middle() -> None:
    shift_px = 6.0
    motion = np.array([shift_px * 0.3 / STRAIGHT.fx_px, 0, 0, 0, 0, 0])
    still, moved = (taken(View(frontal(0.3), motion=each)).astype(float) for each in (None, motion))
    left = np.s_[200:280, 70:110]  # the paper's left edge
    across, down = (np.abs(np.diff(moved[left], axis=axis)).max() for axis in (1, 0))
    assert across < 0.3 * np.abs(np.diff(still[left], axis=1)).max()
    assert down < across + 150
    inside = np.s_[100:380, 100:300]
    assert moved[inside].mean() == pytest.approx(still[inside].mean(), abs=2.0)


def test_glare_saturates_its_place_alone() -> None:
    view = View(frontal(0.3))
    plain, glaring = (taken(each) for each in (view, View(frontal(0.3), glare=Glare((150.0, 200.0), 20.0))))
    assert (glaring[195:206, 145:156] == 255).all()
    np.testing.assert_array_equal(plain[300:, 250:], glaring[300:, 250:])
