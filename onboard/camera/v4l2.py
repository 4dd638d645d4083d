"""Video4Linux cameras, read through OpenCV: JPEG as sent by the camera, stamps of the driver if plausible."""

from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.onboard.camera.camera import Camera, CameraLostError, CameraSettings, Frame
from groundsbot.onboard.camera.driver_sequence import DriverSequence
from groundsbot.onboard.log import Picture, StampSource, without_padding
from groundsbot.onboard.process import RunClock

_NS_PER_S: Final = 1_000_000_000
_NS_PER_MS: Final = 1_000_000
_OLDEST_STAMP_NS: Final = _NS_PER_S  # an older stamp of the driver is from another clock
_EXPOSURE_UNIT_S: Final = 1e-4
_MANUAL_EXPOSURE: Final = 1
_MJPG: Final = cv2.VideoWriter.fourcc(*"MJPG")
_GREY_FIRST: Final = tuple(cv2.VideoWriter.fourcc(*name) for name in ("YUYV", "YUY2"))
_GREY_SECOND: Final = (cv2.VideoWriter.fourcc(*"UYVY"),)


class V4l2Camera(Camera):
    """A Video4Linux camera.

    JPEG from the camera is kept unchanged, and of YUV only the grey plane is used. Other formats are converted by
    OpenCV.

    The stamp of the driver is taken as the start of the exposure, and half of `exposure_s`, if set, is added for its
    middle. The remaining constant delay is `time_offset_s` of robot.yaml. A stamp is rejected if it does not lie in the
    last second of the monotonic clock or is not later than the previous one; the arrival time is used instead.
    """

    def __init__(self, settings: CameraSettings, clock: RunClock) -> None:
        self._settings = settings
        self._clock = clock
        self._capture: cv2.VideoCapture | None = None
        self._format = 0
        self._next_sequence = 0
        self._numbers: DriverSequence | None = None
        self._last_driver_ns = 0

    def open(self) -> list[str]:
        """See Camera."""
        device = self._settings.device
        if not Path(device).exists():
            raise CameraLostError(f"camera {device} is missing")
        capture = cv2.VideoCapture(device, cv2.CAP_V4L2)
        if not capture.isOpened():
            capture.release()
            raise CameraLostError(f"camera {device} cannot be opened: in use by another program, or no permission")
        self._capture = capture
        capture.set(cv2.CAP_PROP_FOURCC, float(_MJPG))  # first, because the available sizes depend on it
        refused = [
            f"{name} is {actual:g}, requested {wanted:g}"
            for name, setting, wanted in self._requested_format()
            if not _is_set(actual := _set(capture, setting, wanted), wanted)
        ]
        self._format = int(capture.get(cv2.CAP_PROP_FOURCC))
        as_it_comes = self._format in (_MJPG, *_GREY_FIRST, *_GREY_SECOND)
        capture.set(cv2.CAP_PROP_CONVERT_RGB, 0.0 if as_it_comes else 1.0)
        if self._format != _MJPG:
            refused.insert(
                0, f"format is {_name(self._format)}, requested MJPG: pictures kept are encoded by the recorder"
            )
        self._numbers = DriverSequence(device, self._next_sequence)
        return refused

    def read(self, timeout_s: float) -> list[Frame]:
        """See Camera. OpenCV waits for `OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT` regardless of `timeout_s`."""
        if self._capture is None or self._numbers is None:
            raise CameraLostError(f"camera {self._settings.device} is not open")
        if not self._capture.grab():
            raise CameraLostError(f"camera {self._settings.device} gives no pictures")
        receive_ns = self._clock.now_ns()
        sequence = self._numbers.take()  # before its buffer goes back to the driver
        done, picture = self._capture.retrieve()
        if not done:
            raise CameraLostError(f"camera {self._settings.device} gives no pictures")
        stamp_ns, source = self._stamp(receive_ns)
        self._next_sequence = sequence + 1
        return [Frame(self._picture(np.asarray(picture, np.uint8)), stamp_ns, receive_ns, source, sequence)]

    def close(self) -> None:
        """See Camera."""
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def _stamp(self, receive_ns: int) -> tuple[int, "StampSource | int"]:
        """Return the best estimate of the middle of the exposure, and its source."""
        if self._capture is None:
            return receive_ns, StampSource.STAMP_SOURCE_ARRIVAL
        driver_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * _NS_PER_MS)
        is_later, self._last_driver_ns = driver_ns > self._last_driver_ns, driver_ns
        stamp_ns = self._clock.from_monotonic(driver_ns)
        if not (is_later and 0 <= receive_ns - stamp_ns < _OLDEST_STAMP_NS):
            return receive_ns, StampSource.STAMP_SOURCE_ARRIVAL
        return stamp_ns + round((self._settings.exposure_s or 0.0) / 2 * _NS_PER_S), StampSource.STAMP_SOURCE_CAMERA

    def _picture(self, picture: NDArray[np.uint8]) -> Picture:
        if self._format == _MJPG and 1 in picture.shape[:2]:  # OpenCV returns JPEG as one row of bytes
            return without_padding(picture.tobytes())
        if picture.ndim == 3 and picture.shape[2] == 2:
            return np.ascontiguousarray(picture[:, :, 0 if self._format in _GREY_FIRST else 1])
        return picture

    def _requested_format(self) -> list[tuple[str, int, float]]:
        settings = self._settings
        wanted = [
            ("width_px", cv2.CAP_PROP_FRAME_WIDTH, settings.width_px),
            ("height_px", cv2.CAP_PROP_FRAME_HEIGHT, settings.height_px),
            ("camera_fps", cv2.CAP_PROP_FPS, settings.fps),
        ]
        if settings.exposure_s is not None:
            wanted.append(("manual exposure", cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE))
            wanted.append(
                ("camera_exposure_s / 0.1 ms", cv2.CAP_PROP_EXPOSURE, round(settings.exposure_s / _EXPOSURE_UNIT_S))
            )
        if settings.gain is not None:
            wanted.append(("camera_gain", cv2.CAP_PROP_GAIN, settings.gain))
        return wanted


def _set(capture: cv2.VideoCapture, setting: int, wanted: float) -> float:
    capture.set(setting, wanted)
    return capture.get(setting)


def _is_set(actual: float, wanted: float) -> bool:
    return abs(actual - wanted) <= 0.01 * abs(wanted)


def _name(fourcc: int) -> str:
    return fourcc.to_bytes(4, "little", signed=fourcc < 0).decode("ascii", "replace")
