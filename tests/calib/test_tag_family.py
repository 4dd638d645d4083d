"""Our bit patterns, read back by the AprilTag library."""

import json
import subprocess
import sys
from typing import get_args

import numpy as np
import pytest

from groundsbot.calib.errors import CalibError
from groundsbot.calib.robot.fields import TagFamily
from groundsbot.calib.tags.family import families, family_size, tag_bits

# Detectors crash when they are taken down, so each lives in a process that leaves without doing so.
READ_BACK = """
import json, os, sys
import numpy as np
from pupil_apriltags import Detector
from groundsbot.calib.tags.family import family_size, tag_bits

family, cell, top, left = sys.argv[1], 10, 40, 50
detector = Detector(families=family, nthreads=1, quad_decimate=1.0)
found = []
for tag_id in range(0, family_size(family), 7):
    bits = tag_bits(family, tag_id)
    side = len(bits) * cell
    picture = np.full((side + 90, side + 110), 220, np.uint8)
    picture[top : top + side, left : left + side] = np.kron(bits, np.ones((cell, cell))) * 200 + 20
    found.append([[each.tag_id, each.hamming, each.corners.tolist()] for each in detector.detect(picture)])
print(json.dumps(found), flush=True)
os._exit(0)
"""


@pytest.mark.parametrize("family", families())
def test_the_library_reads_every_family_upright(family: str) -> None:
    pytest.importorskip("pupil_apriltags", reason="no wheel of pupil-apriltags for this machine")
    done = subprocess.run([sys.executable, "-c", READ_BACK, family], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    pictures = json.loads(done.stdout)
    assert len(pictures) == len(range(0, family_size(family), 7))
    side = 10 * len(tag_bits(family, 0))
    # Edges between pixels: the first dark column is 50, so the border begins at 49.5.
    left, top, right, bottom = 49.5, 39.5, 49.5 + side, 39.5 + side
    for tag_id, detections in zip(range(0, family_size(family), 7), pictures, strict=True):
        assert [(detection[0], detection[1]) for detection in detections] == [(tag_id, 0)]
        # On an upright tag the library begins bottom left and runs counter-clockwise; its pixels begin at their edge.
        ours = np.array(detections[0][2])[::-1] - 0.5
        expected = [[left, top], [right, top], [right, bottom], [left, bottom]]
        np.testing.assert_allclose(ours, np.array(expected), atol=0.25)


def test_a_pattern_handed_out_can_be_changed_without_harm() -> None:
    tag_bits("tag36h11", 3)[:] = True
    assert not tag_bits("tag36h11", 3).all()


def test_family_sizes_and_the_names_that_robot_yaml_knows() -> None:
    assert {family: family_size(family) for family in families()} == {"tag36h11": 587, "tag25h9": 35, "tag16h5": 30}
    assert get_args(TagFamily) == families()


@pytest.mark.parametrize(
    ("family", "tag_id", "words"),
    [
        ("tag36h11", 587, ["587", "tag36h11", "0 to 586"]),
        ("tag25h9", -1, ["-1", "0 to 34"]),
        ("tag36h12", 0, ["'tag36h12'", "tag36h11, tag25h9, tag16h5"]),
    ],
)
def test_an_unknown_family_or_id_is_an_error(family: str, tag_id: int, words: list[str]) -> None:
    with pytest.raises(CalibError) as caught:
        tag_bits(family, tag_id)
    for word in words:
        assert word in str(caught.value)
