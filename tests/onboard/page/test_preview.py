"""The page's picture: small, with outlines, and with words on light and blur."""

import re

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from groundsbot.onboard.detection.tag_detector import Detection
from groundsbot.onboard.log.picture import decode, encode_jpeg
from groundsbot.onboard.page.preview import SideBySide, edge_sigma_px, make_preview
from tests.support.tag_pictures import draw_tag

CORNERS = np.array([[300.0, 200.0], [500.0, 210.0], [490.0, 410.0], [305.0, 400.0]])


def tag_picture(blur_px: float = 0.5) -> NDArray[np.uint8]:
    sharp = draw_tag("tag36h11", 9, CORNERS, (720, 1280))
    return np.asarray(cv2.GaussianBlur(sharp, (0, 0), blur_px), np.uint8)


def detection() -> Detection:
    return Detection("tag36h11", 9, 0, 80.0, CORNERS)


@pytest.mark.parametrize("blur_px", [1.0, 2.0, 4.0])
def test_the_blur_of_an_edge_is_measured(blur_px: float) -> None:
    drawn_px = np.hypot(0.6, np.sqrt(1.0 / 12.0))  # by draw_tag, and by the area of a pixel
    assert edge_sigma_px(tag_picture(blur_px), CORNERS) == pytest.approx(np.hypot(blur_px, drawn_px), rel=0.15)


def test_blur_by_motion_counts_although_half_of_the_sides_are_sharp() -> None:
    moved = np.asarray(cv2.blur(tag_picture(), (21, 1)), np.uint8)
    assert edge_sigma_px(moved, CORNERS) > 5.0


@pytest.mark.parametrize("encoded", [True, False])
def test_a_picture_becomes_small_with_outlines_in_place(encoded: bool) -> None:
    grey = tag_picture()
    preview = make_preview(encode_jpeg(grey, 90) if encoded else grey, [detection()], None)
    seen = decode(preview.jpeg)
    assert seen.shape == (360, 640, 3)
    green = (seen[..., 1].astype(int) - seen[..., 0] > 60) & (seen[..., 1].astype(int) - seen[..., 2] > 60)
    y, x = np.nonzero(green)
    assert (x.min(), x.max(), y.min(), y.max()) == pytest.approx((150, 250, 100, 205), abs=4)


def test_pictures_of_several_cameras_are_side_by_side_and_a_camera_without_one_is_black() -> None:
    dark = make_preview((tag_picture() // 16).astype(np.uint8), [], None)
    blurred = make_preview(tag_picture(4.0), [detection()], None)
    shown = SideBySide(["front", "left", "rear"])
    shown.add("front", blurred)
    shown.add("left", dark)
    joined = shown.take()
    assert joined is not None
    seen = decode(joined.jpeg)
    assert seen.shape == (720, 1280, 3)
    of_front, of_left, of_rear = seen[40:360, :640], seen[40:360, 640:], seen[400:, :640]
    assert np.abs(of_front.astype(int) - decode(blurred.jpeg)[40:]).mean() < 3.0
    assert np.abs(of_left.astype(int) - decode(dark.jpeg)[40:]).mean() < 3.0
    assert of_rear.max() < 10
    assert [each.partition(": ")[0] for each in joined.warnings] == ["front", "left"]
    assert joined.blur_px == blurred.blur_px
    assert shown.take() is None


def test_pictures_that_waited_are_shown_and_that_of_a_camera_which_stopped_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_s = [0.0]
    monkeypatch.setattr("groundsbot.onboard.page.preview.time.monotonic", lambda: now_s[0])
    shown, white = SideBySide(["front", "left"]), make_preview(tag_picture(), [], None)
    for camera in ("left", "front"):
        shown.add(camera, white)
        now_s[0] += 10.0
    joined = shown.take()
    assert joined is not None
    seen = decode(joined.jpeg)
    assert seen[40:360, :640].max() > 200
    assert seen[40:360, 640:].max() < 10


def test_a_good_picture_has_no_warnings() -> None:
    found = make_preview(tag_picture(), [detection()], 150.0)
    assert found.warnings == ()
    assert found.blur_px is not None
    assert found.blur_px < 1.5
    assert make_preview(tag_picture(), [], 150.0).blur_px is None


def test_dark_bright_and_blurred_pictures_are_warned_of() -> None:
    dark = (tag_picture() // 16).astype(np.uint8)
    (warning,) = make_preview(dark, [], 150.0).warnings
    assert warning == "too dark (bright parts have grey 11 of 255): tags will be missed; more light or exposure"
    assert make_preview((tag_picture() // 6).astype(np.uint8), [], 150.0).warnings == ()
    bright = np.maximum(tag_picture(), 252).astype(np.uint8)
    (warning,) = make_preview(bright, [], None).warnings
    assert warning.startswith("too bright (100 % of the picture is white)")
    blurred = tag_picture(5.0)
    (warning,) = make_preview(blurred, [detection()], None).warnings
    assert warning.startswith("blurred (edges of tags by 5.")
    assert re.search(r": tags with sides below 9\d px will be missed; drive slower", warning)
    (warning,) = make_preview(blurred, [detection()], 150.0).warnings
    assert re.search(r": tags beyond 1\.\d m will be missed; drive slower", warning)
