"""The recorder with devices: threads read port and cameras, child processes detect, and the core writes.

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

from groundsbot.onboard.log import Disk, Event, LogHead, RunLog, segment_limits
from groundsbot.onboard.process import RunClock, is_wall_clock_synchronised, read_clocks
from groundsbot.onboard.recorder.camera_detection import CameraDetection
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
        self._detections: list[CameraDetection] = []  # by camera, in the order of robot.yaml

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
        try:
            for camera in files.cameras:
                self._detections.append(CameraDetection(camera, self._put, self._watcher))
            self.start_ns = self._clock.now_ns()  # after the start of the detectors, as data before are not recorded
            run = RunIdentity(
                files.robot,
                files.text,
                files.models,
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
                    expect_camera=bool(files.cameras),
                    open_log=self._open_log,
                )
                for each in self._detections:
                    each.core = self.core
                self.begun.set()
                try:
                    self._record()
                finally:
                    self.core.close(self._clock.now_ns())
        finally:
            closing = [threading.Thread(target=each.close) for each in self._detections]  # each may take some time
            for thread in closing:
                thread.start()
            for thread in closing:
                thread.join()

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
                (
                    any(each.is_busy for each in self._detections)
                    or any(each.is_alive() for each in threads)
                    or not self._work.empty()
                )
                and self._clock.now_ns() < end_ns
            )
        )
        while not self._work.empty():  # acts remain only if the time limit was reached
            self._work.get()()
        for each in self._detections:
            reason = f"pictures: detection had not ended {_END_LIMIT_NS / _NS_PER_S:g} s after the stop"
            each.give_up(reason, self._clock.now_ns())

    def _device_threads(self) -> list[DeviceThread]:
        files, devices = self.files, self.files.robot.devices
        threads: list[DeviceThread] = []
        if devices.encoder_port is not None:
            port = EncoderPort(str(files.path.parent / devices.encoder_port), devices.encoder_baud)
            threads.append(WheelThread(port, self.core, self._put, self._stop, self._on_notice))
        for camera, detection in zip(files.cameras, self._detections, strict=True):
            thread = CameraThread(
                camera,
                self.core,
                self._put,
                self._stop,
                self._on_notice,
                clock=self._clock,
                since_ns=self.start_ns,
                slots=detection.slots,
                detect=detection.detect,
                drop=detection.drop,
            )
            threads.append(thread)
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

    def _put(self, act: Act) -> None:
        """Queue an act for the core's thread, with the present time."""
        self._work.put(partial(act, self._clock.now_ns()))
