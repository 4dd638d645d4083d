"""The commands `groundsbot-calib camera` and `check`: from files to files and lines of text."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from groundsbot.calib.board import DEFAULT_BOARD, BoardFinder, grey_pictures, parse_board
from groundsbot.calib.camera import read_camera_yaml, read_estimate, write_camera_yaml
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import atomic_write, plural
from groundsbot.calib.intrinsics.calibration import (
    Search,
    calibrate_from,
    check_ruler,
    estimate_of,
    require_board,
    search,
    unused_view_lines,
    verdict,
)
from groundsbot.calib.intrinsics.check import Check, compare
from groundsbot.calib.intrinsics.report import report_html

_MOST_NAMED: Final = 20  # a video may have hundreds


def calibrate_camera(
    pictures: Sequence[Path], output: Path, board: str | None, model: str, ruler_mm: str | None, name: str,
    most_views: int, overwrite: bool,
) -> list[str]:  # fmt: skip
    """Calibrate a camera, write its file and the report beside it (both or none), and return lines for the user.

    Args:
        pictures: files, folders of pictures, or videos.
        output: the camera file to write; the report has the ending .html.
        board: specification of the board, as printed on it; None for the default board.
        model: distortion model, or `auto`.
        ruler_mm: measured lengths of the printed 100 mm, as text; None if not measured.
        name: name of the camera in the file.
        most_views: most views to use.
        overwrite: replace existing files.

    Raises:
        CalibError: the input or the calibration is refused, or a file cannot be written.
    """
    page = output.with_suffix(".html")
    _refuse_output(output, page, overwrite)
    check_ruler(_ruler(ruler_mm))
    finder, found, seen = _find_board(pictures, board)
    result = calibrate_from(found, finder, name, model, most_views)
    sentences = verdict(result, finder.board)
    try:
        with atomic_write(page) as partial:
            partial.write_text(report_html(result, sentences), encoding="utf-8")
            write_camera_yaml(result.model, output, estimate_of(result))
    except OSError as error:
        raise CalibError(f"{output}: cannot be written ({error.strerror}); name a file that you may write") from error
    used = f"{seen}, {plural(int(result.lens.views.sum()), 'view')} used"
    return [*_without_board(found.without), *unused_view_lines(result), *sentences, f"{output}: {used}; look at {page}"]


def check_camera(camera: Path, pictures: Sequence[Path], board: str | None) -> Check:
    """Compare a camera file with pictures of a board.

    Raises:
        CalibError: the camera file or the pictures are refused.
    """
    model, estimate = read_camera_yaml(camera), read_estimate(camera)
    finder, found, seen = _find_board(pictures, board)
    result = compare(model, estimate, found.views, finder)
    return replace(result, lines=[*result.lines, seen])


def _find_board(pictures: Sequence[Path], board: str | None) -> tuple[BoardFinder, Search, str]:
    """Return the finder of the board of a word, its views in the pictures, and in words how many there are."""
    finder = BoardFinder(DEFAULT_BOARD if board is None else parse_board(board))
    found = search(grey_pictures(pictures), finder)
    return finder, found, require_board(found, finder)


def _without_board(names: Sequence[str]) -> list[str]:
    lines = [f"{name}: left out, the board is not seen clearly" for name in names[:_MOST_NAMED]]
    more = len(names) - len(lines)
    return [*lines, f"and {more} more without the board"] if more else lines


def _refuse_output(output: Path, page: Path, overwrite: bool) -> None:
    if not output.parent.is_dir():
        raise CalibError(f"{output}: its folder does not exist; make it, or name another")
    if output == page:
        raise CalibError(f"{output}: has the name of the report beside it; name it .yaml")
    for each in (output, page):
        if each.is_dir():
            raise CalibError(f"{each}: is a folder; name a file")
        if each.exists() and not overwrite:
            raise CalibError(f"{each}: exists already; name another, or give --overwrite")


def _ruler(text: str | None) -> list[float]:
    if text is None:
        return []
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise CalibError(f"--ruler-mm is {text!r} but must be one length in mm or two, as 100,99.5") from error
    if len(values) > 2:
        raise CalibError(f"--ruler-mm has {len(values)} lengths but the print has two rulers: across, and down")
    return values
