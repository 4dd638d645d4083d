"""Recorder cores for tests: no device, no clock; what came of them read back from their logs."""

from pathlib import Path

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.onboard.log.losses import LogLosses
from groundsbot.onboard.log.messages import Event, Gyro, TagDetections, WheelEncoders
from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.recorder.recorder import RecorderCore, RunIdentity
from groundsbot.onboard.wheels.protocol import GyroLine, WheelLine, format_gyro_line, format_line

ROBOT_YAML = """
robot_id: gb1
wheels: {radius_left_m: 0.05, radius_right_m: 0.05, track_m: 0.3, ticks_per_turn: 1024}
camera: camera.yaml
recorder: {picture_rate_hz: 5, segment_s: 15}
"""
CAMERA = CameraModel("front", 160, 120, 150.0, 150.0, 79.5, 59.5, "plumb_bob", (0.0,) * 5)
START_NS = 1_800_000_000_000_000_000
UPTIME_NS = 3_600_000_000_000
PERIOD_NS = 10_000_000
DELAY_NS = 1_000_000
MS = 1_000_000
S = 1_000_000_000


def make_core(folder: Path, camera: CameraModel | None = CAMERA, text: str = ROBOT_YAML) -> RecorderCore:
    """A core whose run folder is `folder/run1`, of the robot that a text describes."""
    run = RunIdentity(parse_robot_yaml(text, "robot.yaml"), text, camera, "run1", START_NS, START_NS - UPTIME_NS)
    return RecorderCore(folder, run, durable=False)


def line_of(index: int, boot_id: int = 7) -> WheelLine:
    """Line `index` of a steady drive at 100 Hz."""
    return WheelLine(boot_id, index, index * 10_000, 13 * index, -14 * index, 0)


def gyro_rate_urad_s(sequence: int) -> int:
    """What sample `sequence` of the gyro measures: never the same twice in a row."""
    return sequence * 7919 % 200_003 - 100_000


def gyro_line_of(index: int, boot_id: int = 7) -> GyroLine:
    """The four samples of a gyro at 400 Hz that end when wheel line `index` is measured; they are sent after it."""
    sequence = 4 * index
    rates = tuple(gyro_rate_urad_s(sequence + k) for k in range(4))
    return GyroLine(boot_id, sequence, (index * 10_000 - 7_500) % 2**32, 2_500, rates)


def send_both(core: RecorderCore, index: int, turns: bytes | None = None, boot_id: int = 7) -> int:
    """Gives the core wheel line and gyro line `index` (or other bytes in the gyro's place), and a tick; its time."""
    turns = format_gyro_line(gyro_line_of(index, boot_id)) if turns is None else turns
    return send(core, index, format_line(line_of(index, boot_id)) + turns)


def send(core: RecorderCore, index: int, data: bytes | None = None, boot_id: int = 7) -> int:
    """Gives the core line `index` (or other bytes in its place) at its time, and a tick; returns that time."""
    now_ns = START_NS + index * PERIOD_NS + DELAY_NS
    core.on_serial_bytes(format_line(line_of(index, boot_id)) if data is None else data, now_ns)
    core.tick(now_ns)
    return now_ns


def events_of(log: Path, kind: str | None = None) -> list[Event]:
    """The events in a log, all or those of one kind."""
    events = [each.message for each in read_log(log, ["/events"]) if isinstance(each.message, Event)]
    return [each for each in events if kind in (None, each.kind)]


def wheels_of(log: Path) -> list[WheelEncoders]:
    """The wheel readings in a log, damaged or not."""
    messages = (each.message for each in read_log(log, ["/wheels"], LogLosses()))
    return [message for message in messages if isinstance(message, WheelEncoders)]


def gyro_of(log: Path) -> list[Gyro]:
    """The yaw rates in a log, damaged or not."""
    return [each.message for each in read_log(log, ["/gyro"], LogLosses()) if isinstance(each.message, Gyro)]


def frames_of(log: Path) -> list[TagDetections]:
    """The detections in a log."""
    return [each.message for each in read_log(log, ["/tags/detections"]) if isinstance(each.message, TagDetections)]
