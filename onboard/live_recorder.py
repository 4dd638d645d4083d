"""The recorder at work: threads read port and camera, a child process detects, the core writes.

Everything reaches the core through one queue, in one thread. Whatever arrives is stamped where it arrives, so that a
busy core delays no stamp.
"""

import contextlib
import queue
import secrets
import threading
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Final

from google.protobuf.message import Message

from calib.camera_model import CameraModel, read_camera_yaml
from calib.robot import Robot, parse_robot_yaml
from calib.yaml_file import read_text
from onboard.camera import Camera, CameraEndedError, CameraLostError, CameraSettings, Frame, camera_for
from onboard.clock import RunClock, read_clocks, wall_clock_synchronised
from onboard.detection_process import ChildDetector, DetectionResult, DetectorSettings
from onboard.disk_room import DiskRoom, one_recorder, space_policy
from onboard.encoder_port import EncoderPort, PortLostError
from onboard.errors import OnboardError
from onboard.log_keeper import LogKeeper
from onboard.log_thread import LogThread
from onboard.messages import Event, EventKind
from onboard.recorder import RecorderCore, Run, segment_limits
from onboard.storage import Disk

_NS_PER_S: Final = 1_000_000_000
_READ_S: Final = 0.05
_RETRY_S: Final = 0.5
_TICK_NS: Final = 100_000_000
_QUIET_S: Final = 0.1  # a port that has been silent so long at the end has given everything
_PICTURES_UNDER_WAY: Final = 8
_END_LIMIT_NS: Final = 4 * _NS_PER_S


class RobotFiles:
    """robot.yaml and the camera file it names, read and fitting together.

    Attributes:
        path: of robot.yaml.
        robot: the robot.
        text: its file's text.
        camera: the calibration; None for wheels only.
        camera_settings: how to open the camera; None for wheels only.
    """

    def __init__(self, path: Path) -> None:
        """Reads them.

        Raises:
            CalibError: a file is missing or wrong.
            OnboardError: there is nothing to record, or no calibration for the camera.
        """
        self.path = path
        self.text = read_text(path)
        self.robot: Robot = parse_robot_yaml(self.text, str(path))
        devices = self.robot.devices
        if devices.encoder_port is None and devices.camera is None:
            raise OnboardError(f"{path}: devices names neither encoder_port nor camera; give at least one to record")
        if devices.camera is not None and self.robot.camera is None:
            raise OnboardError(
                f"{path}: devices.camera is {devices.camera} but camera names no calibration; "
                "give a camera_info YAML or take devices.camera out"
            )
        self.camera: CameraModel | None = None
        self.camera_settings: CameraSettings | None = None
        if devices.camera is not None and self.robot.camera is not None:
            self.camera = read_camera_yaml(path.parent / self.robot.camera)
            self.camera_settings = CameraSettings(
                str(path.parent / devices.camera),
                self.camera.width_px,
                self.camera.height_px,
                devices.camera_fps,
                devices.camera_exposure_s,
                devices.camera_gain,
            )

    @property
    def detector_settings(self) -> DetectorSettings:
        """How to detect."""
        options = self.robot.recorder
        return DetectorSettings(tuple(options.families), options.detector, options.quad_decimate, options.jpeg_quality)


def new_run_id(start_ns: int) -> str:
    """A name for a run: its start in UTC, and four digits by chance in case two start at once."""
    start = datetime.fromtimestamp(start_ns // _NS_PER_S, UTC)
    return f"{start:%Y%m%dT%H%M%SZ}-{secrets.token_hex(2)}"


class LiveRecorder:
    """Records one run until it is told to stop.

    Attributes:
        core: what has been written and lost; there from `run` on.
        log: how the log does on its disk; there from `run` on.
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
    ) -> None:
        """Opens nothing yet.

        Args:
            files: the robot.
            output: where run folders go.
            stop: set it to end the recording.
            on_event: told of each event in the log.
            on_notice: told, in words, of what is not for the log: what is waited for.
        """
        self._files = files
        self._output = output
        self._stop = stop
        self._on_event = on_event
        self._on_notice = on_notice
        self._clock = RunClock()
        self._start_ns = self._clock.now_ns()
        self._work: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()  # for the core, in its thread
        self._slots = threading.Semaphore(_PICTURES_UNDER_WAY)
        self._under_way = 0
        self._detector: ChildDetector | None = None

    def run(self) -> None:
        """Records until `stop` is set, then takes in what the devices still hold and closes the log.

        Raises:
            OnboardError: recording cannot start or go on.
        """
        files = self._files
        if files.camera_settings is not None:
            self._detector = ChildDetector(files.detector_settings)
        try:
            run = Run(
                files.robot,
                files.text,
                files.camera,
                new_run_id(self._start_ns),
                self._start_ns,
                self._clock.run_epoch_ns,
            )
            wheels = files.robot.devices.encoder_port is not None
            with one_recorder(files.path, self._output, files.robot.robot_id):
                self.core = RecorderCore(
                    self._output, run, on_event=self._on_event, expect_wheels=wheels, open_log=self._open_log
                )
                try:
                    self._record()
                finally:
                    self.core.close(self._clock.now_ns())
        finally:
            if self._detector is not None:
                self._detector.close()

    def _open_log(self, folder: Path, head: Mapping[str, Message], start_ns: int, keep_pictures: bool) -> LogThread:
        robot, disk = self._files.robot, Disk()
        room = DiskRoom(disk, self._output, robot.robot_id, space_policy(robot))
        limits = segment_limits(robot)
        keeper = LogKeeper(folder, head, start_ns, disk, room, keep_pictures=keep_pictures, limits=limits)
        self.log = LogThread(keeper)
        return self.log

    def _record(self) -> None:
        threads = []
        if self._files.robot.devices.encoder_port is not None:
            threads.append(threading.Thread(target=self._read_wheels, name="wheels", daemon=True))
        if self._files.camera_settings is not None:
            threads.append(threading.Thread(target=self._read_camera, name="camera", daemon=True))
        for thread in threads:
            thread.start()
        try:
            self._serve(lambda: not self._stop.is_set())
        finally:
            self._stop.set()
        end_ns = self._clock.now_ns() + _END_LIMIT_NS
        self._serve(
            lambda: (
                (self._under_way > 0 or any(each.is_alive() for each in threads) or not self._work.empty())
                and self._clock.now_ns() < end_ns
            )
        )
        while not self._work.empty():  # only if time ran out
            self._work.get()()
        if self._under_way:
            reason = f"detection had not ended {_END_LIMIT_NS // _NS_PER_S} s after the stop"
            self.core.on_frames_lost(EventKind.FRAME_DROPPED, reason, self._clock.now_ns(), self._under_way)

    def _serve(self, go_on: Callable[[], bool]) -> None:
        next_tick_ns = 0
        while go_on():
            with contextlib.suppress(queue.Empty):
                self._work.get(timeout=_READ_S)()
            now_ns = self._clock.now_ns()
            if now_ns >= next_tick_ns:
                next_tick_ns = now_ns + _TICK_NS
                clocks = read_clocks()
                now_ns = self._clock.from_monotonic(clocks.monotonic_ns)
                self.core.tick(now_ns, clocks.realtime_ns, wall_clock_synchronised())

    # --- in the thread of the wheels

    def _read_wheels(self) -> None:
        devices = self._files.robot.devices
        port = EncoderPort(devices.encoder_port or "", devices.encoder_baud)
        while self._opened("wheels", port.open, PortLostError):
            self._put(partial(self.core.on_port_connected, port.path))
            try:
                while not self._stop.is_set():
                    self._pass_on(port.read(_READ_S))
                while data := port.read(_QUIET_S):
                    self._pass_on(data)
                return
            except PortLostError as error:
                self._put(partial(self.core.on_port_lost, str(error)))
            finally:
                port.close()

    def _pass_on(self, data: bytes) -> None:
        if data:
            self._put(partial(self.core.on_serial_bytes, data))

    # --- in the thread of the camera

    def _read_camera(self) -> None:
        settings = self._files.camera_settings
        if settings is None:
            return
        camera: Camera | None = None
        refused: list[str] = []

        def open_camera() -> None:
            nonlocal camera, refused
            opened = camera or camera_for(settings, self._clock, self._start_ns)
            refused = opened.open()
            camera = opened  # kept over reconnects: it knows what it has given already

        while self._opened("camera", open_camera, CameraLostError) and camera is not None:
            self._put(partial(self.core.on_camera_connected, settings.device, refused))
            try:
                self._read_frames(camera)
                return
            except CameraEndedError as error:
                self._put(partial(self.core.on_camera_lost, str(error), at_its_end=True))
                return
            except CameraLostError as error:
                self._put(partial(self.core.on_camera_lost, str(error)))
            finally:
                camera.close()

    def _read_frames(self, camera: Camera) -> None:
        stopping = False
        while True:
            stopped = self._stop.is_set()  # asked before the look, so that the last look comes after the stop
            frames = camera.read(_READ_S)
            for frame in frames:
                if self._slots.acquire(blocking=camera.waits):
                    self._put(partial(self._detect, frame))
                else:
                    self._put(partial(self.core.on_frames_lost, EventKind.FRAME_DROPPED, "detection is too slow"))
            if stopped and (not camera.drains or (stopping and not frames)):
                return
            stopping = stopped

    # --- in the thread of the core

    def _detect(self, frame: Frame, _now_ns: int) -> None:
        if self._detector is None:
            return
        self._under_way += 1
        want_jpeg = self.core.wants_picture(frame.stamp_ns)
        self._detector.submit(
            frame.picture, want_jpeg, lambda result: self._put(partial(self._detected, frame, result))
        )

    def _detected(self, frame: Frame, result: DetectionResult, now_ns: int) -> None:
        self._under_way -= 1
        self._slots.release()
        if self._detector is None:
            return
        if result.error is not None:
            self.core.on_frames_lost(EventKind.FRAME_UNUSABLE, result.error, now_ns)
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

    # --- for all threads

    def _put(self, act: Callable[[int], None]) -> None:
        """Hands an act to the core's thread, with the time it was handed over."""
        self._work.put(partial(act, self._clock.now_ns()))

    def _opened(self, what: str, open_device: Callable[[], None], absent: type[OnboardError]) -> bool:
        """Tries until the device opens; says once that it waits. False: told to stop before."""
        told = False
        while not self._stop.is_set():
            try:
                open_device()
            except absent as error:
                if not told:
                    self._on_notice(f"waiting for the {what}: {error}")
                    told = True
                self._stop.wait(_RETRY_S)
            else:
                return True
        return False
