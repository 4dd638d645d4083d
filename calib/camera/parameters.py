"""The intrinsics of a camera as one vector, and the derivatives of pixels with respect to it.

The vector contains fx, fy, cx, cy, and the distortion coefficients in OpenCV's order.
"""

from dataclasses import replace

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


def pixels_by_parameters(model: CameraModel, points_camera_m: FloatArray, pixels: FloatArray) -> FloatArray:
    """Return the Jacobian (..., 2, n) of projected points with respect to the n intrinsics.

    Args:
        model: camera at which the Jacobian is evaluated; its intrinsics are in the order of `parameter_names`.
        points_camera_m: (..., 3) points in the camera's optical frame, z forward.
        pixels: (..., 2) projections of the points by `model`, in px.
    """
    xy = points_camera_m[..., :2] / points_camera_m[..., 2:]
    square = (xy**2).sum(axis=-1)
    focal = np.array([model.fx_px, model.fy_px])
    distorted = (pixels - np.array([model.cx_px, model.cy_px])) / focal
    out = np.zeros((*xy.shape[:-1], 2, 4 + len(model.distortion)))
    for axis in (0, 1):
        out[..., axis, axis] = distorted[..., axis]
        out[..., axis, 2 + axis] = 1.0
    if model.distortion_model == "equidistant":
        radius = np.sqrt(square)
        angle = np.arctan(radius)
        shares = [angle ** (2 * power + 1) / np.maximum(radius, 1e-12) for power in (1, 2, 3, 4)]
        by_coefficients = xy[..., None] * np.stack(shares, axis=-1)[..., None, :]
    else:
        by_coefficients = _radial_and_tangential(model, xy, square)
    out[..., 4:] = focal[:, None] * by_coefficients
    return out


def _radial_and_tangential(model: CameraModel, xy: FloatArray, square: FloatArray) -> FloatArray:
    """Return the derivatives (..., 2, 5 or 8) of distorted coordinates by the coefficients."""
    k1, k2, _, _, k3, *below = model.distortion
    powers = np.stack([square, square**2, square**3], axis=-1)
    denominator = 1.0 + powers @ np.array(below) if below else np.ones_like(square)
    factor = (1.0 + powers @ np.array([k1, k2, k3])) / denominator
    radial = xy[..., None] * (powers / denominator[..., None])[..., None, :]
    out = np.empty((*xy.shape, len(model.distortion)))
    out[..., :2], out[..., 4] = radial[..., :2], radial[..., 2]
    product = 2.0 * xy[..., 0] * xy[..., 1]
    out[..., 0, 2], out[..., 1, 2] = product, square + 2.0 * xy[..., 1] ** 2
    out[..., 0, 3], out[..., 1, 3] = square + 2.0 * xy[..., 0] ** 2, product
    if below:
        out[..., 5:] = -factor[..., None, None] * radial
    return out
