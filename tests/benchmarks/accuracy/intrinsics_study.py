"""How near a calibration comes to the camera that took the pictures, and how well its own sigmas agree with the errors.

    python -m tests.benchmarks.accuracy.intrinsics_study                  both comparisons
    python -m tests.benchmarks.accuracy.intrinsics_study --parts given    the model given, 30 good views
    python -m tests.benchmarks.accuracy.intrinsics_study --parts plain    a tenth of them spoilt, OpenCV's beside ours

Each seed draws 30 views of the board, pictures rendered with noise, blur and a shaking hand; both comparisons look at
the same ones, except for those that are spoilt. `chance` is that of `check`, with the truth as an exact file;
errors are root mean squares over the picture after the best rotation. `map` is the error over seeds over the predicted
one, place by place.
Some 15 seconds of processor time a seed; each line ends with those used so far.
"""

import argparse
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from groundsbot.calib.board.board import DEFAULT_BOARD
from groundsbot.calib.board.finder import BoardFinder, BoardView
from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.camera.parameters import undistorted_camera, with_parameters
from groundsbot.calib.errors import CalibError
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.intrinsics.model_choice import KINDS, calibrate_camera
from groundsbot.calib.intrinsics.projection_uncertainty import (
    PictureGrid,
    chance_of_difference,
    difference_px,
    expected_error_px,
    projection_covariance,
    rms_px,
)
from tests.benchmarks.command_line import seeds_of
from tests.support.board_cases import CASES, take_with_and_without, taken_views

REGION: Final = 0.99


@dataclass(frozen=True)
class Outcome:
    """One seed: squared errors and their prediction are (rows, columns) px^2."""

    chance: float
    inside: bool
    error_px: float
    square: FloatArray
    predicted: FloatArray
    views: int
    corner_sigma_px: float


def judge(truth: CameraModel, views: Sequence[BoardView]) -> Outcome:
    """One calibration with the model given."""
    lens = calibrate_camera(views, BoardFinder(DEFAULT_BOARD), truth.name, [truth.distortion_model]).lens
    covariance = lens.covariance()
    chance = chance_of_difference(lens.fit.model, truth, [(covariance, int(lens.views.sum()))])
    grid = PictureGrid.of(truth)
    error = difference_px(lens.fit.model, grid)
    predicted = expected_error_px(projection_covariance(lens.fit.model, covariance, grid)) ** 2
    return Outcome(
        chance, chance > 1.0 - REGION, rms_px(error), (error**2).sum(axis=-1), predicted,
        int(lens.views.sum()), lens.fit.sigma_px,
    )  # fmt: skip


def map_ratio(outcomes: Sequence[Outcome]) -> FloatArray:
    """(rows, columns) error over predicted error, both root mean squares over seeds; NaN outside the image circle."""
    found, said = (np.array([getattr(each, name) for each in outcomes]) for name in ("square", "predicted"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a place without image in any seed
        return np.asarray(np.sqrt(np.nanmean(found, axis=0) / np.nanmean(said, axis=0)))


def plain_error_px(truth: CameraModel, views: Sequence[BoardView]) -> float:
    """The error of OpenCV's way with its defaults on all views, corners as the detector gives them; NaN: it refuses.

    OpenCV has a separate function for fisheyes. By default it keeps its initial poses, and fits a skew that no camera
    file can hold; both are switched off.
    """
    board = DEFAULT_BOARD.charuco()
    detector = cv2.aruco.CharucoDetector(board)
    places, pixels = [], []
    for view in views:
        corners, ids, _, _ = detector.detectBoard(view.picture)
        place, pixel = board.matchImagePoints(corners, ids)  # type: ignore[call-overload]
        places.append(place)
        pixels.append(pixel)
    size = (truth.width_px, truth.height_px)
    if truth.distortion_model == "equidistant":
        flags = cv2.fisheye.CALIB_RECOMPUTE_EXTRINSIC | cv2.fisheye.CALIB_FIX_SKEW
        try:
            _, K, coefficients, _, _ = cv2.fisheye.calibrate(places, pixels, size, np.eye(3), np.zeros(4), flags=flags)
        except cv2.error:
            return np.nan
    else:
        _, K, coefficients, _, _ = cv2.calibrateCamera(places, pixels, size, None, None)
    kind = "equidistant" if truth.distortion_model == "equidistant" else "plumb_bob"
    found = with_parameters(
        undistorted_camera("plain", size, kind, float(K[0, 0])),
        np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *coefficients.ravel()]),
    )
    return rms_px(difference_px(found, PictureGrid.of(truth)))


@dataclass(frozen=True)
class Beside:
    """One seed's errors by our way, which chooses the model too, and by the plain one; NaN where it refuses."""

    ours_px: float
    plain_px: float
    model: str
    views: int

    @property
    def better(self) -> bool:
        """Whether ours is lower; no plain one is no better than ours."""
        return not np.isnan(self.ours_px) and not self.ours_px >= self.plain_px


def beside(truth: CameraModel, views: Sequence[BoardView]) -> Beside:
    """Both ways on the same views."""
    plain_px = plain_error_px(truth, views)
    try:
        found = calibrate_camera(views, BoardFinder(DEFAULT_BOARD), truth.name, KINDS)
    except CalibError:
        return Beside(np.nan, plain_px, "refused", 0)
    ours_px = rms_px(difference_px(found.model, PictureGrid.of(truth)))
    return Beside(ours_px, plain_px, found.model.distortion_model, int(found.lens.views.sum()))


def study(case: str, seeds: Sequence[int], parts: Sequence[str]) -> None:
    """Prints a line a seed and a summary."""
    given, against = [], []
    for seed in seeds:
        line = f"{case} seed {seed}:"
        good, mixed = _views(CASES[case], seed, parts)
        if "given" in parts:
            each = judge(CASES[case], good)
            given.append(each)
            line += (
                f" chance {each.chance:.2g} {'inside' if each.inside else 'OUTSIDE'}, error {each.error_px:.4f} px, "
                f"predicted {np.sqrt(np.nanmean(each.predicted)):.4f} px, {each.views} views;"
            )
        if "plain" in parts:
            both = beside(CASES[case], mixed)
            against.append(both)
            line += (
                f" spoilt: ours {both.ours_px:.4f} px ({both.model}, {both.views} of {len(mixed)} views), plain "
                f"{both.plain_px:.4f} px{'' if both.better else ' NOT LOWER'}"
            )
        print(f"{line} [{time.process_time():.0f} s]", flush=True)  # noqa: T201
    if given:
        _sum_up(case, given)
    if against:
        better = sum(each.better for each in against)
        print(f"{case}: ours lower in {better} of {len(against)}", flush=True)  # noqa: T201


def _views(truth: CameraModel, seed: int, parts: Sequence[str]) -> tuple[list[BoardView], list[BoardView]]:
    if "plain" not in parts:
        return taken_views(truth, seed), []
    return take_with_and_without(truth, seed) if "given" in parts else ([], taken_views(truth, seed, spoilt_share=0.1))


def _sum_up(case: str, outcomes: Sequence[Outcome]) -> None:
    ratio = map_ratio(outcomes)
    low, middle, high = np.nanquantile(ratio, [0.0, 0.5, 1.0])
    right = np.nanmean((ratio[np.isfinite(ratio)] < 1.5) & (ratio[np.isfinite(ratio)] > 1.0 / 1.5))
    inside, largest = sum(each.inside for each in outcomes), max(each.error_px for each in outcomes)
    mean = np.mean([each.chance for each in outcomes])
    print(f"{case}: inside the {REGION:.0%} region {inside} of {len(outcomes)}, mean chance {mean:.2f}")  # noqa: T201
    print(f"{case}: largest error {largest:.4f} px")  # noqa: T201
    print(  # noqa: T201
        f"{case}: map {low:.2f} to {high:.2f}, median {middle:.2f}, within 1.5 at {right:.0%} of places", flush=True
    )


def main() -> None:
    """Runs the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=seeds_of, default="0-49", help="FIRST-LAST")
    parser.add_argument("--cases", default=",".join(CASES), help="comma-separated, of " + ", ".join(CASES))
    parser.add_argument("--parts", default="given,plain", help="given, plain or both, comma-separated")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    for case in arguments.cases.split(","):
        study(case, arguments.seeds, arguments.parts.split(","))


if __name__ == "__main__":
    main()
