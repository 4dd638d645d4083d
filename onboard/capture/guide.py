"""Selection of pictures of a calibration board, and advice how to hold the board next."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.board import DEFAULT_VIEWS, Board, Coverage, SeenBoard, board_detector, describe_board
from groundsbot.onboard.errors import OnboardError

_NS_PER_S: Final = 1_000_000_000
# At this speed motion blur is a third of a pixel in a long exposure of 1/60 s, in a picture 1280 px wide.
_STILL_PER_S: Final = 20.0 / 1280.0  # in picture widths
_STILL_NS: Final = 200_000_000  # the speed of a moving board is also zero for a moment where it reverses
_GAP_NS: Final = 3 * _NS_PER_S  # the speed cannot be determined over longer gaps
# A view that differs by less adds little to a calibration.
_NEW_SHIFT: Final = 0.04  # of the corners seen in both views, in picture diagonals
_NEW_TILT_DEG: Final = 10.0
_LEAST_SHARED: Final = 4  # common corners needed to compare two views


@dataclass(frozen=True)
class Advice:
    """Result for one picture.

    Attributes:
        keep: the picture is to be kept.
        text: instruction for the person who holds the board.
        seen: the board in the picture, or None.
    """

    keep: bool
    text: str
    seen: SeenBoard | None


class CaptureGuide:
    """Guide for capturing a board, independent of cameras and files.

    Attributes:
        board: the board.
        kept: number of pictures kept so far.
        wanted: number of pictures wanted.
        spread: coverage by the pictures kept.
    """

    def __init__(self, board: Board, wanted: int) -> None:
        """Start without pictures.

        Raises:
            OnboardError: `wanted` is below 1.
        """
        if wanted < 1:
            raise OnboardError(f"--views is {wanted} but must be at least 1; {DEFAULT_VIEWS} are good")
        self.board = board
        self.kept = 0
        self.wanted = wanted
        self.spread = Coverage()
        self._detect = board_detector(board)
        self._views: list[SeenBoard] = []
        self._before: tuple[SeenBoard, int] | None = None
        self._still_since_ns: int | None = None

    @property
    def enough(self) -> bool:
        """Whether there are as many pictures as wanted and no view is missing."""
        return self.kept >= self.wanted and not self.missing

    @property
    def missing(self) -> list[str]:
        """Hints on the views still missing, most important first."""
        return self.spread.missing()

    def handle_frame(self, grey: NDArray[np.uint8], stamp_ns: int) -> Advice:
        """Return the advice for the next picture `[H, W]`; it counts as kept if `Advice.keep` is set."""
        seen = self._find(grey)
        if seen is None:
            self._before, self._still_since_ns = None, None
            return Advice(False, f"no board {self.board.specification} in view; show more of it", None)
        if not self._is_still(seen, stamp_ns, grey.shape[1]):
            return Advice(False, "hold the board still", seen)
        if not self._is_new(seen, grey):
            return Advice(False, self._next(), seen)
        self._keep(seen)
        return Advice(True, f"taken; {self._next()}", seen)

    def remember(self, grey: NDArray[np.uint8]) -> bool:
        """Count a picture of an earlier capture as kept, and return whether it shows the board."""
        seen = self._find(grey)
        if seen is not None:
            self._keep(seen)
        return seen is not None

    def _next(self) -> str:
        if self.enough:
            return "that is enough"
        return (self.missing or ["show it in some other place or tilt it in some other way"])[0]

    def _keep(self, seen: SeenBoard) -> None:
        self.kept += 1
        self.spread.add(seen)
        self._views.append(seen)

    def _find(self, grey: NDArray[np.uint8]) -> SeenBoard | None:
        return describe_board(*self._detect(grey), self.board, (grey.shape[1], grey.shape[0]))

    def _is_still(self, seen: SeenBoard, stamp_ns: int, width_px: int) -> bool:
        before, self._before = self._before, (seen, stamp_ns)
        if before is None or not 0 < stamp_ns - before[1] <= _GAP_NS:
            self._still_since_ns = None
            return False
        moved_px = _shift_px(before[0], seen)
        limit_px = _STILL_PER_S * width_px * (stamp_ns - before[1]) / _NS_PER_S
        if moved_px is None or moved_px > limit_px:
            self._still_since_ns = None
            return False
        if self._still_since_ns is None:
            self._still_since_ns = before[1]
        return stamp_ns - self._still_since_ns >= _STILL_NS

    def _is_new(self, seen: SeenBoard, grey: NDArray[np.uint8]) -> bool:
        far_px = _NEW_SHIFT * float(np.hypot(grey.shape[0], grey.shape[1]))
        return all(_differ(seen, view, far_px) for view in self._views)


def _differ(one: SeenBoard, other: SeenBoard, far_px: float) -> bool:
    shift_px = _shift_px(one, other)
    tilt_deg = float(np.hypot(*(one.tilt_deg - other.tilt_deg)))
    return shift_px is None or shift_px >= far_px or tilt_deg >= _NEW_TILT_DEG


def _shift_px(one: SeenBoard, other: SeenBoard) -> float | None:
    """Return the RMS distance between the corners seen in both views, or None if there are too few."""
    _, at, there = np.intersect1d(one.ids, other.ids, return_indices=True)
    if len(at) < _LEAST_SHARED:
        return None
    apart = one.pixels[at] - other.pixels[there]
    return float(np.sqrt((apart**2).sum(axis=1).mean()))
