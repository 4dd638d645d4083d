"""`info` reports what a log holds."""

import json
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.robot.robot_yaml import Robot, Wheels
from groundsbot.offline.logs.info import LogInfo, describe_log
from groundsbot.onboard.log.messages import (
    CameraCalibration,
    Event,
    PlanarOdometry,
    RunInfo,
    TagDetection,
    TagDetections,
    WheelEncoders,
)
from groundsbot.onboard.log.writing.writer import LogWriter

MS = 1_000_000
ROBOT = Robot(
    robot_id="carl",
    wheels=Wheels.model_validate(
        {"radius_left_m": 0.1, "radius_right_m": 0.1, "track_m": 0.4, "ticks_per_turn": 1000.0}
    ),
)
START_NS = 1_800_000_000_000_000_000


def head() -> dict[str, RunInfo]:
    return {"/run": RunInfo(run_id="monday", robot_id="carl", software_version="9", robot_yaml=ROBOT.model_dump_json())}


def detections(at_ms: int, sequence: int, *tag_ids: int) -> tuple[int, str, TagDetections]:
    tags = [TagDetection(family="tag36h11", tag_id=tag_id, corners_px=[0.0] * 8) for tag_id in tag_ids]
    return at_ms, "/tags/detections", TagDetections(stamp_ns=at_ms * MS, frame_sequence=sequence, detections=tags)


def wheels(at_ms: int, ticks: int, boot_id: int = 1) -> tuple[int, str, WheelEncoders]:
    return at_ms, "/wheels", WheelEncoders(stamp_ns=at_ms * MS, boot_id=boot_id, ticks_left=ticks, ticks_right=ticks)


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """10 Hz of wheels with a gap of 0.7 s and a restart, five pictures of which one is lost."""
    messages = [wheels(100 * k, 10 * k) for k in range(11)]  # to 1.0 s
    messages += [wheels(1700 + 100 * k, 100 - 10 * k) for k in range(5)]  # backwards, to 2.1 s
    messages += [wheels(2200, 0, boot_id=2), wheels(2300, 50, boot_id=2)]
    entries = [*messages, *(detections(500 * k, k + (k > 2), *tags) for k, tags in enumerate([(7,), (), (7, 3), (3,)]))]
    entries.append((1700, "/events", Event(stamp_ns=1700 * MS, kind="wheel_gap", text="0.7 s")))
    log = tmp_path / "monday"
    with LogWriter(log, head(), START_NS, durable=False) as writer:
        for at_ms, topic, message in sorted(entries, key=lambda entry: entry[0]):
            writer.write(topic, message, START_NS + at_ms * MS, START_NS + at_ms * MS)
    return log


def test_a_drive_is_described(drive: Path) -> None:
    info = describe_log(drive)
    assert (info.run_id, info.robot_id, info.software_version) == ("monday", "carl", "9")
    assert info.duration_s == pytest.approx(2.3)
    assert info.start_utc == "2027-01-15 08:00:00 UTC"  # date --utc --date @1800000000
    metres_per_tick = 2 * np.pi * 0.1 / 1000
    assert info.distance_m == pytest.approx((100 + 40 + 50) * metres_per_tick)  # what the restart hides is not counted
    assert info.n_wheel_restarts == 1
    assert (info.n_pictures, info.n_pictures_lost) == (4, 1)
    assert info.tags == {"tag36h11": {3: 2, 7: 2}}
    assert info.events == {"wheel_gap": 1}
    assert {topic.topic: topic.count for topic in info.topics} == {
        "/run": 1,
        "/wheels": 18,
        "/tags/detections": 4,
        "/events": 1,
    }
    rates = {topic.topic: topic.rate_hz for topic in info.topics}
    assert rates["/tags/detections"] == pytest.approx(2.0)
    assert rates["/run"] is None
    (gap,) = info.gaps
    assert gap.topic == "/wheels"
    assert (gap.start_s, gap.duration_s) == pytest.approx((1.0, 0.7))
    assert info.file_bytes == {"0000.core.mcap": (drive / "0000.core.mcap").stat().st_size}


def test_each_camera_is_counted_by_itself(tmp_path: Path) -> None:
    calibrations = {f"/camera/{name}/calibration": CameraCalibration(K=[0.0] * 9) for name in ("left", "front")}
    log = tmp_path / "two.mcap"
    with LogWriter(log, {**head(), **calibrations}, START_NS, durable=False) as writer:
        for k in range(4):
            for name, sequence in (("left", k), ("front", 3 * k)):
                _, _, message = detections(100 * k, sequence, 7)
                at_ns = START_NS + 100 * k * MS
                writer.write(f"/tags/{name}/detections", message, at_ns, at_ns)
    info = describe_log(log)
    assert (info.n_pictures, info.n_pictures_lost, info.pictures_lost) == (8, 6, {"left": 0, "front": 6})
    assert [(each.topic, each.count) for each in info.topics[3:]] == [
        ("/tags/left/detections", 4),
        ("/tags/front/detections", 4),
    ]
    assert "  6 pictures of front lost, by the camera's own count" in info.lines()
    assert info.as_json()["pictures_lost"] == {"left": 0, "front": 6}
    assert info.tags == {"tag36h11": {7: 8}}


def test_json_and_text_have_the_same_content(drive: Path) -> None:
    info = describe_log(drive)
    data = json.loads(json.dumps(info.as_json(), allow_nan=False))
    assert data["run_id"] == "monday"
    assert data["tags"]["tag36h11"] == {"3": 2, "7": 2}
    text = "\n".join(info.lines())
    for wanted in (
        "robot carl, run monday",
        "2027-01-15 08:00:00 UTC, 2.3 s",
        "2 of tag36h11 in 4 observations: 3 7",
        "gap in /wheels: 0.70 s",
    ):
        assert wanted in text
    assert "1 picture lost" in text
    assert "restarted 1 time\n" in f"{text}\n"


def test_a_slow_log_has_no_gaps_at_its_own_pace(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "slow", head(), 0, durable=False) as writer:
        for k in range(6):
            distances = PlanarOdometry.WheelDistances(left_m=float(k), right_m=float(k))
            writer.write("/odometry", PlanarOdometry(stamp_ns=k, wheels=distances), k * 1000 * MS, k * 1000 * MS)
    info = describe_log(tmp_path / "slow")
    assert info.gaps == ()
    assert info.start_utc is None  # it began at zero
    assert info.lines()[2].startswith("  5.0 s, 5.00 m driven")
    assert info.distance_m == pytest.approx(5)
    assert info.n_pictures is None


def test_an_odometry_of_poses_has_a_distance(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "poses", head(), 0, durable=False) as writer:
        for k, (x_m, y_m) in enumerate([(0, 0), (3, 4), (3, 5)]):
            message = PlanarOdometry(stamp_ns=k, pose=PlanarOdometry.PoseInOdom(x_m=x_m, y_m=y_m))
            writer.write("/odometry", message, k * MS, k * MS)
    assert describe_log(tmp_path / "poses").distance_m == pytest.approx(6)


def test_a_log_whose_wheels_are_no_numbers_is_described_too(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "spoilt", head(), 0, durable=False) as writer:
        for k, left_m in enumerate([0.0, float("nan"), 1.0]):
            distances = PlanarOdometry.WheelDistances(left_m=left_m, right_m=0.5)
            writer.write("/odometry", PlanarOdometry(stamp_ns=k, wheels=distances), k * MS, k * MS)
    info = describe_log(tmp_path / "spoilt")
    assert json.loads(json.dumps(info.as_json(), allow_nan=False))["distance_m"] is None
    assert any("wheel readings are not finite, so no map can use it" in line for line in info.lines())


def test_a_log_of_nothing_is_described_too(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "nothing", head(), 0, durable=False):
        pass
    info: LogInfo = describe_log(tmp_path / "nothing")
    assert (info.duration_s, info.distance_m) == (0, None)
    assert any("no wheel readings" in line for line in info.lines())


@pytest.mark.parametrize("content", [b"", b"not a log", b"\x89MCAP0\r\n" + b"\x00" * 40])
def test_what_is_no_log_is_refused_by_name(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "some.mcap"
    path.write_bytes(content)
    with pytest.raises(GroundsbotError, match=r"some\.mcap: "):
        describe_log(path)


def test_a_log_cut_in_its_first_chunk_is_refused(drive: Path) -> None:
    file = drive / "0000.core.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 10])
    with pytest.raises(GroundsbotError, match=r"holds no /run message; .*0000\.core\.mcap"):
        describe_log(drive)


def test_what_is_left_of_a_log_cut_short_is_described(drive: Path) -> None:
    whole = describe_log(drive)
    file = drive / "0000.core.mcap"
    file.write_bytes(file.read_bytes()[:3600])
    info = describe_log(drive)
    assert 0 < info.duration_s < whole.duration_s
    assert any("0000.core.mcap: was never finished" in line for line in info.lines())
