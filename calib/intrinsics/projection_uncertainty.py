"""Projection uncertainty of a calibrated camera over its picture.

A rotation of the camera frame is not observable from intrinsics and is absorbed by the calibration of the mount. Only
the part of an error that no rotation compensates is therefore counted. mrcal does the same (mrcal.secretsauce.net,
projection uncertainty and differences of models); here it is done for points at infinity.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial.transform import Rotation
from scipy.stats import f

from groundsbot.calib.camera import CameraModel, pixels_by_parameters
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray, FloatArray

_COLUMNS = 40
_ROTATION_ROUNDS = 20
_ARRIVED_RAD = 1e-12
_LEAST_RAYS = 10  # of the grid
_COLUMNS_OF_CHANCE = 16


@dataclass(frozen=True)
class PictureGrid:
    """A regular grid over a picture.

    Attributes:
        pixels: (rows, columns, 2) positions in the picture.
        rays: (rows, columns, 3) their rays in the camera frame; NaN outside the image circle.
    """

    pixels: FloatArray
    rays: FloatArray

    @property
    def is_imaged(self) -> BoolArray:
        """(rows, columns) mask of the positions that have a ray: those inside the image circle."""
        return np.asarray(np.isfinite(self.rays).all(axis=-1))

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

    Raises:
        CalibError: the lens images too little of the picture.
    """
    left = projection_errors(model, grid)
    out = np.full((*grid.is_imaged.shape, 2, 2), np.nan)
    out[grid.is_imaged] = left @ covariance @ left.swapaxes(-1, -2)
    return out


def projection_errors(model: CameraModel, grid: PictureGrid) -> FloatArray:
    """Return the derivatives (N, 2, n) of the pixels of a grid's N rays by the intrinsics, after the best rotation.

    Raises:
        CalibError: the lens images too little of the picture.
    """
    rays = grid.rays[grid.is_imaged]
    if len(rays) < _LEAST_RAYS:
        raise CalibError(
            f"camera {model.name}: its {model.distortion_model} lens images {len(rays)} of {grid.is_imaged.size} "
            f"places of the picture, at least {_LEAST_RAYS} are needed; take more views, all over the picture, or "
            "another --model"
        )
    _, by_point = model.project_with_jacobian(rays)
    by_parameters = pixels_by_parameters(model, rays)
    by_turn = np.cross(rays[:, None, :], by_point).reshape(-1, 3)
    flat = by_parameters.reshape(-1, by_parameters.shape[-1])
    turned_away = by_turn @ np.linalg.lstsq(by_turn, flat, rcond=None)[0]
    return np.asarray((flat - turned_away).reshape(by_parameters.shape))


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


def chance_of_difference(
    model: CameraModel, other: CameraModel, covariances: Sequence[tuple[FloatArray, int]]
) -> float:
    """Return the probability of a difference between two cameras as large as theirs or larger, if both are the same.

    The statistic is the mean over the picture of the squared difference of projections over its covariance. Covariances
    from V views have rank V at most and are uncertain themselves, so a chi-square test of all parameters would reject
    too often. The statistic is compared with an F distribution instead, whose degrees of freedom follow from the first
    two moments (Satterthwaite, 1946; Welch, 1947). The probability is 0 if the other camera has no image of a place
    inside this camera's image; how far an image reaches is as uncertain as the parameters.

    Args:
        model: one camera, at which projections are linearised.
        other: another camera for the same pictures.
        covariances: covariances (n, n) of the intrinsics, of one camera or of both, with the numbers of views.
    """
    grid = PictureGrid.of(model, _COLUMNS_OF_CHANCE)
    difference = difference_px(other, grid)
    both = np.asarray(np.isfinite(difference).all(axis=-1))
    inside = np.asarray(binary_erosion(grid.is_imaged, np.ones((3, 3), dtype=np.bool_)))
    if not both.any() or not both[inside].all():
        return 0.0
    left, difference = projection_errors(model, grid)[both[grid.is_imaged]], difference[both]
    total = np.sum([covariance for covariance, _ in covariances], axis=0)
    weight = np.linalg.pinv(left @ total @ left.swapaxes(-1, -2), hermitian=True)
    statistic = float(np.einsum("ni,nij,nj->n", difference, weight, difference).mean())
    metric = (left.swapaxes(-1, -2) @ weight @ left).mean(axis=0)
    expected = float(np.trace(metric @ total))
    freedom = expected**2 / float(np.trace(metric @ total @ metric @ total))
    shares = [(float(np.trace(metric @ each)) / expected) ** 2 / max(n_views - 1, 1) for each, n_views in covariances]
    return float(f.sf(statistic / expected, freedom, 1.0 / sum(shares)))


def rms_px(errors: FloatArray) -> float:
    """Return the root mean square length of errors (..., 2), ignoring NaN."""
    return float(np.sqrt(np.nanmean((errors**2).sum(axis=-1))))
