"""Check of every device of robot.yaml before a drive."""

import math
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final, NamedTuple

from groundsbot.onboard.camera import Camera, CameraEndedError, CameraLostError, CameraSettings, Frame, camera_for
from groundsbot.onboard.detection import ChildDetector, Detection, DetectionResult, save_drawing
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log import Picture
from groundsbot.onboard.monitoring.disk_hours import Load, hours_until_full
from groundsbot.onboard.monitoring.gyro_check import describe_gyro
from groundsbot.onboard.process import RunClock, is_wall_clock_synchronised
from groundsbot.onboard.recorder import RobotCamera, RobotFiles
from groundsbot.onboard.wheels import EncoderPort, PortLostError, StampedGyro, StampedReading, WheelIntake

_NS_PER_S: Final = 1_000_000_000
_LISTEN_NS: Final = 2 * _NS_PER_S
_LOOK_NS: Final = 5 * _NS_PER_S
_LOWEST_RATE_SHARE: Final = 0.5
_BYTES_A_PIXEL: Final = 0.22  # upper estimate for a JPEG, used if no picture was received
_LEAST_HOURS: Final = 1.0
_FEW_HOURS: Final = 10.0
_BYTES_A_MB: Final = 1_000_000
_CHANGING_NAME: Final = re.compile(r"/dev/tty(USB|ACM)\d+")
_LINKS: Final = Path("/dev/serial/by-id")
_OLDEST_WALL_CLOCK_NS: Final = 1_735_689_600 * _NS_PER_S  # 2025


ShowPicture = Callable[[str, Picture, Sequence[Detection]], None]  # takes a camera's name, its picture and tags


class DeviceCheck(NamedTuple):
    """Result of one check."""

    name: str
    passed: bool
    text: str  # what was found, and what to do about it


@dataclass
class _DeviceFindings:
    """Measured rates and sizes; None if not known."""

    lines_hz: float | None = None
    samples_hz: float = 0.0  # of a gyro
    cameras: dict[str, "_CameraFindings"] = field(default_factory=dict)  # by name


class _CameraFindings(NamedTuple):
    """Measured rate and size of a camera's pictures; None if not known."""

    pictures_hz: float | None
    kept_bytes: int | None  # as they would be kept


class _CameraProbe(NamedTuple):
    """Pictures received from the camera."""

    frame: Frame  # the newest
    rate_hz: float | None  # None if there were too few pictures
    refused: list[str]  # settings that the camera did not accept
    is_new: bool  # whether the picture was taken since the check began


def check_robot(
    files: RobotFiles, output: Path, picture: Path, listen_s: float, show: ShowPicture = lambda *_: None
) -> Iterator[DeviceCheck]:
    """Run every check that applies to the robot, and yield each result as soon as it is known.

    Args:
        files: the robot.
        output: folder for recordings.
        picture: picture to save, with the detected tags drawn into it; that of a camera with a name has it in the name
            of the file, as check_left.jpg.
        listen_s: time for which to listen to the wheel controller.
        show: called with a picture of each camera.
    """
    clock, found = RunClock(), _DeviceFindings()
    if files.robot.devices.encoder_port is not None:
        yield from _check_controller(files, clock, found, listen_s)
    for camera in files.cameras:
        named = picture.with_stem(f"{picture.stem}_{camera.name}") if camera.name else picture
        yield from _check_camera(camera, clock, named, found, show)
    yield _check_clock(clock)
    yield _check_disk(output, _load_of(files, found), files.robot.recorder.keep_free_mb)


def _check_controller(
    files: RobotFiles, clock: RunClock, seen: _DeviceFindings, listen_s: float
) -> Iterator[DeviceCheck]:
    """Yield the check of the wheels, and of a gyro if there is one or robot.yaml has one."""
    devices = files.robot.devices
    port = EncoderPort(str(files.path.parent / (devices.encoder_port or "")), devices.encoder_baud)
    intake, n_bytes, found = WheelIntake(), 0, list[StampedReading | StampedGyro]()
    try:
        port.open()
        end_ns = clock.now_ns() + round(listen_s * _NS_PER_S)
        while clock.now_ns() < end_ns:
            data = port.read(0.1)
            n_bytes += len(data)
            found += intake.feed(data, clock.now_ns())
        found += intake.release_all()
    except PortLostError as error:
        yield DeviceCheck("wheels", False, f"{error}; check the cable and devices.encoder_port")
        return
    finally:
        port.close()
    wheels = [each for each in found if isinstance(each, StampedReading)]
    samples = [each for each in found if isinstance(each, StampedGyro)]
    yield _describe_wheels(port, devices.encoder_rate_hz, len(wheels) / listen_s, intake.parser.rejected, n_bytes, seen)
    seen.samples_hz = len(samples) / listen_s
    gyro = describe_gyro(wheels, samples, intake.gyro, files.robot)
    if gyro is not None and wheels:
        yield DeviceCheck("gyro", *gyro)


def _describe_wheels(
    port: EncoderPort, expected_hz: float, rate_hz: float, n_rejected: int, n_bytes: int, seen: _DeviceFindings
) -> DeviceCheck:
    found = f"{port.path}: {rate_hz:.0f} lines/s, {n_rejected} rejected"
    if not n_bytes:
        return DeviceCheck(
            "wheels", False, f"{found}; no data: check that the controller is running and that this is its port"
        )
    if rate_hz < _LOWEST_RATE_SHARE * expected_hz:
        way_out = (
            f"{expected_hz:g} lines/s expected; check devices.encoder_baud ({port.baud}) and the firmware, or set "
            "devices.encoder_rate_hz if the controller sends fewer"
        )
        return DeviceCheck("wheels", False, f"{found}; {way_out}")
    seen.lines_hz = rate_hz
    link = _stable_link(port.path)
    hint = f"; {link} is a name that stays the same when it is plugged in again" if link else ""
    return DeviceCheck("wheels", True, f"{found}{hint}")


def _stable_link(path: str) -> Path | None:
    """Return the stable link that udev makes for a port, if robot.yaml has the other name and a link exists."""
    if not _CHANGING_NAME.fullmatch(path) or not _LINKS.is_dir():
        return None
    return next((link for link in sorted(_LINKS.iterdir()) if link.resolve() == Path(path)), None)


def _check_camera(
    camera: RobotCamera, clock: RunClock, picture: Path, seen: _DeviceFindings, show: ShowPicture
) -> Iterator[DeviceCheck]:
    name, detection = camera.in_words, f"detection {camera.name}".rstrip()
    try:
        look = _probe_camera(camera.settings, clock)
    except CameraLostError as error:
        device = f"cameras.{camera.name}.device" if camera.name else "devices.camera"
        yield DeviceCheck(name, False, f"{error}; check {device}")
        return
    try:
        result = _detect(camera, look.frame)
    except OnboardError as error:
        yield DeviceCheck(detection, False, str(error))
        return
    if result.error is not None:
        yield DeviceCheck(name, False, f"{result.error}; check the camera")
        return
    show(camera.name, look.frame.picture, result.detections)
    width_px, height_px = camera.model.width_px, camera.model.height_px
    seen.cameras[camera.name] = _CameraFindings(look.rate_hz, len(result.jpeg or b"") or None)
    rate = f"{look.rate_hz:.1f} pictures/s" if look.rate_hz else "too few new pictures to measure a rate"
    found = f"{camera.settings.device}: {result.size_px[0]}x{result.size_px[1]} px"
    if result.size_px != (width_px, height_px):
        text = f"{found}, the calibration is for {width_px}x{height_px} px; calibrate at this size"
        yield DeviceCheck(name, False, text)
    elif not look.is_new:
        age_s = (clock.now_ns() - look.frame.stamp_ns) / _NS_PER_S
        text = f"{found}; no new picture, the newest is {age_s:.0f} s old: start the program that takes them"
        yield DeviceCheck(name, False, text)
    else:
        yield DeviceCheck(name, True, "; ".join([f"{found}, {rate}", *look.refused]))
    tags = ", ".join(f"{each.family} {each.tag_id}" for each in result.detections)
    saved = _save(look.frame, result, picture)
    yield DeviceCheck(
        detection, True, f"tags in view: {tags or 'none; hold one in view to test the detection'}; {saved}"
    )


def _save(frame: Frame, result: DetectionResult, path: Path) -> str:
    try:
        save_drawing(frame.picture, result.detections, path)
    except OSError as error:
        return f"picture not saved to {path}: {error.strerror or error}"
    return f"picture: {path}"


def _probe_camera(settings: CameraSettings, clock: RunClock) -> _CameraProbe:
    """Read new pictures, or older ones if there are none, as in a folder that is not being filled yet."""
    begun_ns = clock.now_ns()
    camera = camera_for(settings, clock, since_ns=begun_ns)
    found = _read(camera, clock, begun_ns, _LISTEN_NS)
    if found is None:
        found = _read(camera_for(settings, clock, since_ns=0), clock, begun_ns, _LOOK_NS)
    if found is None:
        raise CameraEndedError(f"camera {settings.device} gave no picture for {_LOOK_NS // _NS_PER_S} s")
    return found


def _read(camera: Camera, clock: RunClock, begun_ns: int, patience_ns: int) -> _CameraProbe | None:
    """Read pictures for some time from the first one on; None if there are none.

    Pictures taken before `begun_ns` are not counted in the rate, because they are read as fast as the disk allows.
    """
    refused = camera.open()
    try:
        end_ns, arrived_ns, newest = clock.now_ns() + patience_ns, list[int](), None
        while clock.now_ns() < end_ns:
            try:
                frames = camera.read(0.1)
            except CameraEndedError:  # a video may be short
                if newest is None:
                    raise
                break
            for frame in frames:
                if newest is None:
                    end_ns = frame.receive_ns + _LISTEN_NS
                newest = frame
                if frame.stamp_ns >= begun_ns:
                    arrived_ns.append(frame.receive_ns)
    finally:
        camera.close()
    if newest is None:
        return None
    elapsed_ns = arrived_ns[-1] - arrived_ns[0] if arrived_ns else 0
    rate_hz = (len(arrived_ns) - 1) * _NS_PER_S / elapsed_ns if elapsed_ns > _NS_PER_S else None
    return _CameraProbe(newest, rate_hz, refused, newest.stamp_ns >= begun_ns)


def _detect(camera: RobotCamera, frame: Frame) -> DetectionResult:
    detector = ChildDetector(camera.detector_settings)  # a crash of the library must not end the check
    try:
        return detector.detect(frame.picture, want_jpeg=True)
    finally:
        detector.close()


def _check_clock(clock: RunClock) -> DeviceCheck:
    now_ns = clock.now_ns()
    if now_ns < _OLDEST_WALL_CLOCK_NS:
        return DeviceCheck(
            "clock", False, "the wall clock is before 2025; set it, as run names and times would be wrong"
        )
    if not is_wall_clock_synchronised():
        return DeviceCheck("clock", True, "not synchronised: maps are not affected, but times of day may be wrong")
    return DeviceCheck("clock", True, "synchronised")


def _load_of(files: RobotFiles, seen: _DeviceFindings) -> Load:
    """Return the expected data rates: as measured, or from robot.yaml if a device gave no data."""
    devices = files.robot.devices
    wheels_hz = 0.0 if devices.encoder_port is None else seen.lines_hz or devices.encoder_rate_hz
    if not files.cameras:
        return Load(wheels_hz, 0.0, 0.0, 0.0, seen.samples_hz)
    pictures_hz, picture_bytes = 0.0, 0.0
    for camera in files.cameras:
        found = seen.cameras.get(camera.name, _CameraFindings(None, None))
        pictures_hz += found.pictures_hz or camera.settings.fps
        picture_bytes += found.kept_bytes or _BYTES_A_PIXEL * camera.model.width_px * camera.model.height_px
    n = len(files.cameras)
    return Load(wheels_hz, pictures_hz, n * files.robot.recorder.picture_rate_hz, picture_bytes / n, seen.samples_hz)


def _hours_words(hours: float) -> str:
    """Return hours, rounded down: to tenths where there are few."""
    return f"{math.floor(10.0 * hours) / 10.0:.1f}" if hours < _FEW_HOURS else f"{hours:.0f}"


def _check_disk(output: Path, load: Load, keep_free_mb: int) -> DeviceCheck:
    folder = output.absolute()
    while not folder.exists():
        folder = folder.parent
    free_bytes = shutil.disk_usage(folder).free
    hours = hours_until_full(max(0, free_bytes - keep_free_mb * _BYTES_A_MB), load.bytes_per_s)
    hours = math.inf if hours is None else hours
    kept = f"{load.kept_pictures_hz:.3g} pictures/s of {load.picture_bytes / 1e3:.0f} kB" if load.kept_hz else "none"
    found = (
        f"{output}: {free_bytes / 1e9:.1f} GB free, enough for about {_hours_words(hours)} h with pictures kept: {kept}"
    )
    if hours < _LEAST_HOURS:
        return DeviceCheck("disk", False, f"{found}; {_LEAST_HOURS:g} h needed: make room or lower picture_rate_hz")
    return DeviceCheck("disk", True, found)
