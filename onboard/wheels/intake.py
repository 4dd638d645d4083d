"""Conversion of the wheel controller's bytes to readings with stamps on the run's clock."""

from typing import Final, NamedTuple

from groundsbot.onboard.log import WheelEncoders
from groundsbot.onboard.process import DeviceClockFilter
from groundsbot.onboard.wheels.protocol import EncoderParser, WheelReading, WheelUnwrapper

# The first readings of a boot wait this long for the clock mapping, because they may have been buffered. It is longer
# than the bursts of 300 ms in which lines may arrive, and short enough that readings are on the disk within a second.
WARM_UP_NS: Final = 350_000_000


class StampedReading(NamedTuple):
    """One wheel reading."""

    reading: WheelReading
    stamp_ns: int  # time of measurement, on the run's clock
    host_ns: int  # time of arrival


class WheelIntake:
    """Parser, unwrapper and clock mapping in sequence.

    Attributes:
        parser: the parser, which counts invalid lines.
        unwrapper: the unwrapper, which counts repeated and overtaken lines.
    """

    def __init__(self) -> None:
        self.parser = EncoderParser()
        self.unwrapper = WheelUnwrapper()
        self._filter = DeviceClockFilter()
        self._held: list[tuple[WheelReading, int]] = []
        self._holding = False
        self._last_stamp_ns = 0

    def feed(self, data: bytes, host_ns: int) -> list[StampedReading]:
        """Return the readings that are ready after the arrival of `data` at `host_ns`."""
        ready: list[StampedReading] = []
        for line in self.parser.feed(data):
            reading = self.unwrapper.unwrap(line, host_ns)
            if reading is None:
                continue
            if reading.new_epoch:
                ready += self.release_all()
                self._filter = DeviceClockFilter()
                self._holding = True
            self._filter.observe(reading.device_time_us, host_ns)
            if self._holding:
                self._held.append((reading, host_ns))
            else:
                ready.append(self._stamp(reading, host_ns))
        return ready + self.release_due(host_ns)

    def release_due(self, now_ns: int) -> list[StampedReading]:
        """Return the readings that have waited long enough for the clock mapping."""
        if self._held and now_ns - self._held[0][1] >= WARM_UP_NS:
            return self.release_all()
        return []

    def release_all(self) -> list[StampedReading]:
        """Return all readings that wait for the clock mapping."""
        ready = [self._stamp(reading, host_ns) for reading, host_ns in self._held]
        self._held.clear()
        self._holding = False
        return ready

    def _stamp(self, reading: WheelReading, host_ns: int) -> StampedReading:
        stamp_ns = max(self._filter.stamp_ns(reading.device_time_us), self._last_stamp_ns + 1)
        self._last_stamp_ns = stamp_ns
        return StampedReading(reading, stamp_ns, host_ns)


def wheel_message(each: StampedReading) -> WheelEncoders:
    """Return the message of one wheel reading."""
    reading = each.reading
    return WheelEncoders(
        stamp_ns=each.stamp_ns,
        device_time_us=reading.device_time_us,
        boot_id=reading.boot_id,
        sequence=reading.sequence,
        ticks_left=reading.ticks_left,
        ticks_right=reading.ticks_right,
        flags=reading.flags,
    )
