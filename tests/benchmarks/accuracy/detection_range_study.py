"""How large a tag must be in the picture to be found, in the dark and where the picture is blurred.

    python -m tests.benchmarks.accuracy.detection_range_study [--decimate 2] [--tags 40]

A row a brightness and blur: the grey level of a tag's white, the sigma of the blur, and the least side in pixels from
which on nine of ten tags are found, in any of `--tags` orientations. Tags are tag36h11, drawn in perspective with noise
of two grey levels. The page on the robot warns by these figures (docs/robot_page.md).
"""

import argparse
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.onboard.detection.tag_detector import TagDetector
from tests.benchmarks.command_line import say
from tests.support.tag_pictures import draw_tag

FAMILY: Final = "tag36h11"
SIDES_PX: Final = (12, 14, 16, 18, 20, 22, 25, 28, 32, 36, 40, 45, 50, 57, 64, 72, 80, 100, 120)
GAINS: Final = (1.0, 0.3, 0.15, 0.1, 0.07, 0.05, 0.03)
BLURS_PX: Final = (0.6, 1.0, 1.5, 2.0, 3.0, 4.0)
SHARE: Final = 0.9
_NOISE: Final = 2.0  # sigma of the sensor, grey levels
_WHITE_GREY: Final = 230  # of `draw_tag`
_DRAWN_BLUR_PX: Final = 0.6  # of `draw_tag`
_TILT: Final = 0.15  # of the side, by which corners are moved at random


def tag_picture(side_px: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """A tag of about that side, in a random orientation."""
    size = round(2.5 * side_px) + 20
    angle = rng.uniform(0.0, 2.0 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    bent = square + rng.uniform(-0.5, 0.5, (4, 2)) * _TILT
    corners_px = side_px * bent @ turn.T + size / 2.0 + rng.uniform(-0.5, 0.5, 2)
    return draw_tag(FAMILY, int(rng.integers(587)), corners_px, (size, size))


def degrade(picture: NDArray[np.uint8], gain: float, blur_px: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """The picture with less light and a blur of that sigma together with its own."""
    more_px = np.sqrt(max(blur_px**2 - _DRAWN_BLUR_PX**2, 0.0))
    blurred = cv2.GaussianBlur(picture.astype(np.float64), (0, 0), more_px) if more_px > 0.0 else picture
    noisy = gain * np.asarray(blurred, np.float64) + _NOISE * rng.standard_normal(picture.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def least_side_px(detector: TagDetector, gain: float, blur_px: float, n_tags: int) -> float:
    """The least side from which on nine of ten tags are found; infinite where none is."""
    rng = np.random.default_rng(1)
    least = np.inf
    for side_px in reversed(SIDES_PX):
        pictures = [degrade(tag_picture(side_px, rng), gain, blur_px, rng) for _ in range(n_tags)]
        if np.mean([len(detector.detect(each)) > 0 for each in pictures]) < SHARE:
            break
        least = side_px
    return least


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--decimate", type=float, default=2.0)
    parser.add_argument("--tags", type=int, default=40)
    arguments = parser.parse_args()
    detector = TagDetector((FAMILY,), quad_decimate=arguments.decimate)
    say(f"decimate {arguments.decimate:g}")
    say("white grey   blur px   least side px")
    for gain, blur_px in [*((gain, BLURS_PX[0]) for gain in GAINS), *((1.0, blur_px) for blur_px in BLURS_PX[1:])]:
        least = least_side_px(detector, gain, blur_px, arguments.tags)
        say(f"{gain * _WHITE_GREY:10.0f} {blur_px:9.1f} {least:15.0f}")


if __name__ == "__main__":
    main()
