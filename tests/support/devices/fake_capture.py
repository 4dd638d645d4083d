"""Stands in for cv2.VideoCapture of a Video4Linux camera that gives JPEG and keeps its own size."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from groundsbot.onboard.camera.camera import Camera, CameraSettings
from groundsbot.onboard.camera.v4l2 import V4l2Camera
from groundsbot.onboard.process.clock import RunClock

MJPG = float(cv2.VideoWriter.fourcc(*"MJPG"))
_MS = 1_000_000
_PERIOD_S = 0.02


class FakeCapture:
    """Gives pictures one after the other, then none.

    Attributes:
        released: how often it was let go.
        settings: what it was set to.
    """

    def __init__(
        self,
        pictures: Sequence[bytes | NDArray[np.uint8]],
        stamp_ms: Callable[[], float] = lambda: time.monotonic_ns() / _MS - 20.0,
        fourcc: float = MJPG,
        padding: int = 0,
    ) -> None:
        self.released = 0
        self.settings: dict[int, float] = {}
        self._pictures = list(pictures)
        self._stamp_ms = stamp_ms
        self._now_ms = 0.0
        self._kept = {cv2.CAP_PROP_FRAME_WIDTH: 160.0, cv2.CAP_PROP_FRAME_HEIGHT: 120.0, cv2.CAP_PROP_FOURCC: fourcc}
        self._padding = padding

    def isOpened(self) -> bool:
        return True

    def set(self, setting: int, value: float) -> bool:
        self.settings[setting] = value
        return True

    def get(self, setting: int) -> float:
        if setting == cv2.CAP_PROP_POS_MSEC:
            return self._now_ms
        return self._kept.get(setting, self.settings.get(setting, 0.0))

    def grab(self) -> bool:
        time.sleep(_PERIOD_S)
        if not self._pictures:
            return False
        self._now_ms = self._stamp_ms()
        return True

    def retrieve(self) -> tuple[bool, NDArray[np.uint8]]:
        picture = self._pictures.pop(0)
        if isinstance(picture, bytes):
            return True, np.frombuffer(picture + bytes(self._padding), np.uint8)[np.newaxis]
        return True, picture

    def release(self) -> None:
        self.released += 1


def v4l2_camera_of(device: Path) -> Callable[[CameraSettings, RunClock, int], Camera]:
    """In place of `camera_for`: the device whatever robot.yaml says."""

    def camera_for(_settings: CameraSettings, clock: RunClock, _since_ns: int) -> Camera:
        return V4l2Camera(CameraSettings(str(device), 160, 120, 15.0), clock)

    return camera_for
