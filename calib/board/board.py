"""The boards that a camera is calibrated with: ChArUco, chessboard, and Kalibr's AprilGrid, each specified by one word.

The word of a printed ChArUco board, as `7x9-25mm-18mm-5x5_100`, is on its sheet and given as --board; the default board
does not need it. Boards of others read `11x8-30mm-22mm-4x4_50-legacy`, `chessboard-9x6-25mm`, `aprilgrid-6x6-88mm-0.3`.
"""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

from groundsbot.calib.errors import CalibError

if TYPE_CHECKING:
    import cv2

_SIDES: Final = r"(\d{1,3})x(\d{1,3})"
_NUMBER: Final = r"(\d+(?:\.\d+)?)"
_CHARUCO: Final = re.compile(rf"{_SIDES}-{_NUMBER}mm-{_NUMBER}mm-(\w+?)(-legacy)?")
_CHESSBOARD: Final = re.compile(rf"chessboard-{_SIDES}-{_NUMBER}mm")
_APRILGRID: Final = re.compile(rf"aprilgrid-{_SIDES}-{_NUMBER}mm-{_NUMBER}")
_DICTIONARIES: Final = {f"{side}x{side}_{size}": size for side in (4, 5, 6, 7) for size in (50, 100, 250, 1000)} | {
    "aruco_original": 1024, "aruco_mip_36h12": 250,
    "apriltag_16h5": 30, "apriltag_25h9": 35, "apriltag_36h10": 2320, "apriltag_36h11": 587,
}  # fmt: skip
_LEAST_SQUARES: Final = 3
MARKER_SHARE: Final = 0.72  # side of a marker over that of a square
_LARGEST_SHARE: Final = 0.9  # the same, at most: a white margin must separate a marker from the black squares
_LEAST_SPACING: Final = 0.1  # of the tags of a grid, in sides of a tag


@dataclass(frozen=True)
class CharucoBoard:
    """A ChArUco board. With the numbering of OpenCV 4.6 and later, the square at the top left is black.

    Attributes:
        columns: number of squares across.
        rows: number of squares down.
        square_mm: side of a square.
        marker_mm: side of a marker, including its black border.
        dictionary: dictionary of the markers: cells by cells, and its size, as `5x5_100`, or as `apriltag_36h11`.
        legacy: the pattern of OpenCV before 4.6, in which the square at the top left is white if `rows` is even.
    """

    columns: int = 7
    rows: int = 9
    square_mm: float = 25.0
    marker_mm: float = 18.0
    dictionary: str = "5x5_100"
    legacy: bool = False

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < _LEAST_SQUARES:
            raise CalibError(
                f"board of {self.columns}x{self.rows} squares: at least {_LEAST_SQUARES}x{_LEAST_SQUARES}; add some"
            )
        if self.dictionary not in _DICTIONARIES:
            raise CalibError(f"dictionary is {self.dictionary!r} but must be one of {', '.join(_DICTIONARIES)}")
        if not self.square_mm > 0.0 or not 0.0 < self.marker_mm <= _LARGEST_SHARE * self.square_mm:
            raise CalibError(
                f"board with markers of {self.marker_mm:g} mm in squares of {self.square_mm:g} mm: must be above 0 and "
                f"at most {_LARGEST_SHARE:g} of the square; take {MARKER_SHARE:g} of it for the markers"
            )
        if self.n_markers > _DICTIONARIES[self.dictionary]:
            raise CalibError(
                f"board of {self.columns}x{self.rows} squares takes {self.n_markers} markers but {self.dictionary} has "
                f"{_DICTIONARIES[self.dictionary]}; take fewer squares or a larger dictionary"
            )

    @property
    def n_markers(self) -> int:
        """Number of markers: one in each white square."""
        return self.columns * self.rows // 2

    @property
    def specification(self) -> str:
        """The board in one word, as `parse_board` reads it."""
        word = f"{self.columns}x{self.rows}-{self.square_mm:g}mm-{self.marker_mm:g}mm-{self.dictionary}"
        return word + "-legacy" * self.legacy

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of all squares together."""
        return self.columns * self.square_mm, self.rows * self.square_mm

    def charuco(self) -> "cv2.aruco.CharucoBoard":
        """Return OpenCV's object of the board; its lengths are in metres."""
        import cv2

        name = re.sub(r"(\d)H(\d)", r"\1h\2", f"DICT_{self.dictionary.upper()}")
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_mm / 1000.0, self.marker_mm / 1000.0, markers
        )
        board.setLegacyPattern(self.legacy)
        return board


@dataclass(frozen=True)
class Chessboard:
    """A plain chessboard.

    Attributes:
        columns: number of inner corners across, one less than squares.
        rows: number of inner corners down.
        square_mm: side of a square.
    """

    columns: int
    rows: int
    square_mm: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < _LEAST_SQUARES or not self.square_mm > 0.0:
            raise CalibError(
                f"board {self.specification}: at least {_LEAST_SQUARES}x{_LEAST_SQUARES} inner corners and squares "
                "above 0 mm; give the corners between four squares, across and down"
            )

    @property
    def specification(self) -> str:
        """The board in one word, as `parse_board` reads it."""
        return f"chessboard-{self.columns}x{self.rows}-{self.square_mm:g}mm"

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of all squares together."""
        return (self.columns + 1) * self.square_mm, (self.rows + 1) * self.square_mm


@dataclass(frozen=True)
class AprilGrid:
    """Kalibr's grid of tags 36h11: tag 0 is at the lower left, and black squares join the corners of the tags.

    Attributes:
        columns: number of tags across (`tagCols`).
        rows: number of tags up (`tagRows`).
        tag_mm: side of a tag (`tagSize`).
        spacing: gap between two tags over the side of a tag (`tagSpacing`).
    """

    columns: int
    rows: int
    tag_mm: float
    spacing: float

    def __post_init__(self) -> None:
        most = _DICTIONARIES["apriltag_36h11"]
        if not 2 <= self.columns * self.rows <= most:
            raise CalibError(f"board {self.specification}: must have 2 to {most} tags; give tags across and up")
        if not self.tag_mm > 0.0 or not _LEAST_SPACING <= self.spacing <= 1.0:
            raise CalibError(
                f"board {self.specification}: tags must be above 0 mm and the spacing {_LEAST_SPACING:g} to 1; give "
                "the gap between two tags over the side of a tag, as 0.3"
            )

    @property
    def specification(self) -> str:
        """The board in one word, as `parse_board` reads it."""
        return f"aprilgrid-{self.columns}x{self.rows}-{self.tag_mm:g}mm-{self.spacing:g}"

    @property
    def gap_mm(self) -> float:
        """Gap between two tags, and side of a black square."""
        return self.spacing * self.tag_mm

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of all tags and black squares together."""
        pitch_mm = self.tag_mm + self.gap_mm
        return self.columns * pitch_mm + self.gap_mm, self.rows * pitch_mm + self.gap_mm


Board: TypeAlias = CharucoBoard | Chessboard | AprilGrid

DEFAULT_BOARD: Final = CharucoBoard()
DEFAULT_VIEWS: Final = 30  # recommended number of pictures for a calibration


def parse_board(specification: str) -> Board:
    """Return the board of a word, such as `7x9-25mm-18mm-5x5_100`, `chessboard-9x6-25mm` or `aprilgrid-6x6-88mm-0.3`.

    The parts are squares across and down, the side of a square, the side of a marker, and the dictionary; or inner
    corners across and down and the side of a square; or tags across and up, the side of a tag, and their spacing.

    Raises:
        CalibError: the word has another form, or specifies an impossible board.
    """
    word = specification.strip().lower()
    if found := _CHARUCO.fullmatch(word):
        columns, rows, square_mm, marker_mm, dictionary, legacy = found.groups()
        return CharucoBoard(int(columns), int(rows), float(square_mm), float(marker_mm), dictionary, legacy is not None)
    if found := _CHESSBOARD.fullmatch(word):
        columns, rows, square_mm = found.groups()
        return Chessboard(int(columns), int(rows), float(square_mm))
    if found := _APRILGRID.fullmatch(word):
        columns, rows, tag_mm, spacing = found.groups()
        return AprilGrid(int(columns), int(rows), float(tag_mm), float(spacing))
    raise CalibError(
        f"board is {specification!r} but must read like {DEFAULT_BOARD.specification} (copy it from the print), "
        "chessboard-9x6-25mm (inner corners, squares) or aprilgrid-6x6-88mm-0.3 (tags, their side, gap over side)"
    )
