"""The intrinsics of a camera as one vector, and the derivatives of pixels with respect to it.

The vector contains fx, fy, cx, cy, and the distortion coefficients in OpenCV's order.
"""

from dataclasses import replace

import cv2
import numpy as np

from groundsbot.calib.camera.distortion import COEFFICIENTS
from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation import FloatArray

FOCAL_AND_CENTRE = ("fx_px", "fy_px", "cx_px", "cy_px")
_NAMES = {
    "plumb_bob": ("k1", "k2", "p1", "p2", "k3"),
    "rational_polynomial": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "equidistant": ("k1", "k2", "k3", "k4"),
}


def parameter_names(distortion_model: str) -> tuple[str, ...]:
    """Return the names of the vector's entries."""
    return (*FOCAL_AND_CENTRE, *_NAMES[distortion_model])


def parameters_of(model: CameraModel) -> FloatArray:
    """Return the intrinsics as a vector (n,)."""
    return np.array([model.fx_px, model.fy_px, model.cx_px, model.cy_px, *model.distortion])


def with_parameters(model: CameraModel, parameters: FloatArray) -> CameraModel:
    """Return the camera with other intrinsics (n,).

    Raises:
        CalibError: the intrinsics are impossible.
    """
    fx, fy, cx, cy, *coefficients = (float(value) for value in parameters)
    return replace(model, fx_px=fx, fy_px=fy, cx_px=cx, cy_px=cy, distortion=tuple(coefficients))


def undistorted_camera(name: str, size_px: tuple[int, int], distortion_model: str, focal_px: float) -> CameraModel:
    """Return a camera with the principal point in the middle of the picture and all distortion coefficients zero."""
    width_px, height_px = size_px
    return CameraModel(
        name, width_px, height_px, focal_px, focal_px, 0.5 * (width_px - 1), 0.5 * (height_px - 1), distortion_model,
        (0.0,) * COEFFICIENTS[distortion_model],
    )  # fmt: skip


def pixels_by_parameters(model: CameraModel, points_camera_m: FloatArray) -> FloatArray:
    """Return the Jacobian (N, 2, n) of projected points with respect to the n intrinsics.

    Args:
        model: camera at which the Jacobian is evaluated; its intrinsics are in the order of `parameter_names`.
        points_camera_m: (N, 3) points in the camera's optical frame, z forward.
    """
    points, origin, n = points_camera_m[:, np.newaxis], np.zeros(3), 4 + len(model.distortion)
    if not len(points):
        return np.zeros((0, 2, n))
    if model.distortion_model == "equidistant":
        jacobian = cv2.fisheye.projectPoints(points, origin, origin, model.matrix, np.array(model.distortion))[1]
        return np.asarray(jacobian[:, :n], dtype=np.float64).reshape(-1, 2, n)
    jacobian = cv2.projectPoints(points, origin, origin, model.matrix, np.array(model.distortion))[1]
    return np.asarray(jacobian[:, 6 : 6 + n], dtype=np.float64).reshape(-1, 2, n)
