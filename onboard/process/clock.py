"""Time: the only place that reads a clock, and the mapping of the wheel controller's clock onto the host's."""

import ctypes
import functools
import itertools
import time
from collections import deque
from typing import Final, NamedTuple

_NS_PER_US: Final = 1000

_BUCKET_NS: Final = 500_000_000
_WINDOW_BUCKETS: Final = 120  # a minute
_MAX_RATE_ERROR: Final = 0.01  # ceramic resonators are within 0.5 %

_STEP_NS: Final = 10_000_000
_STEPS_REMEMBERED: Final = 8
_RECENT_NS: Final = 5_000_000_000
_AHEAD_NS: Final = 100_000_000

_TIMEX_BYTES: Final = 512  # more than struct timex needs on any Linux
_TIME_ERROR: Final = 5


class ClockReading(NamedTuple):
    """Both clocks at one moment."""

    monotonic_ns: int
    realtime_ns: int


class RunClock:
    """The one line on which every stamp of a run lies: monotonic time plus an offset frozen at the start.

    So it reads like wall-clock time but never steps, whatever happens to the wall clock.

    Attributes:
        run_epoch_ns: realtime minus monotonic, at the start.
    """

    def __init__(self) -> None:
        reading = read_clocks()
        self.run_epoch_ns = reading.realtime_ns - reading.monotonic_ns
        self._offsets_ns = deque([self.run_epoch_ns], maxlen=_STEPS_REMEMBERED)  # realtime minus monotonic

    def now_ns(self) -> int:
        """Now, on the run's line."""
        return time.monotonic_ns() + self.run_epoch_ns

    def from_monotonic(self, monotonic_ns: int) -> int:
        """A monotonic time on the run's line."""
        return monotonic_ns + self.run_epoch_ns

    def from_realtime(self, realtime_ns: int) -> int:
        """A recent wall-clock time on the run's line, also if the wall clock has stepped since.

        The wall clock's offset at that time is the newest of those seen by which it is of the last few seconds; the
        present one if there is none.
        """
        reading = read_clocks()
        offset_ns = reading.realtime_ns - reading.monotonic_ns
        if abs(offset_ns - self._offsets_ns[-1]) < _STEP_NS:
            self._offsets_ns[-1] = offset_ns
        else:
            self._offsets_ns.append(offset_ns)
        now_ns = self.from_monotonic(reading.monotonic_ns)
        for each_ns in reversed(self._offsets_ns):
            at_ns = realtime_ns - each_ns + self.run_epoch_ns
            if -_AHEAD_NS <= now_ns - at_ns <= _RECENT_NS:
                return at_ns
        return realtime_ns - offset_ns + self.run_epoch_ns


def read_clocks() -> ClockReading:
    """Reads both clocks; of three tries the one that was interrupted least."""
    tries = []
    for _ in range(3):
        before_ns, realtime_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        tries.append((after_ns - before_ns, (before_ns + after_ns) // 2, realtime_ns))
    return ClockReading(*min(tries)[1:])


@functools.cache
def _libc() -> ctypes.CDLL:
    """Asked several times a second, and looking the library up takes longer than the call."""
    return ctypes.CDLL(None)


def is_wall_clock_synchronised() -> bool:
    """Whether the kernel says that something disciplines its wall clock; False where it does not say."""
    try:
        state: int = _libc().adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))  # modes 0: read only
    except (AttributeError, OSError):
        return False
    return 0 <= state < _TIME_ERROR


class DeviceClockFilter:
    """When a reading was measured, on the host's clock, from its device time and its time of arrival.

    Arrival is measurement plus a delay that is never below some least one. So a line below all points (device time,
    arrival), as close to them as can be, is the mapping between the clocks, a fixed delay aside: the passive one-way
    filter of Olson (2010), "A passive solution to the sensor synchronization problem", here with the clocks' rates
    learned as well by the linear programme of Moon, Skelly and Towsley (1999), "Estimation and removal of clock skew
    from network delay measurements", over the last minute. Its solution is the edge of the points' lower hull that
    spans their mean device time.
    """

    def __init__(self) -> None:
        self._fastest: deque[tuple[int, int]] = deque(maxlen=_WINDOW_BUCKETS)  # (device, host) per finished bucket
        self._bucket = 0
        self._bucket_best: tuple[int, int] | None = None
        # The mapping: host = device + offset + rate_error * (device - origin), device time in ns.
        self._origin_ns = 0
        self._offset_ns = 0
        self._rate_error = 0.0

    def observe(self, device_time_us: int, host_ns: int) -> None:
        """Learns from one reading.

        Args:
            device_time_us: the device's clock, unwrapped, not running backwards.
            host_ns: time of arrival, on the run's clock.
        """
        device_ns = device_time_us * _NS_PER_US
        if self._bucket_best is None:
            self._origin_ns, self._offset_ns, self._bucket_best = device_ns, host_ns - device_ns, (device_ns, host_ns)
            return
        bucket = (device_ns - self._origin_ns) // _BUCKET_NS  # each holds the end of a burst, the first one too
        if bucket != self._bucket:
            self._fastest.append(self._bucket_best)
            self._fit()
            self._bucket, self._bucket_best = bucket, (device_ns, host_ns)
        elif host_ns - self._map(device_ns) < self._bucket_best[1] - self._map(self._bucket_best[0]):
            self._bucket_best = (device_ns, host_ns)
        early_ns = self._map(device_ns) - host_ns
        if early_ns > 0:  # faster than any before
            self._offset_ns -= early_ns

    def stamp_ns(self, device_time_us: int) -> int:
        """When a reading was measured, by the mapping as it now is: never after its arrival, once observed.

        A better mapping may lie a little lower than the one before it, so stamps of successive calls may step back.
        """
        return self._map(device_time_us * _NS_PER_US)

    def _map(self, device_ns: int) -> int:
        return device_ns + self._offset_ns + round(self._rate_error * (device_ns - self._origin_ns))

    def _fit(self) -> None:
        points = [(device - self._origin_ns, host - device) for device, host in self._fastest]
        rate_error = _rate_error(points)
        if rate_error is not None:
            self._rate_error = rate_error
        self._offset_ns = min(delay - round(self._rate_error * at) for at, delay in points)


def _rate_error(points: list[tuple[int, int]]) -> float | None:
    """The slope of the lower hull's edge that spans the mean of x; `points` in order of x.

    Where that slope is none that a clock can have (the points' beginning lay in a buffer, say), the longest edge with
    a possible one stands in; None if there is none.
    """
    hull = _lower_hull(points)
    mean_times_n = sum(x for x, _ in points)
    edges = [(a, b, (b[1] - a[1]) / (b[0] - a[0])) for a, b in itertools.pairwise(hull) if b[0] > a[0]]
    possible = [edge for edge in edges if abs(edge[2]) <= _MAX_RATE_ERROR]
    for a, b, slope in possible:
        if a[0] * len(points) <= mean_times_n <= b[0] * len(points):
            return slope
    return max(possible, key=lambda edge: edge[1][0] - edge[0][0])[2] if possible else None


def _lower_hull(points: list[tuple[int, int]]) -> list[tuple[int, int]]:
    hull: list[tuple[int, int]] = []
    for point in points:
        while len(hull) > 1 and _turns_down(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    return hull


def _turns_down(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> bool:
    """Whether b lies on or above the line from a to c."""
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])
