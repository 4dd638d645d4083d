"""The calibration board: a chessboard with ArUco markers in its white squares (ChArUco).

One word specifies a board, as `7x9-25mm-18mm-5x5_100`. It is printed on the sheet and given to `camera` as --board;
the default board does not need it.
"""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from groundsbot.calib.errors import CalibError

if TYPE_CHECKING:
    import cv2

_SPECIFICATION: Final = re.compile(r"(\d{1,3})x(\d{1,3})-(\d+(?:\.\d+)?)mm-(\d+(?:\.\d+)?)mm-(\w+)")
_DICTIONARIES: Final = tuple(f"{side}x{side}_{size}" for side in (4, 5, 6, 7) for size in (50, 100, 250, 1000))
_LEAST_SQUARES: Final = 3
MARKER_SHARE: Final = 0.72  # side of a marker over that of a square
_LARGEST_SHARE: Final = 0.9  # the same, at most: a white margin must separate a marker from the black squares


@dataclass(frozen=True)
class Board:
    """A ChArUco board with the numbering of OpenCV 4.6 and later: the square at the top left is black.

    Attributes:
        columns: number of squares across.
        rows: number of squares down.
        square_mm: side of a square.
        marker_mm: side of a marker, including its black border.
        dictionary: dictionary of the markers: cells by cells, and its size, as `5x5_100`.
    """

    columns: int = 7
    rows: int = 9
    square_mm: float = 25.0
    marker_mm: float = 18.0
    dictionary: str = "5x5_100"

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
        if self.n_markers > self._dictionary_size:
            raise CalibError(
                f"board of {self.columns}x{self.rows} squares takes {self.n_markers} markers but {self.dictionary} has "
                f"{self._dictionary_size}; take fewer squares or a larger dictionary"
            )

    @property
    def n_markers(self) -> int:
        """Number of markers: one in each white square."""
        return self.columns * self.rows // 2

    @property
    def specification(self) -> str:
        """The board in one word, as `parse_board` reads it."""
        return f"{self.columns}x{self.rows}-{self.square_mm:g}mm-{self.marker_mm:g}mm-{self.dictionary}"

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of all squares together."""
        return self.columns * self.square_mm, self.rows * self.square_mm

    def charuco(self) -> "cv2.aruco.CharucoBoard":
        """Return OpenCV's object of the board; its lengths are in metres."""
        import cv2

        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{self.dictionary.upper()}"))
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_mm / 1000.0, self.marker_mm / 1000.0, markers
        )

    @property
    def _dictionary_size(self) -> int:
        return int(self.dictionary.split("_")[1])


DEFAULT_BOARD: Final = Board()
DEFAULT_VIEWS: Final = 30  # recommended number of pictures for a calibration


def parse_board(specification: str) -> Board:
    """Return the board of a word such as `7x9-25mm-18mm-5x5_100`.

    The parts are squares across and down, the side of a square, the side of a marker, and the dictionary.

    Raises:
        CalibError: the word has another form, or specifies an impossible board.
    """
    found = _SPECIFICATION.fullmatch(specification.strip().lower())
    if found is None:
        raise CalibError(
            f"board is {specification!r} but must read like {DEFAULT_BOARD.specification}; copy it from the print"
        )
    columns, rows, square_mm, marker_mm, dictionary = found.groups()
    return Board(int(columns), int(rows), float(square_mm), float(marker_mm), dictionary)
