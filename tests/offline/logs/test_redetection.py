"""Tags looked for again in recorded pictures: new detections, all else as it was, the old log untouched."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.onboard.log.head import log_head
from groundsbot.onboard.log.messages import Event, EventKind, StampSource, TagDetection, TagDetections
from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.log.writing.writer import LogWriter
from tests.support.data.logs import CAMERA, MS, ROBOT_YAML, START_NS, Entry, picture_entry, wheel_entry, write_log
from tests.support.programs import Run
from tests.support.tag_pictures import draw_tag

CORNERS = np.array([[50.0, 30.0], [110.0, 32.0], [108.0, 92.0], [52.0, 90.0]])


def jpeg(tag_id: int, family: str = "tag36h11") -> bytes:
    return cv2.imencode(".jpg", draw_tag(family, tag_id, CORNERS, (120, 160)))[1].tobytes()


def old_detections(index: int, at_ns: int) -> Entry:
    """What a detector that saw something else had said."""
    tag = TagDetection(family="tag36h11", tag_id=99, corners_px=[0.0] * 8)
    message = TagDetections(
        stamp_ns=at_ns,
        frame_sequence=index,
        has_wheel_sequence=True,
        wheel_sequence=10 * index,
        width_px=160,
        height_px=120,
        detections=[tag],
        stamp_source=StampSource.STAMP_SOURCE_CAMERA,
    )
    return Entry("/tags/detections", message, at_ns + 9 * MS, at_ns)


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """Pictures 0, 2, 4 of tags 0, 2, 4 are kept, the last without detections; picture 6 is cut short."""
    entries = [wheel_entry(index, START_NS + index * 10 * MS) for index in range(100)]
    for index in range(8):
        at_ns = START_NS + index * 100 * MS + 5 * MS
        if index != 4:
            entries.append(old_detections(index, at_ns))
        if index in (0, 2, 4):
            entries.append(picture_entry(at_ns, jpeg(index)))
        if index == 6:
            entries.append(picture_entry(at_ns, jpeg(index)[:500]))
    return write_log(tmp_path / "run1", sorted(entries, key=lambda entry: entry.log_time_ns))


def tags_by_picture(log: Path) -> dict[int, list[int]]:
    """Tags by the number of their picture."""
    return {
        (each.message.stamp_ns - START_NS) // (100 * MS): [tag.tag_id for tag in each.message.detections]
        for each in read_log(log, ["/tags/detections"])
        if isinstance(each.message, TagDetections)
    }


def test_new_detections_and_all_else_as_it_was(recorded: Path, tmp_path: Path, run: Run) -> None:
    before = {path.name: path.read_bytes() for path in recorded.iterdir()}
    outcome = run("detect", recorded, "-o", tmp_path / "again", "--processes", 2)
    assert outcome.code == 3
    assert "1 pictures cannot be used" in outcome.out
    assert "4 older detections kept, of pictures not recorded" in outcome.out
    assert "4 pictures" in outcome.out
    assert tags_by_picture(tmp_path / "again") == {0: [0], 1: [99], 2: [2], 3: [99], 4: [4], 5: [99], 6: [99], 7: [99]}
    assert {path.name: path.read_bytes() for path in recorded.iterdir()} == before

    old, new = list(read_log(recorded)), list(read_log(tmp_path / "again"))
    others = [each for each in new if each.topic not in ("/tags/detections", "/events")]
    assert others == [each for each in old if each.topic != "/tags/detections"]
    kinds = [each.message.kind for each in new if isinstance(each.message, Event)]
    assert kinds == [EventKind.DETECTED_AGAIN]
    messages = {each.message.stamp_ns: each.message for each in new if isinstance(each.message, TagDetections)}
    for index in (2, 4):
        message = messages[START_NS + index * 100 * MS + 5 * MS]
        assert (message.width_px, message.height_px) == (160, 120)
        assert "quad_decimate=1" in message.detector_settings
        assert message.wheel_sequence == 10 * index  # of picture 4 found anew
        np.testing.assert_allclose(np.reshape(message.detections[0].corners_px, (4, 2)), CORNERS, atol=0.5)
    assert messages[START_NS + 205 * MS].stamp_source == StampSource.STAMP_SOURCE_CAMERA
    assert messages[START_NS + 205 * MS].frame_sequence == 2


def test_pictures_of_several_cameras_taken_at_one_time(tmp_path: Path, run: Run) -> None:
    """Each has its own detections, and its wheel sequence and number from its own old ones."""
    text = ROBOT_YAML + "cameras: {front: {camera: f}, left: {camera: l}}\n"
    head = log_head(parse_robot_yaml(text, "r"), text, {"front": CAMERA, "left": CAMERA}, "run1", START_NS, 5)
    with LogWriter(tmp_path / "run1", head, START_NS, keep_pictures=True, durable=False) as writer:
        for name, tag_id in (("front", 1), ("left", 2)):
            old = old_detections(tag_id, START_NS)
            writer.write(f"/tags/{name}/detections", old.message, START_NS, START_NS)
            for at_ns in (START_NS, START_NS + MS):  # the second has no old detections
                picture = picture_entry(at_ns, jpeg(tag_id)).message
                writer.write(f"/camera/{name}/image", picture, writer.last_log_time_ns, at_ns)
    assert run("detect", tmp_path / "run1", "-o", tmp_path / "again", "--processes", 1).code == 0
    found = [
        (each.topic, [tag.tag_id for tag in each.message.detections], each.message.frame_sequence)
        for each in read_log(tmp_path / "again", ["/tags/detections"])
        if isinstance(each.message, TagDetections)
    ]
    of_front, of_left = "/tags/front/detections", "/tags/left/detections"
    assert sorted(found) == [(of_front, [1], 0), (of_front, [1], 1), (of_left, [2], 0), (of_left, [2], 2)]


def test_an_empty_file_is_reported(tmp_path: Path, run: Run) -> None:
    entries = [wheel_entry(0, START_NS), picture_entry(START_NS + MS, jpeg(3))]
    log = write_log(tmp_path / "run1", entries)
    assert run("detect", log, "-o", tmp_path / "whole", "--processes", 1).code == 0
    (log / "0001.core.mcap").touch()
    outcome = run("detect", log, "-o", tmp_path / "again", "--processes", 1)
    assert outcome.code == 3
    assert "0001.core.mcap: not usable: is empty" in outcome.out
    assert tags_by_picture(tmp_path / "again") == {0: [3]}


def test_without_the_detections_of_pictures_that_were_not_kept(recorded: Path, tmp_path: Path, run: Run) -> None:
    output = tmp_path / "again.mcap"
    assert run("detect", recorded, "-o", output, "--processes", 1, "--drop-others", "--decimate", 2).code == 3
    assert tags_by_picture(output) == {0: [0], 2: [2], 4: [4], 6: [99]}  # picture 6 was kept, if of no use
    assert len(list(read_log(output, ["/wheels"]))) == 100


def test_another_family(recorded: Path, tmp_path: Path, run: Run) -> None:
    assert run("detect", recorded, "-o", tmp_path / "a", "--processes", 1, "--family", "tag25h9", "--drop-others").code
    assert tags_by_picture(tmp_path / "a") == {0: [], 2: [], 4: [], 6: [99]}


def test_what_cannot_be_is_one_line_and_leaves_nothing(recorded: Path, tmp_path: Path, run: Run) -> None:
    outcome = run("detect", recorded, "-o", recorded)
    assert (outcome.code, outcome.err.count("\n")) == (1, 1)
    assert "exists already" in outcome.err
    bare = write_log(tmp_path / "bare", [wheel_entry(0, START_NS)])
    outcome = run("detect", bare, "-o", tmp_path / "new")
    assert outcome.code == 1
    assert "holds no pictures" in outcome.err
    outcome = run("detect", recorded, "-o", tmp_path / "new", "--family", "tag99h1")
    assert outcome.code == 1
    assert "tag99h1" in outcome.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bare", "run1"]
