"""The core of the recorder, which turns bytes and pictures with their times into a log.

It reads no clock and no device, so that live and simulated recordings use the same code. The same calls give the same
log, byte by byte.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.robot import Robot
from groundsbot.onboard.detection import Detection, TagDetector
from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log import (
    Cameras,
    ClockAnchor,
    Event,
    EventKind,
    LogHead,
    LogOpener,
    LogWriter,
    RunFrames,
    RunLog,
    Severity,
    StampSource,
    cameras_by_name,
    encode_jpeg,
    log_head,
    segment_limits,
)
from groundsbot.onboard.recorder.camera_intake import CameraIntake
from groundsbot.onboard.recorder.counted_log import CountedLog
from groundsbot.onboard.recorder.drive_progress import DriveProgress
from groundsbot.onboard.recorder.losses import RecordingLosses
from groundsbot.onboard.recorder.waiting_detections import ReadyDetections, WaitingDetections
from groundsbot.onboard.recorder.watches import Watches
from groundsbot.onboard.wheels import StampedGyro, StampedReading, WheelIntake, gyro_message, wheel_message

_NS_PER_S: Final = 1_000_000_000
_ANCHOR_PERIOD_NS: Final = _NS_PER_S


class RunIdentity(NamedTuple):
    """Identity of a run."""

    robot: Robot
    robot_yaml: str  # the text that `robot` was read from
    camera: Cameras  # its camera, or its cameras by name; None: a run of wheels only
    run_id: str
    start_ns: int  # on the run's clock
    run_epoch_ns: int  # realtime minus monotonic time at the start


def _writer_opener(robot: Robot, *, durable: bool) -> LogOpener:
    """Return an opener of logs that wait for the disk."""

    def open_writer(folder: Path, head: LogHead, start_ns: int, keep_pictures: bool) -> RunLog:
        limits = segment_limits(robot)
        return LogWriter(folder, head, start_ns, keep_pictures=keep_pictures, durable=durable, limits=limits)

    return open_writer


class RecorderCore:
    """Core that writes one run into `<folder>/<run_id>/`.

    All times are ns on the run's clock. The log time of a message is the time of reception by the host, or the newest
    log time if a later message has been written already.

    Attributes:
        folder: the run's folder.
        counts: number of messages accepted, by topic; those that wait for the disk included.
        losses: number of losses, by a description.
        newest_ns: arrival of the newest message, by topic.
        progress: metres driven and tags seen.
    """

    def __init__(
        self,
        folder: Path,
        run: RunIdentity,
        *,
        detector: TagDetector | None = None,
        on_event: Callable[[Event], None] | None = None,
        expect_wheels: bool = True,
        expect_camera: bool = False,
        durable: bool = True,
        open_log: LogOpener | None = None,
    ) -> None:
        """Open the log.

        Args:
            folder: folder for run folders.
            run: identity of the run.
            detector: detector for `on_frame`; not needed for `on_detections`.
            on_event: called with each event after it is written.
            expect_wheels: report silence of the wheels, and let detections wait for wheel readings.
            expect_camera: count a camera that never sends a picture as a loss.
            durable: see LogWriter.
            open_log: opens another log than a LogWriter, as one that does not wait for the disk.

        Raises:
            LogError: the log cannot be opened.
        """
        self.folder = folder / run.run_id
        self.progress = DriveProgress(run.robot.wheels)
        self._run = run
        self._options = run.robot.recorder
        self._detector = detector
        self._intake = WheelIntake()
        models = cameras_by_name(run.camera)
        self._watches = Watches(
            run.run_epoch_ns,
            run.start_ns if expect_wheels else None,
            models or ("",),
            expect_camera=expect_camera,
            gyro_since_ns=run.start_ns if expect_wheels and run.robot.gyro is not None else None,
        )
        self._waiting = WaitingDetections(wheels=expect_wheels)
        self._next_anchor_ns = 0
        keep_pictures = self._options.picture_rate_hz > 0 and run.camera is not None
        open_log = open_log or _writer_opener(run.robot, durable=durable)
        head = log_head(run.robot, run.robot_yaml, run.camera, run.run_id, run.start_ns, run.run_epoch_ns)
        self._log = CountedLog(open_log(self.folder, head, run.start_ns, keep_pictures), on_event)
        self._missing = RecordingLosses(self._log)
        self.counts, self.losses, self.newest_ns = self._log.counts, self._log.losses, self._log.newest_ns
        self._cameras = {
            name: CameraIntake(
                name,
                run.robot.with_camera(name) if name else run.robot,
                models.get(name),
                RunFrames.of(f"{run.robot.robot_id}_{run.run_id}", name).camera,
                self._log,
                self._missing,
                watch,
                keep_pictures=keep_pictures,
            )
            for name, watch in self._watches.cameras.items()
        }
        self._port_is_lost = False
        self._closed = False
        self.event(EventKind.RECORDING_STARTED, Severity.SEVERITY_INFO, f"run {run.run_id}", run.start_ns)

    @property
    def written(self) -> Mapping[str, int]:
        """Number of messages on the disk, by topic, without the heads of files."""
        return self._log.written

    def tags_in_view(self, camera: str = "") -> tuple[str, ...]:
        """Return family and id of the tags in the newest picture of a camera."""
        return self._cameras[camera].tags_in_view

    # --- wheels

    def on_serial_bytes(self, data: bytes, host_ns: int) -> None:
        """Process bytes read from the port at `host_ns`, split at any position."""
        for each in self._intake.feed(data, host_ns):
            self._write_reading(each)
        self._write_waiting(host_ns)

    def on_port_connected(self, name: str, host_ns: int) -> None:
        """Record that the port was opened or reopened."""
        self._intake.parser.restart()
        self._port_is_lost = False
        self.event(EventKind.PORT_CONNECTED, Severity.SEVERITY_INFO, name, host_ns)

    def on_port_lost(self, reason: str, host_ns: int) -> None:
        """Record that the port was lost."""
        self._port_is_lost = True
        self.event(EventKind.PORT_LOST, Severity.SEVERITY_WARNING, reason, host_ns)

    def _write_reading(self, each: StampedReading | StampedGyro) -> None:
        if isinstance(each, StampedGyro):
            self._missing.gyro.note_reading(each)
            self._log.write("/gyro", gyro_message(each), each.host_ns, each.stamp_ns)
            self._watches.gyro.reset(each.host_ns)
            return
        self._missing.note_reading(each, self._waiting.newest_wheels_ns)
        self._log.write("/wheels", wheel_message(each), each.host_ns, each.stamp_ns)
        self._waiting.note_wheels(each.stamp_ns, each.reading.sequence)
        self._watches.wheels.reset(each.host_ns)
        self.progress.note_wheels(each)

    # --- cameras; `camera` is the name of one, empty for the only one

    def on_camera_connected(self, name: str, refused: Sequence[str], host_ns: int, camera: str = "") -> None:
        """Record that the camera was opened or reopened; `refused` lists settings that it did not accept."""
        self._cameras[camera].on_connected(name, refused, host_ns)

    def on_camera_lost(self, reason: str, host_ns: int, *, at_its_end: bool = False, camera: str = "") -> None:
        """Record that the camera was lost; with `at_its_end` it was a file that ended, which is no fault."""
        self._cameras[camera].on_lost(reason, host_ns, at_its_end=at_its_end)

    def on_detector_restarted(self, reason: str, host_ns: int, camera: str = "") -> None:
        """Record that the camera's detection process was replaced."""
        self._cameras[camera].event(EventKind.DETECTOR_RESTARTED, Severity.SEVERITY_WARNING, reason, host_ns, 1)

    def on_frame(
        self,
        grey: NDArray[np.uint8],
        stamp_ns: int,
        receive_ns: int,
        source: "StampSource | int",
        sequence: int,
        camera: str = "",
    ) -> None:
        """Detect the tags in a grey picture [height, width] at once, and write the picture if one is due.

        Args:
            grey: the picture.
            stamp_ns: middle of the exposure.
            receive_ns: time of reception by the host.
            source: source of the stamp.
            sequence: number of the picture.
            camera: name of the camera.

        Raises:
            LogError: the core has no detector.
        """
        if self._detector is None:
            raise LogError("pictures came to a recorder that was made without a detector; give it one")
        height_px, width_px = grey.shape
        if self.wants_picture(stamp_ns, camera):
            self.on_picture(encode_jpeg(grey, self._options.jpeg_quality), stamp_ns, receive_ns, camera)
        self.on_detections(
            self._detector.detect(grey),
            (width_px, height_px),
            stamp_ns,
            receive_ns,
            source,
            sequence,
            detector=self._detector.library,
            detector_settings=self._detector.settings,
            camera=camera,
        )

    def on_detections(
        self,
        detections: Sequence[Detection],
        size_px: tuple[int, int],
        stamp_ns: int,
        receive_ns: int,
        source: "StampSource | int",
        sequence: int,
        *,
        detector: str = "",
        detector_settings: str = "",
        camera: str = "",
    ) -> None:
        """Process the tags of one picture, possibly none; `size_px` is (width, height), the rest as in `on_frame`."""
        intake = self._cameras[camera]
        message = intake.on_detections(
            detections, size_px, stamp_ns, receive_ns, source, sequence, detector, detector_settings
        )
        self.progress.note_tags(detections, stamp_ns)
        if message is not None:
            self._waiting.add(intake.detections_topic, message, receive_ns)
            self._write_waiting(receive_ns)

    def wants_picture(self, stamp_ns: int, camera: str = "") -> bool:
        """Return whether to keep the picture with this stamp. Call it once per picture, in order."""
        return self._cameras[camera].wants_picture(stamp_ns)

    def on_picture(self, jpeg: bytes, stamp_ns: int, receive_ns: int, camera: str = "") -> None:
        """Write one picture, encoded as JPEG."""
        self._cameras[camera].on_picture(jpeg, stamp_ns, receive_ns)

    def on_frames_lost(self, kind: EventKind, reason: str, host_ns: int, count: int = 1, camera: str = "") -> None:
        """Count pictures that were dropped or unusable; their number is reported once a second."""
        self._cameras[camera].on_frames_lost(kind, reason, host_ns, count)

    def _write_waiting(self, now_ns: int) -> None:
        self._write_detections(self._waiting.take_ready(now_ns))

    def _write_detections(self, ready: Iterable[ReadyDetections]) -> None:
        for topic, message, receive_ns in ready:
            self._log.write(topic, message, receive_ns, message.stamp_ns)

    # --- time

    def tick(self, now_ns: int, realtime_ns: int | None = None, synchronised: bool = False) -> None:
        """Do what is due by time; call it a few times a second.

        Args:
            now_ns: present time of the run's clock.
            realtime_ns: present time of the wall clock; None if it is the run's clock, as in a simulation.
            synchronised: whether the wall clock is synchronised.
        """
        for each in self._intake.release_due(now_ns):
            self._write_reading(each)
        self._write_waiting(now_ns)
        for alarm in self._watches.alarms(now_ns, now_ns if realtime_ns is None else realtime_ns):
            self.event(alarm.kind, Severity.SEVERITY_WARNING, alarm.text, now_ns)
        self._log.report_notes(now_ns)
        if now_ns < self._next_anchor_ns:
            return
        self._next_anchor_ns = now_ns - now_ns % _ANCHOR_PERIOD_NS + _ANCHOR_PERIOD_NS
        anchor = ClockAnchor(
            stamp_ns=now_ns,
            monotonic_ns=now_ns - self._run.run_epoch_ns,
            realtime_ns=now_ns if realtime_ns is None else realtime_ns,
            synchronised=synchronised,
        )
        self._log.write("/clock", anchor, now_ns, now_ns)
        self._missing.report(self._intake, now_ns)
        self._log.report_excess(now_ns)

    def event(self, kind: EventKind, severity: "Severity | int", text: str, host_ns: int, count: int = 0) -> None:
        """Write an event."""
        self._log.event(kind, severity, text, host_ns, count)

    def on_note(self, text: str, host_ns: int) -> None:
        """Write what a person notes during the drive."""
        self.event(EventKind.NOTE, Severity.SEVERITY_INFO, text, host_ns)

    def close(self, now_ns: int) -> None:
        """Write waiting data and finish the files. A second call does nothing."""
        if self._closed:
            return
        self._closed = True
        for each in self._intake.release_all():
            self._write_reading(each)
        self._write_detections(self._waiting.take_all())
        self._missing.report(self._intake, now_ns)
        self._missing.count_missing(self._watches, port_is_lost=self._port_is_lost)
        self._log.report_notes(now_ns)
        self._log.report_excess(now_ns)
        lost = ", ".join(f"{count} {what}" for what, count in sorted(self.losses.items())) or "nothing"
        self.event(
            EventKind.RECORDING_STOPPED, Severity.SEVERITY_INFO, f"lost so far: {lost}", now_ns, self.losses.total()
        )
        self._log.close()
