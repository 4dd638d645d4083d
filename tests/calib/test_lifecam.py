"""Corners of real pictures: a chessboard of 10 by 10 corners by a webcam, against mrcal's fit of the same corners."""

from pathlib import Path
from typing import Final

import numpy as np
import pytest
from scipy.spatial import Delaunay

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.intrinsics.bundle import BoardObservations
from groundsbot.calib.intrinsics.projection_uncertainty import (
    PictureGrid,
    difference_px,
    expected_error_px,
    projection_covariance,
    rms_px,
)
from groundsbot.calib.intrinsics.robust_fit import first_guess, fit_lens
from tests.support.paths import SHARED

CORNERS: Final = SHARED / "data" / "lifecam" / "lifecam_1280p_10x10.vnl"
SIDE_M: Final = 0.0254
MRCAL: Final = CameraModel(
    "mrcal", 1280, 720, 1131.171517, 1129.437477, 609.574878, 349.7414005, "rational_polynomial",
    (0.1039356761, -1.133505033, 0.002868861125, 0.001091292882, 2.699775641, -0.07902839361, 0.3027812824,
     -0.0003332983907),
)  # fmt: skip


def read_views(path: Path) -> list[FloatArray]:
    """The pictures in which every corner was found."""
    found: dict[str, list[list[float]]] = {}
    for line in path.read_text().splitlines():
        name, *rest = line.split()
        if name != "#" and not line.startswith("#") and rest[0] != "-":
            found.setdefault(name, []).append([float(rest[0]), float(rest[1])])
    return [np.array(each) for each in found.values() if len(each) == 100]


@pytest.mark.skipif(not CORNERS.exists(), reason="../shared/data/lifecam is not here")
@pytest.mark.parametrize("kind", ["plumb_bob", "rational_polynomial"])
def test_projections_are_those_of_mrcal_and_sigmas_say_so(kind: str) -> None:
    views = read_views(CORNERS)
    assert len(views) == 12
    columns, rows = np.meshgrid(np.arange(10), np.arange(10))
    board_m = np.stack([SIDE_M * columns, SIDE_M * rows, 0.0 * rows], axis=-1).reshape(-1, 3)
    numbers = np.repeat(np.arange(len(views)), 100)
    seen = BoardObservations(numbers, np.tile(board_m, (len(views), 1)), np.concatenate(views))
    lens = fit_lens(seen, len(views), first_guess(seen, len(views), (1280, 720), kind, "webcam"))
    grid = PictureGrid.of(MRCAL)
    inside = Delaunay(seen.pixels).find_simplex(grid.pixels) >= 0
    shown = PictureGrid(grid.pixels, np.where(inside[..., None], grid.rays, np.nan))
    difference = rms_px(difference_px(lens.fit.model, shown))
    own = PictureGrid(grid.pixels, np.where(inside[..., None], lens.fit.model.unproject(grid.pixels), np.nan))
    predicted = expected_error_px(projection_covariance(lens.fit.model, lens.covariance(), own))
    assert difference < 0.6
    assert difference < 3.0 * float(np.sqrt(np.nanmean(predicted**2)))
