"""Sheets of paper in a PDF: vector graphics true to scale, in mm from the upper left corner."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, Literal, NamedTuple

import numpy as np

from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray, atomic_write

try:
    from reportlab.lib.units import mm
    from reportlab.pdfbase.pdfmetrics import stringWidth
    from reportlab.pdfgen.canvas import Canvas
except ImportError as error:  # not installed on robots
    raise CalibError("printing needs reportlab, which is not installed; pip install 'groundsbot[laptop]'") from error

PAPERS_MM: Final = {"a4": (210.0, 297.0), "letter": (215.9, 279.4), "a3": (297.0, 420.0)}
HOW_TO_PRINT: Final = 'Print at 100 % (not "fit to page"). Hold a ruler against both rulers: 100 mm must be 100 mm.'

_EDGE_MM: Final = 5.0  # margin along the paper's edges that many printers cannot print
_RULER_MM: Final = 6.5  # width of a ruler with its numbers
_HEAD_MM: Final = 15.0  # height of a title and two lines of text
_APART_MM: Final = 3.0  # between the print and the rulers and text
_FONT: Final = "Helvetica"
_TITLE_PT: Final = 11.0
_TEXT_PT: Final = 8.0
_TEXT_MM: Final = 4.0  # distance between base lines
_LINE_MM: Final = 0.1
_TICKS_MM: Final = ((10, 3.0), (5, 2.2), (1, 1.4))  # (interval in mm, length of the tick)
_NUMBERS_PT: Final = 5.0
_CAPITAL_MM: Final = 0.72 * _NUMBERS_PT / mm  # height of Helvetica's digits

Align = Literal["left", "middle", "right"]
Line = tuple[float, float, float, float]  # x and y of one end and of the other, in mm


class Rectangle(NamedTuple):
    """A rectangle: upper left corner, width and height, in mm."""

    x_mm: float
    y_mm: float
    width_mm: float
    height_mm: float


class Sheets:
    """A PDF to which sheets are added one by one.

    Attributes:
        width_mm: width of the paper.
        height_mm: height of the paper.
    """

    def __init__(self, path: Path, size_mm: tuple[float, float], title: str) -> None:
        self.width_mm, self.height_mm = size_mm
        self._canvas = Canvas(
            str(path), pagesize=(self.width_mm * mm, self.height_mm * mm), pageCompression=1, invariant=1
        )
        self._canvas.setTitle(title)
        self._canvas.setCreator("groundsbot")
        # Asks viewers not to scale the sheets when they print them.
        self._canvas.setViewerPreference("PrintScaling", "None")

    def blacken(self, rectangles: Iterable[Rectangle]) -> None:
        """Fill rectangles as one path, so that no gap appears between adjacent ones."""
        path = self._canvas.beginPath()
        for x_mm, y_mm, width_mm, height_mm in rectangles:
            path.rect(x_mm * mm, self._up(y_mm + height_mm), width_mm * mm, height_mm * mm)
        self._canvas.drawPath(path, stroke=0, fill=1)

    def triangle(self, x_mm: float, y_mm: float, side_mm: float) -> None:
        """Draw a black triangle that points up, with its lower left corner at x and y."""
        path = self._canvas.beginPath()
        path.moveTo(x_mm * mm, self._up(y_mm))
        path.lineTo((x_mm + side_mm) * mm, self._up(y_mm))
        path.lineTo((x_mm + side_mm / 2) * mm, self._up(y_mm - side_mm))
        path.close()
        self._canvas.drawPath(path, stroke=0, fill=1)

    def lines(self, lines: Iterable[Line]) -> None:
        """Draw thin vertical or horizontal lines, as filled shapes: renderers snap strokes to whole dots."""
        half_mm = _LINE_MM / 2
        self.blacken(
            Rectangle(
                min(x1_mm, x2_mm) - half_mm,
                min(y1_mm, y2_mm) - half_mm,
                abs(x2_mm - x1_mm) + _LINE_MM,
                abs(y2_mm - y1_mm) + _LINE_MM,
            )
            for x1_mm, y1_mm, x2_mm, y2_mm in lines
        )

    def text(self, x_mm: float, y_mm: float, text: str, size_pt: float, align: Align = "left") -> None:
        """Write one line of text with its base line at y."""
        self._canvas.setFont(_FONT, size_pt)
        x_mm -= {"left": 0.0, "middle": 0.5, "right": 1.0}[align] * text_width_mm(text, size_pt)
        self._canvas.drawString(x_mm * mm, self._up(y_mm), text)

    def head(self, title: str, *lines: str) -> None:
        """Write a title and lines of text at the top of the sheet."""
        x_mm, y_mm = _EDGE_MM + _RULER_MM + _APART_MM, _EDGE_MM + 4.0
        self.text(x_mm, y_mm, title, _TITLE_PT)
        for index, line in enumerate(lines, start=1):
            self.text(x_mm, y_mm + index * _TEXT_MM, line, _TEXT_PT)

    def rulers(self) -> None:
        """Draw rulers from 0 along the left and the lower edge, as long as the paper allows."""
        across_mm = _whole_cm(self.width_mm - 2 * _EDGE_MM - _RULER_MM)
        down_mm = _whole_cm(self.height_mm - 2 * _EDGE_MM - _RULER_MM)
        x_mm, y_mm = _EDGE_MM + _RULER_MM, self.height_mm - _EDGE_MM - _RULER_MM
        self.lines(
            [
                (x_mm, y_mm, x_mm + across_mm, y_mm),
                (x_mm, y_mm, x_mm, y_mm - down_mm),
                *((x_mm + along, y_mm, x_mm + along, y_mm + long_mm) for along, long_mm in _ticks(across_mm)),
                *((x_mm, y_mm - along, x_mm - long_mm, y_mm - along) for along, long_mm in _ticks(down_mm)),
            ]
        )
        long_mm = _TICKS_MM[0][1] + 0.5
        for along in range(0, across_mm + 1, 10):
            self.text(x_mm + along, y_mm + long_mm + _CAPITAL_MM, str(along), _NUMBERS_PT, "middle")
        for along in range(0, down_mm + 1, 10):
            self.text(x_mm - long_mm, y_mm - along + _CAPITAL_MM / 2, str(along), _NUMBERS_PT, "right")

    def end_sheet(self) -> None:
        """Finish the sheet and begin the next one."""
        self._canvas.showPage()

    def save(self) -> None:
        """Write the file."""
        self._canvas.save()

    def _up(self, y_mm: float) -> float:
        return (self.height_mm - y_mm) * mm


@contextmanager
def write_sheets(path: Path, size_mm: tuple[float, float], title: str, overwrite: bool) -> Iterator[Sheets]:
    """Yield a PDF of sheets of one size, and write it atomically when the block ends.

    Raises:
        CalibError: `path` exists and `overwrite` is false, or it cannot be written.
    """
    if path.exists() and not overwrite:
        raise CalibError(f"{path}: exists already; name another file, or give --overwrite")
    try:
        with atomic_write(path) as temporary:
            sheets = Sheets(temporary, size_mm, title)
            yield sheets
            sheets.save()
    except OSError as error:
        raise CalibError(f"{path}: cannot be written ({error.strerror}); name a file that you may write") from error


def paper_size_mm(paper: str) -> tuple[float, float]:
    """Return width and height of a paper in portrait orientation.

    Raises:
        CalibError: the paper is unknown.
    """
    if paper.lower() not in PAPERS_MM:
        raise CalibError(f"--paper is {paper!r} but must be one of {', '.join(PAPERS_MM)}")
    return PAPERS_MM[paper.lower()]


def room_on(paper_mm: tuple[float, float]) -> Rectangle:
    """Return the area of a paper within text, rulers and margins."""
    width_mm, height_mm = paper_mm
    left_mm, top_mm = _EDGE_MM + _RULER_MM + _APART_MM, _EDGE_MM + _HEAD_MM
    return Rectangle(
        left_mm, top_mm, width_mm - left_mm - _EDGE_MM, height_mm - top_mm - _EDGE_MM - _RULER_MM - _APART_MM
    )


def black_cells(bits: BoolArray, x_mm: float, y_mm: float, cell_mm: float) -> Iterator[Rectangle]:
    """Yield the black cells of a pattern whose upper left corner is at x and y, with neighbours in a row merged."""
    for row, cells in enumerate(bits):
        edges = np.flatnonzero(np.diff(~cells, prepend=False, append=False))
        for first, end in edges.reshape(-1, 2):
            yield Rectangle(x_mm + first * cell_mm, y_mm + row * cell_mm, (end - first) * cell_mm, cell_mm)


def text_width_mm(text: str, size_pt: float) -> float:
    """Return the width of a line of text."""
    return float(stringWidth(text, _FONT, size_pt)) / mm


def _whole_cm(length_mm: float) -> int:
    return int(length_mm // 10) * 10


def _ticks(length_mm: int) -> Iterator[tuple[int, float]]:
    """Yield position and length of the ticks of a ruler, in mm."""
    for along_mm in range(length_mm + 1):
        yield along_mm, next(long_mm for every_mm, long_mm in _TICKS_MM if along_mm % every_mm == 0)
