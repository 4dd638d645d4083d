"""Several cameras on one robot: what happens to one leaves the others and the wheels alone. With a row of the table of
faults.
"""

import os
import shutil
import signal
from functools import partial
from pathlib import Path

import pytest

from groundsbot.fixtures.recording.devices import PictureFolder
from groundsbot.onboard.log.messages import (
    CameraCalibration,
    CompressedImage,
    EventKind,
    RunInfo,
    Severity,
    TagDetections,
    WheelEncoders,
)
from groundsbot.onboard.log.reading.reader import read_head, read_log
from groundsbot.onboard.log.writing.segments import SegmentLimits
from groundsbot.onboard.log.writing.storage import Disk
from groundsbot.onboard.recorder.disk.log_keeper import LogKeeper
from groundsbot.onboard.recorder.disk.room import DiskRoom, SpacePolicy
from groundsbot.onboard.recorder.event_limits import EventLimits
from tests.support.devices.live_recording import (
    Driver,
    Recording,
    check_gapless,
    recording,
    tag_jpeg,
    two_cameras_yaml,
    until,
)
from tests.support.devices.recorder_cores import MS, START_NS, events_of

_UNDER_WAY = 8  # pictures of a camera in detection


@pytest.fixture
def robot(tmp_path: Path) -> Path:
    """A robot with the cameras front and left, of which every picture is kept."""
    return two_cameras_yaml(tmp_path)


def detected(made: Recording, camera: str) -> int:
    return made.recorder.core.counts[f"/tags/{camera}/detections"]


def seen_of_front(made: Recording, times: int) -> bool:
    return detected(made, "front") + made.losses.get("pictures of front", 0) == times


def test_row_51_a_camera_whose_detection_hangs_or_that_is_unplugged_leaves_the_others_alone(
    tmp_path: Path, robot: Path
) -> None:
    front, left, picture = PictureFolder(tmp_path / "front"), PictureFolder(tmp_path / "left"), tag_jpeg()
    with Driver(tmp_path / "wheels") as driver:
        driver.plug_in()
        with recording(robot, tmp_path / "logs") as made:
            made.wait_for(EventKind.CAMERA_CONNECTED, 2)
            left.show(picture)
            until(lambda: detected(made, "left") == 1, "a picture of left")
            os.kill(made.recorder._detections[1]._detector._process.pid or 0, signal.SIGSTOP)
            for _ in range(_UNDER_WAY + 2):
                left.show(picture)
            until(lambda: len(made.recorder._detections[1]._under_way) == _UNDER_WAY, "a detection that is full")
            for n in range(1, _UNDER_WAY + 1):
                front.show(picture)
                until(partial(seen_of_front, made, n), f"{n} of front")
            assert detected(made, "front") == _UNDER_WAY
            shutil.rmtree(tmp_path / "left")
            made.wait_for(EventKind.CAMERA_LOST)
            front.show(picture)
            until(lambda: detected(made, "front") > _UNDER_WAY, "one more of front")
    assert not [what for what in made.losses if "front" in what or "wheel" in what]
    assert made.losses["pictures of left"] == _UNDER_WAY + 2
    (lost,) = events_of(made.log, EventKind.CAMERA_LOST)
    assert lost.text.startswith("left: folder of pictures")
    check_gapless(made.log, driver.refused)


def test_a_disk_that_is_too_slow_drops_pictures_of_all_cameras_alike_and_nothing_else(tmp_path: Path) -> None:
    head = {"/run": RunInfo(), **{f"/camera/{name}/calibration": CameraCalibration() for name in ("front", "left")}}
    disk = Disk(durable=False)
    keeper = LogKeeper(
        tmp_path / "run",
        head,
        START_NS,
        disk,
        DiskRoom(disk, tmp_path, "gb1", SpacePolicy()),
        keep_pictures=True,
        limits=SegmentLimits(),
    )
    for index in range(40):  # 80 MB while the disk takes nothing
        at_ns = START_NS + index * 10 * MS
        for topic in ("/camera/front/image", "/camera/left/image"):
            keeper.write(topic, CompressedImage(data=bytes(1_000_000)), at_ns, at_ns)
        assert keeper.write("/wheels", WheelEncoders(stamp_ns=at_ns), at_ns, at_ns)
        assert keeper.status.waiting_bytes < 20_000_000
    lost = keeper.status.lost
    assert lost.keys() == {"/camera/front/image", "/camera/left/image"}
    assert abs(lost["/camera/front/image"] - lost["/camera/left/image"]) <= 1
    keeper.finish(0.0)
    (note,) = (each for each in keeper.take_notes() if each.lost)
    assert note.lost == lost
    assert len(list(read_log(tmp_path / "run", ["/wheels"]))) == 40


def test_events_of_a_camera_with_a_loose_contact_hide_none_of_another() -> None:
    limits, kind, warning = EventLimits(), EventKind.CAMERA_LOST, Severity.SEVERITY_WARNING
    of_left = [limits.allows(kind, warning, "left: unplugged", START_NS, 0, "left") for _ in range(100)]
    assert 0 < sum(of_left) < 100
    assert limits.allows(kind, warning, "front: unplugged", START_NS, 0, "front")
    assert [(each.source, each.times) for each in limits.take()] == [("left", 100 - sum(of_left))]


def test_each_camera_has_its_own_detections_pictures_and_head(tmp_path: Path, robot: Path) -> None:
    front, left, picture = PictureFolder(tmp_path / "front"), PictureFolder(tmp_path / "left"), tag_jpeg()
    with recording(robot, tmp_path / "logs") as made:
        for shown in (front, left, left):
            shown.show(picture)
        until(lambda: (detected(made, "front"), detected(made, "left")) == (1, 2), "all pictures")
    found = list(read_log(made.log, ["/tags/detections", "/camera/image"]))
    pictures = {"front": 0, "left": 0}
    for each in found:
        name = each.topic.split("/")[2]
        if isinstance(each.message, TagDetections):
            assert [tag.tag_id for tag in each.message.detections] == [9]
        elif isinstance(each.message, CompressedImage):
            assert each.message.frame_id.endswith(f"/camera_{name}")
            pictures[name] += 1
    assert pictures == {"front": 1, "left": 2}
    assert {"/camera/front/calibration", "/camera/left/calibration", "/tf"} < read_head(made.log).keys()
