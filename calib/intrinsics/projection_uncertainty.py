"""Projection uncertainty of a calibrated camera over its picture.

A rotation of the camera frame is not observable from intrinsics and is absorbed by the calibration of the mount. Only
the part of an error that no rotation compensates is therefore counted. mrcal does the same (mrcal.secretsauce.net,
projection uncertainty and differences of models); here it is done for points at infinity.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera import CameraModel, pixels_by_parameters
from groundsbot.calib.foundation import FloatArray

_COLUMNS = 40
_ROTATION_ROUNDS = 20
_ARRIVED_RAD = 1e-12


@dataclass(frozen=True)
class PictureGrid:
    """A regular grid over a picture.

    Attributes:
        pixels: (rows, columns, 2) positions in the picture.
        rays: (rows, columns, 3) their rays in the camera frame; NaN outside the image circle.
    """

    pixels: FloatArray
    rays: FloatArray

    @staticmethod
    def of(model: CameraModel, columns: int = _COLUMNS) -> "PictureGrid":
        """Return the centres of equal, nearly square cells."""
        rows = max(2, round(columns * model.height_px / model.width_px))
        across = (np.arange(columns) + 0.5) * model.width_px / columns - 0.5
        down = (np.arange(rows) + 0.5) * model.height_px / rows - 0.5
        pixels = np.stack(np.meshgrid(across, down), axis=-1)
        return PictureGrid(pixels, model.unproject(pixels))


def projection_covariance(model: CameraModel, covariance: FloatArray, grid: PictureGrid) -> FloatArray:
    """Return covariances (rows, columns, 2, 2) in px^2 of projected far points, after the best rotation.

    They are NaN outside the image circle.

    Args:
        model: the camera.
        covariance: (n, n) covariance of its intrinsics.
        grid: grid of the camera.
    """
    inside = np.isfinite(grid.rays).all(axis=-1)
    rays = grid.rays[inside]
    pixels, by_point = model.project_with_jacobian(rays)
    by_parameters = pixels_by_parameters(model, rays, pixels)
    by_turn = np.cross(rays[:, None, :], by_point).reshape(-1, 3)
    flat = by_parameters.reshape(-1, by_parameters.shape[-1])
    made_up = by_turn @ np.linalg.solve(by_turn.T @ by_turn, by_turn.T @ flat)
    left = (flat - made_up).reshape(by_parameters.shape)
    out = np.full((*inside.shape, 2, 2), np.nan)
    out[inside] = left @ covariance @ left.swapaxes(-1, -2)
    return out


def expected_error_px(covariance: FloatArray) -> FloatArray:
    """Return the root mean square length of errors with covariances (..., 2, 2)."""
    return np.asarray(np.sqrt(np.trace(covariance, axis1=-2, axis2=-1)))


def difference_px(other: CameraModel, grid: PictureGrid) -> FloatArray:
    """Return differences (rows, columns, 2) between the projections of two cameras, after the best rotation.

    They are NaN where one of the two cameras has no image.

    Args:
        other: a camera.
        grid: grid of another camera with the same picture size.
    """
    turn, rays = Rotation.identity(), grid.rays.reshape(-1, 3)
    used = np.asarray(np.isfinite(rays).all(axis=1))
    for _ in range(_ROTATION_ROUNDS):
        pixels, by_point = other.project_with_jacobian(turn.apply(np.where(used[:, None], rays, np.nan)))
        error = pixels - grid.pixels.reshape(-1, 2)
        imaged = np.isfinite(error).all(axis=1)
        by_turn = np.cross(turn.apply(rays[imaged])[:, None, :], by_point[imaged]).reshape(-1, 3)
        step = np.linalg.lstsq(by_turn, -error[imaged].ravel(), rcond=None)[0]
        turn = Rotation.from_rotvec(step) * turn
        if np.abs(step).max() < _ARRIVED_RAD:
            break
    pixels = other.project(turn.apply(np.where(used[:, None], rays, np.nan)))
    return np.asarray((pixels - grid.pixels.reshape(-1, 2)).reshape(grid.pixels.shape))


def rms_px(errors: FloatArray) -> float:
    """Return the root mean square length of errors (..., 2), ignoring NaN."""
    return float(np.sqrt(np.nanmean((errors**2).sum(axis=-1))))
