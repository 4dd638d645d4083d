"""Intake of one camera: checks of its pictures, choice of those to keep, and their messages."""

from collections.abc import Sequence

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.robot import Robot
from groundsbot.onboard.detection import Detection, detections_message
from groundsbot.onboard.log import (
    DETECTIONS_TOPIC,
    PICTURE_TOPIC,
    CompressedImage,
    EventKind,
    Severity,
    StampSource,
    TagDetections,
    camera_topic,
    timestamp,
)
from groundsbot.onboard.recorder.counted_log import CountedLog
from groundsbot.onboard.recorder.losses import RecordingLosses
from groundsbot.onboard.recorder.pictures import PictureChecks, PictureSchedule
from groundsbot.onboard.recorder.watches import SilenceWatch


class CameraIntake:
    """Intake of one camera of a run. All times are ns on the run's clock.

    Attributes:
        detections_topic: topic of its detections.
        tags_in_view: family and id of the tags in its newest picture.
    """

    def __init__(
        self,
        name: str,
        robot: Robot,
        model: CameraModel | None,
        frame: str,
        log: CountedLog,
        missing: RecordingLosses,
        watch: SilenceWatch,
        *,
        keep_pictures: bool,
    ) -> None:
        """Prepare for the first picture.

        Args:
            name: name of the camera; empty for the only one.
            robot: the robot with this camera alone.
            model: the calibration, which pictures must fit; None accepts any size.
            frame: frame of the pictures.
            log: log of the run.
            missing: reporter of losses.
            watch: watch of the pictures.
            keep_pictures: whether pictures can be written.
        """
        self.detections_topic = camera_topic(DETECTIONS_TOPIC, name)
        self.tags_in_view: tuple[str, ...] = ()
        self._name = name
        self._log = log
        self._missing = missing
        self._watch = watch
        self._keep_pictures = keep_pictures
        self._picture_topic = camera_topic(PICTURE_TOPIC, name)
        self._frame = frame
        self._checks = PictureChecks(model)
        self._schedule = PictureSchedule(robot.recorder.picture_rate_hz, robot.devices.camera_fps)

    def on_connected(self, device: str, refused: Sequence[str], host_ns: int) -> None:
        """Record that the camera was opened or reopened; `refused` lists settings that it did not accept."""
        self._watch.reset(host_ns)
        self.event(EventKind.CAMERA_CONNECTED, Severity.SEVERITY_INFO, device, host_ns)
        if refused:
            text = f"{device} did not accept settings: {'; '.join(refused)}"
            self.event(EventKind.CAMERA_SETTING, Severity.SEVERITY_WARNING, text, host_ns)

    def on_lost(self, reason: str, host_ns: int, *, at_its_end: bool) -> None:
        """Record that the camera was lost; with `at_its_end` it was a file that ended, which is no fault."""
        self._watch.pause(at_its_end=at_its_end)
        severity = Severity.SEVERITY_INFO if at_its_end else Severity.SEVERITY_WARNING
        self.event(EventKind.CAMERA_LOST, severity, reason, host_ns)

    def on_detections(
        self,
        detections: Sequence[Detection],
        size_px: tuple[int, int],
        stamp_ns: int,
        receive_ns: int,
        source: "StampSource | int",
        sequence: int,
        detector: str,
        detector_settings: str,
    ) -> TagDetections | None:
        """Check a picture, and return the message of its tags; None if it is refused."""
        self._watch.reset(receive_ns)
        odd_size = self._checks.odd_size(size_px)
        if odd_size is not None:
            self.event(EventKind.FRAME_SIZE, Severity.SEVERITY_ERROR, odd_size, receive_ns)
        if self._checks.is_first_without_stamp(source):
            self._missing.note_stamp(self._name)
        self.tags_in_view = tuple(f"{each.family} {each.tag_id}" for each in detections)
        try:
            return detections_message(detections, size_px, stamp_ns, source, sequence, detector, detector_settings)
        except ValueError as error:  # raised by protobuf for a number that does not fit its field
            self._log.refuse(f"{self.detections_topic}: picture {sequence} at {stamp_ns} ns, {size_px} px: {error}")
            return None

    def wants_picture(self, stamp_ns: int) -> bool:
        """Return whether to keep the picture with this stamp. Call it once per picture, in order."""
        return self._keep_pictures and self._schedule.is_due(stamp_ns)

    def on_picture(self, jpeg: bytes, stamp_ns: int, receive_ns: int) -> None:
        """Write one picture, encoded as JPEG."""
        if self._keep_pictures:
            stamp = timestamp(stamp_ns)
            message = CompressedImage(timestamp=stamp, frame_id=self._frame, data=jpeg, format="jpeg")
            self._log.write(self._picture_topic, message, receive_ns, stamp_ns)

    def on_frames_lost(self, kind: EventKind, reason: str, host_ns: int, count: int) -> None:
        """Count pictures that were dropped or unusable; their number is reported once a second."""
        self._watch.reset(host_ns)
        self._missing.note_pictures(kind, count, reason, self._name)

    def event(self, kind: EventKind, severity: "Severity | int", text: str, host_ns: int, count: int = 0) -> None:
        """Write an event of the camera, with its name."""
        self._log.event(kind, severity, of_camera(self._name, text), host_ns, count, self._name)


def of_camera(name: str, text: str) -> str:
    """Return a text with the name of a camera in front, if it has one."""
    return f"{name}: {text}" if name else text
