"""Detection of tags in the pictures of one camera, in a process of its own, on their way to the core."""

import threading
from functools import partial
from typing import Final

from groundsbot.calib.foundation import is_complete, is_jpeg
from groundsbot.onboard.camera import Frame
from groundsbot.onboard.detection import ChildDetector, DetectionResult
from groundsbot.onboard.log import EventKind
from groundsbot.onboard.recorder.device_threads import Put
from groundsbot.onboard.recorder.recorder import RecorderCore
from groundsbot.onboard.recorder.robot_files import RobotCamera
from groundsbot.onboard.recorder.watching import Watcher

_PICTURES_UNDER_WAY: Final = 8


class CameraDetection:
    """Detection for one camera. All methods but `close` are called in the core's thread.

    Each camera has its own process and places for pictures, so that one whose pictures take long, or whose detection
    hangs, takes nothing from the others.

    Attributes:
        slots: places for pictures under way; one is acquired before `detect` is called.
    """

    core: RecorderCore  # set before the first picture

    def __init__(self, camera: RobotCamera, put: Put, watcher: Watcher | None) -> None:
        """Start the process and wait until it is ready.

        Args:
            camera: the camera.
            put: queues an act for the core's thread.
            watcher: is offered the pictures.

        Raises:
            OnboardError: the process cannot be started, or no detector is installed.
        """
        self.slots = threading.Semaphore(_PICTURES_UNDER_WAY)
        self._name = camera.name
        self._put = put
        self._watcher = watcher
        self._under_way: dict[Frame, bool] = {}  # pictures in detection, and whether to keep them
        self._detector = ChildDetector(camera.detector_settings, self._on_restart)

    @property
    def is_busy(self) -> bool:
        """Whether pictures are in detection."""
        return bool(self._under_way)

    def detect(self, frame: Frame, now_ns: int) -> None:
        """Have the tags in a picture detected."""
        if frame.refusal:
            self.slots.release()
            self._lose(EventKind.FRAME_UNUSABLE, f"unusable pictures: {frame.refusal}", now_ns)
            return
        self._under_way[frame] = want_jpeg = self.core.wants_picture(frame.stamp_ns, self._name)
        self._detector.submit(
            frame.picture, want_jpeg, lambda result: self._put(partial(self._take_detections, frame, result))
        )

    def drop(self, frame: Frame, now_ns: int) -> None:
        """Count a picture for which there was no slot, and keep it if it is due."""
        is_wanted = self.core.wants_picture(frame.stamp_ns, self._name)
        self._keep_picture(frame, is_wanted, "pictures: detection is too slow", now_ns)

    def give_up(self, reason: str, now_ns: int) -> None:
        """Count the pictures that are still in detection, and keep those that are due."""
        for frame, is_wanted in self._under_way.items():
            self._keep_picture(frame, is_wanted, reason, now_ns)

    def close(self) -> None:
        """End the process."""
        self._detector.close()

    def _keep_picture(self, frame: Frame, is_wanted: bool, reason: str, now_ns: int) -> None:
        """Write a picture without detections, if it is to be kept; its tags can be detected later."""
        picture = frame.picture
        if is_wanted and isinstance(picture, bytes) and is_jpeg(picture) and is_complete(picture):
            self.core.on_picture(picture, frame.stamp_ns, frame.receive_ns, self._name)
        self._lose(EventKind.FRAME_DROPPED, reason, now_ns)

    def _take_detections(self, frame: Frame, result: DetectionResult, now_ns: int) -> None:
        self._under_way.pop(frame)
        self.slots.release()
        if result.error is not None:
            self._lose(EventKind.FRAME_UNUSABLE, f"unusable pictures: {result.error}", now_ns)
            return
        if result.jpeg is not None:
            self.core.on_picture(result.jpeg, frame.stamp_ns, frame.receive_ns, self._name)
        self.core.on_detections(
            result.detections,
            result.size_px,
            frame.stamp_ns,
            frame.receive_ns,
            frame.source,
            frame.sequence,
            detector=self._detector.library,
            detector_settings=self._detector.settings,
            camera=self._name,
        )
        if self._watcher is not None:
            self._watcher.offer_picture(frame.picture, result.detections, self._name)

    def _lose(self, kind: EventKind, reason: str, now_ns: int) -> None:
        self.core.on_frames_lost(kind, reason, now_ns, camera=self._name)

    def _on_restart(self, reason: str) -> None:
        self._put(partial(self._report_restart, reason))

    def _report_restart(self, reason: str, now_ns: int) -> None:
        self.core.on_detector_restarted(reason, now_ns, self._name)
