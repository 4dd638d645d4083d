"""Does a calibration still fit the camera that took these pictures?

The camera is fitted anew to the pictures, and the two are compared: by statistics, whether chance explains the
difference, and in pixels, whether it matters. A file that says what its own errors are (`groundsbot_estimate`) is held
to the sum of both covariances; any other is taken at its word, by an F test of poses alone against poses and camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.stats import chi2, f

from groundsbot.calib.board import BoardFinder, BoardView
from groundsbot.calib.camera import CameraEstimate, CameraModel, parameters_of
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.intrinsics.bundle import adjust_bundle
from groundsbot.calib.intrinsics.calibration import place_in_picture, refuse_few
from groundsbot.calib.intrinsics.model_choice import Calibration, calibrate_camera
from groundsbot.calib.intrinsics.projection_uncertainty import PictureGrid, difference_px, rms_px

_CHANCE: Final = 0.001
# A camera that is off by less is as good as corners of tags, of which the best detector's err by 0.04 to 0.1 px.
_MATTERS_PX: Final = 0.1


@dataclass(frozen=True)
class Check:
    """What came of it.

    Attributes:
        fits: the camera may go on being used.
        chance: how likely pictures of an unchanged camera differ as much.
        difference_px: root mean square over the picture of where the two put far points.
        residual_px: typical residual of a corner's coordinate with the file's camera, and with the one fitted anew.
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
    """Compares a camera with pictures.

    Raises:
        CalibError: pictures of another size, or too few to tell.
    """
    height_px, width_px = views[0].picture.shape
    if (width_px, height_px) != (model.width_px, model.height_px):
        raise CalibError(
            f"{views[0].name}: has {width_px}x{height_px} pixels but the camera file is for "
            f"{model.width_px}x{model.height_px}; take pictures of the size that was calibrated, or calibrate again"
        )
    refuse_few(views)
    again = calibrate_camera(views, finder, model.name, [model.distortion_model])
    with np.errstate(over="ignore", invalid="ignore"):  # a camera that no lens has puts points nowhere
        with_file = _residuals_with(model, again)
        chance = _chance(model, estimate, again, with_file)
        difference = difference_px(model, PictureGrid.of(again.model))
        off_px = rms_px(difference) if np.isfinite(difference).any() else np.inf
        typical = _typical_px(with_file), _typical_px(again.lens.fit.residual_px)
    fits = chance > _CHANCE or off_px < _MATTERS_PX
    return Check(fits, chance, off_px, typical, _lines(fits, chance, off_px, typical, difference))


def _residuals_with(model: CameraModel, again: Calibration) -> FloatArray:
    """(N, 2) of the corners kept, with the file's camera and the poses that suit it best."""
    lens = again.lens
    seen, poses = lens.seen, lens.fit.poses
    imaged = np.asarray(np.isfinite(model.project(poses.points(seen.view, seen.points_m)[0])).all(axis=1))
    whitening = np.where(imaged[:, None, None], seen.whitening(lens.extra_sigma_px), 0.0)
    fit = adjust_bundle(model, poses, seen, whitening, hold_intrinsics=True)
    return np.where(imaged[:, None], fit.residual_px, float(model.width_px))


def _chance(model: CameraModel, estimate: CameraEstimate | None, again: Calibration, with_file: FloatArray) -> float:
    lens = again.lens
    n = len(lens.fit.information)
    if estimate is not None and len(estimate.parameters) == n:
        off = parameters_of(again.model) - parameters_of(model)
        distance = float(off @ np.linalg.lstsq(lens.covariance() + estimate.matrix(), off, rcond=None)[0])
        return float(chi2.sf(distance, n))
    whitened = np.einsum("nij,nj->ni", lens.seen.whitening(lens.extra_sigma_px), with_file)
    excess = max(float((whitened**2).sum()) - lens.fit.cost, 0.0) / n
    return float(f.sf(excess / lens.variance, n, lens.freedom))


def _typical_px(residual_px: FloatArray) -> float:
    return float(np.sqrt(np.median((residual_px**2).sum(axis=1)) / chi2.median(2)))


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
    lines.append(f"corners lie {typical_px[0]:.3f} px off with the file, {typical_px[1]:.3f} px with a fresh fit")
    if fits and chance <= _CHANCE:
        lines.append(f"the difference is real, and less than {_MATTERS_PX:g} px: corners of tags err by as much")
    if not fits:
        lines.append("calibrate again; was the lens turned, the zoom or focus moved, or the picture cropped?")
    return lines
