"""Calibration of a camera from pictures of a board, with checks of the input and of the result, and hints in words."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.board import Board, BoardFinder, BoardView, Coverage, GreyPicture, describe_board, why_no_board
from groundsbot.calib.camera import CameraEstimate, parameter_names
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import FloatArray, plural
from groundsbot.calib.intrinsics.bundle import inverse
from groundsbot.calib.intrinsics.model_choice import KINDS, Calibration, calibrate_camera, first_fit
from groundsbot.calib.intrinsics.projection_uncertainty import PictureGrid, expected_error_px, projection_covariance
from groundsbot.calib.intrinsics.view_choice import distinct, most_telling

_LEAST_VIEWS: Final = 5
_ANOTHER_VIEW_SHARE: Final = 0.02  # mean shift of corners over the picture's width
_MOST_OUTLYING: Final = 1.0 / 3.0
_LARGEST_SIGMA_PX: Final = 0.5  # corners have errors of hundredths; the worst of OpenCV's are off by a third
_LARGEST_FOCAL_SIGMA: Final = 0.01  # relative; the field of view in a data sheet is as accurate
_LARGEST_ERROR_PX: Final = 3.0
_KEPT_WITHOUT_BOARD: Final = 20
_POOR_ERROR_PX: Final = 0.1
_UNEQUAL_FOCALS: Final = 0.01
_FULL_RULER_MM: Final = 100.0
_RULER_TOLERANCE: Final = 0.01  # reading a ruler is accurate to half a millimetre at each end of 100 mm


@dataclass(frozen=True)
class Search:
    """Result of the search for the calibration board in pictures.

    Attributes:
        views: detected corners of the board, one entry for each picture that shows it.
        without: names of the pictures in which the board was not found.
        some_without: the first pictures of `without`, at most 20, to find out what they show instead.
    """

    views: list[BoardView]
    without: list[str]
    some_without: list[GreyPicture]


def search(pictures: Iterable[tuple[str, GreyPicture]], finder: BoardFinder) -> Search:
    """Search the board in every picture."""
    found = Search([], [], [])
    for name, picture in pictures:
        view = finder.find(picture, name)
        if view is not None:
            found.views.append(view)
            continue
        found.without.append(name)
        if len(found.some_without) < _KEPT_WITHOUT_BOARD:
            found.some_without.append(picture)
    return found


def require_board(found: Search, finder: BoardFinder) -> str:
    """Refuse pictures of which too few show the board, and return how many show it, in words.

    Raises:
        CalibError: fewer than five pictures show the board. If none does, the message says what they show instead.
    """
    n_views, pictures = len(found.views), plural(len(found.views) + len(found.without), "picture")
    name = f"board {finder.board.specification}"
    if not n_views:
        why = why_no_board(found.some_without, finder.board, finder)
        raise CalibError(f"{name} is not seen clearly in any of {pictures}, {why}")
    if n_views < _LEAST_VIEWS:
        raise CalibError(
            f"{name} is seen in {n_views} of {pictures} only but at least {_LEAST_VIEWS} are needed, 20 to 40 are "
            "good; take more, all over the picture and tilted every way"
        )
    return f"{name} is seen in {n_views} of {pictures}"


def check_ruler(measured_mm: Sequence[float]) -> None:
    """Refuse a print that is not true to scale.

    Args:
        measured_mm: measured lengths of the printed 100 mm, across and down; the second may be missing.

    Raises:
        CalibError: a length is out of range, the print is stretched, or its scale is off by more than 1 %.
    """
    for each in measured_mm:
        if not 10.0 <= each <= 1000.0:
            raise CalibError(
                f"--ruler-mm is {each:g} but must be 10 to 1000, the measured length of the printed 100 mm; give mm"
            )
    off = [each / _FULL_RULER_MM - 1.0 for each in measured_mm]
    if len(off) == 2 and abs(off[0] - off[1]) > _RULER_TOLERANCE:
        raise CalibError(
            f"--ruler-mm: the print is {100 * off[0]:+.1f} % across and {100 * off[1]:+.1f} % down, and a "
            "stretched print gives a wrong camera; print it again at 100 % of its size"
        )
    worst = max(off, key=abs, default=0.0)
    if abs(worst) > _RULER_TOLERANCE:
        raise CalibError(
            f"--ruler-mm: the print is {100 * worst:+.1f} % of its size off, so tags printed that way would be too; "
            'print it again at 100 %, not "fit to page"'
        )


def calibrate_from(found: Search, finder: BoardFinder, name: str, model: str, most: int) -> Calibration:
    """Calibrate the camera from the views found.

    Args:
        found: the views, at least five.
        finder: the finder of the board.
        name: name of the camera.
        model: one of `KINDS`, or `auto`.
        most: most views to use; of more, the most informative ones.

    Raises:
        CalibError: the views are all alike, or they do not determine a camera.
    """
    kinds = _kinds(model)
    refuse_alike(found.views)
    views = found.views
    if len(views) > most:
        lens = first_fit(views, finder, name, kinds)
        kept = np.nonzero(lens.views)[0][most_telling(lens.fit.by_view, most)]
        views = [views[index] for index in kept]
    result = calibrate_camera(views, finder, name, kinds)
    refuse_unclear(result)
    return result


def estimate_of(result: Calibration) -> CameraEstimate:
    """Return the uncertainty of a calibration, for the camera file."""
    covariance = result.lens.covariance()
    return CameraEstimate(
        n_views=int(result.lens.views.sum()),
        n_corners=int(result.lens.corners.sum()),
        corner_sigma_px=result.corner_sigma_px,
        expected_error_px=_expected_rms_px(result),
        parameters=list(parameter_names(result.model.distortion_model)),
        sigmas=[float(value) for value in np.sqrt(np.diag(covariance))],
        covariance=[float(value) for value in covariance.ravel()],
    )


def error_map(result: Calibration) -> tuple[PictureGrid, FloatArray]:
    """Return a grid over the picture, and the RMS prediction error expected there, in pixels."""
    grid = PictureGrid.of(result.model)
    return grid, expected_error_px(projection_covariance(result.model, result.lens.covariance(), grid))


def unused_view_lines(result: Calibration) -> list[str]:
    """Return a line for each view that was not used."""
    lines = []
    for index, view in enumerate(result.views):
        if result.blurred[index]:
            lines.append(f"{view.name}: left out, too blurred")
        elif not result.lens.views[index]:
            misfit = float(np.sqrt(result.lens.view_misfit[index]))
            lines.append(f"{view.name}: left out, its residuals are {misfit:.1f} times those of other views")
    return lines


def verdict(result: Calibration, board: Board) -> list[str]:
    """Return sentences on the quality of a calibration and on the views still missing."""
    model, estimate = result.model, estimate_of(result)
    off = f"the expected prediction error is {estimate.expected_error_px:.3f} px (RMS over the picture)"
    lines = [f"{model.distortion_model}: {off}; corners were found to {estimate.corner_sigma_px:.3f} px"]
    _, expected = error_map(result)
    enough = bool(np.nanmax(expected) < _POOR_ERROR_PX)
    if enough:
        lines.append(f"that is good: below {_POOR_ERROR_PX:g} px everywhere, and corners of tags err by 0.04 to 0.1 px")
    if np.nanmax(expected) > max(_POOR_ERROR_PX, 3.0 * float(np.nanmedian(expected))):
        row, column = np.unravel_index(int(np.nanargmax(expected)), expected.shape)
        place = place_in_picture(int(row), int(column), expected.shape)
        lines.append(f"at the {place} it is {np.nanmax(expected):.2f} px: show the board there")
    size_px = model.width_px, model.height_px
    used = (view for view, kept in zip(result.views, result.lens.views, strict=True) if kept)
    boards = (describe_board(view.corners.ids, view.corners.pixels, board, size_px) for view in used)
    missing = Coverage(each for each in boards if each is not None).missing()
    lines += [f"to improve it further, {each}" for each in missing] if enough else missing
    sigma = np.hypot(estimate.sigmas[0] / model.fx_px, estimate.sigmas[1] / model.fy_px)
    unequal = model.fx_px / model.fy_px - 1.0
    if abs(unequal) > max(_UNEQUAL_FOCALS, 4.0 * sigma):
        lines.append(
            f"fx and fy differ by {100 * unequal:+.1f} %, which is rare: measure the print's rulers, across and down"
        )
    return lines


def _kinds(model: str) -> Sequence[str]:
    if model == "auto":
        return KINDS
    if model not in KINDS:
        raise CalibError(f"--model is {model!r} but must be auto or one of {', '.join(KINDS)}; choose one of these")
    return (model,)


def refuse_alike(views: Sequence[BoardView]) -> None:
    """Refuse views that are all alike.

    Raises:
        CalibError: fewer than five views differ.
    """
    another_px = _ANOTHER_VIEW_SHARE * views[0].picture.shape[1]
    different = distinct([(view.corners.ids, view.corners.pixels) for view in views], another_px)
    if different < _LEAST_VIEWS:
        raise CalibError(
            f"only {different} of {len(views)} views differ by more than {another_px:.0f} px, at least {_LEAST_VIEWS} "
            "must; move the board between pictures and tilt it every way"
        )


def refuse_unclear(result: Calibration) -> None:
    """Refuse a calibration that the views do not determine.

    Raises:
        CalibError: the corners do not fit, too many views contradict the others, or errors may be too large.
    """
    lens, model = result.lens, result.model
    if lens.fit.sigma_px > _LARGEST_SIGMA_PX:
        raise CalibError(
            f"no camera fits the corners better than to {lens.fit.sigma_px:.1f} px, limit {_LARGEST_SIGMA_PX:g} px; "
            "check that all pictures are of one camera with one focus and zoom, and that the board is flat and the one "
            "of --board"
        )
    outlying = int((~lens.views & ~result.blurred).sum())
    if outlying > _MOST_OUTLYING * len(lens.views):
        raise CalibError(
            f"{outlying} of {len(lens.views)} views contradict the others, limit a third; check that all pictures "
            "are of one camera with one focus and zoom, and that the board is the same and flat"
        )
    if lens.views.sum() < _LEAST_VIEWS:
        raise CalibError(
            f"only {plural(int(lens.views.sum()), 'view')} of {len(lens.views)} are sharp and agree, at least "
            f"{_LEAST_VIEWS} are needed; take more, holding board and camera still"
        )
    # Few similar views differ by little from each other; the noise of corners bounds what they leave open.
    sigma = float(np.sqrt(max(lens.covariance()[0, 0], inverse(lens.fit.information)[0, 0]))) / model.fx_px
    if sigma > _LARGEST_FOCAL_SIGMA:
        raise CalibError(
            f"the focal length is determined to {100 * sigma:.1f} % only, limit {100 * _LARGEST_FOCAL_SIGMA:g} %; "
            "tilt the board by 30 degrees and more, to every side, as only tilted boards determine it"
        )
    expected_px = _expected_rms_px(result)
    if expected_px > _LARGEST_ERROR_PX:
        raise CalibError(
            f"the expected prediction error is {expected_px:.1f} px, limit {_LARGEST_ERROR_PX:g} px; show the board "
            "all over the picture, near and tilted every way"
        )


def _expected_rms_px(result: Calibration) -> float:
    return float(np.sqrt(np.nanmean(error_map(result)[1] ** 2)))


def place_in_picture(row: int, column: int, shape: tuple[int, ...]) -> str:
    """Return the position in the picture of a cell of a grid, in words."""
    down, across = ("top", "", "bottom")[3 * row // shape[0]], ("left", "", "right")[3 * column // shape[1]]
    return " ".join(filter(None, (down, across))) or "middle"
