"""Pictures of a board in, a camera and a verdict in words out; or one line why there is none."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.board import Board, BoardFinder, BoardView, Coverage, GreyPicture, describe_board, why_no_board
from groundsbot.calib.camera import CameraEstimate, parameter_names
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import FloatArray, plural
from groundsbot.calib.intrinsics.model_choice import KINDS, Calibration, calibrate_camera, first_fit
from groundsbot.calib.intrinsics.projection_uncertainty import PictureGrid, expected_error_px, projection_covariance
from groundsbot.calib.intrinsics.view_choice import distinct, most_telling

_LEAST_VIEWS: Final = 5
_ANOTHER_VIEW_SHARE: Final = 0.02  # of the picture's width that a corner shifts by
_MOST_OUTLYING: Final = 1.0 / 3.0
_LARGEST_EXTRA_PX: Final = 0.5  # a corner errs by hundredths; OpenCV finds the coarsest to a third
_LARGEST_FOCAL_SIGMA: Final = 0.01  # relative; the field of view in a data sheet is as good
_LARGEST_ERROR_PX: Final = 3.0
_KEPT_WITHOUT_BOARD: Final = 20
_POOR_ERROR_PX: Final = 0.1
_UNEQUAL_FOCALS: Final = 0.01
_FULL_RULER_MM: Final = 100.0
_RULER_TOLERANCE: Final = 0.01  # half a millimetre at each end of 100 mm is what an eye reads


@dataclass(frozen=True)
class Search:
    """What the pictures show.

    Attributes:
        views: those with the board.
        without: names of those without.
        some_without: a few of these pictures.
    """

    views: list[BoardView]
    without: list[str]
    some_without: list[GreyPicture]


def search(pictures: Iterable[tuple[str, GreyPicture]], finder: BoardFinder) -> Search:
    """Looks for the board in every picture."""
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


def require_board(found: Search, board: Board, finder: BoardFinder) -> None:
    """Refuses pictures without the board.

    Raises:
        CalibError: with what is there instead.
    """
    if not found.views:
        why = why_no_board(found.some_without, board, finder)
        pictures = plural(len(found.without), "picture")
        raise CalibError(f"board {board.specification} is not seen clearly in any of {pictures}, {why}")


def check_ruler(measured_mm: Sequence[float]) -> None:
    """Refuses a print whose rulers, across and down, are not what is written beside them.

    Raises:
        CalibError: by how much it is off, and what follows.
    """
    for each in measured_mm:
        if not 10.0 <= each <= 1000.0:
            raise CalibError(
                f"--ruler-mm is {each:g} but must be what a ruler shows beside the print's 100 mm; give mm"
            )
    off = [each / _FULL_RULER_MM - 1.0 for each in measured_mm]
    if len(off) == 2 and abs(off[0] - off[1]) > _RULER_TOLERANCE:
        raise CalibError(
            f"--ruler-mm: the print is {100 * off[0]:+.1f} % across and {100 * off[1]:+.1f} % down, stretched, which "
            "would make a wrong camera; print it again at 100 % of its size"
        )
    worst = max(off, key=abs, default=0.0)
    if abs(worst) > _RULER_TOLERANCE:
        raise CalibError(
            f"--ruler-mm: the print is {100 * worst:+.1f} % of its size off, so tags printed that way would be too; "
            'print it again at 100 %, not "fit to page"'
        )


def calibrate_from(found: Search, finder: BoardFinder, name: str, model: str, most: int) -> Calibration:
    """The camera, or why there is none.

    Args:
        found: at least one view.
        finder: of the board.
        name: of the camera.
        model: one of `KINDS`, or `auto`.
        most: views to use; of more, the most telling ones.

    Raises:
        CalibError: too few views, views all alike, or views that do not tell a camera.
    """
    kinds = _kinds(model)
    refuse_few(found.views)
    views = found.views
    if len(views) > most:
        lens = first_fit(views, finder, name, kinds)
        kept = np.nonzero(lens.views)[0][most_telling(lens.fit.by_view, most)]
        views = [views[index] for index in kept]
    result = calibrate_camera(views, finder, name, kinds)
    _refuse_unclear(result)
    return result


def estimate_of(result: Calibration) -> CameraEstimate:
    """What the calibration says of its own errors, for the camera's file."""
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
    """Places, and how many pixels a prediction may be off there (root mean square)."""
    grid = PictureGrid.of(result.model)
    return grid, expected_error_px(projection_covariance(result.model, result.lens.covariance(), grid))


def unused_view_lines(result: Calibration) -> list[str]:
    """A line for each view that was not used."""
    lines = []
    for index, view in enumerate(result.views):
        if result.blurred[index]:
            lines.append(f"{view.name}: left out, too blurred")
        elif not result.lens.views[index]:
            misfit = float(np.sqrt(result.lens.view_misfit[index]))
            lines.append(f"{view.name}: left out, its corners lie {misfit:.1f} times as far off as others'")
    return lines


def verdict(result: Calibration, board: Board) -> list[str]:
    """What is good and what is missing, in sentences."""
    model, estimate = result.model, estimate_of(result)
    off = f"predictions are {estimate.expected_error_px:.3f} px off (RMS over the picture)"
    lines = [f"{model.distortion_model}: {off}; corners were found to {estimate.corner_sigma_px:.3f} px"]
    _, expected = error_map(result)
    enough = bool(np.nanmax(expected) < _POOR_ERROR_PX)
    if enough:
        lines.append(f"that is good: nowhere {_POOR_ERROR_PX:g} px, and corners of tags err by 0.04 to 0.1 px")
    if np.nanmax(expected) > max(_POOR_ERROR_PX, 3.0 * float(np.nanmedian(expected))):
        row, column = np.unravel_index(int(np.nanargmax(expected)), expected.shape)
        place = place_in_picture(int(row), int(column), expected.shape)
        lines.append(f"at the {place} they are {np.nanmax(expected):.2f} px off: show the board there")
    size_px = model.width_px, model.height_px
    used = (view for view, kept in zip(result.views, result.lens.views, strict=True) if kept)
    boards = (describe_board(view.corners.ids, view.corners.pixels, board, size_px) for view in used)
    missing = Coverage(each for each in boards if each is not None).missing()
    lines += [f"to make it surer still, {each}" for each in missing] if enough else missing
    sigma = np.hypot(estimate.sigmas[0] / model.fx_px, estimate.sigmas[1] / model.fy_px)
    unequal = model.fx_px / model.fy_px - 1.0
    if abs(unequal) > max(_UNEQUAL_FOCALS, 4.0 * sigma):
        lines.append(
            f"fx and fy differ by {100 * unequal:+.1f} %, which few lenses do: measure the print's rulers, across and "
            "down"
        )
    return lines


def _kinds(model: str) -> Sequence[str]:
    if model == "auto":
        return KINDS
    if model not in KINDS:
        raise CalibError(f"--model is {model!r} but must be auto or one of {', '.join(KINDS)}; choose one of these")
    return (model,)


def refuse_few(views: Sequence[BoardView]) -> None:
    """Refuses too few views, and views that are all alike.

    Raises:
        CalibError: with how many are needed.
    """
    if len(views) < _LEAST_VIEWS:
        raise CalibError(
            f"the board is seen in {plural(len(views), 'picture')} only but at least {_LEAST_VIEWS} are needed, 20 to "
            "40 are good; take more, all over the picture and tilted every way"
        )
    another_px = _ANOTHER_VIEW_SHARE * views[0].picture.shape[1]
    different = distinct([(view.corners.ids, view.corners.pixels) for view in views], another_px)
    if different < _LEAST_VIEWS:
        raise CalibError(
            f"only {different} of {len(views)} views differ by more than {another_px:.0f} px, at least {_LEAST_VIEWS} "
            "must; move the board between pictures and tilt it every way"
        )


def _refuse_unclear(result: Calibration) -> None:
    lens, model = result.lens, result.model
    if lens.extra_sigma_px > _LARGEST_EXTRA_PX:
        raise CalibError(
            f"corners lie {lens.extra_sigma_px:.1f} px off whatever the camera, limit {_LARGEST_EXTRA_PX:g} px; are "
            "all pictures of one camera with one focus and zoom, and is the board flat and the one that --board names?"
        )
    outlying = int((~lens.views & ~result.blurred).sum())
    if outlying > _MOST_OUTLYING * len(lens.views):
        raise CalibError(
            f"{outlying} of {len(lens.views)} views contradict the others, limit a third; are all pictures of one "
            "camera with one focus and zoom, and is the board the same and flat?"
        )
    if lens.views.sum() < _LEAST_VIEWS:
        raise CalibError(
            f"only {plural(int(lens.views.sum()), 'view')} of {len(lens.views)} are sharp and agree, at least "
            f"{_LEAST_VIEWS} are needed; take more, holding board and camera still"
        )
    sigma = float(np.sqrt(lens.covariance()[0, 0])) / model.fx_px
    if sigma > _LARGEST_FOCAL_SIGMA:
        raise CalibError(
            f"the focal length comes out to {100 * sigma:.1f} % only, limit {100 * _LARGEST_FOCAL_SIGMA:g} %: it shows "
            "in tilted boards alone; tilt the board by 30 degrees and more, to every side"
        )
    expected_px = _expected_rms_px(result)
    if expected_px > _LARGEST_ERROR_PX:
        raise CalibError(
            f"predictions would be {expected_px:.1f} px off, limit {_LARGEST_ERROR_PX:g} px; show the board all over "
            "the picture, near and tilted every way"
        )


def _expected_rms_px(result: Calibration) -> float:
    return float(np.sqrt(np.nanmean(error_map(result)[1] ** 2)))


def place_in_picture(row: int, column: int, shape: tuple[int, ...]) -> str:
    """In words where a cell of a grid lies."""
    down, across = ("top", "", "bottom")[3 * row // shape[0]], ("left", "", "right")[3 * column // shape[1]]
    return " ".join(filter(None, (down, across))) or "middle"
