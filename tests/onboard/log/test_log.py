"""Logs: each file opens alone, any MCAP tool reads them, and a reader never returns a wrong message."""

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.writer import MCAP0_MAGIC, Writer

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.robot.camera_section import Mount
from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.onboard.errors import LogError, MessageRefusedError
from groundsbot.onboard.log.head import RunFrames, camera_from_message, log_head, mount_message
from groundsbot.onboard.log.messages import (
    CameraCalibration,
    ClockAnchor,
    CompressedImage,
    Event,
    FrameTransform,
    RunInfo,
    TagDetections,
    WheelEncoders,
    timestamp,
)
from groundsbot.onboard.log.reading.reader import find_logs, read_head, read_log
from groundsbot.onboard.log.writing.segments import SegmentLimits
from groundsbot.onboard.log.writing.writer import LogWriter
from tests.support.data.logs import run_info_of

START_NS = 1_800_000_000_000_000_000
MS = 1_000_000
CAMERA = CameraModel(
    "camera", 640, 480, 600.0, 601.0, 320.5, 239.5, "rational_polynomial", tuple(0.01 * i for i in range(8))
)
ROBOT_YAML = """
robot_id: gb1
wheels: {radius_left_m: 0.05, radius_right_m: 0.05, track_m: 0.3, ticks_per_turn: 1024}
mount: {x_m: 0.1, y_m: -0.02, z_m: 0.4, pitch_rad: 0.1, yaw_rad: 0.2}
"""


def write_run(folder: Path, run_id: str = "run1", n: int = 300, pictures: bool = True) -> Path:
    robot = parse_robot_yaml(ROBOT_YAML, "robot.yaml")
    head = log_head(robot, ROBOT_YAML, CAMERA, run_id, START_NS, 5)
    with LogWriter(folder / run_id, head, START_NS, keep_pictures=pictures, durable=False) as writer:
        for index in range(n):
            at_ns = START_NS + index * 10 * MS
            writer.write(
                "/wheels", WheelEncoders(stamp_ns=at_ns, sequence=index, ticks_left=7 * index), at_ns + MS, at_ns
            )
            if pictures and index % 10 == 5:
                picture = CompressedImage(
                    timestamp=timestamp(at_ns), data=b"\xff\xd8\xff\xd9", format="jpeg", frame_id="camera"
                )
                writer.write("/camera/image", picture, at_ns + 2 * MS, at_ns)
    return folder / run_id


def test_a_run_folder_reads_as_one_log_in_order(tmp_path: Path) -> None:
    run = write_run(tmp_path)
    assert sorted(path.name for path in run.iterdir()) == ["0000.camera.mcap", "0000.core.mcap"]
    log = list(read_log(run))
    assert [each.topic for each in log[:4]] == ["/run", "/camera/calibration", "/tf", "/wheels"]
    assert [each.log_time_ns for each in log] == sorted(each.log_time_ns for each in log)
    counts = {topic: sum(each.topic == topic for each in log) for topic in {each.topic for each in log}}
    assert counts == {"/run": 1, "/camera/calibration": 1, "/tf": 1, "/wheels": 300, "/camera/image": 30}
    wheels = [each for each in log if each.topic == "/wheels"]
    assert [each.message for each in wheels[:2]] == [
        WheelEncoders(stamp_ns=START_NS, sequence=0),
        WheelEncoders(stamp_ns=START_NS + 10 * MS, sequence=1, ticks_left=7),
    ]
    assert wheels[1].publish_time_ns == START_NS + 10 * MS


def test_a_chunk_of_thousands_of_messages_is_read_whole(tmp_path: Path) -> None:
    head = log_head(parse_robot_yaml(ROBOT_YAML, "robot.yaml"), ROBOT_YAML, CAMERA, "run1", START_NS, 5)
    with LogWriter(tmp_path / "run1", head, START_NS, keep_pictures=False, durable=False) as writer:
        for index in range(2500):
            at_ns = START_NS + index
            writer.write("/wheels", WheelEncoders(stamp_ns=at_ns, ticks_left=index), at_ns, at_ns)
    wheels = [each.message for each in read_log(tmp_path / "run1", ["/wheels"])]
    assert wheels == [WheelEncoders(stamp_ns=START_NS + index, ticks_left=index) for index in range(2500)]


def test_each_file_opens_alone(tmp_path: Path) -> None:
    run = write_run(tmp_path)
    for name in ("0000.core.mcap", "0000.camera.mcap"):
        assert [each.topic for each in read_log(run / name)][:3] == ["/run", "/camera/calibration", "/tf"]
        assert run_info_of(run / name).robot_yaml == ROBOT_YAML
    assert run_info_of(run).run_id == "run1"


def test_two_cameras_have_their_own_topics_in_every_file(tmp_path: Path) -> None:
    """Calibration and mount of each at the head, once for the reader, and no topic without a camera's name."""
    text = ROBOT_YAML.replace("mount: {", "cameras: {front: {camera: f, mount: {").rstrip() + "}, left: {camera: l}}\n"
    head = log_head(parse_robot_yaml(text, "robot.yaml"), text, {"front": CAMERA, "left": CAMERA}, "run1", START_NS, 5)
    run = tmp_path / "run1"
    with LogWriter(run, head, START_NS, keep_pictures=True, limits=SegmentLimits(MS)) as writer:
        for index, name in enumerate(("front", "left", "left")):
            at_ns = START_NS + index * MS
            writer.write(f"/tags/{name}/detections", TagDetections(stamp_ns=at_ns), at_ns, at_ns)
            writer.write(f"/camera/{name}/image", CompressedImage(data=b"x"), at_ns, at_ns)
        with pytest.raises(LogError, match="head has no calibration of that camera"):
            writer.write("/camera/image", CompressedImage(), START_NS + 3 * MS, START_NS)
    heads = ["/run", "/camera/front/calibration", "/camera/left/calibration", "/tf", "/tf"]
    for file in sorted(run.iterdir()):
        with file.open("rb") as stream:
            channels = make_reader(stream).get_summary().channels.values()  # type: ignore[union-attr]  # it has one
        assert not {each.topic for each in channels} & {"/camera/image", "/camera/calibration", "/tags/detections"}
        assert [each.topic for each in read_log(file)][:5] == heads
    assert [each.topic for each in read_log(run)].count("/tf") == 2
    mounts = read_head(run)["/tf"]
    assert not isinstance(mounts, Message)
    frames = [each.child_frame_id for each in mounts if isinstance(each, FrameTransform)]
    assert frames == ["gb1_run1/camera_front", "gb1_run1/camera_left"]
    assert [each.topic[6:10] for each in read_log(run, ["/tags/detections"])] == ["fron", "left", "left"]
    assert len(list(read_log(run, ["/camera/left/image"]))) == 2


def test_only_the_topics_asked_for(tmp_path: Path) -> None:
    run = write_run(tmp_path)
    (run / "0000.camera.mcap").write_bytes(b"")  # not opened unless pictures are asked for
    assert {each.topic for each in read_log(run, ["/wheels"])} == {"/wheels"}
    assert [each.topic for each in read_log(run, ["/tf", "/events"])] == ["/tf"]
    with pytest.raises(LogError, match=r"0000\.camera\.mcap: is empty"):
        list(read_log(run, ["/camera/image"]))


def test_one_file_for_all_topics(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "drive.mcap"
    with LogWriter(path, {"/run": RunInfo(run_id="a")}, 5) as writer:
        writer.write("/camera/image", CompressedImage(data=b"x"), 6, 6)
        writer.write("/clock", ClockAnchor(stamp_ns=7), 7, 7)
    assert [each.topic for each in read_log(path)] == ["/run", "/camera/image", "/clock"]
    assert [each.name for each in path.parent.iterdir()] == ["drive.mcap"]


def test_a_decoder_that_knows_foxgloves_schemas_only(tmp_path: Path) -> None:
    """The plain mcap reader, and classes built from the schemas in the file: none of our code."""
    run = write_run(tmp_path)
    found = {}
    for name in ("0000.core.mcap", "0000.camera.mcap"):
        with (run / name).open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                assert schema is not None
                if schema.name.startswith("foxglove."):
                    found[channel.topic] = decode_by_schema(schema.data, schema.name, message.data)
    assert set(found) == {"/camera/image", "/camera/calibration", "/tf"}
    image, calibration, mount = (found[topic] for topic in ("/camera/image", "/camera/calibration", "/tf"))
    assert (image.format, image.frame_id, image.data[:2]) == ("jpeg", "camera", b"\xff\xd8")  # type: ignore[attr-defined]  # built at run time
    assert (calibration.width, calibration.K[0], len(calibration.D)) == (640, 600.0, 8)  # type: ignore[attr-defined]  # same
    assert list(calibration.P[:3]) == [600.0, 0.0, 320.5]  # type: ignore[attr-defined]  # same
    frames = (mount.parent_frame_id, mount.child_frame_id)  # type: ignore[attr-defined]  # same
    assert frames == ("gb1_run1/base", "gb1_run1/camera")
    assert mount.translation.x == 0.1  # type: ignore[attr-defined]  # same


def decode_by_schema(schema: bytes, name: str, data: bytes) -> object:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name)).FromString(data)


def test_stamps_in_the_message_and_around_it_agree(tmp_path: Path) -> None:
    for each in read_log(write_run(tmp_path), ["/wheels", "/camera/image"]):
        message = each.message
        inside = message.timestamp.ToNanoseconds() if isinstance(message, CompressedImage) else message.stamp_ns  # type: ignore[attr-defined]  # wheels
        assert inside == each.publish_time_ns


def test_the_camera_comes_back_out_of_the_log(tmp_path: Path) -> None:
    messages = [each.message for each in read_log(write_run(tmp_path), ["/camera/calibration"])]
    assert [camera_from_message(each) for each in messages if isinstance(each, CameraCalibration)] == [CAMERA]
    with pytest.raises(LogError, match="K has 0 numbers"):
        camera_from_message(CameraCalibration())


def test_the_mount_takes_points_in_camera_to_base() -> None:
    message = mount_message(Mount(x_m=0.1, z_m=0.4), 0, RunFrames("base", "camera"))  # level and straight ahead
    rotation = message.rotation
    # The camera's z (forward) is the base's x, its x (right) the base's -y: a turn by 120 degrees.
    assert [rotation.x, rotation.y, rotation.z, rotation.w] == pytest.approx([-0.5, 0.5, -0.5, 0.5])
    assert isinstance(message, FrameTransform)


def test_nothing_is_refused_half(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "r", {"/run": RunInfo(run_id="a")}, 10, durable=False) as writer:
        writer.write("/clock", ClockAnchor(stamp_ns=1), 20, 20)
        for log_ns, publish_ns in ((-1, 20), (20, -1), (2**63, 20), (20, 2**64)):
            with pytest.raises(MessageRefusedError, match="must lie in"):
                writer.write("/clock", ClockAnchor(), log_ns, publish_ns)
        with pytest.raises(LogError, match="before the last"):
            writer.write("/clock", ClockAnchor(), 19, 19)
        with pytest.raises(LogError, match=r"holds groundsbot\.ClockAnchor, not groundsbot\.Event"):
            writer.write("/clock", Event(), 21, 21)
        with pytest.raises(LogError, match="no such topic"):
            writer.write("/clocks", ClockAnchor(), 21, 21)
        with pytest.raises(LogError, match="keeps no pictures"):
            writer.write("/camera/image", CompressedImage(), 21, 21)
        writer.write("/clock", ClockAnchor(stamp_ns=2), 21, 21)
    assert [each.log_time_ns for each in read_log(tmp_path / "r")] == [10, 20, 21]


def test_half_a_second_after_it_came_a_message_is_in_the_file(tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "r", {"/run": RunInfo(run_id="a")}, START_NS)
    active = tmp_path / "r" / "0000.core.mcap.active"
    for index in range(200):
        writer.write("/clock", ClockAnchor(stamp_ns=index), START_NS + index * 10 * MS, START_NS)
        if index % 50 == 1:
            cut = tmp_path / f"cut{index}.mcap"
            cut.write_bytes(active.read_bytes())
            stamps = stamps_of_a_torn_file(cut)
            assert stamps == list(range(len(stamps)))
            assert len(stamps) >= index - 50
    writer.close()
    writer.close()
    assert not active.exists()


def stamps_of_a_torn_file(path: Path) -> list[int]:
    stamps: list[int] = []
    clock = (each.message for each in read_log(path, ["/clock"]))
    with pytest.raises(LogError, match="cut short or never finished"):
        stamps.extend(each.stamp_ns for each in clock if isinstance(each, ClockAnchor))
    return stamps


def test_what_was_discarded_leaves_nothing(tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "r", {"/run": RunInfo(run_id="a")}, 0, keep_pictures=True)
    writer.discard()
    assert list((tmp_path / "r").iterdir()) == []
    with pytest.raises(LogError, match="without /run"):
        LogWriter(tmp_path / "r", {}, 0)
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="cannot write a log here"):
        LogWriter(tmp_path / "file", {"/run": RunInfo()}, 0)


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda data: b"", "is empty"),
        (lambda data: b"t_s,tag_id\n1,2\n" * 9, "is not an MCAP file"),
        (lambda data: data[:8], "ends at byte 8"),
        (lambda data: data[: len(data) // 4], "does not fit in the file|cut short"),
        (lambda data: data[:2000] + b"\0" * 6000, "damaged|cut short|not fit"),
    ],
)
def test_damage_is_one_clear_line(tmp_path: Path, damage: Callable[[bytes], bytes], expected: str) -> None:
    path = write_run(tmp_path, pictures=False) / "0000.core.mcap"
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(LogError, match=expected) as caught:
        list(read_log(path))
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("claimed", [100, 100 << 20])
def test_a_zstd_bomb_is_refused_before_it_unfolds(tmp_path: Path, claimed: int) -> None:
    data = zstandard.compress(b"\0" * (100 << 20))
    builder = RecordBuilder()
    Chunk("zstd", data, 0, 0, 1, claimed).write(builder)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(MCAP0_MAGIC + builder.end())  # type: ignore[no-untyped-call]  # mcap leaves it unannotated
    tracemalloc.start()
    with pytest.raises(LogError, match=r"limit|not the 100 bytes"):
        list(read_log(path))
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak_bytes < 10 << 20


def foreign_log(path: Path, topic: str, schema: str, first: bool) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        if first:
            run = writer.register_channel(
                "/run", "protobuf", writer.register_schema("groundsbot.RunInfo", "protobuf", b"")
            )
            writer.add_message(run, 0, RunInfo(run_id="a").SerializeToString(), 0)
        channel = writer.register_channel(topic, "protobuf", writer.register_schema(schema, "protobuf", b""))
        writer.add_message(channel, 0, b"", 0)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it unannotated


def test_a_topic_with_another_schema_and_a_log_without_run(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    foreign_log(path, "/wheels", "std_msgs.String", first=True)
    with pytest.raises(LogError, match=r"topic /wheels holds std_msgs\.String .* must be groundsbot\.WheelEncoders"):
        list(read_log(path))
    foreign_log(path, "/wheels", "groundsbot.WheelEncoders", first=False)
    with pytest.raises(LogError, match="does not begin with /run"):
        list(read_log(path))
    foreign_log(path, "/somebody/elses", "std_msgs.String", first=True)
    assert [each.topic for each in read_log(path)] == ["/run"]


def test_files_of_two_runs_in_one_folder(tmp_path: Path) -> None:
    run = write_run(tmp_path, "run1")
    other = write_run(tmp_path, "run2", pictures=False)
    (other / "0000.core.mcap").rename(run / "0001.core.mcap")
    with pytest.raises(LogError, match=r"0000\.core\.mcap belongs to run run1, 0001\.core\.mcap to run2"):
        list(read_log(run))


def test_what_a_log_argument_means(tmp_path: Path) -> None:
    runs = [write_run(tmp_path / robot, run, 3) for robot in ("b", "a") for run in ("r1", "r0")]
    assert find_logs([tmp_path]) == sorted(runs)
    assert find_logs([runs[0], tmp_path / "a"]) == [runs[0], *sorted(runs[2:])]
    file = runs[0] / "0000.core.mcap"
    assert find_logs([file]) == [file]
    with pytest.raises(LogError, match="no such log"):
        find_logs([tmp_path / "gone"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match=r"holds no \.mcap file"):
        find_logs([tmp_path / "empty"])
    LogWriter(tmp_path / "empty" / "r", {"/run": RunInfo(run_id="a")}, 0)
    assert find_logs([tmp_path / "empty"]) == [tmp_path / "empty" / "r"]  # unfinished, and used as far as it goes
