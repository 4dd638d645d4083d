"""The recorder's core: what goes in with its times comes out in the log, the same to the byte each time."""

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.onboard.detection.tag_detector import Detection
from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log.messages import Event, EventKind, Severity, StampSource, TagDetections
from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.recorder.event_limits import EventLimits
from groundsbot.onboard.recorder.recorder import RecorderCore, RunIdentity
from groundsbot.onboard.wheels.protocol import WheelLine, format_line

ROBOT_YAML = """
robot_id: gb1
wheels: {radius_left_m: 0.05, radius_right_m: 0.05, track_m: 0.3, ticks_per_turn: 1024}
mount: {x_m: 0.1, z_m: 0.4, pitch_rad: -0.1}
camera: camera.yaml
recorder: {picture_rate_hz: PICTURES}
"""
CAMERA = CameraModel("front", 64, 48, 60.0, 61.0, 31.5, 23.5, "plumb_bob", (0.1, 0.0, 0.0, 0.0, 0.0))
START_NS = 1_800_000_000_000_000_000
MS = 1_000_000
S = 1_000_000_000
TAG = Detection("tag36h11", 4, 0, 55.5, np.array([[1.25, 2.0], [9.0, 2.5], [9.5, 9.0], [1.0, 8.75]]))


def make_core(folder: Path, pictures_hz: float = 0.0, camera: CameraModel | None = CAMERA) -> RecorderCore:
    text = ROBOT_YAML.replace("PICTURES", str(pictures_hz))
    run = RunIdentity(parse_robot_yaml(text, "robot.yaml"), text, camera, "run1", START_NS, START_NS - 5)
    return RecorderCore(folder, run, durable=False)


def wheel_bytes(index: int, boot_id: int = 7) -> bytes:
    return format_line(WheelLine(boot_id, index, index * 10_000 + 2**32 - 50_000, 13 * index, -14 * index, 0))


def drive(core: RecorderCore, n_lines: int = 200, skip: range = range(0)) -> int:
    """Lines every 10 ms, each a millisecond on its way; a picture every 100 ms, 5 ms after a reading."""
    now_ns = START_NS
    for index in range(n_lines):
        measured_ns = START_NS + index * 10 * MS
        now_ns = measured_ns + MS
        if index not in skip:
            core.on_serial_bytes(wheel_bytes(index), now_ns)
        if index % 10 == 0:
            stamp_ns = measured_ns + 5 * MS
            if core.wants_picture(stamp_ns):
                core.on_picture(b"\xff\xd8\xff jpeg \xff\xd9", stamp_ns, now_ns + 6 * MS)
            now_ns += 6 * MS
            core.on_detections([TAG], (64, 48), stamp_ns, now_ns, StampSource.STAMP_SOURCE_SIMULATION, index // 10)
        core.tick(now_ns)
    return now_ns


def events(folder: Path) -> list[Event]:
    return [each.message for each in read_log(folder, ["/events"]) if isinstance(each.message, Event)]


def test_every_line_and_picture_is_in_the_log_with_its_stamp(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    core.close(drive(core))
    log = list(read_log(tmp_path / "run1"))
    wheels = [each for each in log if each.topic == "/wheels"]
    assert [each.message.sequence for each in wheels] == list(range(200))  # type: ignore[attr-defined]  # of its topic
    # Both a millisecond of fixed delay: the mapping cannot know it. Device times are whole microseconds.
    stamps = np.array([each.publish_time_ns for each in wheels])
    assert np.abs(stamps - START_NS - MS - 10 * MS * np.arange(200)).max() < 5_000
    assert [each.log_time_ns for each in log] == sorted(each.log_time_ns for each in log)
    assert not core.losses
    frames = [each.message for each in log if each.topic == "/tags/detections"]
    assert [frame.frame_sequence for frame in frames] == list(range(20))  # type: ignore[attr-defined]  # of its topic
    assert frames[3].detections[0].corners_px == pytest.approx(TAG.corners_px.ravel())  # type: ignore[attr-defined]  # same


def test_detections_name_the_last_wheel_reading_measured_before_them(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    # The lines come in bursts of 20: when a picture's tags are known, the readings around it are still on their way.
    pending = b""
    for index in range(400):
        pending += wheel_bytes(index)
        now_ns = START_NS + index * 10 * MS + MS
        if index % 20 == 19:
            core.on_serial_bytes(pending, now_ns)
            pending = b""
        if index % 10 == 5:
            core.on_detections([], (64, 48), START_NS + index * 10 * MS - 4 * MS, now_ns, 5, index)
    core.close(START_NS + 4000 * MS)
    frames = [each.message for each in read_log(tmp_path / "run1", ["/tags/detections"])]
    named = {
        each.frame_sequence: each.wheel_sequence if each.has_wheel_sequence else None
        for each in frames
        if isinstance(each, TagDetections)
    }
    # The first two came before any reading, and waited no longer than what is to be safe after a second may.
    assert named == {index: index - 1 for index in range(5, 400, 10)} | {5: None, 15: None}


def test_while_wheels_are_silent_detections_wait_for_them_and_name_none(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    core.on_detections([TAG], (64, 48), START_NS, START_NS + MS, 5, 0)
    core.tick(START_NS + 350 * MS)
    assert core.counts["/tags/detections"] == 0
    core.tick(START_NS + 351 * MS)
    assert core.counts["/tags/detections"] == 1
    core.close(START_NS + 600 * MS)
    (found,) = read_log(tmp_path / "run1", ["/tags/detections"])
    assert not found.message.has_wheel_sequence  # type: ignore[attr-defined]  # of its topic


def test_same_calls_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        core = make_core(tmp_path / name, pictures_hz=5.0)
        core.close(drive(core))
    for file in ("0000.core.mcap", "0000.camera.mcap"):
        assert (tmp_path / "a/run1" / file).read_bytes() == (tmp_path / "b/run1" / file).read_bytes()


def test_pictures_are_kept_at_their_rate(tmp_path: Path) -> None:
    core = make_core(tmp_path, pictures_hz=5.0)  # of 10 a second
    core.close(drive(core))
    stamps = [each.publish_time_ns for each in read_log(tmp_path / "run1", ["/camera/image"])]
    assert stamps == [START_NS + 5 * MS + index * 200 * MS for index in range(10)]


def test_pictures_are_in_the_frame_of_the_runs_camera(tmp_path: Path) -> None:
    core = make_core(tmp_path, pictures_hz=5.0)
    core.close(drive(core))
    topics = ["/camera/image", "/camera/calibration", "/tf"]
    found = {each.topic: each.message for each in read_log(tmp_path / "run1", topics)}
    image, calibration, mount = (found[topic] for topic in topics)
    assert image.frame_id == calibration.frame_id == mount.child_frame_id == "gb1_run1/camera"  # type: ignore[attr-defined]  # of its topic
    assert mount.parent_frame_id == "gb1_run1/base"  # type: ignore[attr-defined]  # of its topic


def test_pictures_whose_times_jitter_are_kept_all_the_same(tmp_path: Path) -> None:
    core = make_core(tmp_path, pictures_hz=10.0)
    early_and_late_ms = [0, 30, -30, 35, -20, 0, 39, 0] * 4 + [600, 520, 440, 350, 260, 170, 80, 0]  # held up, and then
    kept = [core.wants_picture(START_NS + (100 * i + each) * MS) for i, each in enumerate(early_and_late_ms)]
    core.close(START_NS + 5 * S)
    assert all(kept)


def test_at_the_cameras_own_rate_every_picture_is_kept(tmp_path: Path) -> None:
    core = make_core(tmp_path, pictures_hz=15.0)
    assert all(core.wants_picture(START_NS + index * MS) for index in range(100))
    core.close(START_NS + S)


def test_lost_lines_are_counted_and_told(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    core.close(drive(core, 300, skip=range(150, 215)))
    assert core.losses == {"wheel lines": 65}
    told = [each for each in events(tmp_path / "run1") if each.kind == EventKind.WHEEL_GAP]
    assert [each.text for each in told] == [
        "no wheel reading for 0.660 s",
        "65 lines missing by their sequence numbers",
    ]
    assert [each.count for each in told] == [65, 65]


def test_a_controller_reset_is_an_event(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    now_ns = drive(core)
    for index in range(100):
        core.on_serial_bytes(wheel_bytes(index, boot_id=8), now_ns + (3000 + 10 * index) * MS)
    core.close(now_ns + 5000 * MS)
    assert core.losses == {"wheel controller resets": 1}
    assert [each.kind for each in events(tmp_path / "run1")] == [
        "recording_started",
        "wheel_reset",
        "recording_stopped",
    ]
    assert core.counts["/wheels"] == 300


def test_events_of_a_kind_are_limited_in_rate_and_those_above_it_counted(tmp_path: Path) -> None:
    """A controller that resets at each line must not fill the disk with events."""
    core = make_core(tmp_path)
    told: Counter[str] = Counter()
    n_lines, now_ns = 5000, START_NS
    for index in range(n_lines):
        now_ns = START_NS + index * 2 * MS
        core.on_serial_bytes(wheel_bytes(0, boot_id=index), now_ns)
        if index % 50 == 0:
            core.on_port_lost("unplugged", now_ns)
            core.on_port_connected("port", now_ns)
            core.tick(now_ns)
    core.close(now_ns + S)
    resets = [each for each in events(tmp_path / "run1") if each.kind == EventKind.WHEEL_RESET]
    assert 30 < len(resets) < 30 + 2 * 12
    assert sum(each.count for each in resets) == core.losses["wheel controller resets"] == n_lines - 1
    assert "more such events, the last: boot " in resets[-1].text
    assert core.written["/wheels"] == n_lines
    for each in events(tmp_path / "run1"):
        told[each.kind] += each.count or 1
    assert told[EventKind.PORT_LOST] == told[EventKind.PORT_CONNECTED] == n_lines // 50


def test_a_kind_of_events_does_not_limit_another_and_recovers() -> None:
    limits = EventLimits()

    def n_allowed(kind: EventKind, now_ns: int) -> int:
        return sum(limits.allows(kind, Severity.SEVERITY_WARNING, f"{index}", now_ns, 2) for index in range(40))

    assert n_allowed(EventKind.PORT_LOST, START_NS) == 30
    assert n_allowed(EventKind.CAMERA_LOST, START_NS) == 30
    assert [(each.kind, each.times, each.total, each.text) for each in limits.take()] == [
        (EventKind.PORT_LOST, 10, 20, "39"),
        (EventKind.CAMERA_LOST, 10, 20, "39"),
    ]
    assert n_allowed(EventKind.PORT_LOST, START_NS + 5 * S) == 5
    assert n_allowed(EventKind.PORT_LOST, START_NS + 6 * S) == 0  # none overtakes those that are held
    assert len(list(limits.take())) == 1
    assert n_allowed(EventKind.PORT_LOST, START_NS + 600 * S) == 30


def test_noise_and_repeated_lines_are_told_once_a_second(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    now_ns = drive(core)
    core.on_serial_bytes(b"garbage\r\n" * 5 + wheel_bytes(199), now_ns + MS)
    core.close(now_ns + 2 * MS)
    told = {each.kind: each.count for each in events(tmp_path / "run1")}
    assert told["wheel_line_rejected"] == 5
    assert told["wheel_sequence"] == 1
    assert core.counts["/wheels"] == 200


def test_a_picture_size_that_does_not_fit_the_calibration_is_one_event(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    for index in range(5):
        core.on_detections([], (128, 96), START_NS, START_NS + index * MS, 5, index)
    core.close(START_NS + 1000 * MS)
    (told,) = [each for each in events(tmp_path / "run1") if each.kind == EventKind.FRAME_SIZE]
    assert "128x96" in told.text
    assert "64x48" in told.text


def test_a_stamp_out_of_range_costs_that_message_only(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    core.on_detections([], (64, 48), -5, START_NS, 5, 0)
    core.close(drive(core))
    assert core.losses == {"messages refused": 1}
    assert core.counts["/tags/detections"] == 20
    assert "message_refused" in [each.kind for each in events(tmp_path / "run1")]


def test_a_run_of_wheels_only(tmp_path: Path) -> None:
    core = make_core(tmp_path, pictures_hz=5.0, camera=None)
    core.on_serial_bytes(b"".join(map(wheel_bytes, range(50))), START_NS)
    core.close(START_NS + MS)
    topics = [each.topic for each in read_log(tmp_path / "run1")]
    assert topics == ["/run", "/events", *["/wheels"] * 50, "/events"]


def test_a_run_is_never_written_over(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    with pytest.raises(LogError, match=r"0000\.core\.mcap\.active: a recording is running"):
        make_core(tmp_path)
    core.close(START_NS)
    with pytest.raises(LogError, match="exists already"):
        make_core(tmp_path)
    assert sorted(each.name for each in (tmp_path / "run1").iterdir()) == ["0000.core.mcap"]


def test_a_recording_to_which_the_wheels_never_spoke_has_lost_something(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    core.tick(START_NS + 4 * S)
    core.close(START_NS + 4 * S)
    assert core.losses == {"recording without a single wheel reading": 1}


def end_of(core: RecorderCore, from_ns: int) -> dict[str, int]:
    """Goes on for a minute without news, and closes."""
    for index in range(600):
        core.tick(from_ns + index * 100 * MS)
    core.close(from_ns + 60 * S)
    return dict(core.losses)


def test_a_port_that_does_not_come_back_is_a_loss_and_one_that_does_is_none(tmp_path: Path) -> None:
    for name, comes_back in (("gone", False), ("back", True)):
        core = make_core(tmp_path / name)
        now_ns = drive(core)
        core.on_port_lost("unplugged", now_ns)
        if comes_back:
            core.on_port_connected("port", now_ns)
            core.on_serial_bytes(wheel_bytes(200), now_ns + MS)
            core.close(now_ns + 2 * MS)
            assert not core.losses
        else:
            assert end_of(core, now_ns) == {
                "wheel port gone or silent at the end": 1,
                "camera gone or silent at the end": 1,
            }
            (told,) = [each.text for each in events(tmp_path / name / "run1") if each.kind == "recording_stopped"]
            assert "1 wheel port gone or silent at the end" in told


def test_a_port_lost_just_before_the_end_is_a_loss(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    now_ns = drive(core)
    core.on_port_lost("unplugged", now_ns)
    core.close(now_ns + MS)
    assert core.losses == {"wheel port gone or silent at the end": 1}


def test_a_camera_that_never_comes_or_does_not_come_back_is_a_loss(tmp_path: Path) -> None:
    run = RunIdentity(parse_robot_yaml(ROBOT_YAML.replace("PICTURES", "0"), "r"), "", CAMERA, "run1", START_NS, 0)
    for name, said in (
        ("never", {"recording without a single picture": 1}),
        ("lost", {"camera gone or silent at the end": 1}),
        ("over", {}),
        ("silent", {"camera gone or silent at the end": 1}),
    ):
        core = RecorderCore(tmp_path / name, run, durable=False, expect_wheels=False, expect_camera=True)
        if name != "never":
            core.on_camera_connected("camera", [], START_NS)
            core.on_detections([], (64, 48), START_NS, START_NS + MS, StampSource.STAMP_SOURCE_CAMERA, 0)
        if name in ("lost", "over"):
            core.on_camera_lost("unplugged, or a film's end", START_NS + 2 * MS, at_its_end=name == "over")
        assert end_of(core, START_NS + 3 * MS) == said


def test_without_a_port_in_robot_yaml_detections_wait_for_nothing(tmp_path: Path) -> None:
    run = RunIdentity(parse_robot_yaml(ROBOT_YAML.replace("PICTURES", "0"), "r"), "", CAMERA, "run1", START_NS, 0)
    core = RecorderCore(tmp_path, run, durable=False, expect_wheels=False)
    core.on_detections([TAG], (64, 48), START_NS, START_NS + MS, StampSource.STAMP_SOURCE_CAMERA, 0)
    assert core.counts["/tags/detections"] == 1
    core.close(START_NS + S)
