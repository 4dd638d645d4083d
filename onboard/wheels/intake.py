"""Conversion of the wheel controller's bytes to readings of wheels and gyro with stamps on the run's clock."""

from typing import Final, NamedTuple

from groundsbot.onboard.log import Gyro, WheelEncoders
from groundsbot.onboard.process import DeviceClockFilter
from groundsbot.onboard.wheels.gyro import GyroReading, GyroUnwrapper
from groundsbot.onboard.wheels.protocol import EncoderParser, GyroLine, WheelReading, WheelUnwrapper

# The first readings of a boot wait this long for the clock mapping, because they may have been buffered. It is longer
# than the bursts of 300 ms in which lines may arrive, and short enough that readings are on the disk within a second.
WARM_UP_NS: Final = 350_000_000


class StampedReading(NamedTuple):
    """One wheel reading."""

    reading: WheelReading
    stamp_ns: int  # time of measurement, on the run's clock
    host_ns: int  # time of arrival


class StampedGyro(NamedTuple):
    """One yaw rate of the gyro."""

    reading: GyroReading
    stamp_ns: int
    host_ns: int


class WheelIntake:
    """Parser, unwrappers and clock mapping in sequence. The clock is learnt from the lines of the wheels alone.

    Attributes:
        parser: the parser, which counts invalid lines.
        unwrapper: the unwrapper of the wheels, which counts repeated and overtaken lines.
        gyro: the unwrapper of the gyro, which counts samples left out.
    """

    def __init__(self) -> None:
        self.parser = EncoderParser()
        self.unwrapper = WheelUnwrapper()
        self.gyro = GyroUnwrapper()
        self._filter = DeviceClockFilter()
        self._held: list[tuple[WheelReading | GyroReading, int]] = []
        self._holding = False
        self._boot_id = 0  # of the present epoch, in the log
        self._last_stamp_ns = 0
        self._last_gyro_ns = 0

    def feed(self, data: bytes, host_ns: int) -> list[StampedReading | StampedGyro]:
        """Return the readings that are ready after the arrival of `data` at `host_ns`."""
        ready: list[StampedReading | StampedGyro] = []
        for line in self.parser.feed(data):
            if isinstance(line, GyroLine):
                ready += self._take_gyro(line, host_ns)
                continue
            reading = self.unwrapper.unwrap(line, host_ns)
            if reading is None:
                continue
            if reading.new_epoch:
                ready += self.release_all()
                self._filter = DeviceClockFilter()
                self.gyro.begin_epoch()
                self._holding, self._boot_id = True, reading.boot_id
            self._filter.observe(reading.device_time_us, host_ns)
            if self._holding:
                self._held.append((reading, host_ns))
            else:
                ready.append(self._stamp(reading, host_ns))
        return ready + self.release_due(host_ns)

    def _take_gyro(self, line: GyroLine, host_ns: int) -> list[StampedReading | StampedGyro]:
        if not self.unwrapper.epochs:
            return []  # a recording begins with the first wheel reading
        expected_us = self.unwrapper.expected_time_us(line.boot_id, host_ns)
        readings = self.gyro.unwrap(line, self._boot_id, expected_us)
        if self._holding:
            self._held += [(reading, host_ns) for reading in readings]
            return []
        return [self._stamp(reading, host_ns) for reading in readings]

    def release_due(self, now_ns: int) -> list[StampedReading | StampedGyro]:
        """Return the readings that have waited long enough for the clock mapping."""
        if self._held and now_ns - self._held[0][1] >= WARM_UP_NS:
            return self.release_all()
        return []

    def release_all(self) -> list[StampedReading | StampedGyro]:
        """Return all readings that wait for the clock mapping."""
        ready = [self._stamp(reading, host_ns) for reading, host_ns in self._held]
        self._held.clear()
        self._holding = False
        return ready

    def _stamp(self, reading: WheelReading | GyroReading, host_ns: int) -> StampedReading | StampedGyro:
        stamp_ns = self._filter.stamp_ns(reading.device_time_us)
        if isinstance(reading, GyroReading):
            self._last_gyro_ns = stamp_ns = max(stamp_ns, self._last_gyro_ns + 1)
            return StampedGyro(reading, stamp_ns, host_ns)
        self._last_stamp_ns = stamp_ns = max(stamp_ns, self._last_stamp_ns + 1)
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


def gyro_message(each: StampedGyro) -> Gyro:
    """Return the message of one yaw rate."""
    reading = each.reading
    return Gyro(
        stamp_ns=each.stamp_ns,
        yaw_rate_rad_s=reading.yaw_rate_rad_s,
        device_time_us=reading.device_time_us,
        boot_id=reading.boot_id,
        sequence=reading.sequence,
    )
