"""Check whether a calibration still fits the camera that took given pictures.

The camera is calibrated again from the pictures, and the two results are compared in pixels and statistically, with the
sum of both covariances. A file without a covariance (`groundsbot_estimate`) is taken as exact.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.board import BoardFinder, BoardView
from groundsbot.calib.camera import CameraEstimate, CameraModel
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.intrinsics.bundle import find_poses, project_corners
from groundsbot.calib.intrinsics.calibration import place_in_picture, refuse_alike, refuse_unclear
from groundsbot.calib.intrinsics.model_choice import Calibration, calibrate_camera
from groundsbot.calib.intrinsics.projection_uncertainty import PictureGrid, chance_of_difference, difference_px, rms_px

_CHANCE: Final = 0.001
# A smaller difference is below the errors of tag corners, which are 0.04 to 0.1 px with the best detector.
_MATTERS_PX: Final = 0.1


@dataclass(frozen=True)
class Check:
    """Result of a check.

    Attributes:
        fits: the calibration still fits.
        chance: p-value: probability of a difference this large with an unchanged camera.
        difference_px: RMS over the picture of the difference between the two projections of far points.
        residual_px: typical residual of a corner's coordinate with the file's camera, and with the new one.
        lines: the verdict in words.
    """

    fits: bool
    chance: float
    difference_px: float
    residual_px: tuple[float, float]
    lines: list[str]


def compare(
    model: CameraModel, estimate: CameraEstimate | None, views: Sequence[BoardView], finder: BoardFinder
) -> Check:
    """Compare a camera model with a new calibration from views of a board.

    Args:
        model: camera model to check.
        estimate: uncertainty of the model, or None if its file has none.
        views: views of the board.
        finder: finder of the board.

    Returns:
        The verdict, with the differences in pixels and the probability of a difference this large.

    Raises:
        CalibError: the pictures have another size than the model, fewer than five of them show the board differently,
            or they do not determine the intrinsics.
    """
    height_px, width_px = views[0].picture.shape
    if (width_px, height_px) != (model.width_px, model.height_px):
        raise CalibError(
            f"{views[0].name}: has {width_px}x{height_px} pixels but the camera file is for "
            f"{model.width_px}x{model.height_px}; take pictures of the size that was calibrated, or calibrate again"
        )
    refuse_alike(views)
    again = calibrate_camera(views, finder, model.name, [model.distortion_model])
    refuse_unclear(again)
    with np.errstate(over="ignore", invalid="ignore"):  # an unphysical camera projects points to infinity
        with_file = _residuals_with(model, again)
        chance = _chance(model, estimate, again)
        difference = difference_px(model, PictureGrid.of(again.model))
        off_px = rms_px(difference) if np.isfinite(difference).any() else np.inf
        typical = _typical_px(with_file), _typical_px(again.lens.fit.residual_px)
    fits = still_fits(chance, off_px)
    return Check(fits, chance, off_px, typical, _lines(fits, chance, off_px, typical, difference))


def still_fits(chance: float, off_px: float) -> bool:
    """Return whether a difference of `off_px` that has this chance with an unchanged camera is by chance or small."""
    return chance > _CHANCE or off_px < _MATTERS_PX


def _residuals_with(model: CameraModel, again: Calibration) -> FloatArray:
    """Return residuals (N, 2) of the corners kept, with the file's camera and poses fitted to it."""
    seen = again.lens.seen
    residual = project_corners(model, find_poses(model, seen, int(again.lens.views.sum())), seen) - seen.pixels
    return np.where(np.isfinite(residual), residual, float(model.width_px))


def _chance(model: CameraModel, estimate: CameraEstimate | None, again: Calibration) -> float:
    covariances = [(again.lens.covariance(), int(again.lens.views.sum()))]
    if estimate is not None and len(estimate.parameters) == len(covariances[0][0]):
        covariances.append((estimate.matrix(), estimate.n_views))
    return chance_of_difference(again.model, model, covariances)


def _typical_px(residual_px: FloatArray) -> float:
    return float(np.sqrt(np.median((residual_px**2).sum(axis=1)) / chdtri(2, 0.5)))


def _lines(
    fits: bool, chance: float, off_px: float, typical_px: tuple[float, float], difference: FloatArray
) -> list[str]:
    by_chance = f"chance {chance:.2g}" if chance >= 1e-6 else "chance below 1e-6"
    differ = f"predictions differ by {off_px:.3f} px (RMS over the picture) from the camera that these pictures show"
    lines = [f"{'fits' if fits else 'does not fit any more'}: {differ}; {by_chance} that it is the same"]
    length = np.linalg.norm(difference, axis=-1)
    if np.isfinite(length).any():
        row, column = np.unravel_index(int(np.nanargmax(length)), length.shape)
        place = place_in_picture(int(row), int(column), length.shape)
        lines.append(f"the most at the {place}: {np.nanmax(length):.2f} px")
    lines.append(
        f"residuals of corners are {typical_px[0]:.3f} px with the file, {typical_px[1]:.3f} px with a new fit"
    )
    if fits and chance <= _CHANCE:
        lines.append(f"the difference is significant but below {_MATTERS_PX:g} px, the error of tag corners")
    if not fits:
        lines.append("calibrate again; the lens, zoom or focus may have moved, or the picture may be cropped now")
    return lines
