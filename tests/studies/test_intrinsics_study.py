"""The study of intrinsics, small."""

from tests.benchmarks.accuracy.intrinsics_study import beside, judge
from tests.support.board_cases import FISHEYE, NARROW, take_with_and_without, taken_views


def test_a_fisheye_lies_in_the_region_that_its_calibration_names() -> None:
    outcome = judge(FISHEYE, taken_views(FISHEYE, 3, 10))
    assert outcome.inside
    assert outcome.error_px < 0.02
    assert outcome.views == 10
    assert outcome.corner_sigma_px < 0.01


def test_bad_views_have_less_effect_than_in_the_plain_calibration() -> None:
    good, mixed = take_with_and_without(NARROW, 2, 14, spoilt_share=0.15)
    assert sum(any(view is other for other in mixed) for view in good) == 12  # two are spoilt
    found = beside(NARROW, mixed)
    assert found.better
    assert found.ours_px < 0.1
    assert found.model == "plumb_bob"
