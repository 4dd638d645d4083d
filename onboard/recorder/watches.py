"""What the recorder watches for: silence of a device, and steps of the wall clock."""

from collections.abc import Iterator
from typing import Final, NamedTuple

from groundsbot.onboard.log import EventKind

_NS_PER_S: Final = 1_000_000_000
_WHEEL_SILENCE_NS: Final = 2_800_000_000  # ticks come a few times a second: told of within 3 s
_CAMERA_SILENCE_NS: Final = 3 * _NS_PER_S
# A clock that is being brought back in line without a step runs wrong by less than a tenth (chrony: 8.3 %).
_SLEWING: Final = 0.1
_STEP_NS: Final = 50_000_000


class SilenceWatch:
    """Tells once that a device has been silent for too long."""

    def __init__(self, limit_ns: int, since_ns: int | None) -> None:
        """Waits from `since_ns` on; None: not before `heard`."""
        self._limit_ns = limit_ns
        self._since_ns = since_ns
        self._is_gone = False
        self.is_silent = False

    @property
    def is_missing(self) -> bool:
        """Whether what is expected does not come: the device is gone, or silent for too long."""
        return self._is_gone or self.is_silent

    def reset(self, now_ns: int) -> None:
        """The device spoke, or is there again."""
        self._since_ns, self.is_silent, self._is_gone = now_ns, False, False

    def pause(self, *, at_its_end: bool = False) -> None:
        """No word is expected for now; `at_its_end`: nor missed."""
        self._since_ns, self.is_silent, self._is_gone = None, False, not at_its_end

    def fell_silent(self, now_ns: int) -> bool:
        """Whether this is the moment to tell of it."""
        if self.is_silent or self._since_ns is None or now_ns - self._since_ns < self._limit_ns:
            return False
        self.is_silent = True
        return True


class ClockWatch:
    """Notices when the wall clock steps against the monotonic one."""

    def __init__(self) -> None:
        self._last: tuple[int, int] | None = None  # monotonic, realtime minus monotonic

    def step_ns(self, monotonic_ns: int, realtime_ns: int) -> int | None:
        """How far the wall clock has stepped since the last look; None: not at all."""
        offset_ns = realtime_ns - monotonic_ns
        last, self._last = self._last, (monotonic_ns, offset_ns)
        if last is None:
            return None
        step_ns = offset_ns - last[1]
        allowed_ns = _STEP_NS + _SLEWING * (monotonic_ns - last[0])
        return step_ns if abs(step_ns) > allowed_ns else None


class Alarm(NamedTuple):
    """What is wrong now."""

    kind: EventKind
    text: str


class Watches:
    """Silent devices and a wall clock that steps, each told of once.

    Attributes:
        wheels: told of each reading.
        camera: told of each picture; it is not silent before the first.
    """

    def __init__(self, run_epoch_ns: int, wheels_since_ns: int | None, *, expect_camera: bool) -> None:
        """Begins to watch.

        Args:
            run_epoch_ns: realtime minus monotonic, as frozen for the run's clock.
            wheels_since_ns: from when on wheel readings are expected; None: not before the first.
            expect_camera: whether one that never comes is missed.
        """
        self.wheels = SilenceWatch(_WHEEL_SILENCE_NS, wheels_since_ns)
        self.camera = SilenceWatch(_CAMERA_SILENCE_NS, None)
        self.camera.pause(at_its_end=not expect_camera)
        self._wall_clock = ClockWatch()
        self._run_epoch_ns = run_epoch_ns

    def alarms(self, now_ns: int, realtime_ns: int) -> Iterator[Alarm]:
        """What to tell of at this moment of the run's clock and of the wall clock."""
        if self.wheels.fell_silent(now_ns):
            text = "no valid data from the wheels for 3 s: check cable, port and baud rate"
            yield Alarm(EventKind.NO_WHEEL_DATA, text)
        if self.camera.fell_silent(now_ns):
            yield Alarm(EventKind.NO_PICTURES, "no picture for 3 s: check cable and driver")
        step_ns = self._wall_clock.step_ns(now_ns - self._run_epoch_ns, realtime_ns)
        if step_ns is not None:
            text = f"the wall clock stepped by {step_ns / _NS_PER_S:+.3f} s; the log's clock goes on evenly"
            yield Alarm(EventKind.CLOCK_STEP, text)
