"""Status file and systemd notifications of a recording.

They have a thread of their own, so that the status also shows a disk or device that blocks the recording. The watchdog
of systemd is notified only while the log makes progress.
"""

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, Literal, NamedTuple

from groundsbot.onboard.log import DETECTIONS_TOPIC, Event, EventKind, Severity, camera_topic
from groundsbot.onboard.monitoring.disk_hours import hours_until_full
from groundsbot.onboard.monitoring.status import (
    DeviceStatus,
    DiskStatus,
    ProgressStatus,
    Rates,
    RecordingSnapshot,
    Status,
    write_status,
)
from groundsbot.onboard.process import Notifier, is_wall_clock_synchronised
from groundsbot.onboard.recorder import LiveRecorder, LogStatus, RobotCamera

_NS_PER_S: Final = 1_000_000_000
_PERIOD_S: Final = 1.0
_EVENTS_SHOWN: Final = 6
_SILENT_S: Final = 3.0
_STALLED_S: Final = 5.0
_WHEELS: Final = "wheel readings"
_YAW_RATES: Final = "yaw rates"
_NOTICES: Final = 8  # most different notices; bounds memory over weeks


class _EventGroup(NamedTuple):
    """Events of one kind."""

    kind: str
    text: str  # of the newest
    times: int
    first: str  # time of day
    newest: str

    def __str__(self) -> str:
        since = f" ({self.times} times since {self.first})" if self.times > 1 else ""
        return f"{self.newest} {self.kind}: {self.text}{since}"


class Housekeeper(threading.Thread):
    """Thread that reports the status of one recording from its start to its end."""

    def __init__(
        self,
        recorder: LiveRecorder,
        path: Path,
        notifier: Notifier,
        on_notice: Callable[[str], None],
        period_s: float = _PERIOD_S,
        *,
        on_status: Callable[[Status], None] | None = None,
        goes_on: Callable[[], bool] = lambda: False,
    ) -> None:
        """Prepare; the thread is not started yet.

        Args:
            recorder: the recorder.
            path: path of the status file.
            notifier: notifier for systemd.
            on_notice: called once for each problem with the status itself.
            period_s: time between two reports.
            on_status: called with each status.
            goes_on: whether the program goes on after this run; systemd is then not told of an end.
        """
        super().__init__(name="housekeeping", daemon=True)
        self._recorder = recorder
        self._path = path
        self._notifier = notifier
        self._on_notice = on_notice
        watchdog_s = notifier.watchdog_s or _STALLED_S * 2.0
        self._period_s = min(period_s, watchdog_s / 4.0)
        self._stalled_s = watchdog_s / 2.0
        self._on_status = on_status
        self._goes_on = goes_on
        self._over = threading.Event()
        self._rates = Rates()
        self._events: dict[str, _EventGroup] = {}  # by kind, the newest last
        self._free_bytes = 0
        self._reported: set[str] = set()
        self._said_stopping = False

    def note(self, event: Event) -> None:
        """Store a warning, an error or a person's note for the status; called by the recorder."""
        if event.severity != Severity.SEVERITY_INFO or event.kind == EventKind.NOTE:
            group = self._events.pop(event.kind, None)
            now = time.strftime("%H:%M:%S")
            times, first = (group.times + 1, group.first) if group is not None else (1, now)
            self._events[event.kind] = _EventGroup(event.kind, event.text, times, first, now)

    def last_events(self) -> list[str]:
        """Return a line for each of the kinds with the newest events."""
        return [str(each) for each in list(self._events.values())[-_EVENTS_SHOWN:]]

    def run(self) -> None:
        """Report each period until `end` is called."""
        while not self._recorder.begun.wait(self._period_s):
            if self._over.is_set():
                return
        self._notifier.ready()
        while not self._over.wait(self._period_s):
            stopping = self._recorder.is_stopping
            if stopping and not self._goes_on():
                self._notify_stopping()
                self._write("stopping")
            else:
                self._notify_systemd(self._write("stopping" if stopping else "recording"))

    def end(self) -> None:
        """Stop the thread and write the last status, after the recording has ended or failed to begin."""
        self._over.set()
        self.join(2.0 * self._period_s)
        if not self._goes_on():
            self._notify_stopping()
        if self._recorder.begun.is_set() and not self.is_alive():  # a thread still alive is blocked by its disk
            self._write("stopped")

    def _notify_stopping(self) -> None:
        """Notify systemd once that the service stops; its watchdog ends then."""
        if not self._said_stopping:
            self._said_stopping = True
            self._notifier.stopping()

    def _write(self, state: Literal["recording", "stopping", "stopped"]) -> Status | None:
        """Write the status and return it, or None if that failed, which must not end the recording."""
        try:
            status = self._inspect(state)
            reason = write_status(status, self._path)
            if self._on_status is not None:
                self._on_status(status)
        except Exception as error:  # errors here must not affect the watchdog, which depends on the log alone
            self._report(f"status: cannot be determined ({type(error).__name__}: {error})")
            return None
        if reason is not None:
            self._report(f"status: {self._path} cannot be written ({reason})")
        return status

    def _report(self, text: str) -> None:
        if text not in self._reported and len(self._reported) < _NOTICES:
            self._reported.add(text)
            self._on_notice(text)

    def _notify_systemd(self, status: Status | None) -> None:
        text = "the status cannot be determined"
        if status is not None:
            pictures = " and ".join(f"{each.rate_hz:.0f}" for each in status.cameras.values() or [status.camera])
            rates = f"{status.wheels.rate_hz:.0f} lines/s, {pictures} fps"
            text = "; ".join(status.problems) or rates
        if self._log_stalled_s() < self._stalled_s:
            self._notifier.alive(text)
        else:
            self._notifier.notify_trouble(text)

    def _log_stalled_s(self) -> float:
        return max(self._recorder.stalled_s, self._recorder.log.stalled_s)

    def _inspect(self, state: Literal["recording", "stopping", "stopped"]) -> Status:
        recorder, core, log = self._recorder, self._recorder.core, self._recorder.log.status
        devices = recorder.files.robot.devices
        now_ns = recorder.now_ns()
        counts = dict(core.counts)
        self._rates.add(
            RecordingSnapshot(now_ns, counts, dict(core.newest_ns), _size_of(core.folder), dict(core.losses))
        )
        wheels = self._rates.device("/wheels", devices.encoder_port or "none", devices.encoder_port is not None)
        cameras = {
            each.name: self._rates.device(camera_topic(DETECTIONS_TOPIC, each.name), _device_of(each), expected=True)
            for each in recorder.files.cameras
        }
        no_camera = DeviceStatus(name="none", rate_hz=0.0, age_s=None, expected=False)
        has_gyro = recorder.files.robot.gyro is not None or counts.get("/gyro", 0) > 0
        gyro = self._rates.device("/gyro", devices.encoder_port or "none", expected=True) if has_gyro else None
        stalled_s = self._log_stalled_s() if state == "recording" else 0.0
        recorded_s = (now_ns - recorder.start_ns) / _NS_PER_S
        seeing = {name for name, each in cameras.items() if not _is_silent(each, recorded_s)}
        silent = [_WHEELS] if _is_silent(wheels, recorded_s) else []
        silent += [f"pictures of {name}".removesuffix(" of ") for name in cameras if name not in seeing]
        silent += [_YAW_RATES] if gyro is not None and _is_silent(gyro, recorded_s) else []
        problems = [f"no {what} for {_SILENT_S:g} s" for what in silent]
        lately = ", ".join(f"{count} {what}" for what, count in sorted(self._rates.lost_lately().items()))
        if lately:
            problems.append(f"lost in the last 10 s: {lately}")
        if stalled_s > _STALLED_S:
            problems.insert(0, f"the log has made no progress for {stalled_s:.0f} s")
        if log.problem is not None:
            problems.insert(0, f"disk: {log.problem}")
        return Status(
            robot_id=recorder.files.robot.robot_id,
            run_id=core.folder.name,
            folder=_path_text(core.folder),
            pid=os.getpid(),
            state=state,
            updated_ns=time.time_ns(),
            recording_s=round(recorded_s, 1),
            wheels=wheels,
            camera=next(iter(cameras.values()), no_camera),
            cameras=cameras if recorder.files.robot.cameras else {},
            gyro=gyro,
            tags_in_view=[
                f"{tag} in {name}".removesuffix(" in ")
                for name in cameras
                if name in seeing
                for tag in core.tags_in_view(name)
            ],
            progress=ProgressStatus(**core.progress.now._asdict()),
            counts=dict(log.written),
            losses=dict(core.losses),
            disk=self._disk(log),
            clock_synchronised=is_wall_clock_synchronised(),
            stalled_s=round(stalled_s, 2),
            problems=problems if state == "recording" else [],
            last_events=self.last_events(),
        )

    def _disk(self, log: LogStatus) -> DiskStatus:
        try:
            room = os.statvfs(self._recorder.output)
            self._free_bytes = room.f_bavail * room.f_frsize
        except OSError:
            self._free_bytes = 0
        per_s = self._rates.bytes_per_s()
        hours = hours_until_full(self._free_bytes, per_s)
        return DiskStatus(
            free_bytes=self._free_bytes,
            bytes_per_s=per_s,
            hours_left=None if hours is None else round(hours, 1),
            waiting_bytes=log.waiting_bytes,
            problem=log.problem,
        )


def _device_of(camera: RobotCamera) -> str:
    return camera.robot.devices.camera or "none"


def _is_silent(device: DeviceStatus, recorded_s: float) -> bool:
    """Return whether an expected device has given nothing for too long."""
    return device.expected and (recorded_s if device.age_s is None else device.age_s) > _SILENT_S


def _path_text(path: Path) -> str:
    """Return a path as text; names need not be UTF-8, but JSON must be."""
    return os.fsencode(path).decode(errors="backslashreplace")


def _size_of(folder: Path) -> int:
    """Return the size of the run's files, or 0 if a file is removed during the scan."""
    try:
        return sum(each.stat().st_size for each in os.scandir(folder))
    except OSError:
        return 0
