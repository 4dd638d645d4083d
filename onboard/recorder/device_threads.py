"""Threads that open, read and reopen the port and the cameras, and pass data on with the time of arrival.

After any error a thread reports it and tries again, because a recorder runs for hours unattended.
"""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Final

from groundsbot.onboard.camera import Camera, CameraEndedError, Frame, camera_for
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.log import EventKind
from groundsbot.onboard.process import RunClock
from groundsbot.onboard.recorder.recorder import RecorderCore
from groundsbot.onboard.recorder.robot_files import RobotCamera
from groundsbot.onboard.wheels import EncoderPort

_NS_PER_S: Final = 1_000_000_000
_READ_S: Final = 0.05
_RETRY_S: Final = 0.5
_DROPPED: Final = "pictures: dropped by the camera's driver"
_QUIET_S: Final = 0.1  # silence at the end after which a device has no more data
_DRAIN_NS: Final = 300_000_000  # after this time at the end all data that a device had buffered are read
# Pause between reads, so that several lines are read together: waking a thread costs as much as two lines, and lines
# have their own times of measurement. It is not a whole number of ms, because a reader in step with the lines would
# find all of them at the same age, and never one that has just arrived.
_BREATH_S: Final = 0.0073

Act = Callable[[int], None]  # called with the time at which it was queued
Put = Callable[[Act], None]


class DeviceThread(threading.Thread, ABC):
    """Thread that keeps one device open until stopped."""

    def __init__(self, name: str, put: Put, stop: threading.Event, on_notice: Callable[[str], None]) -> None:
        """Prepare; the thread is not started yet.

        Args:
            name: name of the device in messages.
            put: queues an act for the core's thread.
            stop: ends the thread, after the data buffered by the device have been read.
            on_notice: called once per wait for the device, with the reason.
        """
        super().__init__(name=name, daemon=True)
        self._put = put
        self._stop_event = stop
        self._on_notice = on_notice
        self._noticed = False

    def run(self) -> None:
        """Open and read the device, again after each loss."""
        while not self._stop_event.is_set():
            if not self._open():
                self._stop_event.wait(_RETRY_S)
                continue
            begun_s = time.monotonic()
            try:
                self._read()
                return
            except CameraEndedError as error:
                self._on_loss(str(error), at_its_end=True)
                return
            except OnboardError as error:
                self._on_loss(str(error), at_its_end=False)
            except Exception as error:  # an unexpected error must not end the recording of the device
                self._on_loss(f"{self.name}: {error!r}", at_its_end=False)
            finally:
                self._close()
            if time.monotonic() - begun_s < _RETRY_S:  # a loose contact
                self._stop_event.wait(_RETRY_S)

    def _open(self) -> bool:
        try:
            self._connect()
        except Exception as error:
            self._close()
            if not self._noticed:
                reason = str(error) if isinstance(error, OnboardError) else repr(error)
                self._on_notice(f"waiting for the {self.name}: {reason}")
                self._noticed = True
            return False
        self._noticed = False
        return True

    @abstractmethod
    def _connect(self) -> None:
        """Open the device and report it."""

    @abstractmethod
    def _read(self) -> None:
        """Read until stopped and no data are left."""

    @abstractmethod
    def _on_loss(self, reason: str, *, at_its_end: bool) -> None:
        """Report the loss of the device."""

    @abstractmethod
    def _close(self) -> None:
        """Release the device; never raises."""


class WheelThread(DeviceThread):
    """Thread that reads the wheel controller's port."""

    def __init__(
        self,
        port: EncoderPort,
        core: RecorderCore,
        put: Put,
        stop: threading.Event,
        on_notice: Callable[[str], None],
    ) -> None:
        super().__init__("wheels", put, stop, on_notice)
        self._port = port
        self._core = core

    def _connect(self) -> None:
        self._port.open()
        self._put(partial(self._core.on_port_connected, self._port.path))

    def _read(self) -> None:
        while not self._stop_event.is_set():
            if self._pass_on(self._port.read(_READ_S)):
                time.sleep(_BREATH_S)
        end_ns = time.monotonic_ns() + _DRAIN_NS
        while self._pass_on(self._port.read(_QUIET_S)) and time.monotonic_ns() < end_ns:
            pass

    def _on_loss(self, reason: str, *, at_its_end: bool) -> None:
        del at_its_end  # a port does not end
        self._put(partial(self._core.on_port_lost, reason))

    def _close(self) -> None:
        self._port.close()

    def _pass_on(self, data: bytes) -> bool:
        if data:
            self._put(partial(self._core.on_serial_bytes, data))
        return bool(data)


class CameraThread(DeviceThread):
    """Thread that reads a camera."""

    def __init__(
        self,
        camera: RobotCamera,
        core: RecorderCore,
        put: Put,
        stop: threading.Event,
        on_notice: Callable[[str], None],
        *,
        clock: RunClock,
        since_ns: int,
        slots: threading.Semaphore,
        detect: Callable[[Frame, int], None],
        drop: Callable[[Frame, int], None],
    ) -> None:
        """Prepare; the thread is not started yet.

        Args:
            camera: the camera.
            core: the core, which is notified of connection and loss.
            put: see DeviceThread.
            stop: see DeviceThread.
            on_notice: see DeviceThread.
            clock: the run's clock.
            since_ns: older pictures in a folder are ignored.
            slots: one is acquired for each picture passed to `detect`, and released after its detection.
            detect: called in the core's thread with a picture and the time.
            drop: called in the core's thread with a picture for which there was no slot.
        """
        super().__init__(camera.in_words, put, stop, on_notice)
        self._of = camera.name
        self._settings = camera.settings
        self._core = core
        self._clock = clock
        self._since_ns = since_ns
        self._slots = slots
        self._detect = detect
        self._drop = drop
        self._next_sequence = 0
        self._camera: Camera | None = None  # kept over reconnections, as it knows the pictures already read

    def _connect(self) -> None:
        self._camera = self._camera or camera_for(self._settings, self._clock, self._since_ns)
        refused = self._camera.open()
        self._put(partial(self._core.on_camera_connected, self._settings.device, refused, camera=self._of))

    def _read(self) -> None:
        if self._camera is None:
            return
        while not self._stop_event.is_set():
            for frame in self._camera.read(_READ_S):
                self._pass_on(frame, self._camera.patience_s)
        # Pictures present when recording ends belong to it, so the last read comes after the stop.
        stopped_ns = self._clock.now_ns()
        while self._camera.drains:
            frames = [frame for frame in self._camera.read(_QUIET_S) if frame.stamp_ns <= stopped_ns]
            if not frames:
                return
            for frame in frames:
                self._pass_on(frame, self._camera.patience_s)

    def _pass_on(self, frame: Frame, patience_s: float) -> None:
        n_lost, self._next_sequence = frame.sequence - self._next_sequence, frame.sequence + 1
        if n_lost > 0:
            lost = partial(self._core.on_frames_lost, EventKind.FRAME_DROPPED, _DROPPED, count=n_lost)
            self._put(partial(lost, camera=self._of))
        waited_s = (self._clock.now_ns() - frame.stamp_ns) / _NS_PER_S
        if self._slots.acquire(timeout=max(0.0, min(patience_s - waited_s, patience_s))):
            self._put(partial(self._detect, frame))
        else:
            self._put(partial(self._drop, frame))

    def _on_loss(self, reason: str, *, at_its_end: bool) -> None:
        self._put(partial(self._core.on_camera_lost, reason, at_its_end=at_its_end, camera=self._of))

    def _close(self) -> None:
        if self._camera is not None:
            self._camera.close()
