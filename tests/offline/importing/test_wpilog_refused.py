"""WPILib logs that cannot become a run: one line that says why and what to do, exit 1, nothing written."""

import re
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.support.data.importing.wpilogs import (
    MODULES,
    N_ROWS,
    PERIOD_US,
    PHOTON_2025,
    START_US,
    DataLog,
    add_modules,
    add_photon,
    add_speeds,
    as_record,
    good,
    packet_2024,
    packet_2025,
    pictures,
    poses,
    stamps_us,
)
from tests.support.programs import Run

AT = " ".join(f"{x},{y}" for x, y in MODULES)
Make = Callable[[], bytes]
SPEEDS, TAGS = "/Drive/ActualSpeeds", "/photonvision/front/rawBytes"


def changed(at: int, value: bytes) -> Make:
    def make() -> bytes:
        content = good().content()
        return content[:at] + value + content[at + len(value) :]

    return make


def with_record(raw: bytes) -> Make:
    """A record in the middle of a good log."""

    def make() -> bytes:
        log = good()
        log.records.insert(len(log.records) // 2, raw)
        return log.content()

    return make


def with_speed(stamp_us: int, payload: bytes) -> Make:
    def make() -> bytes:
        log = good()
        log.add(SPEEDS, "", stamp_us, payload)
        return log.content()

    return make


def with_packet(payload: bytes, type_: str = "rawBytes") -> Make:
    def make() -> bytes:
        log = DataLog()
        add_speeds(log)
        log.add(TAGS, type_, START_US, payload)
        return log.content()

    return make


def only(*parts: Callable[[DataLog], None]) -> Make:
    def make() -> bytes:
        log = DataLog()
        for part in parts:
            part(log)
        return log.content()

    return make


def modules(log: DataLog) -> None:
    add_modules(log, "/Drive/Modules", "SwerveModulePosition[]")


def targets(log: DataLog) -> None:
    add_speeds(log, "/Drive/TargetSpeeds")


def of_field(log: DataLog) -> None:
    add_speeds(log, "/Drive/FieldRelativeSpeeds")


def other_schema(log: DataLog) -> None:
    log.add("/.schema/struct:ChassisSpeeds", "structschema", 0, b"double vx;double vy;double omega;double slip")


def no_tags(log: DataLog) -> None:
    log.add(TAGS, "rawBytes", START_US, packet_2024([]))


def robot_poses(log: DataLog) -> None:
    log.doubles("/Vision/EstimatedPoses", "struct:Pose3d[]", START_US, np.ones(7))


def before_the_start(log: DataLog) -> None:
    log.doubles(SPEEDS, "struct:ChassisSpeeds", -5, [0.0, 0.0, 0.0])


def long_before(log: DataLog) -> None:
    for k in range(3):
        log.doubles(SPEEDS, "struct:ChassisSpeeds", k, [0.1, 0.0, 0.0])


def reset_pose(log: DataLog) -> None:
    for stamp, pose in zip(stamps_us(), poses(), strict=True):
        far = 15.0 * (stamp > START_US + 2_000_000)
        log.doubles("/Drive/Pose", "struct:Pose2d", stamp, pose + np.array([far, 0.0, 0.0]))


def yaw(name: str, scale: float = 1.0) -> Callable[[DataLog], None]:
    def add(log: DataLog) -> None:
        for k in range(N_ROWS):
            log.doubles(name, "double", START_US + k * PERIOD_US, [scale * 0.01 * k])

    return add


def fiducials(log: DataLog) -> None:
    log.doubles("NT:/limelight/rawfiducials", "double[]", START_US, [4.0, 1.0, 2.0])


def impossible_fiducial(log: DataLog) -> None:
    log.doubles("NT:/limelight/rawfiducials", "double[]", START_US, [4.0, 1.0, 2.0, 0.1, -3.0, 2.0, 0.1])


def huge_ids(log: DataLog) -> None:
    _, corners, places = pictures()[0]
    for tag_id in corners:
        log.add(TAGS, "rawBytes", START_US, packet_2024([(tag_id + 5000, corners[tag_id], places[tag_id])]))


def no_focal_length(log: DataLog) -> None:
    add_photon(log, camera=False)
    log.doubles("/photonvision/front/cameraIntrinsics", "double[]", 1, [0.0, 0, 640, 0, 900, 360, 0, 0, 1])


_NAN = np.array([np.nan, 0.0, 0.0]).tobytes()
_START_OF_NOTHING = struct.pack("<BII", 0, 9, 1000)

# By case: how the log is made, what is said, and the options.
BAD: dict[str, tuple[Make, str, *tuple[str, ...]]] = {
    "empty": (lambda: b"", r"is empty; copy the log from the robot again"),
    "no log": (lambda: b"PK\x03\x04 something else", r"does not begin with WPILOG"),
    "cut in its header": (lambda: good().content()[:9], r"ends within its header, after 9 bytes"),
    "another version": (changed(6, b"\x00\x02"), r"DataLog version 2\.0, only 1\.0 is known"),
    "a header longer than the file": (changed(8, b"\xff\xff\xff\x7f"), r"header claims 2147483647 bytes of text"),
    "cut after its header": (lambda: good().content()[:12], r"no odometry: no ChassisSpeeds"),
    "cut before its tags": (lambda: good().content()[:2000], r"no tags: none of its topics holds PhotonVision"),
    "a record that reaches beyond": (
        lambda: with_record(b"\x0c\x01" + struct.pack("<I", 1 << 30) + b"\x01")() + bytes(range(1, 256)) * 300,
        r"damaged: the record at byte \d+ claims 1073741824 bytes, \d+ are left; copy",
    ),
    "a record of no topic": (with_record(as_record(77, 5, b"abc")), r"belongs to entry 77, which was never started"),
    "a control record of no kind": (with_record(as_record(0, 5, b"\x09abc")), r"control record of kind 9, must be"),
    "a topic without its name": (
        with_record(as_record(0, 5, _START_OF_NOTHING)),
        r"starts a topic, and is too short for the topic's name and type",
    ),
    "a name without end": (
        with_record(as_record(0, 5, struct.pack("<BII", 0, 9, 9000) + bytes(9000) + bytes(8))),
        r"starts a topic whose name has 9000 bytes, limit 4096",
    ),
    "a stamp of centuries": (with_speed(1 << 60, bytes(24)), r"has the stamp 1\.153e\+12 s, the limit is ten years"),
    "half a struct": (with_speed(START_US + 1, bytes(20)), r"at 5\.000 s has 20 bytes, must have 24"),
    "a speed that is none": (with_speed(START_US + 1, _NAN), r"at 5\.000 s has a number that is not finite"),
    "a robot like a bullet": (
        with_speed(START_US + 9_000_000, np.array([900.0, 0.0, 0.0]).tobytes()),
        r"the robot moves .* limits 20 m/s, 50 rad/s; was the odometry reset\? choose another topic",
    ),
    "a struct of another schema": (
        only(other_schema, add_speeds, add_photon),
        r"the log's ChassisSpeeds is 'double vx;double vy;double omega;double slip', known is",
    ),
    "an odometry from before the start": (only(before_the_start, add_photon), r"no record after the robot's start"),
    "odometry of another time": (only(long_before, add_photon), r"its tags were seen from 5\.000 to .* odometry"),
    "setpoints only": (only(targets, add_photon), r"not used: /Drive/TargetSpeeds .*; name a topic with --odom"),
    "speeds along the field": (
        only(of_field, add_photon),
        r"these speeds are along the field's axes, not those of the base",
        "--odometry-topic", "/Drive/FieldRelativeSpeeds",
    ),
    "two odometries": (
        only(add_speeds, lambda log: add_speeds(log, "/Drive/Other"), add_photon),
        r"2 topics fit: /Drive/ActualSpeeds .*, /Drive/Other .*; choose one with --odometry-topic",
    ),
    "modules at no place": (only(modules, add_photon), r"give --swerve-modules-m, the places of the wheels"),
    "modules of another number": (
        only(modules, add_photon),
        r"holds 4 swerve modules, 2 places were given", "--swerve-modules-m", "0.3,0.3 -0.3,0.3",
    ),
    "modules at one place": (
        only(modules, add_photon),
        r"all swerve modules have the same position", "--swerve-modules-m", "0.3,0.3 0.3,0.3 0.3,0.3 0.3,0.3",
    ),
    "places that are none": (good().content, r"must be the places of 2 to 16 wheels", "--swerve-modules-m", "0.3 0.3"),
    "places that nothing uses": (good().content, r"--swerve-modules-m would have no effect", "--swerve-modules-m", AT),
    "a pose that was reset": (
        only(reset_pose, add_photon),
        r"the robot moves 15 m .* was the odometry reset\?", "--odometry-topic", "/Drive/Pose",
    ),
    "a packet cut short": (with_packet(packet_2024([])[:5]), r"packet at 5\.000 s has no form of PhotonVision's"),
    "a packet with more targets than bytes": (
        with_packet(struct.pack(">dB", 1.0, 200) + bytes(100)),
        r"packet at 5\.000 s has no form of PhotonVision's results",
    ),
    "a packet of 2025 cut short": (with_packet(packet_2025([])[:-1], PHOTON_2025), r"has no form of PhotonVision"),
    "a latency of hours": (with_packet(packet_2024([], 1e7)), r"claims a latency of 1e\+07 ms, limit 10000"),
    "a camera that saw no tag": (only(add_speeds, no_tags), r"no tags: no tag was seen in /photonvision/front/raw"),
    "poses of the robot only": (only(add_speeds, robot_poses), r"computed from a field layout are not measurements"),
    "tags of no family": (only(add_speeds, huge_ids), r"no tag is left: .* a number that tag36h11 does not have"),
    "fiducials of another form": (only(add_speeds, fiducials), r"has 3 numbers, must have 7 a tag"),
    "a fiducial behind": (only(add_speeds, impossible_fiducial), r"has a tag .*, which is impossible"),
    "a camera without a focal length": (only(add_speeds, no_focal_length), r"cameraIntrinsics: .* fx_px is 0\.0"),
    "a yaw without a unit": (
        only(add_speeds, add_photon, yaw("/Gyro/Yaw")),
        r"its name says neither degrees nor radians", "--imu-topic", "/Gyro/Yaw",
    ),
    "a yaw of degrees that is called radians": (
        only(add_speeds, add_photon, yaw("/Gyro/YawRad", 200.0)),
        r"turns by .* rad/s at .* limit 50; was the yaw reset", "--imu-topic", "/Gyro/YawRad",
    ),
    "a topic that is not there": (
        good().content,
        r"--tags-topic /tags has no records in this", "--tags-topic", "/tags",
    ),
    "a topic of another type": (good().content, r"is of type struct:ChassisSpeeds, must be", "--tags-topic", SPEEDS),
    "an option of bags": (good().content, r"not a bag, so --base-frame would have no effect", "--base-frame", "base"),
    "ticks": (good().content, r"holds no ticks, so --ticks-per-turn would have no effect", "--ticks-per-turn", "100"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_a_bad_log_is_one_line_and_nothing_is_written(tmp_path: Path, run: Run, name: str) -> None:
    make, pattern, *options = BAD[name]
    path = tmp_path / "drive.wpilog"
    path.write_bytes(make())
    outcome = run("import", path, "-o", tmp_path / "runs", *options)
    assert outcome.code == 1, outcome
    assert outcome.out == ""
    assert outcome.err.count("\n") == 1, outcome.err
    assert str(path) in outcome.err or outcome.err.startswith("error: --"), outcome.err
    assert re.search(pattern, outcome.err), outcome.err
    assert not (tmp_path / "runs").exists()


def test_a_log_cut_anywhere_is_a_run_or_one_line(tmp_path: Path, run: Run) -> None:
    content = good().content()
    path = tmp_path / "drive.wpilog"
    for k, share in enumerate(np.linspace(0.02, 0.98, 12)):
        path.write_bytes(content[: int(share * len(content))])
        outcome = run("import", path, "-o", tmp_path / str(k))
        if outcome.code == 0:
            assert "ends within a record" in outcome.out
        else:
            assert (outcome.code, outcome.err.count("\n"), (tmp_path / str(k)).exists()) == (1, 1, False), outcome


def test_flipped_bytes_end_in_a_run_or_one_line(tmp_path: Path, run: Run) -> None:
    content, random = good().content(), np.random.default_rng(0)
    path = tmp_path / "drive.wpilog"
    for k in range(40):
        spoilt = bytearray(content)
        for at in random.integers(0, len(content), 3):
            spoilt[at] = int(random.integers(256))
        path.write_bytes(spoilt)
        outcome = run("import", path, "-o", tmp_path / str(k))
        assert outcome.code in (0, 1), outcome
        assert outcome.code == 0 or outcome.err.count("\n") == 1, outcome
        assert outcome.code == 0 or not (tmp_path / str(k)).exists()


def test_what_is_no_file_is_one_line(tmp_path: Path, run: Run) -> None:
    (tmp_path / "folder.wpilog").mkdir()
    for name, pattern in (("none.wpilog", "does not exist"), ("folder.wpilog", "is a folder; give one .wpilog file")):
        outcome = run("import", tmp_path / name, "-o", tmp_path / "runs")
        assert (outcome.code, outcome.err.count("\n")) == (1, 1)
        assert pattern in outcome.err


def test_places_of_modules_are_for_these_logs(tmp_path: Path, run: Run) -> None:
    outcome = run("import", tmp_path, "-o", tmp_path / "runs", "--swerve-modules-m", AT)
    assert (outcome.code, outcome.err.count("\n")) == (1, 1)
    assert "is not a .wpilog file, so --swerve-modules-m would have no effect" in outcome.err
