"""Tells which pictures of a calibration board are worth keeping, and what to do with the board next."""

from dataclasses import dataclass
from typing import Any, Final, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.board import DEFAULT_VIEWS, Board, Coverage, SeenBoard, describe_board
from groundsbot.onboard.errors import OnboardError

_NS_PER_S: Final = 1_000_000_000
# What moves so fast is smeared by a third of a pixel in 1/60 s, a long exposure, in a picture 1280 px wide.
_STILL_PER_S: Final = 20.0 / 1280.0  # of the picture's width
_STILL_NS: Final = 200_000_000  # so long, as a board also stands still for a moment where it turns back
_GAP_NS: Final = 3 * _NS_PER_S  # between two pictures that long apart it may have been anywhere
# A view that differs by less tells the calibration what it knows already.
_NEW_SHIFT: Final = 0.04  # of the picture's diagonal, of the corners seen in both
_NEW_TILT_DEG: Final = 10.0
_LEAST_SHARED: Final = 4  # corners to compare two views by


@dataclass(frozen=True)
class Advice:
    """What a picture led to.

    Attributes:
        keep: the picture is worth keeping.
        text: what to do with the board now.
        seen: the board in it, if it is there.
    """

    keep: bool
    text: str
    seen: SeenBoard | None


class CaptureGuide:
    """Takes one picture after the other. Knows nothing of cameras and files.

    Attributes:
        board: which board.
        kept: pictures kept so far.
        wanted: how many are wanted.
        spread: what they cover.
    """

    def __init__(self, board: Board, wanted: int) -> None:
        """Begins without any.

        Raises:
            OnboardError: none are wanted.
        """
        if wanted < 1:
            raise OnboardError(f"--views is {wanted} but must be at least 1; {DEFAULT_VIEWS} are good")
        self.board = board
        self.kept = 0
        self.wanted = wanted
        self.spread = Coverage()
        self._detector = cv2.aruco.CharucoDetector(board.charuco())
        self._views: list[SeenBoard] = []
        self._before: tuple[SeenBoard, int] | None = None
        self._still_since_ns: int | None = None

    @property
    def enough(self) -> bool:
        """As many as wanted, and they miss nothing."""
        return self.kept >= self.wanted and not self.missing

    @property
    def missing(self) -> list[str]:
        """What the pictures kept still miss, the most needed first."""
        return self.spread.missing()

    def handle_frame(self, grey: NDArray[np.uint8], stamp_ns: int) -> Advice:
        """Looks at a picture `[H, W]`, the next in time; it counts as kept where the advice says to keep it."""
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
        """Counts a picture of an earlier time as kept; says whether it shows the board."""
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
        # OpenCV gives None where there are none, which its stubs do not know.
        pixels, ids = cast(tuple[Any, Any], self._detector.detectBoard(grey)[:2])
        if ids is None:
            return None
        numbers, places = np.ravel(ids).astype(np.int64), np.asarray(pixels, np.float64).reshape(-1, 2)
        return describe_board(numbers, places, self.board, (grey.shape[1], grey.shape[0]))

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
    """RMS of how far the corners seen in both are apart; None where they are too few."""
    _, at, there = np.intersect1d(one.ids, other.ids, return_indices=True)
    if len(at) < _LEAST_SHARED:
        return None
    apart = one.pixels[at] - other.pixels[there]
    return float(np.sqrt((apart**2).sum(axis=1).mean()))
