"""A thread for the port and one for the camera: open, read, reconnect, and hand on what came with its time.

Whatever goes wrong in here, the thread says so and tries again: a recorder runs for hours with nobody watching.
"""

import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Final

from groundsbot.onboard.camera import Camera, CameraEndedError, CameraSettings, Frame, camera_for
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.process import RunClock
from groundsbot.onboard.recorder.recorder import RecorderCore
from groundsbot.onboard.wheels import EncoderPort

_NS_PER_S: Final = 1_000_000_000
_READ_S: Final = 0.05
_RETRY_S: Final = 0.5
_QUIET_S: Final = 0.1  # a device that has been silent so long at the end has given everything
_DRAIN_NS: Final = 300_000_000  # and one that never is silent has given all that it held
# Lines that come meanwhile are read at once: their own times tell when they were measured, and waking a thread costs as
# much as two lines. No whole number of ms: in step with the lines, the reader would find each at the same age, and
# never one that has just come.
_BREATH_S: Final = 0.0073

Act = Callable[[int], None]  # takes the time at which it was handed over
Put = Callable[[Act], None]


class DeviceThread(threading.Thread, ABC):
    """Keeps one device open until told to stop."""

    def __init__(self, name: str, put: Put, stop: threading.Event, on_notice: Callable[[str], None]) -> None:
        """Starts nothing yet.

        Args:
            name: of the device, for people.
            put: hands an act to the core's thread.
            stop: ends the thread, once what the device holds has been read.
            on_notice: told once what is waited for.
        """
        super().__init__(name=name, daemon=True)
        self._put = put
        self._stop_event = stop
        self._on_notice = on_notice
        self._told = False

    def run(self) -> None:
        """Opens the device, reads it, and does so again when it was lost."""
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
            except Exception as error:  # a fault of ours or of a library's must not end the recording of a device
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
            if not self._told:
                reason = str(error) if isinstance(error, OnboardError) else repr(error)
                self._on_notice(f"waiting for the {self.name}: {reason}")
                self._told = True
            return False
        self._told = False
        return True

    @abstractmethod
    def _connect(self) -> None:
        """Opens the device and says so."""

    @abstractmethod
    def _read(self) -> None:
        """Reads until told to stop and nothing is left."""

    @abstractmethod
    def _on_loss(self, reason: str, *, at_its_end: bool) -> None:
        """Says that the device is gone."""

    @abstractmethod
    def _close(self) -> None:
        """Lets go of the device; never fails."""


class WheelThread(DeviceThread):
    """Reads the wheel controller's port."""

    def __init__(
        self,
        port: EncoderPort,
        core: RecorderCore,
        put: Put,
        stop: threading.Event,
        on_notice: Callable[[str], None],
    ) -> None:
        """Starts nothing yet."""
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
        del at_its_end  # a port has none
        self._put(partial(self._core.on_port_lost, reason))

    def _close(self) -> None:
        self._port.close()

    def _pass_on(self, data: bytes) -> bool:
        if data:
            self._put(partial(self._core.on_serial_bytes, data))
        return bool(data)


class CameraThread(DeviceThread):
    """Reads the camera."""

    def __init__(
        self,
        settings: CameraSettings,
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
        """Starts nothing yet.

        Args:
            settings: of the camera.
            core: told of its comings and goings.
            put: see DeviceThread.
            stop: see DeviceThread.
            on_notice: see DeviceThread.
            clock: the run's.
            since_ns: older pictures in a folder are left alone.
            slots: one is taken for each picture given to `detect`, which gives it back.
            detect: takes a picture and the time, in the core's thread.
            drop: takes a picture for which there was no slot.
        """
        super().__init__("camera", put, stop, on_notice)
        self._settings = settings
        self._core = core
        self._clock = clock
        self._since_ns = since_ns
        self._slots = slots
        self._detect = detect
        self._drop = drop
        self._camera: Camera | None = None  # kept over reconnects: it knows what it has given already

    def _connect(self) -> None:
        self._camera = self._camera or camera_for(self._settings, self._clock, self._since_ns)
        refused = self._camera.open()
        self._put(partial(self._core.on_camera_connected, self._settings.device, refused))

    def _read(self) -> None:
        if self._camera is None:
            return
        while not self._stop_event.is_set():
            for frame in self._camera.read(_READ_S):
                self._pass_on(frame, self._camera.patience_s)
        # What is there when recording ends still belongs to it, so the last look comes after the stop.
        stopped_ns = self._clock.now_ns()
        while self._camera.drains:
            frames = [frame for frame in self._camera.read(_QUIET_S) if frame.stamp_ns <= stopped_ns]
            if not frames:
                return
            for frame in frames:
                self._pass_on(frame, self._camera.patience_s)

    def _pass_on(self, frame: Frame, patience_s: float) -> None:
        waited_s = (self._clock.now_ns() - frame.stamp_ns) / _NS_PER_S
        if self._slots.acquire(timeout=max(0.0, min(patience_s - waited_s, patience_s))):
            self._put(partial(self._detect, frame))
        else:
            self._put(partial(self._drop, frame))

    def _on_loss(self, reason: str, *, at_its_end: bool) -> None:
        self._put(partial(self._core.on_camera_lost, reason, at_its_end=at_its_end))

    def _close(self) -> None:
        if self._camera is not None:
            self._camera.close()
