"""What `salvage` refuses before it works, and which file it blames."""

from pathlib import Path

import pytest

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.logs.new_log import new_log
from groundsbot.offline.logs.salvaging import salvage
from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log.head import log_head
from groundsbot.onboard.log.losses import LogLosses
from groundsbot.onboard.log.messages import CompressedImage, TagDetections
from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.log.writing.writer import LogWriter
from tests.support.data.logs import CAMERA, ROBOT_YAML, START_NS, drive, write_log


def test_a_folder_is_no_single_file_and_no_work_is_done(tmp_path: Path) -> None:
    log = write_log(tmp_path / "run1", drive(0.2))
    with pytest.raises(
        OfflineError, match=r"x\.mcap: must name a new folder, without \.mcap, because .*run1 is a folder"
    ):
        salvage(log, tmp_path / "x.mcap")
    assert [each.name for each in tmp_path.iterdir()] == ["run1"]


def test_what_fails_elsewhere_is_not_blamed_on_the_output(tmp_path: Path) -> None:
    output = tmp_path / "new.mcap"
    with pytest.raises(OSError, match="Input/output error") as caught, new_log(output):
        raise OSError(5, "Input/output error", "old.mcap")
    assert not isinstance(caught.value, GroundsbotError)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["new.mcap", "new"])
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(GroundsbotError, match=f"{name}: cannot be written"), new_log(tmp_path / "file" / name):
        pytest.fail("is not reached")


def test_an_output_that_cannot_be_begun_is_not_blamed_on_the_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_log(tmp_path / "run1", drive(0.2))

    def full(*_: object, **__: object) -> None:
        raise LogError("0000.core.mcap: No space left on device")

    monkeypatch.setattr(LogWriter, "__init__", full)
    with pytest.raises(LogError, match="No space left on device"):
        salvage(log, tmp_path / "new")
    assert [each.name for each in tmp_path.iterdir()] == ["run1"]


def test_a_log_of_two_cameras_that_was_cut_short_keeps_all_of_both(tmp_path: Path) -> None:
    text = ROBOT_YAML + "cameras: {front: {camera: f}, left: {camera: l}}\n"
    head = log_head(parse_robot_yaml(text, "r"), text, {"front": CAMERA, "left": CAMERA}, "run1", START_NS, 5)
    writer = LogWriter(tmp_path / "run1", head, START_NS, keep_pictures=True, durable=False)
    for name in ("front", "left"):
        writer.write(f"/tags/{name}/detections", TagDetections(), START_NS, START_NS)
        writer.write(f"/camera/{name}/image", CompressedImage(data=b"x"), START_NS, START_NS)
    writer.flush()
    before = list(read_log(tmp_path / "run1", losses=LogLosses()))
    salvage(tmp_path / "run1", tmp_path / "whole")
    after = [each for each in read_log(tmp_path / "whole") if each.topic != "/events"]
    assert [each.topic for each in after].count("/tf") == 2
    assert sorted(after, key=str) == sorted(before, key=str)
