"""Collects the messages of one log that a map uses."""

from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Final, NamedTuple

from groundsbot.offline.measurements.motion_model.odometry_messages import OdometryMessages
from groundsbot.offline.measurements.motion_model.wheel_segments import WheelRow
from groundsbot.offline.measurements.tag_messages import TagMessages
from groundsbot.onboard.log import (
    CameraCalibration,
    Event,
    Gyro,
    LogMessage,
    PlanarOdometry,
    RunInfo,
    Severity,
    TagDetections,
    TagObservations,
    WheelEncoders,
    camera_of,
)

MEASURED_TOPICS: Final = (
    "/run",
    "/camera/calibration",
    "/wheels",
    "/gyro",
    "/tags/detections",
    "/odometry",
    "/tags/observations",
    "/events",
)
_GYRO_KEPT_NS: Final = 2_000_000_000  # before the time, as a frozen value is one that stays for a second
_MOST_EVENTS: Final = 500  # a recorder merges frequent events into one, so a recorded log has fewer


class RunEvent(NamedTuple):
    """An event that the recorder logged, such as a gap, a loss or a reconnection."""

    stamp_ns: int
    is_loss: bool
    text: str


@dataclass
class RunMessages:
    """The messages of one log, collected in their order."""

    info: RunInfo | None = None
    calibrations: dict[str, CameraCalibration] = field(default_factory=dict)  # by name of the camera
    wheels: list[WheelRow] = field(default_factory=list)
    odometry: OdometryMessages = field(default_factory=OdometryMessages)
    gyro: list[tuple[int, float]] = field(default_factory=list)
    picture_sizes: dict[str, tuple[int, int]] = field(default_factory=dict)  # of the first, by name of the camera
    observations: TagMessages = field(default_factory=TagMessages)
    events: list[RunEvent] = field(default_factory=list)
    n_other_size: int = 0

    def add(self, entry: LogMessage) -> None:
        """Add one message of the log."""
        message = entry.message
        if isinstance(message, WheelEncoders):
            self.wheels.append((message.stamp_ns, message.boot_id, message.ticks_left, message.ticks_right))
        elif isinstance(message, PlanarOdometry):
            self.odometry.add(message)
        elif isinstance(message, Gyro):
            self.gyro.append((message.stamp_ns, message.yaw_rate_rad_s))
        elif isinstance(message, TagDetections):
            self._add_detections(message, camera_of(entry.topic))
        elif isinstance(message, TagObservations):
            self.observations.add_observations(message)
        elif isinstance(message, RunInfo):
            self.info = self.info or message
        elif isinstance(message, CameraCalibration):
            self.calibrations.setdefault(camera_of(entry.topic), message)
        elif isinstance(message, Event) and len(self.events) < _MOST_EVENTS:
            is_loss = message.severity in (Severity.SEVERITY_WARNING, Severity.SEVERITY_ERROR)
            self.events.append(RunEvent(message.stamp_ns, is_loss, message.text or message.kind))

    def forget(self, wheels_ns: int, pictures_ns: Mapping[str, int]) -> None:
        """Remove what is no longer needed for the motion after a time, and pictures up to a stamp of their own.

        Args:
            wheels_ns: the last wheel reading before it stays, as the motion after it begins there.
            pictures_ns: the same time by the stamps of each camera's pictures, by name, the first camera's first.
        """
        del self.wheels[: max(0, bisect_right(self.wheels, wheels_ns, key=itemgetter(0)) - 1)]
        self.odometry.forget(wheels_ns)
        del self.gyro[: max(0, bisect_right(self.gyro, wheels_ns - _GYRO_KEPT_NS, key=itemgetter(0)) - 1)]
        self.observations.forget(pictures_ns)

    def _add_detections(self, message: TagDetections, camera: str) -> None:
        size = (message.width_px, message.height_px)
        if size != self.picture_sizes.setdefault(camera, size):
            self.n_other_size += 1
            return
        self.observations.add_detections(message, camera)
