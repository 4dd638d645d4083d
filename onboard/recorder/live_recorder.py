"""The recorder with devices: threads read port and camera, a child process detects, and the core writes.

All data reach the core through one queue, in one thread. They are stamped on arrival, so that a busy core does not
delay stamps.
"""

import contextlib
import queue
import secrets
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Final

from groundsbot.calib.foundation import is_complete, is_jpeg
from groundsbot.onboard.camera import Frame
from groundsbot.onboard.detection import ChildDetector, DetectionResult
from groundsbot.onboard.log import Disk, Event, EventKind, LogHead, RunLog, segment_limits
from groundsbot.onboard.process import RunClock, is_wall_clock_synchronised, read_clocks
from groundsbot.onboard.recorder.device_threads import Act, CameraThread, DeviceThread, WheelThread
from groundsbot.onboard.recorder.disk.log_keeper import LogKeeper
from groundsbot.onboard.recorder.disk.log_thread import LogThread
from groundsbot.onboard.recorder.disk.room import DiskRoom, one_recorder, space_policy
from groundsbot.onboard.recorder.recorder import RecorderCore, RunIdentity
from groundsbot.onboard.recorder.robot_files import RobotFiles
from groundsbot.onboard.recorder.watching import WatchedLog, Watcher
from groundsbot.onboard.wheels import EncoderPort

_NS_PER_S: Final = 1_000_000_000
_WAIT_S: Final = 0.05
_TICK_NS: Final = 100_000_000
_PICTURES_UNDER_WAY: Final = 8
_END_LIMIT_NS: Final = 1_500_000_000  # a device that blocks must not keep the log open


def new_run_id(start_ns: int) -> str:
    """Return a name for a run: its start in UTC, and four random digits in case two runs start at the same time."""
    start = datetime.fromtimestamp(start_ns // _NS_PER_S, UTC)
    return f"{start:%Y%m%dT%H%M%SZ}-{secrets.token_hex(2)}"


class LiveRecorder:
    """Recorder of one run.

    Attributes:
        core: the core, with counts and losses; set by `run`.
        log: the log on its disk; set by `run`.
        begun: set when `core` and `log` exist.
        files: the robot.
        output: folder for run folders.
        start_ns: start of the run on its clock; set by `run`.
    """

    core: RecorderCore
    log: LogThread

    def __init__(
        self,
        files: RobotFiles,
        output: Path,
        stop: threading.Event,
        on_event: Callable[[Event], None],
        on_notice: Callable[[str], None],
        watcher: Watcher | None = None,
    ) -> None:
        """Prepare; no device or file is opened yet.

        Args:
            files: the robot.
            output: folder for run folders.
            stop: ends the recording when set.
            on_event: called with each event of the log.
            on_notice: called with messages that are not in the log, as on missing devices.
            watcher: is offered what is recorded.
        """
        self.files = files
        self.output = output
        self.begun = threading.Event()
        self._stop = stop
        self._on_event = on_event
        self._on_notice = on_notice
        self._watcher = watcher
        self._clock = RunClock()
        self.start_ns = 0
        self._served_s = time.monotonic()
        self._work: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()  # acts for the core's thread
        self._slots = threading.Semaphore(_PICTURES_UNDER_WAY)
        self._under_way: dict[Frame, bool] = {}  # pictures in detection, and whether to keep them
        self._detector: ChildDetector | None = None

    def now_ns(self) -> int:
        """Return the present time of the run's clock."""
        return self._clock.now_ns()

    @property
    def is_stopping(self) -> bool:
        """Whether the stop of the recording has been requested."""
        return self._stop.is_set()

    @property
    def stalled_s(self) -> float:
        """Time since the last cycle of the core's thread, which normally has twenty cycles per second."""
        return time.monotonic() - self._served_s

    def note(self, text: str) -> None:
        """Write a note into the log; called from any thread after `begun` is set."""
        self._put(partial(self.core.on_note, text))

    def run(self) -> None:
        """Record until `stop` is set, then read the data buffered by the devices and close the log.

        Raises:
            OnboardError: recording cannot start or continue.
        """
        files = self.files
        if files.camera_settings is not None:
            self._detector = ChildDetector(files.detector_settings, self._on_detector_restart)
        self.start_ns = self._clock.now_ns()  # after the start of the detector, as data before are not recorded
        try:
            run = RunIdentity(
                files.robot,
                files.text,
                files.camera,
                new_run_id(self.start_ns),
                self.start_ns,
                self._clock.run_epoch_ns,
            )
            wheels = files.robot.devices.encoder_port is not None
            with one_recorder(files.path, self.output, files.robot.robot_id):
                self.core = RecorderCore(
                    self.output,
                    run,
                    on_event=self._on_event,
                    expect_wheels=wheels,
                    expect_camera=files.camera_settings is not None,
                    open_log=self._open_log,
                )
                self.begun.set()
                try:
                    self._record()
                finally:
                    self.core.close(self._clock.now_ns())
        finally:
            if self._detector is not None:
                self._detector.close()

    def _open_log(self, folder: Path, head: LogHead, start_ns: int, keep_pictures: bool) -> RunLog:
        robot, disk = self.files.robot, Disk()
        room = DiskRoom(disk, self.output, robot.robot_id, space_policy(robot))
        limits = segment_limits(robot)
        keeper = LogKeeper(folder, head, start_ns, disk, room, keep_pictures=keep_pictures, limits=limits)
        self.log = LogThread(keeper)
        if self._watcher is None:
            return self.log
        self._watcher.offer_head(head, start_ns)
        return WatchedLog(self.log, self._watcher)

    def _record(self) -> None:
        threads = self._device_threads()
        for thread in threads:
            thread.start()
        try:
            self._serve(lambda: not self._stop.is_set())
        finally:
            self._stop.set()
        end_ns = self._clock.now_ns() + _END_LIMIT_NS
        self._serve(
            lambda: (
                (self._under_way or any(each.is_alive() for each in threads) or not self._work.empty())
                and self._clock.now_ns() < end_ns
            )
        )
        while not self._work.empty():  # acts remain only if the time limit was reached
            self._work.get()()
        for frame, is_wanted in self._under_way.items():
            reason = f"pictures: detection had not ended {_END_LIMIT_NS / _NS_PER_S:g} s after the stop"
            self._keep_picture(frame, is_wanted, reason, self._clock.now_ns())

    def _device_threads(self) -> list[DeviceThread]:
        files, devices = self.files, self.files.robot.devices
        threads: list[DeviceThread] = []
        if devices.encoder_port is not None:
            port = EncoderPort(str(files.path.parent / devices.encoder_port), devices.encoder_baud)
            threads.append(WheelThread(port, self.core, self._put, self._stop, self._on_notice))
        if files.camera_settings is not None:
            camera = CameraThread(
                files.camera_settings,
                self.core,
                self._put,
                self._stop,
                self._on_notice,
                clock=self._clock,
                since_ns=self.start_ns,
                slots=self._slots,
                detect=self._detect,
                drop=self._drop,
            )
            threads.append(camera)
        return threads

    def _serve(self, go_on: Callable[[], bool]) -> None:
        next_tick_ns = 0
        while go_on():
            self._served_s = time.monotonic()
            with contextlib.suppress(queue.Empty):
                self._work.get(timeout=_WAIT_S)()
            now_ns = self._clock.now_ns()
            if now_ns >= next_tick_ns:
                next_tick_ns = now_ns + _TICK_NS
                clocks = read_clocks()
                now_ns = self._clock.from_monotonic(clocks.monotonic_ns)
                self.core.tick(now_ns, clocks.realtime_ns, is_wall_clock_synchronised())

    # --- in the thread of the core

    def _detect(self, frame: Frame, now_ns: int) -> None:
        if self._detector is None:
            return
        if frame.refusal:
            self._slots.release()
            self.core.on_frames_lost(EventKind.FRAME_UNUSABLE, f"unusable pictures: {frame.refusal}", now_ns)
            return
        self._under_way[frame] = want_jpeg = self.core.wants_picture(frame.stamp_ns)
        self._detector.submit(
            frame.picture, want_jpeg, lambda result: self._put(partial(self._take_detections, frame, result))
        )

    def _drop(self, frame: Frame, now_ns: int) -> None:
        self._keep_picture(frame, self.core.wants_picture(frame.stamp_ns), "pictures: detection is too slow", now_ns)

    def _keep_picture(self, frame: Frame, is_wanted: bool, reason: str, now_ns: int) -> None:
        """Write a picture without detections, if it is to be kept; its tags can be detected later."""
        picture = frame.picture
        if is_wanted and isinstance(picture, bytes) and is_jpeg(picture) and is_complete(picture):
            self.core.on_picture(picture, frame.stamp_ns, frame.receive_ns)
        self.core.on_frames_lost(EventKind.FRAME_DROPPED, reason, now_ns)

    def _take_detections(self, frame: Frame, result: DetectionResult, now_ns: int) -> None:
        self._under_way.pop(frame)
        self._slots.release()
        if self._detector is None:
            return
        if result.error is not None:
            self.core.on_frames_lost(EventKind.FRAME_UNUSABLE, f"unusable pictures: {result.error}", now_ns)
            return
        if result.jpeg is not None:
            self.core.on_picture(result.jpeg, frame.stamp_ns, frame.receive_ns)
        self.core.on_detections(
            result.detections,
            result.size_px,
            frame.stamp_ns,
            frame.receive_ns,
            frame.source,
            frame.sequence,
            detector=self._detector.library,
            detector_settings=self._detector.settings,
        )
        if self._watcher is not None:
            self._watcher.offer_picture(frame.picture, result.detections)

    # --- for all threads

    def _on_detector_restart(self, reason: str) -> None:
        self._put(partial(self.core.on_detector_restarted, reason))

    def _put(self, act: Act) -> None:
        """Queue an act for the core's thread, with the present time."""
        self._work.put(partial(act, self._clock.now_ns()))
