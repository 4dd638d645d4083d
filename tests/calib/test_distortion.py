"""Lenses at random, with roots of the denominator inside the picture: every ray that OpenCV finds is found."""

import cv2
import numpy as np
import pytest

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray

# A fit to real pictures: the denominator's root at a radius of 0.37 is cancelled by the numerator's to a thousandth.
NEARLY_CANCELLED = CameraModel(
    "cancelled", 640, 480, 681.4, 681.5, 314.18, 223.85, "rational_polynomial",
    (4.403, -184.4, -0.002677, -0.001402, 728.4, 4.201, -181.6, 718.5),
)  # fmt: skip
PIXELS = np.stack(np.meshgrid(np.linspace(-0.5, 639.5, 17), np.linspace(-0.5, 479.5, 13)), axis=-1).reshape(-1, 2)


def draw_rational(rng: np.random.Generator, cancelled: bool) -> CameraModel:
    """A rational lens with a root of its denominator, which a root of the numerator nearly cancels, or not."""
    focal_px, square, near = rng.uniform(250.0, 1200.0), rng.uniform(0.02, 1.5), 10.0 ** rng.uniform(-4.0, -2.0)
    k = rng.normal(0.0, 0.2, 3)
    below = np.convolve([1.0, k[2], 0.0], [1.0, -1.0 / square])
    moved = square * (1.0 + rng.choice([-1.0, 1.0]) * near)
    above = np.convolve([1.0, k[0], k[1]], [1.0, -1.0 / moved]) if cancelled else np.array([1.0, *k])
    p1, p2 = rng.normal(0.0, 0.001, 2)
    coefficients = (above[1], above[2], p1, p2, above[3], *below[1:])
    return CameraModel("drawn", 640, 480, focal_px, focal_px, 320.0, 240.0, "rational_polynomial", coefficients)


def undistort_by_opencv(camera: CameraModel) -> tuple[FloatArray, FloatArray]:
    """The pixels for which OpenCV finds a point that projects to them, and these points."""
    lens = (camera.matrix, np.array(camera.distortion))
    ends = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    points = cv2.undistortPointsIter(PIXELS[:, None], *lens, np.eye(3), np.eye(3), ends)[:, 0]
    away = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    back = cv2.projectPoints(away, np.zeros(3), np.zeros(3), *lens)[0][:, 0]
    found = np.abs(back - PIXELS).max(axis=1) < 1e-6
    return PIXELS[found], np.asarray(points[found], np.float64)


def is_reached(camera: CameraModel, points: FloatArray, cancelled: bool) -> FloatArray:
    """Whether the image grows all the way from the axis to a point; a lens folds no image onto another.

    Around a cancelled root, a ring in which it folds is passed.
    """
    k1, k2, _, _, k3, k4, k5, k6 = camera.distortion
    squares = np.linspace(0.0, 1.0, 2000) * (points**2).sum(axis=1)[:, None]
    factor = (1.0 + squares * (k1 + squares * (k2 + squares * k3))) / (
        1.0 + squares * (k4 + squares * (k5 + squares * k6))
    )
    falling = np.diff(np.sqrt(squares) * factor, axis=1) <= 0.0
    if cancelled:
        pole = min(abs(root) for root in np.roots([k6, k5, k4, 1.0]) if root.imag == 0.0 and root.real > 0.0)
        falling &= np.abs(squares[:, 1:] / pole - 1.0) > 0.15
    return np.asarray(~falling.any(axis=1))


@pytest.mark.parametrize("cancelled", [True, False], ids=["cancelled", "uncancelled"])
def test_what_opencv_undistorts_inside_the_picture_has_a_ray(cancelled: bool) -> None:
    rng = np.random.default_rng(0)
    lenses = [draw_rational(rng, cancelled) for _ in range(100)] + [NEARLY_CANCELLED] * cancelled
    checked = 0
    for camera in lenses:
        pixels, points = undistort_by_opencv(camera)
        if not len(pixels):
            continue
        reached = is_reached(camera, points, cancelled)
        rays = camera.unproject(pixels[reached])
        np.testing.assert_allclose(camera.project(rays), pixels[reached], rtol=0, atol=1e-6, err_msg=f"{camera}")
        checked += int(reached.sum())
    assert checked > 0.7 * len(lenses) * len(PIXELS)


def test_a_root_that_is_nearly_cancelled_is_no_edge_of_the_image() -> None:
    pixels, points = undistort_by_opencv(NEARLY_CANCELLED)
    rays = NEARLY_CANCELLED.unproject(pixels)
    same = np.abs(rays[:, :2] / rays[:, 2:] - points).max(axis=1) < 1e-6
    assert np.isfinite(rays).all()
    assert same.mean() > 0.98
    assert np.linalg.norm(points[same], axis=1).max() > 0.5
