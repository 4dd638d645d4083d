"""Corners sharpened on the picture: nearer to the truth than the detector's, or left as they were."""

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.onboard.detection.corner_refinement import refine_corners
from groundsbot.onboard.detection.tag_detector import TagDetector
from tests.benchmarks.accuracy.corner_error_study import CASES, Case, Errors, pictures_of, study_case
from tests.support.tag_pictures import draw_tag

LEANING = np.array([[200.3, 120.7], [330.6, 141.2], [321.4, 265.9], [190.8, 250.1]])
CELLS = np.array([8])


@cache
def picture() -> NDArray[np.uint8]:
    """A tag with the noise of a sensor."""
    noise = np.random.default_rng(0).normal(0.0, 2.0, (480, 640))
    return np.clip(draw_tag("tag36h11", 17, LEANING) + noise, 0, 255).astype(np.uint8)


def near_the_truth() -> FloatArray:
    """As a detector may have them."""
    return LEANING + np.random.default_rng(1).normal(0.0, 0.3, (4, 2))


def test_refined_corners_are_at_their_true_places() -> None:
    found, good = refine_corners(picture(), near_the_truth()[None], CELLS)
    assert good.tolist() == [True]
    assert np.sqrt(np.mean((found[0] - LEANING) ** 2)) < 0.02
    # In whatever order they come: the sides are the same.
    turned, _ = refine_corners(picture(), np.roll(near_the_truth(), 1, axis=0)[None, ::-1], CELLS)
    np.testing.assert_allclose(turned[0, ::-1], np.roll(found[0], 1, axis=0), atol=5e-3)


@pytest.mark.parametrize("blur_px", [0.5, 1.0])
def test_light_from_one_side_is_not_taken_for_rotated_sides(blur_px: float) -> None:
    light = np.linspace(0.5, 1.0, 640)  # a sixth brighter at one end of the tag than at the other
    lit = cv2.GaussianBlur(picture(), (0, 0), blur_px) * light
    found, good = refine_corners(lit.astype(np.uint8), near_the_truth()[None], CELLS)
    assert good.tolist() == [True]
    assert np.sqrt(np.mean((found[0] - LEANING) ** 2)) < 0.03


def test_small_tags_are_not_moved_by_the_cells_beside_their_border() -> None:
    small = LEANING.mean(axis=0) + 0.28 * (LEANING - LEANING.mean(axis=0))  # cells of 4.5 px
    errors = []
    for shift_px in np.random.default_rng(2).uniform(-0.5, 0.5, (6, 2)):
        true_px = small + shift_px
        blurred = cv2.GaussianBlur(draw_tag("tag36h11", 17, true_px), (0, 0), 0.9)
        found, good = refine_corners(blurred.astype(np.uint8), true_px[None], CELLS)
        assert good.tolist() == [True]
        errors.append(found[0] - true_px)
    assert np.abs(np.mean(errors, axis=0)).max() < 0.02


def test_each_tag_of_a_picture_on_its_own() -> None:
    off = near_the_truth()
    elsewhere = off + np.array([40.0, 30.0])  # where no tag is
    both, good = refine_corners(picture(), np.stack([elsewhere, off]), np.array([8, 8]))
    alone, _ = refine_corners(picture(), off[None], CELLS)
    assert good.tolist() == [False, True]
    np.testing.assert_array_equal(both[0], elsewhere)
    np.testing.assert_allclose(both[1], alone[0], atol=1e-3)


@pytest.mark.parametrize(("first", "last"), [((185, 180), (215, 215)), ((255, 240), (275, 280))])
def test_a_tag_with_something_before_one_side_stays_as_detected(first: tuple[int, int], last: tuple[int, int]) -> None:
    hidden = picture().copy()
    cv2.rectangle(hidden, first, last, 90.0, -1)
    found, good = refine_corners(hidden, LEANING[None], CELLS)
    assert good.tolist() == [False]
    np.testing.assert_array_equal(found[0], LEANING)


def test_no_tag_and_a_tag_beyond_the_pictures_edge() -> None:
    none, good = refine_corners(picture(), np.zeros((0, 4, 2)), np.zeros(0, dtype=np.int64))
    assert none.shape == (0, 4, 2)
    assert good.shape == (0,)
    cut = picture()[:, 230:]  # through the tag
    there = LEANING - [230.0, 0.0]
    found, good = refine_corners(cut, there[None], CELLS)
    assert good.tolist() == [False]
    np.testing.assert_array_equal(found[0], there)


def test_the_bending_of_sides_by_the_lens_is_modelled() -> None:
    case = Case("wide", side_px=160.0, off_axis_px=400.0)
    camera, taken = pictures_of(case, 3)
    with_lens, without = Errors(), Errors()
    for grey, true_px in taken:
        for errors, model in ((with_lens, camera), (without, None)):
            errors.add(refine_corners(grey, true_px[None], CELLS, model)[0][0], true_px)
    assert with_lens.rmse_px < 0.06
    assert with_lens.rmse_px < 0.4 * without.rmse_px


def test_the_detector_sharpens_and_says_so() -> None:
    plain, sharp = (TagDetector(refine=refine) for refine in (False, True))
    assert "corners=library" in plain.settings
    assert "corners=sides" in sharp.settings
    camera = CameraModel("c", 320, 240, 900.0, 900.0, 160.0, 120.0, "plumb_bob", (-0.9, 0.0, 0.0, 0.0, 0.0))
    other = TagDetector(camera=camera)  # of pictures of another size: nothing is known of this lens
    assert "corners=sides,lens" in other.settings
    (detected,), (found,), (of_other,) = (each.detect(picture()) for each in (plain, sharp, other))
    expected, _ = refine_corners(picture(), detected.corners_px[None], CELLS)
    np.testing.assert_array_equal(found.corners_px, expected[0])
    np.testing.assert_array_equal(of_other.corners_px, expected[0])
    assert np.abs(found.corners_px - detected.corners_px).max() > 0.005


def test_the_study_in_small() -> None:
    errors = study_case(CASES[0], 3)
    for detector in ("pupil-apriltags /2", "pyapriltags /1", "aruco"):
        assert errors[detector, "as detected"].n_pictures == 3
    for detector in ("pupil-apriltags /1", "pupil-apriltags /2"):
        assert errors[detector, "sides, lens"].rmse_px < 0.035
        assert errors[detector, "sides, lens"].rmse_px < errors[detector, "as detected"].rmse_px
    # A saddle is what cornerSubPix looks for; a tag's outer corners are none.
    assert errors["pupil-apriltags /1", "cornerSubPix"].rmse_px > 0.1
