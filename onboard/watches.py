"""What the recorder watches for: silence, steps of the wall clock, and things that come in numbers."""

from collections.abc import Iterator
from typing import Final, NamedTuple

from onboard.messages import EventKind

# A clock that is being brought back in line without a step runs wrong by less than a tenth (chrony: 8.3 %).
_SLEWING: Final = 0.1
_STEP_NS: Final = 50_000_000


class SilenceWatch:
    """Tells once that a device has been silent for too long."""

    def __init__(self, limit_ns: int, since_ns: int | None) -> None:
        """Waits from `since_ns` on; None: not before `heard`."""
        self._limit_ns = limit_ns
        self._since_ns = since_ns
        self.is_silent = False

    def heard(self, now_ns: int) -> None:
        """The device spoke, or is there again."""
        self._since_ns, self.is_silent = now_ns, False

    def gone(self) -> None:
        """Nothing is expected for now."""
        self._since_ns, self.is_silent = None, False

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


class Tally(NamedTuple):
    """What happened several times."""

    kind: EventKind
    times: int
    text: str  # of the last time


class Tallies:
    """Counts what comes in numbers, so that it is told of now and then and not each time."""

    def __init__(self) -> None:
        self._counted: dict[EventKind, Tally] = {}

    def add(self, kind: EventKind, count: int, text: str) -> None:
        """Counts; nothing if `count` is 0."""
        if count:
            before = self._counted.get(kind)
            self._counted[kind] = Tally(kind, count + (before.times if before else 0), text)

    def take(self) -> Iterator[Tally]:
        """What has been counted since the last time."""
        counted, self._counted = self._counted, {}
        yield from counted.values()
