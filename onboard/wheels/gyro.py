"""Unwraps the samples of a gyro: counters of 32 bits, and samples that repeat, come late or were not measured."""

from typing import Final, NamedTuple

from groundsbot.onboard.wheels.protocol import GyroLine, Unmeasured, nearest

# A line lies at most this far from the newest wheel reading of its controller, whose clock it has.
_FARTHEST_US: Final = 2_000_000
# The sequence numbers may say that more samples are missing than the time does, by a factor of two and this many, as
# the spacing of samples varies.
_MISCOUNT: Final = 1
_RAD_PER_URAD: Final = 1e-6


class GyroReading(NamedTuple):
    """One yaw rate with unwrapped counters."""

    boot_id: int
    sequence: int
    device_time_us: int
    yaw_rate_rad_s: float
    lost: int  # samples missing before this one


class GyroUnwrapper:
    """Unwrapper of the counters of gyro lines, within the present epoch of their controller.

    Attributes:
        out_of_order: number of samples dropped because they are not later than those before.
        unplaced: number of samples dropped because their boot or time does not fit the wheel lines.
        renumbered: number of lines whose sequence number contradicts their time; the time is used.
        saturated: number of samples beyond the gyro's range.
        unreadable: number of samples for which the gyro did not answer.
    """

    def __init__(self) -> None:
        self.out_of_order = 0
        self.unplaced = 0
        self.renumbered = 0
        self.saturated = 0
        self.unreadable = 0
        self._last: tuple[int, int] | None = None  # sequence and time of the newest sample
        self._shift = 0  # of sequence numbers, after wrong ones
        self._missing = 0  # samples since the newest reading

    def begin_epoch(self) -> None:
        """Forget the counters, as at a restart of the controller."""
        self._last, self._shift, self._missing = None, 0, 0

    def unwrap(self, line: GyroLine, boot_id: int, expected_us: int | None) -> list[GyroReading]:
        """Return the measured samples of a line, none if it is repeated, late or does not fit the wheel lines.

        Args:
            line: the parsed line.
            boot_id: name of the present epoch in the log.
            expected_us: device time at its arrival by the wheel lines; None if they are of another boot.
        """
        n_samples = len(line.yaw_rates_urad_s)
        first_us = 0 if expected_us is None else nearest(line.t_us, expected_us)
        if expected_us is None or abs(first_us - expected_us) > _FARTHEST_US:
            self.unplaced += n_samples
            return []
        before_us = first_us - 1 if self._last is None else self._last[1]
        if first_us + (n_samples - 1) * line.period_us <= before_us:
            self.out_of_order += n_samples
            return []
        sequence, missing = self._number(line, first_us)
        self._missing += missing
        readings = []
        for index, rate in enumerate(line.yaw_rates_urad_s):
            if isinstance(rate, Unmeasured):
                self.saturated += rate is Unmeasured.SATURATED
                self.unreadable += rate is Unmeasured.UNREADABLE
                continue
            at_us = first_us + index * line.period_us
            if at_us <= before_us:  # the controller's batches overlap
                self.out_of_order += 1
                continue
            readings.append(GyroReading(boot_id, sequence + index, at_us, rate * _RAD_PER_URAD, self._missing))
            self._missing = 0
        self._last = sequence + n_samples - 1, first_us + (n_samples - 1) * line.period_us
        return readings

    def _number(self, line: GyroLine, first_us: int) -> tuple[int, int]:
        """Return the unwrapped sequence number of a line's first sample, and how many samples are missing before it."""
        if self._last is None:
            return line.sequence, 0
        next_sequence, last_us = self._last[0] + 1, self._last[1]
        sequence = nearest(line.sequence + self._shift, next_sequence)
        lost_by_time = max(0, round((first_us - last_us) / line.period_us) - 1)
        if not 0 <= sequence - next_sequence <= 2 * lost_by_time + _MISCOUNT:
            self.renumbered += 1
            self._shift += next_sequence + lost_by_time - sequence
            sequence = next_sequence + lost_by_time
        return sequence, sequence - next_sequence
