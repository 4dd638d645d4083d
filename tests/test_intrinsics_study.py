"""The study of intrinsics, small."""

from calib.board import DEFAULT_BOARD
from calib.board_finder import BoardFinder
from calib.intrinsics import calibrated
from calib.projection_uncertainty import PictureGrid, difference_px, rms_px
from tests.benchmarks.intrinsics_study import plain_error_px, run_seed
from tests.board_cases import FISHEYE, NARROW, taken_views


def test_a_fisheye_lies_in_the_region_that_its_calibration_names() -> None:
    outcome = run_seed(FISHEYE, 3, 10)
    assert outcome.inside
    assert outcome.error_px < 0.02
    assert outcome.views == 10
    assert outcome.corner_sigma_px < 0.01


def test_spoilt_views_harm_less_than_the_plain_way() -> None:
    views = taken_views(NARROW, 2, 14, spoilt_share=0.15)
    model = calibrated(views, BoardFinder(DEFAULT_BOARD), "narrow", ["plumb_bob"]).model
    ours, plain = rms_px(difference_px(NARROW, model, PictureGrid.of(NARROW))), plain_error_px(NARROW, views)
    assert ours < plain
    assert ours < 0.1
