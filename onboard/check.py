"""Before driving: does every device do what the robot's file says?"""

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from calib.robot import Robot
from onboard.camera import CameraEndedError, CameraLostError, Frame, camera_for
from onboard.clock import RunClock, wall_clock_synchronised
from onboard.detection_process import ChildDetector, DetectionResult
from onboard.drawing import save_drawn
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
_CHANGING_NAME: Final = re.compile(r"/dev/tty(USB|ACM)\d+")
_LINKS: Final = Path("/dev/serial/by-id")
_OLDEST_WALL_CLOCK_NS: Final = 1_735_689_600 * _NS_PER_S  # 2025


class CheckResult(NamedTuple):
    """One check."""

    name: str
    passed: bool
    text: str  # what was found, and what to do about it


def check_robot(files: RobotFiles, output: Path, picture: Path) -> Iterator[CheckResult]:
    """Runs every check that fits the robot, each result as soon as it is there.

    Args:
        files: the robot.
        output: where recordings will go.
        picture: where to save what the camera sees, with the tags found drawn into it.
    """
    clock = RunClock()
    if files.robot.devices.encoder_port is not None:
        yield _check_wheels(files.robot, clock)
    if files.camera_settings is not None:
        yield from _check_camera(files, clock, picture)
    yield _check_clock(clock)
    yield _check_disk(files.robot, output)


def _check_wheels(robot: Robot, clock: RunClock) -> CheckResult:
    devices = robot.devices
    port = EncoderPort(devices.encoder_port or "", devices.encoder_baud)
    parser, n_bytes = EncoderParser(), 0
    try:
        port.open()
        end_ns = clock.now_ns() + _LISTEN_NS
        while clock.now_ns() < end_ns:
            data = port.read(0.1)
            n_bytes += len(data)
            parser.feed(data)
    except PortLostError as error:
        return CheckResult("wheels", False, f"{error}; check the cable and devices.encoder_port")
    finally:
        port.close()
    seconds = _LISTEN_NS / _NS_PER_S
    rate_hz, expected_hz = parser.accepted / seconds, TOPICS["/wheels"].expected_rate_hz or 0.0
    found = f"{port.path}: {rate_hz:.0f} lines/s, {parser.rejected} rejected"
    if not n_bytes:
        return CheckResult("wheels", False, f"{found}; it is silent: is the controller running, and is this its port?")
    if rate_hz < _LOWEST_RATE_SHARE * expected_hz:
        way_out = f"{expected_hz:.0f} lines/s expected; check devices.encoder_baud ({port.baud}) and the firmware"
        return CheckResult("wheels", False, f"{found}; {way_out}")
    link = _stable_link(port.path)
    hint = f"; {link} stays the same when it is plugged in again" if link else ""
    return CheckResult("wheels", True, f"{found}{hint}")


def _stable_link(path: str) -> Path | None:
    """The name that udev gives a port for good, where robot.yaml has the other one."""
    if not _CHANGING_NAME.fullmatch(path) or not _LINKS.is_dir():
        return None
    return next((link for link in sorted(_LINKS.iterdir()) if link.resolve() == Path(path)), None)


def _check_camera(files: RobotFiles, clock: RunClock, picture: Path) -> Iterator[CheckResult]:
    if files.camera_settings is None or files.camera is None:
        return
    try:
        frame, rate_hz, refused = _look(files, clock)
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
    rate = f", {rate_hz:.0f} pictures/s" if rate_hz else ""
    found = f"{files.camera_settings.device}: {result.size_px[0]}x{result.size_px[1]} px{rate}"
    if result.size_px != (width_px, height_px):
        text = f"{found}, the calibration is for {width_px}x{height_px} px; calibrate at this size"
        yield CheckResult("camera", False, text)
    else:
        yield CheckResult("camera", True, "; ".join([found, *refused]))
    tags = ", ".join(f"{each.family} {each.tag_id}" for each in result.detections)
    saved = _saved(frame, result, picture)
    yield CheckResult("detection", True, f"tags in view: {tags or 'none; hold one up to see it found'}; {saved}")


def _saved(frame: Frame, result: DetectionResult, path: Path) -> str:
    try:
        save_drawn(frame.picture, result.detections, path)
    except OSError as error:
        return f"picture not saved to {path}: {error.strerror or error}"
    return f"picture: {path}"


def _look(files: RobotFiles, clock: RunClock) -> tuple[Frame, float, list[str]]:
    """The newest picture, how many come a second (0: nobody knows), and what the camera would not be set to."""
    settings = files.camera_settings
    if settings is None:
        raise CameraLostError("robot.yaml names no camera")
    camera = camera_for(settings, clock, since_ns=0)
    refused = camera.open()
    try:
        end_ns, stamps_ns, newest = clock.now_ns() + _LOOK_NS, list[int](), None
        while clock.now_ns() < end_ns:
            for newest in camera.read(0.1):
                stamps_ns.append(newest.receive_ns)
                end_ns = min(end_ns, stamps_ns[0] + _LISTEN_NS)
    finally:
        camera.close()
    if newest is None:
        raise CameraEndedError(f"camera {settings.device} gave no picture for {_LOOK_NS // _NS_PER_S} s")
    elapsed_ns = stamps_ns[-1] - stamps_ns[0]
    return newest, (len(stamps_ns) - 1) * _NS_PER_S / elapsed_ns if elapsed_ns > _NS_PER_S else 0.0, refused


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
