"""Sheets of tags to print and cut out."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.calib.errors import CalibError
from groundsbot.calib.printing.sheet import (
    HOW_TO_PRINT,
    Sheets,
    black_cells,
    paper_size_mm,
    room_on,
    text_width_mm,
    write_sheets,
)
from groundsbot.calib.tags import tag_bits

_SMALLEST_MM: Final = 20.0  # the label of a smaller tag is illegible
_BETWEEN_MM: Final = 6.0  # between two tags, for the cutting marks of both
_MARK_MM: Final = 2.0
_MARK_AWAY_MM: Final = 0.5  # gap to the corner, so that no mark remains on the cut tag
_LABEL_MM: Final = 6.0  # height of the strip with the label below a tag
_LABEL_PT: Final = 10.0  # smaller on narrow tags
_UP_MM: Final = 2.4  # side of the triangle that points up


class _Piece(NamedTuple):
    """The piece to cut out: a tag, its white margin, and the strip with its label below."""

    family: str
    size_mm: float

    @property
    def cell_mm(self) -> float:
        """Side of a cell of the tag."""
        return self.size_mm / len(tag_bits(self.family, 0))

    @property
    def width_mm(self) -> float:
        """Width with the white margin of one cell that the family needs around its black border."""
        return self.size_mm + 2.0 * self.cell_mm

    @property
    def height_mm(self) -> float:
        """Height including the strip."""
        return self.width_mm + _LABEL_MM


def print_tags(
    family: str,
    ids: Sequence[int],
    size_mm: float,
    paper: str,
    path: Path,
    packed: bool = False,
    overwrite: bool = False,
) -> int:
    """Write a PDF with tags true to scale, cutting marks, and a ruler along two edges of each sheet.

    Args:
        family: family of the tags.
        ids: ids of the tags.
        size_mm: side of the black border's outer edge.
        paper: a4, letter or a3.
        path: the PDF.
        packed: put as many tags on a sheet as fit, instead of one.
        overwrite: replace `path` if it exists.

    Returns:
        The number of sheets.

    Raises:
        CalibError: the tags do not fit on the paper or are smaller than 20 mm, the family, an id or the paper is
            unknown, or the file cannot be written.
    """
    upright_mm = paper_size_mm(paper)
    piece = _Piece(family, size_mm)
    _check_size(piece, paper)
    paper_mm = max((upright_mm, upright_mm[::-1]), key=lambda each: _fitting(piece, each)) if packed else upright_mm
    places = _places(piece, paper_mm, _grid(piece, paper_mm) if packed else (1, 1))
    batches = [ids[first : first + len(places)] for first in range(0, len(ids), len(places))]
    with write_sheets(path, paper_mm, f"groundsbot tags {family} {size_mm:g} mm", overwrite) as sheets:
        for index, batch in enumerate(batches, start=1):
            sheets.rulers()
            _write_head(sheets, piece, f"sheet {index} of {len(batches)}")
            for tag_id, (x_mm, y_mm) in zip(batch, places, strict=False):
                _draw(sheets, piece, tag_id, x_mm, y_mm)
            sheets.end_sheet()
    return len(batches)


def _check_size(piece: _Piece, paper: str) -> None:
    if not piece.size_mm >= _SMALLEST_MM:
        raise CalibError(f"--size-mm is {piece.size_mm:g} but must be at least {_SMALLEST_MM:g}; print larger tags")
    room = room_on(paper_size_mm(paper))
    if piece.width_mm > room.width_mm or piece.height_mm > room.height_mm:
        cells = len(tag_bits(piece.family, 0))
        share = cells / (cells + 2.0)
        largest_mm = int(share * min(room.width_mm, room.height_mm - _LABEL_MM))
        raise CalibError(
            f"--size-mm is {piece.size_mm:g} but at most {largest_mm} fits on {paper} with the white margin of "
            f"{piece.family} and beside the rulers; print smaller tags or take larger paper"
        )


def _grid(piece: _Piece, paper_mm: tuple[float, float]) -> tuple[int, int]:
    """Return how many pieces fit across and down."""
    room = room_on(paper_mm)
    return (
        int((room.width_mm + _BETWEEN_MM) // (piece.width_mm + _BETWEEN_MM)),
        int((room.height_mm + _BETWEEN_MM) // (piece.height_mm + _BETWEEN_MM)),
    )


def _fitting(piece: _Piece, paper_mm: tuple[float, float]) -> int:
    across, down = _grid(piece, paper_mm)
    return across * down


def _places(piece: _Piece, paper_mm: tuple[float, float], grid: tuple[int, int]) -> list[tuple[float, float]]:
    """Return the upper left corners of the pieces in reading order, centred on the sheet."""
    room = room_on(paper_mm)
    across, down = grid
    step_x_mm, step_y_mm = piece.width_mm + _BETWEEN_MM, piece.height_mm + _BETWEEN_MM
    left_mm = room.x_mm + (room.width_mm + _BETWEEN_MM - across * step_x_mm) / 2.0
    top_mm = room.y_mm + (room.height_mm + _BETWEEN_MM - down * step_y_mm) / 2.0
    return [(left_mm + column * step_x_mm, top_mm + row * step_y_mm) for row in range(down) for column in range(across)]


def _write_head(sheets: Sheets, piece: _Piece, which: str) -> None:
    family, size_mm = piece.family, piece.size_mm
    sheets.head(
        f"Tags {family}, {size_mm:g} mm, {which}",
        f"{size_mm:g} mm is the outer edge of the black border; robot.yaml calls it default_size_m: {size_mm / 1e3:g}. "
        "Keep the white margin.",
        HOW_TO_PRINT,
    )


def _draw(sheets: Sheets, piece: _Piece, tag_id: int, x_mm: float, y_mm: float) -> None:
    """Draw a piece with its upper left corner at x and y."""
    cell_mm = piece.cell_mm
    sheets.blacken(black_cells(tag_bits(piece.family, tag_id), x_mm + cell_mm, y_mm + cell_mm, cell_mm))
    label = f"up   {piece.family}   id {tag_id}   {piece.size_mm:g} mm"
    room_mm = piece.size_mm + cell_mm - _UP_MM - 1.0
    size_pt = min(_LABEL_PT, _LABEL_PT * room_mm / text_width_mm(label, _LABEL_PT))
    foot_mm = y_mm + piece.width_mm + 0.6 * _LABEL_MM
    sheets.triangle(x_mm + cell_mm, foot_mm, _UP_MM)
    sheets.text(x_mm + cell_mm + _UP_MM + 1.0, foot_mm, label, size_pt)
    for corner_x_mm, outwards_x in ((x_mm, -1.0), (x_mm + piece.width_mm, 1.0)):
        for corner_y_mm, outwards_y in ((y_mm, -1.0), (y_mm + piece.height_mm, 1.0)):
            near_x_mm, near_y_mm = corner_x_mm + _MARK_AWAY_MM * outwards_x, corner_y_mm + _MARK_AWAY_MM * outwards_y
            sheets.lines(
                [
                    (near_x_mm, corner_y_mm, near_x_mm + _MARK_MM * outwards_x, corner_y_mm),
                    (corner_x_mm, near_y_mm, corner_x_mm, near_y_mm + _MARK_MM * outwards_y),
                ]
            )
