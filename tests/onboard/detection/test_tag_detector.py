"""Whichever library finds a tag: the same corners, in the same order, by OpenCV's pixel convention."""

import importlib.util
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.onboard.detection.tag_detector import SMALLEST_SIDE_PX, TagDetector
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.recorder.robot_files import RobotFiles
from tests.support.devices.live_recording import robot_yaml
from tests.support.tag_pictures import draw_tag

LIBRARIES = [
    name
    for name, module in (("pupil-apriltags", "pupil_apriltags"), ("pyapriltags", "pyapriltags"))
    if importlib.util.find_spec(module)
]
LEANING = np.array([[200.3, 120.7], [330.6, 141.2], [321.4, 265.9], [190.8, 250.1]])


@pytest.mark.parametrize(("library", "decimate"), list(product(LIBRARIES, (1.0, 2.0))))
@pytest.mark.parametrize("turns", [0, 1, 2])
def test_corners_of_a_known_tag(library: str, decimate: float, turns: int) -> None:
    corners = np.roll(LEANING, turns, axis=0)  # the tag mounted turned by so many right angles
    found = TagDetector(["tag36h11"], library, decimate).detect(draw_tag("tag36h11", 17, corners))
    assert [(each.family, each.tag_id, each.hamming) for each in found] == [("tag36h11", 17, 0)]
    np.testing.assert_allclose(found[0].corners_px, corners, atol=0.15)
    # Half a pixel of convention is a shift of the mean; it must not hide in the tolerance of a single corner.
    np.testing.assert_allclose(np.mean(found[0].corners_px - corners, axis=0), 0.0, atol=0.05)
    assert found[0].decision_margin > 20
    assert library in TagDetector(["tag36h11"], library, decimate).library


@pytest.mark.parametrize("library", LIBRARIES)
def test_every_family_asked_for_is_found(library: str) -> None:
    left = draw_tag("tag36h11", 3, LEANING)
    right = draw_tag("tag25h9", 5, LEANING)
    found = TagDetector(["tag25h9", "tag36h11"], library, 1.0).detect(np.hstack([left, right]))
    assert [(each.family, each.tag_id) for each in found if each.hamming == 0] == [("tag25h9", 5), ("tag36h11", 3)]


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("shape", [(0, 0), (0, 640), (1, 1), (SMALLEST_SIDE_PX - 1, 640)])
def test_empty_and_tiny_pictures_hold_no_tag(library: str, shape: tuple[int, int]) -> None:
    assert TagDetector(["tag36h11"], library).detect(np.zeros(shape, np.uint8)) == []


def test_a_picture_in_colour_is_refused() -> None:
    with pytest.raises(OnboardError, match="must be grey"):
        TagDetector().detect(np.zeros((480, 640, 3), np.uint8))


@pytest.mark.parametrize(
    ("families", "library"), [(["tag36h10"], LIBRARIES[0]), ([], LIBRARIES[0]), (["tag36h11"], "aruco")]
)
def test_an_unusable_family_is_an_error(families: list[str], library: str) -> None:
    with pytest.raises(OnboardError, match=r"recorder\.(families|detector)"):
        TagDetector(families, library)


@pytest.mark.skipif(len(LIBRARIES) < 2, reason="only one library is installed")
def test_both_libraries_find_the_same_tags_and_corners_by_default() -> None:
    """So a robot on ARM and a laptop detect alike: what the libraries differ by is fitted away."""
    rng = np.random.default_rng(4)
    apart, plain_apart = list[FloatArray](), list[FloatArray]()
    for _ in range(20):
        corners = LEANING + rng.uniform(-15.0, 15.0, (4, 2)) + rng.uniform(-80.0, 80.0, 2)
        noisy = draw_tag("tag36h11", 17, corners) + rng.normal(0.0, 2.0, (480, 640))
        picture = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        for refine, differences in ((True, apart), (False, plain_apart)):
            one, other = (TagDetector(library=name, refine=refine).detect(picture) for name in LIBRARIES)
            assert [each.tag_id for each in one] == [each.tag_id for each in other] == [17]
            differences.append(np.abs(one[0].corners_px - other[0].corners_px))
    assert np.median(apart) < 0.001
    assert np.max(apart) < 0.05
    assert np.median(plain_apart) > 10.0 * np.median(apart)


def test_threads_of_robot_yaml_reach_the_detector(tmp_path: Path) -> None:
    robot = robot_yaml(tmp_path, "{camera: pictures}", "{detector_threads: 3}")
    assert "threads=3" in RobotFiles(robot).cameras[0].detector_settings.make().settings
