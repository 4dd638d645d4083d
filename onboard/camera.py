"""Where pictures come from: a camera, a video file, or a folder into which somebody else puts them."""

import os
import re
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Final

# OpenCV reads this once: a stalled camera would block for ten seconds.
os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", "2")

import cv2
import numpy as np

from onboard.clock import RunClock
from onboard.detection_process import Picture
from onboard.errors import OnboardError
from onboard.messages import StampSource
from onboard.picture import is_complete

_NS_PER_S: Final = 1_000_000_000
_PICTURE_NAME: Final = re.compile(r"(\d{1,19})\.(?:png|jpe?g)", re.IGNORECASE)
_POLL_S: Final = 0.01
_SETTLE_POLLS: Final = 5  # a folder's time of change is coarser than the moment of a look at it
_UNFINISHED_LIMIT_NS: Final = _NS_PER_S
_CLOCK_TOLERANCE_NS: Final = 100_000_000
_AT_ONCE: Final = 8  # pictures a read
_OLDEST_STAMP_NS: Final = _NS_PER_S  # a driver's stamp further in the past is of another clock
_V4L2_EXPOSURE_UNIT_S: Final = 1e-4
_V4L2_MANUAL_EXPOSURE: Final = 1


class CameraLostError(OnboardError):
    """The camera is absent or went away; it may come back."""


class CameraEndedError(CameraLostError):
    """A video file is over; it does not come back."""


@dataclass(frozen=True)
class Frame:
    """One picture as it came; times on the run's clock."""

    picture: Picture
    stamp_ns: int  # middle of the exposure
    receive_ns: int
    source: "StampSource | int"
    sequence: int  # a hole is a lost picture


@dataclass(frozen=True)
class CameraSettings:
    """What to ask of a camera."""

    device: str  # /dev/video0 or its stable link, a video file, or a folder
    width_px: int
    height_px: int
    fps: float
    exposure_s: float | None = None
    gain: float | None = None


class Camera(ABC):
    """One source of pictures.

    Attributes:
        waits: pictures wait for their reader; none is lost if it is slow.
        drains: what is there when recording ends still belongs to it.
    """

    waits = False
    drains = False

    @abstractmethod
    def open(self) -> list[str]:
        """Opens the device; returns what it would not be set to, in words.

        Raises:
            CameraLostError: it is absent or will not open.
        """

    @abstractmethod
    def read(self, timeout_s: float) -> list[Frame]:
        """The next pictures; none if none come in time.

        Raises:
            CameraLostError: it went away.
        """

    @abstractmethod
    def close(self) -> None:
        """Lets go of the device; never fails."""


def camera_for(settings: CameraSettings, clock: RunClock, since_ns: int) -> Camera:
    """The source that the device's name means.

    Args:
        settings: of robot.yaml.
        clock: the run's clock.
        since_ns: pictures in a folder that are older are left alone.
    """
    path = Path(settings.device)
    if path.is_dir():
        return FolderCamera(path, clock, since_ns)
    if path.is_file():
        return VideoCamera(path, clock)
    if settings.device.startswith("/dev/"):
        return V4l2Camera(settings, clock)
    return FolderCamera(path, clock, since_ns)  # it may be made yet


class FolderCamera(Camera):
    """A folder of `<t_ns>.png` or `.jpg`, picked up as they appear.

    A picture's name is the middle of its exposure on the host's wall clock. A file that lacks its end is still being
    written and waits; one that never gets it is handed on after a second, for the decoder to refuse.
    """

    waits = True
    drains = True

    def __init__(self, folder: Path, clock: RunClock, since_ns: int) -> None:
        self._folder = folder
        self._clock = clock
        self._since_ns = since_ns
        self._seen: set[str] = set()
        self._unfinished: dict[str, tuple[int, int]] = {}  # name: (bytes, since when)
        self._changed_ns = -1
        self._polls_left = 0
        self._sequence = 0

    def open(self) -> list[str]:
        """See Camera."""
        if not self._folder.is_dir():
            raise CameraLostError(f"{self._folder} is neither a folder of pictures, a video file nor under /dev")
        return []

    def read(self, timeout_s: float) -> list[Frame]:
        """See Camera."""
        deadline_ns = self._clock.now_ns() + round(timeout_s * _NS_PER_S)
        while True:
            frames = self._look()
            if frames or self._clock.now_ns() >= deadline_ns:
                return frames
            time.sleep(_POLL_S)

    def close(self) -> None:
        """See Camera."""

    def _look(self) -> list[Frame]:
        try:
            changed_ns = self._folder.stat().st_mtime_ns
            if changed_ns != self._changed_ns:
                self._changed_ns, self._polls_left = changed_ns, _SETTLE_POLLS
            if self._polls_left == 0 and not self._unfinished:
                return []
            self._polls_left = max(self._polls_left - 1, 0)
            new = (each.name for each in self._folder.iterdir() if each.name not in self._seen)
            names = sorted(filter(_PICTURE_NAME.fullmatch, new), key=_stamp_in)
            frames: list[Frame] = []
            for name in names:
                frames += self._take(name)
                if len(frames) == _AT_ONCE:
                    self._polls_left = _SETTLE_POLLS  # there may be more
                    break
        except OSError as error:
            raise CameraLostError(f"folder of pictures {self._folder} was lost: {error.strerror}") from error
        return frames

    def _take(self, name: str) -> list[Frame]:
        stamp_ns = self._clock.from_realtime(_stamp_in(name))
        if stamp_ns < self._since_ns:
            self._seen.add(name)
            return []
        data = (self._folder / name).read_bytes()
        now_ns = self._clock.now_ns()
        if not is_complete(data):
            length, since_ns = self._unfinished.get(name, (-1, now_ns))
            if length != len(data):
                since_ns = now_ns
            self._unfinished[name] = (len(data), since_ns)
            if now_ns - since_ns < _UNFINISHED_LIMIT_NS:
                return []
        self._unfinished.pop(name, None)
        self._seen.add(name)
        self._sequence += 1
        source = StampSource.STAMP_SOURCE_FILE_NAME
        if stamp_ns > now_ns + _CLOCK_TOLERANCE_NS:  # named by another clock
            stamp_ns, source = now_ns, StampSource.STAMP_SOURCE_ARRIVAL
        return [Frame(data, stamp_ns, now_ns, source, self._sequence - 1)]


def _stamp_in(name: str) -> int:
    return int(name.partition(".")[0])


class VideoCamera(Camera):
    """A video file, played once at its own speed; stamps are the opening time plus the position in the file."""

    waits = True

    def __init__(self, path: Path, clock: RunClock) -> None:
        self._path = path
        self._clock = clock
        self._capture: cv2.VideoCapture | None = None
        self._start_ns = 0
        self._sequence = 0

    def open(self) -> list[str]:
        """See Camera."""
        capture = cv2.VideoCapture(str(self._path))
        if not capture.isOpened():
            raise CameraEndedError(f"video {self._path} cannot be opened; give a file that OpenCV reads")
        self._capture, self._start_ns, self._sequence = capture, self._clock.now_ns(), 0
        return []

    def read(self, timeout_s: float) -> list[Frame]:
        """See Camera."""
        if self._capture is None:
            raise CameraLostError(f"video {self._path} is not open")
        done, picture = self._capture.read()
        if not done:
            raise CameraEndedError(f"video {self._path} is over after {self._sequence} pictures")
        stamp_ns = self._start_ns + round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        time.sleep(max(0.0, (stamp_ns - self._clock.now_ns()) / _NS_PER_S))
        self._sequence += 1
        frame = Frame(
            np.asarray(picture, np.uint8),
            stamp_ns,
            self._clock.now_ns(),
            StampSource.STAMP_SOURCE_VIDEO,
            self._sequence - 1,
        )
        return [frame]

    def close(self) -> None:
        """See Camera."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None


class V4l2Camera(Camera):
    """A camera of Video4Linux.

    The driver's stamp is taken for the start of the exposure; half of `exposure_s`, where set, leads to its middle.
    What remains is the constant `time_offset_s` of robot.yaml. A stamp that is not of the last second of the
    monotonic clock is not believed: the picture's arrival stands in for it.
    """

    def __init__(self, settings: CameraSettings, clock: RunClock) -> None:
        self._settings = settings
        self._clock = clock
        self._capture: cv2.VideoCapture | None = None
        self._sequence = 0

    def open(self) -> list[str]:
        """See Camera."""
        device = self._settings.device
        if not Path(device).exists():
            raise CameraLostError(f"camera {device} is absent")
        capture = cv2.VideoCapture(device, cv2.CAP_V4L2)
        if not capture.isOpened():
            raise CameraLostError(f"camera {device} cannot be opened: in use by another program, or no permission")
        self._capture = capture
        return [
            f"{name} is {actual:g}, asked for {wanted:g}"
            for name, setting, wanted in self._wanted()
            if not _is_set(actual := _set(capture, setting, wanted), wanted)
        ]

    def read(self, timeout_s: float) -> list[Frame]:
        """See Camera."""
        if self._capture is None:
            raise CameraLostError(f"camera {self._settings.device} is not open")
        done, picture = self._capture.read()
        receive_ns = self._clock.now_ns()
        if not done:
            raise CameraLostError(f"camera {self._settings.device} gives no pictures")
        stamp_ns = self._clock.from_monotonic(round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6))
        source = StampSource.STAMP_SOURCE_CAMERA
        if not 0 <= receive_ns - stamp_ns < _OLDEST_STAMP_NS:
            stamp_ns, source = receive_ns, StampSource.STAMP_SOURCE_ARRIVAL
        elif self._settings.exposure_s is not None:
            stamp_ns += round(self._settings.exposure_s / 2 * _NS_PER_S)
        self._sequence += 1
        return [Frame(np.asarray(picture, np.uint8), stamp_ns, receive_ns, source, self._sequence - 1)]

    def close(self) -> None:
        """See Camera."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _wanted(self) -> list[tuple[str, int, float]]:
        settings = self._settings
        wanted = [
            ("format", cv2.CAP_PROP_FOURCC, float(cv2.VideoWriter.fourcc(*"MJPG"))),
            ("width_px", cv2.CAP_PROP_FRAME_WIDTH, settings.width_px),
            ("height_px", cv2.CAP_PROP_FRAME_HEIGHT, settings.height_px),
            ("camera_fps", cv2.CAP_PROP_FPS, settings.fps),
        ]
        if settings.exposure_s is not None:
            wanted.append(("manual exposure", cv2.CAP_PROP_AUTO_EXPOSURE, _V4L2_MANUAL_EXPOSURE))
            wanted.append(
                (
                    "camera_exposure_s / 0.1 ms",
                    cv2.CAP_PROP_EXPOSURE,
                    round(settings.exposure_s / _V4L2_EXPOSURE_UNIT_S),
                )
            )
        if settings.gain is not None:
            wanted.append(("camera_gain", cv2.CAP_PROP_GAIN, settings.gain))
        return wanted


def _set(capture: cv2.VideoCapture, setting: int, wanted: float) -> float:
    capture.set(setting, wanted)
    return capture.get(setting)


def _is_set(actual: float, wanted: float) -> bool:
    return abs(actual - wanted) <= 0.01 * abs(wanted)
