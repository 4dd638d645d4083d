"""Before driving: does every device do what the robot's file says?"""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from calib.robot import Robot
from onboard.camera import CameraEndedError, CameraLostError, Frame, camera_for
from onboard.clock import RunClock, wall_clock_synchronised
from onboard.detection_process import ChildDetector, DetectionResult
from onboard.encoder_port import EncoderPort, PortLostError
from onboard.encoder_protocol import EncoderParser
from onboard.errors import OnboardError
from onboard.messages import TOPICS
from onboard.robot_files import RobotFiles

_NS_PER_S: Final = 1_000_000_000
_LISTEN_NS: Final = 2 * _NS_PER_S
_LOOK_NS: Final = 5 * _NS_PER_S
_LOWEST_RATE_SHARE: Final = 0.5
_CORE_BYTES_PER_S: Final = 5_000  # 100 Hz of wheels and 15 Hz of detections, compressed
_PICTURE_BYTES: Final = 200_000  # a JPEG of 1280x720, on the safe side
_LEAST_HOURS: Final = 1.0
_OLDEST_WALL_CLOCK_NS: Final = 1_735_689_600 * _NS_PER_S  # 2025


class CheckResult(NamedTuple):
    """One check."""

    name: str
    passed: bool
    text: str  # what was found, and what to do about it


def check_robot(files: RobotFiles, output: Path) -> Iterator[CheckResult]:
    """Runs every check that fits the robot, each result as soon as it is there.

    Args:
        files: the robot.
        output: where recordings will go.
    """
    clock = RunClock()
    if files.robot.devices.encoder_port is not None:
        yield _check_wheels(files.robot, clock)
    if files.camera_settings is not None:
        yield from _check_camera(files, clock)
    yield _check_clock(clock)
    yield _check_disk(files.robot, output)


def _check_wheels(robot: Robot, clock: RunClock) -> CheckResult:
    devices = robot.devices
    port = EncoderPort(devices.encoder_port or "", devices.encoder_baud)
    parser = EncoderParser()
    end_ns = clock.now_ns() + _LISTEN_NS
    try:
        port.open()
        while clock.now_ns() < end_ns:
            parser.feed(port.read(0.1))
    except PortLostError as error:
        return CheckResult("wheels", False, f"{error}; check the cable and devices.encoder_port")
    finally:
        port.close()
    seconds = _LISTEN_NS / _NS_PER_S
    rate_hz, expected_hz = parser.accepted / seconds, TOPICS["/wheels"].expected_rate_hz or 0.0
    found = f"{port.path}: {rate_hz:.0f} lines/s, {parser.rejected} rejected"
    if rate_hz < _LOWEST_RATE_SHARE * expected_hz:
        way_out = f"{expected_hz:.0f} lines/s expected; check devices.encoder_baud ({port.baud}) and the firmware"
        return CheckResult("wheels", False, f"{found}; {way_out}")
    return CheckResult("wheels", True, found)


def _check_camera(files: RobotFiles, clock: RunClock) -> Iterator[CheckResult]:
    if files.camera_settings is None or files.camera is None:
        return
    try:
        frame, refused = _one_frame(files, clock)
    except CameraLostError as error:
        yield CheckResult("camera", False, f"{error}; check devices.camera")
        return
    try:
        result = _detect(files, frame)
    except OnboardError as error:
        yield CheckResult("detection", False, str(error))
        return
    if result.error is not None:
        yield CheckResult("camera", False, f"{result.error}; check the camera")
        return
    width_px, height_px = files.camera.width_px, files.camera.height_px
    found = f"{files.camera_settings.device}: {result.size_px[0]}x{result.size_px[1]} px"
    if result.size_px != (width_px, height_px):
        text = f"{found}, the calibration is for {width_px}x{height_px} px; calibrate at this size"
        yield CheckResult("camera", False, text)
    else:
        yield CheckResult("camera", True, "; ".join([found, *refused]))
    tags = ", ".join(f"{each.family} {each.tag_id}" for each in result.detections)
    yield CheckResult("detection", True, f"tags in view: {tags or 'none; hold one up to see it found'}")


def _one_frame(files: RobotFiles, clock: RunClock) -> tuple[Frame, list[str]]:
    settings = files.camera_settings
    if settings is None:
        raise CameraLostError("robot.yaml names no camera")
    camera = camera_for(settings, clock, since_ns=0)
    refused = camera.open()
    try:
        end_ns = clock.now_ns() + _LOOK_NS
        while clock.now_ns() < end_ns:
            frames = camera.read(0.1)
            if frames:
                return frames[-1], refused
        raise CameraEndedError(f"camera {settings.device} gave no picture for {_LOOK_NS // _NS_PER_S} s")
    finally:
        camera.close()


def _detect(files: RobotFiles, frame: Frame) -> DetectionResult:
    detector = ChildDetector(files.detector_settings)  # a library that crashes must not take the check with it
    try:
        return detector.detect(frame.picture)
    finally:
        detector.close()


def _check_clock(clock: RunClock) -> CheckResult:
    now_ns = clock.now_ns()
    if now_ns < _OLDEST_WALL_CLOCK_NS:
        return CheckResult("clock", False, "the wall clock lies before 2025; set it, or run names and times mislead")
    if not wall_clock_synchronised():
        return CheckResult("clock", True, "not synchronised: fine for a map, but times of day may be off")
    return CheckResult("clock", True, "synchronised")


def _check_disk(robot: Robot, output: Path) -> CheckResult:
    folder = output.absolute()
    while not folder.exists():
        folder = folder.parent
    free_bytes = shutil.disk_usage(folder).free
    hours = free_bytes / (_CORE_BYTES_PER_S + _PICTURE_BYTES * robot.recorder.picture_rate_hz) / 3600
    found = f"{output}: {free_bytes / 1e9:.1f} GB free, enough for about {hours:.0f} h"
    if hours < _LEAST_HOURS:
        return CheckResult("disk", False, f"{found}; {_LEAST_HOURS:g} h needed: make room or lower picture_rate_hz")
    return CheckResult("disk", True, found)
