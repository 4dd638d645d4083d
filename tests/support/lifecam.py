"""Corners of real pictures in ../shared: a chessboard of 10 by 10 corners, taken by a webcam."""

from typing import Final

import numpy as np

from groundsbot.calib.intrinsics.bundle import BoardObservations
from tests.support.paths import SHARED

LIFECAM: Final = SHARED / "data" / "lifecam" / "lifecam_1280p_10x10.vnl"
LIFECAM_SIZE_PX: Final = (1280, 720)
_SIDE_M: Final = 0.0254


def read_lifecam() -> tuple[BoardObservations, int]:
    """Return the corners of the pictures in which every corner was found, and the number of these pictures."""
    found: dict[str, list[list[float]]] = {}
    for line in LIFECAM.read_text().splitlines():
        name, *rest = line.split()
        if not name.startswith("#") and rest[0] != "-":
            found.setdefault(name, []).append([float(rest[0]), float(rest[1])])
    views = [np.array(each) for each in found.values() if len(each) == 100]
    columns, rows = np.meshgrid(np.arange(10), np.arange(10))
    board_m = np.stack([_SIDE_M * columns, _SIDE_M * rows, 0.0 * rows], axis=-1).reshape(-1, 3)
    view = np.repeat(np.arange(len(views)), 100)
    return BoardObservations(view, np.tile(board_m, (len(views), 1)), np.concatenate(views)), len(views)
