"""How far calibrations from the halves of one set of views differ, what they predict of it, and what `check` says.

    python -m tests.benchmarks.accuracy.halves_study lifecam '/usr/share/doc/opencv-doc/examples/data/left[01]*.jpg' \
        --board chessboard-9x6-25mm                            real pictures; the second set is of Debian's opencv-doc
    python -m tests.benchmarks.accuracy.halves_study narrow wide rational fisheye --views 15

A set is a folder or a pattern of pictures, `lifecam` (corners in ../shared), or a simulated camera of
`tests.support.board_cases`. A real set is split at random into halves, `--pairs` times. Of a simulated one, other
corners are drawn for each pair, `--views` in each half, with independent noise and an error in each view that is
quadratic over the board. Differences are root mean squares over the part of the picture in which corners were seen,
after the best rotation, and over the pairs. `check` compares the first half's camera, as it is and with a focal length
1 % longer, with the second half's pictures, unless `camera` refuses one of the halves because it does not determine the
camera.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from scipy.spatial import Delaunay

from groundsbot.calib.board import BoardFinder, grey_pictures, parse_board
from groundsbot.calib.camera import CameraModel
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.calib.intrinsics.bundle import BoardObservations, select_views
from groundsbot.calib.intrinsics.calibration import refuse_unclear, search
from groundsbot.calib.intrinsics.check import still_fits
from groundsbot.calib.intrinsics.model_choice import KINDS, Calibration, calibrate_camera, collect_observations
from groundsbot.calib.intrinsics.projection_uncertainty import (
    PictureGrid,
    chance_of_difference,
    difference_px,
    expected_error_px,
    projection_covariance,
    rms_px,
)
from groundsbot.calib.intrinsics.robust_fit import LensFit, first_guess, fit_lens
from tests.benchmarks.command_line import say
from tests.support.board_cases import CASES, make_corners
from tests.support.lifecam import LIFECAM_SIZE_PX, read_lifecam

SIGMA_PX: Final = 0.1
BEND_PX: Final = 0.1
LONGER: Final = 1.01

Calibrate = Callable[[Sequence[str]], Calibration]
"""Calibrates from one half, with the best of the lens models given."""


@dataclass(frozen=True)
class Pair:
    """Two halves of a set.

    Attributes:
        calibrations: of the two halves.
        pixels: (N, 2) corners of both.
    """

    calibrations: tuple[Calibrate, Calibrate]
    pixels: FloatArray


@dataclass(frozen=True)
class Outcome:
    """Result of one pair.

    Attributes:
        square: squared difference in px^2.
        predicted: its prediction.
        is_refused: `camera` refuses one of the halves.
        is_changed: `check` finds a change.
        is_found: `check` finds the longer focal length.
    """

    square: float
    predicted: float
    is_refused: bool
    is_changed: bool
    is_found: bool


def judge(pair: Pair, kinds: Sequence[str]) -> Outcome:
    """Calibrate from both halves, and compare.

    Raises:
        CalibError: a half fits no camera at all.
    """
    first, second = (calibrate(kinds) for calibrate in pair.calibrations)
    model = first.model
    grids = [_inside(each.model, pair.pixels) for each in (first, second)]
    predicted = sum(
        float(np.nanmean(expected_error_px(projection_covariance(each.model, each.lens.covariance(), grid)) ** 2))
        for each, grid in zip((first, second), grids, strict=True)
    )
    square = rms_px(difference_px(second.model, grids[0])) ** 2
    again = second
    if second.model.distortion_model != model.distortion_model:
        again = pair.calibrations[1]([model.distortion_model])
    try:
        refuse_unclear(first)
        refuse_unclear(again)
    except CalibError:
        return Outcome(square, predicted, is_refused=True, is_changed=False, is_found=False)
    longer = replace(model, fx_px=LONGER * model.fx_px, fy_px=LONGER * model.fy_px)
    changed, found = (not fits(each, first.lens, again.lens) for each in (model, longer))
    return Outcome(square, predicted, is_refused=False, is_changed=changed, is_found=found)


def fits(model: CameraModel, first: LensFit, again: LensFit) -> bool:
    """Return what `check` says of a camera with the covariance of `first`, and of pictures that gave `again`."""
    covariances = [(lens.covariance(), int(lens.views.sum())) for lens in (again, first)]
    chance = chance_of_difference(again.fit.model, model, covariances)
    return still_fits(chance, rms_px(difference_px(model, PictureGrid.of(again.fit.model))))


def _inside(model: CameraModel, pixels: FloatArray) -> PictureGrid:
    grid = PictureGrid.of(model)
    seen = Delaunay(pixels).find_simplex(grid.pixels) >= 0
    return PictureGrid(grid.pixels, np.where(seen[..., None], grid.rays, np.nan))


def pairs_of_pictures(paths: Sequence[Path], board: str, count: int) -> Iterator[Pair]:
    """Yield random halves of the pictures that show the board."""
    finder = BoardFinder(parse_board(board))
    views = search(grey_pictures(paths), finder).views

    def calibrate(half: BoolArray) -> Calibrate:
        own = [view for view, kept in zip(views, half, strict=True) if kept]
        return lambda kinds: calibrate_camera(own, finder, "camera", kinds)

    for half in _halves(len(views), count):
        yield Pair((calibrate(half), calibrate(~half)), collect_observations(views, finder).pixels)


def pairs_of_lifecam(count: int) -> Iterator[Pair]:
    """Yield random halves of the LifeCam's views."""
    seen, n_views = read_lifecam()
    for half in _halves(n_views, count):
        yield Pair((_of_corners(seen, half, LIFECAM_SIZE_PX), _of_corners(seen, ~half, LIFECAM_SIZE_PX)), seen.pixels)


def simulated_pairs(camera: CameraModel, n_views: int, count: int) -> Iterator[Pair]:
    """Yield halves of `n_views` views each."""
    for seed in range(count):
        seen, _ = make_corners(camera, seed, 2 * n_views, SIGMA_PX, BEND_PX)
        half, size_px = np.arange(2 * n_views) < n_views, (camera.width_px, camera.height_px)
        yield Pair((_of_corners(seen, half, size_px), _of_corners(seen, ~half, size_px)), seen.pixels)


def _halves(n_views: int, count: int) -> Iterator[BoolArray]:
    rng = np.random.default_rng(0)
    for _ in range(count):
        yield np.asarray(rng.permutation(n_views) < n_views // 2)


def _of_corners(seen: BoardObservations, half: BoolArray, size_px: tuple[int, int]) -> Calibrate:
    own, n_views = select_views(seen, half), int(half.sum())

    def calibrate(kinds: Sequence[str]) -> Calibration:
        if len(kinds) > 1:
            raise CalibError("corners without pictures: the model cannot be chosen, give one")
        lens = fit_lens(own, n_views, first_guess(own, n_views, size_px, kinds[0], "camera"))
        return Calibration(lens, [], lens.fit.poses, np.zeros(n_views, dtype=np.bool_), {})

    return calibrate


def study(title: str, pairs: Iterator[Pair], kinds: Sequence[str]) -> None:
    """Print a line of what was found."""
    outcomes, failed = [], ""
    for pair in pairs:
        try:
            outcomes.append(judge(pair, kinds))
        except CalibError as error:
            failed = f"; others have no fit, the last one: {error}"
    if outcomes:
        found, predicted = (np.array([getattr(each, name) for each in outcomes]) for name in ("square", "predicted"))
        said = [sum(getattr(each, name) for each in outcomes) for name in ("is_refused", "is_changed", "is_found")]
        title += (
            f": {len(outcomes)} pairs differ by {np.sqrt(found.mean()):.3f} px, predicted "
            f"{np.sqrt(predicted.mean()):.3f} px, ratio {np.sqrt(found.mean() / predicted.mean()):.2f} (medians "
            f"{np.sqrt(np.median(found) / np.median(predicted)):.2f}); refused {said[0]}, changed {said[1]}, 1 % found "
            f"{said[2]}"
        )
    say(title + failed)


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="+", help="folder, pattern, lifecam, or of " + ", ".join(CASES))
    parser.add_argument("--board", default="chessboard-9x6-25mm", help="in the pictures")
    parser.add_argument("--models", default="plumb_bob", help="auto or lens models; a simulated camera has its own")
    parser.add_argument("--pairs", type=int, default=20)
    parser.add_argument("--views", default="15", help="in each simulated half, comma-separated")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    for name in arguments.sets:
        if name in CASES:
            for n_views in map(int, arguments.views.split(",")):
                camera = CASES[name]
                pairs = simulated_pairs(camera, n_views, arguments.pairs)
                study(f"{name}, {n_views} views a half", pairs, [camera.distortion_model])
            continue
        for model in arguments.models.split(","):
            if name == "lifecam":
                pairs = pairs_of_lifecam(arguments.pairs)
            else:
                paths = sorted(Path(name).parent.glob(Path(name).name))
                pairs = pairs_of_pictures(paths, arguments.board, arguments.pairs)
            study(f"{name}, {model}", pairs, KINDS if model == "auto" else [model])


if __name__ == "__main__":
    main()
