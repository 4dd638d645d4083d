"""The run's clock, and the mapping of the wheel controller's clock to it. Stamps come from these clocks only."""

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
    """The clock of all stamps of a run: monotonic time plus the offset to the wall clock at the start.

    It resembles wall-clock time but never steps when the wall clock is set.

    Attributes:
        run_epoch_ns: realtime minus monotonic time at the start.
    """

    def __init__(self) -> None:
        reading = read_clocks()
        self.run_epoch_ns = reading.realtime_ns - reading.monotonic_ns
        self._offsets_ns = deque([self.run_epoch_ns], maxlen=_STEPS_REMEMBERED)  # realtime minus monotonic

    def now_ns(self) -> int:
        """Return the present time of the run's clock."""
        return time.monotonic_ns() + self.run_epoch_ns

    def from_monotonic(self, monotonic_ns: int) -> int:
        """Convert a monotonic time to the run's clock."""
        return monotonic_ns + self.run_epoch_ns

    def from_realtime(self, realtime_ns: int) -> int:
        """Convert a recent wall-clock time to the run's clock, also if the wall clock has stepped since.

        The offset used is the newest observed offset by which the time lies in the last five seconds, or the present
        offset if there is none.
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
    """Read both clocks; the least interrupted of three attempts is returned."""
    tries = []
    for _ in range(3):
        before_ns, realtime_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        tries.append((after_ns - before_ns, (before_ns + after_ns) // 2, realtime_ns))
    return ClockReading(*min(tries)[1:])


@functools.cache
def _libc() -> ctypes.CDLL:
    """Return the C library, cached because loading it takes longer than the frequent calls."""
    return ctypes.CDLL(None)


def is_wall_clock_synchronised() -> bool:
    """Return whether the kernel reports its wall clock as synchronised; False if that is unknown."""
    try:
        state: int = _libc().adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES))  # modes 0: read only
    except (AttributeError, OSError):
        return False
    return 0 <= state < _TIME_ERROR


class DeviceClockFilter:
    """Estimator of the host time of measurements from device time and time of arrival.

    The arrival is the measurement plus a delay with a lower bound. The line closest below all points (device time,
    arrival) is therefore the mapping between the clocks, up to a constant delay. This is the passive one-way filter of
    Olson (2010), "A passive solution to the sensor synchronization problem". The rate of the clocks is estimated as
    well, over the last minute, by the linear programme of Moon, Skelly and Towsley (1999), "Estimation and removal of
    clock skew from network delay measurements". Its solution is the edge of the lower hull of the points that spans
    their mean device time.
    """

    def __init__(self) -> None:
        self._fastest: deque[tuple[int, int]] = deque(
            maxlen=_WINDOW_BUCKETS
        )  # (device, host) with the least delay per finished bucket
        self._bucket = 0
        self._bucket_best: tuple[int, int] | None = None
        # Mapping: host = device + offset + rate_error * (device - origin), device time in ns.
        self._origin_ns = 0
        self._offset_ns = 0
        self._rate_error = 0.0

    def observe(self, device_time_us: int, host_ns: int) -> None:
        """Update the mapping by one reading.

        Args:
            device_time_us: time of the device's clock, unwrapped and not decreasing.
            host_ns: time of arrival, on the run's clock.
        """
        device_ns = device_time_us * _NS_PER_US
        if self._bucket_best is None:
            self._origin_ns, self._offset_ns, self._bucket_best = device_ns, host_ns - device_ns, (device_ns, host_ns)
            return
        bucket = (
            device_ns - self._origin_ns
        ) // _BUCKET_NS  # each contains the end of a burst, including the first one
        if bucket != self._bucket:
            self._fastest.append(self._bucket_best)
            self._fit()
            self._bucket, self._bucket_best = bucket, (device_ns, host_ns)
        elif host_ns - self._map(device_ns) < self._bucket_best[1] - self._map(self._bucket_best[0]):
            self._bucket_best = (device_ns, host_ns)
        early_ns = self._map(device_ns) - host_ns
        if early_ns > 0:  # a smaller delay than any before
            self._offset_ns -= early_ns

    def stamp_ns(self, device_time_us: int) -> int:
        """Convert a time of the device's clock to the run's clock, by the present estimate of the mapping.

        The result is never later than the arrival of a reading that `observe` was called with. Each call of `observe`
        may lower the mapping, so the results of successive calls may decrease slightly although `device_time_us` grows.

        Args:
            device_time_us: time of the measurement on the device's clock, unwrapped.

        Returns:
            Nanoseconds of the run's clock.
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
    """Return the slope of the edge of the lower hull that spans the mean of x; `points` are sorted by x.

    If a clock cannot have that slope, because the first points were buffered, for example, the slope of the longest
    edge with a possible one is returned, or None if there is none.
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
    """Return whether b lies on or above the line from a to c."""
    return (b[1] - a[1]) * (c[0] - a[0]) >= (c[1] - a[1]) * (b[0] - a[0])
