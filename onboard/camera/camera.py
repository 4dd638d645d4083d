"""The interface of cameras, and video files as a camera."""

import threading
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log import Picture, StampSource
from groundsbot.onboard.process import RunClock

_NS_PER_S: Final = 1_000_000_000


class CameraLostError(OnboardError):
    """Error: the camera is missing or was lost; it may come back."""


class CameraEndedError(CameraLostError):
    """Error: a video file has ended; it does not come back."""


@dataclass(frozen=True, eq=False)  # compared and hashed by identity
class Frame:
    """One picture as received, with times on the run's clock."""

    picture: Picture
    stamp_ns: int  # middle of the exposure
    receive_ns: int
    source: "StampSource | int"
    sequence: int  # a gap means lost pictures
    refusal: str = ""  # why the picture cannot be used; `picture` is empty then


@dataclass(frozen=True)
class CameraSettings:
    """Settings requested from a camera."""

    device: str  # /dev/video0 or a stable link to it, a video file, or a folder
    width_px: int
    height_px: int
    fps: float
    exposure_s: float | None = None
    gain: float | None = None


class Camera(ABC):
    """A source of pictures.

    Attributes:
        patience_s: age up to which a picture may wait for the detection before it is dropped.
        drains: pictures still present when recording ends belong to the recording.
    """

    patience_s = 0.0
    drains = False

    @abstractmethod
    def open(self) -> list[str]:
        """Open the device, and return a text for each setting that it did not accept.

        Raises:
            CameraLostError: the device is missing or cannot be opened.
        """

    @abstractmethod
    def read(self, timeout_s: float) -> list[Frame]:
        """Return the next pictures, or an empty list if none arrive in time.

        Raises:
            CameraLostError: the device was lost.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the device; never raises."""


class VideoCamera(Camera):
    """A video file, played once at its own speed. Stamps are the opening time plus the position in the file."""

    patience_s = threading.TIMEOUT_MAX  # reading can wait, so no picture needs to be dropped

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
