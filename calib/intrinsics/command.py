"""`groundsbot-calib camera` and `check`: files in, files and lines out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from groundsbot.calib.board import DEFAULT_BOARD, BoardFinder, grey_pictures, parse_board
from groundsbot.calib.camera import read_camera_yaml, read_estimate, write_camera_yaml
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import atomic_write, plural
from groundsbot.calib.intrinsics.calibration import (
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
    """Writes `output` and the page beside it, both or none; returns what to say.

    Raises:
        CalibError: one line why not.
    """
    page = output.with_suffix(".html")
    _refuse_output(output, page, overwrite)
    check_ruler(_ruler(ruler_mm))
    printed = DEFAULT_BOARD if board is None else parse_board(board)
    finder = BoardFinder(printed)
    found = search(grey_pictures(pictures), finder)
    require_board(found, printed, finder)
    result = calibrate_from(found, finder, name, model, most_views)
    sentences = verdict(result, printed)
    try:
        with atomic_write(page) as partial:
            partial.write_text(report_html(result, sentences), encoding="utf-8")
            write_camera_yaml(result.model, output, estimate_of(result))
    except OSError as error:
        raise CalibError(f"{output}: cannot be written ({error.strerror}); name a file that you may write") from error
    used = f"{int(result.lens.views.sum())} of {plural(len(found.views), 'view')} used"
    return [*_without_board(found.without), *unused_view_lines(result), *sentences, f"{output}: {used}; look at {page}"]


def check_camera(camera: Path, pictures: Sequence[Path], board: str | None) -> Check:
    """Compares a camera file with pictures.

    Raises:
        CalibError: one line why not.
    """
    model, estimate = read_camera_yaml(camera), read_estimate(camera)
    printed = DEFAULT_BOARD if board is None else parse_board(board)
    finder = BoardFinder(printed)
    found = search(grey_pictures(pictures), finder)
    require_board(found, printed, finder)
    return compare(model, estimate, found.views, finder)


def _without_board(names: Sequence[str]) -> list[str]:
    lines = [f"{name}: left out, the board is not seen clearly" for name in names[:_MOST_NAMED]]
    more = len(names) - len(lines)
    return [*lines, f"and {more} more without the board"] if more else lines


def _refuse_output(output: Path, page: Path, overwrite: bool) -> None:
    if not output.parent.is_dir():
        raise CalibError(f"{output}: its folder is not there; make it, or name another")
    if output == page:
        raise CalibError(f"{output}: ends as the page beside it does; name it .yaml")
    for each in (output, page):
        if each.is_dir():
            raise CalibError(f"{each}: is a folder; name a file")
        if each.exists() and not overwrite:
            raise CalibError(f"{each}: is there already; name another, or give --overwrite")


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
