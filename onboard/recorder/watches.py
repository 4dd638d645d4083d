"""Monitoring of silent devices and of steps of the wall clock."""

from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

from groundsbot.onboard.log import EventKind

_NS_PER_S: Final = 1_000_000_000
_WHEEL_SILENCE_NS: Final = 2_800_000_000  # checked a few times a second, so that the event comes within 3 s
_CAMERA_SILENCE_NS: Final = 3 * _NS_PER_S
# Largest rate error of a clock that is slewed instead of stepped (chrony: 8.3 %).
_SLEWING: Final = 0.1
_STEP_NS: Final = 50_000_000


class SilenceWatch:
    """Detector of a device that is silent for too long.

    Attributes:
        is_silent: the device has been silent for too long.
    """

    def __init__(self, limit_ns: int, since_ns: int | None) -> None:
        """Expect data from `since_ns` on, or not before `reset` if it is None."""
        self._limit_ns = limit_ns
        self._since_ns = since_ns
        self._is_gone = False
        self.is_silent = False

    @property
    def is_missing(self) -> bool:
        """Whether an expected device is gone, or silent for too long."""
        return self._is_gone or self.is_silent

    def reset(self, now_ns: int) -> None:
        """Note data from the device, or its return."""
        self._since_ns, self.is_silent, self._is_gone = now_ns, False, False

    def pause(self, *, at_its_end: bool = False) -> None:
        """Expect no data until `reset`; the device is missing, unless `at_its_end`."""
        self._since_ns, self.is_silent, self._is_gone = None, False, not at_its_end

    def fell_silent(self, now_ns: int) -> bool:
        """Return whether the device has become silent since the last call."""
        if self.is_silent or self._since_ns is None or now_ns - self._since_ns < self._limit_ns:
            return False
        self.is_silent = True
        return True


class ClockWatch:
    """Detector of steps of the wall clock against the monotonic clock."""

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None  # monotonic, realtime minus monotonic

    def step_ns(self, monotonic_ns: int, realtime_ns: int) -> int | None:
        """Return the step of the wall clock since the last call, or None."""
        offset_ns = realtime_ns - monotonic_ns
        last, self._last = self._last, (monotonic_ns, offset_ns)
        if last is None:
            return None
        step_ns = offset_ns - last[1]
        allowed_ns = _STEP_NS + _SLEWING * (monotonic_ns - last[0])
        return step_ns if abs(step_ns) > allowed_ns else None


class Alarm(NamedTuple):
    """A fault to report."""

    kind: EventKind
    text: str


class Watches:
    """Monitoring of wheels, gyro, cameras and wall clock; each fault is reported once.

    Attributes:
        wheels: watch of the wheel readings.
        gyro: watch of the yaw rates.
        cameras: watches of the pictures, by camera; one is not silent before its first picture.
    """

    def __init__(
        self,
        run_epoch_ns: int,
        wheels_since_ns: int | None,
        cameras: Iterable[str],
        *,
        expect_camera: bool,
        gyro_since_ns: int | None = None,
    ) -> None:
        """Start monitoring.

        Args:
            run_epoch_ns: realtime minus monotonic time at the start of the run.
            wheels_since_ns: time from which on wheel readings are expected; None: after the first one.
            cameras: names of the cameras.
            expect_camera: count a camera that never sends a picture as missing.
            gyro_since_ns: time from which on yaw rates are expected; None: after the first one.
        """
        self.gyro = SilenceWatch(_WHEEL_SILENCE_NS, gyro_since_ns)
        self.wheels = SilenceWatch(_WHEEL_SILENCE_NS, wheels_since_ns)
        self.cameras = {name: SilenceWatch(_CAMERA_SILENCE_NS, None) for name in cameras}
        for watch in self.cameras.values():
            watch.pause(at_its_end=not expect_camera)
        self._wall_clock = ClockWatch()
        self._run_epoch_ns = run_epoch_ns

    def alarms(self, now_ns: int, realtime_ns: int) -> Iterator[Alarm]:
        """Yield the alarms due at this time of the run's clock and of the wall clock."""
        if self.wheels.fell_silent(now_ns):
            text = "no valid data from the wheels for 3 s: check cable, port and baud rate"
            yield Alarm(EventKind.NO_WHEEL_DATA, text)
        if self.gyro.fell_silent(now_ns):
            yield Alarm(EventKind.NO_GYRO_DATA, "no yaw rate for 3 s: check the gyro's cable and the firmware")
        for name, watch in self.cameras.items():
            if watch.fell_silent(now_ns):
                text = f"no picture{f' of {name}' if name else ''} for 3 s: check cable and driver"
                yield Alarm(EventKind.NO_PICTURES, text)
        step_ns = self._wall_clock.step_ns(now_ns - self._run_epoch_ns, realtime_ns)
        if step_ns is not None:
            text = f"the wall clock stepped by {step_ns / _NS_PER_S:+.3f} s; the log's clock is not affected"
            yield Alarm(EventKind.CLOCK_STEP, text)
