r"""The line protocol of the wheel controller. For firmware it is described in docs/wheel_protocol.md.

The controller sends one line per reading of the wheels, and with a gyro one line per batch of yaw rates:

    $GBW,1,<boot_id>,<sequence>,<t_us>,<ticks_left>,<ticks_right>,<flags>*<CRC16>\r\n
    $GBG,2,<boot_id>,<sequence>,<t_us>,<period_us>,<yaw_rate_urad_s>[,<yaw_rate_urad_s>...]*<CRC16>\r\n

This module does not depend on a port or a clock.
"""

import binascii
import re
from collections import deque
from enum import StrEnum
from typing import Final, NamedTuple

WHEEL_VERSION: Final = 1  # version of the protocol in which a line was defined
GYRO_VERSION: Final = 2
LINE_LIMIT_BYTES: Final = 256  # the longest line of wheels has 76, of a gyro 251
MOST_SAMPLES: Final = 20  # of a gyro in one line

_U16: Final = 1 << 16
_U32: Final = 1 << 32
_I32: Final = 1 << 31
_NEWLINE: Final = b"\n"
_REJECTED_KEPT: Final = 4
_REMEMBERED_LINES: Final = 1024  # to distinguish repeated from overtaken lines
# A controller has restarted with its old boot_id if this many lines in a row, in order, are older than the newest by at
# least this. Lines repeated or overtaken on their way are neither that many nor that old.
_RESTART_LINES: Final = 50
_RESTART_US: Final = 2_000_000
_NEXT_LIFE: Final = 0x9E3779B1  # added to the boot_id at a restart that keeps it, so that boots stay distinct
# Samples wait in a batch no longer than this, so that they are on the disk as soon as wheel readings.
_LONGEST_BATCH_US: Final = 100_000
_LONGEST_PERIOD_US: Final = 1_000_000
_FASTEST_URAD_S: Final = 50_000_000  # a map refuses faster rates
_LINE: Final = re.compile(
    rb"\$(GBW,%d,(\d{1,10}),(\d{1,10}),(\d{1,10}),(-?\d{1,10}),(-?\d{1,10}),(\d{1,5}))\*([0-9A-F]{4})\r" % WHEEL_VERSION
)
_GYRO_LINE: Final = re.compile(
    rb"\$(GBG,%d,(\d{1,10}),(\d{1,10}),(\d{1,10}),(\d{1,7})((?:,(?:-?\d{1,8}|[SE])){1,%d}))\*([0-9A-F]{4})\r"
    % (GYRO_VERSION, MOST_SAMPLES)
)


class WheelLine(NamedTuple):
    """One line as sent by the controller; counters wrap around at 32 bits."""

    boot_id: int
    sequence: int
    t_us: int
    ticks_left: int
    ticks_right: int
    flags: int


class Unmeasured(StrEnum):
    """Reason for which a gyro's sample has no yaw rate."""

    SATURATED = "S"  # the rate was beyond the gyro's range
    UNREADABLE = "E"  # the gyro did not answer


class GyroLine(NamedTuple):
    """A batch of evenly spaced yaw rates as sent by the controller; counters wrap around at 32 bits."""

    boot_id: int
    sequence: int  # of the first sample; each sample counts
    t_us: int  # of the first sample
    period_us: int
    yaw_rates_urad_s: tuple[int | Unmeasured, ...]  # positive to the left


class WheelReading(NamedTuple):
    """One reading with unwrapped counters."""

    boot_id: int
    sequence: int
    device_time_us: int
    ticks_left: int
    ticks_right: int
    flags: int
    new_epoch: bool  # first reading of a boot; the motion since the reading before is unknown
    lost: int  # readings missing before this one, by sequence number


def crc16(data: bytes) -> int:
    """Return CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, not reflected; 0x29B1 for b"123456789"."""
    return binascii.crc_hqx(data, 0xFFFF)


def format_line(line: WheelLine) -> bytes:
    """Return the bytes of one line, with counters modulo 2^32 (ticks in [-2^31, 2^31)) and flags modulo 2^16."""
    return _seal(
        f"GBW,{WHEEL_VERSION},{line.boot_id % _U32},{line.sequence % _U32},{line.t_us % _U32},"
        f"{_as_signed_int(line.ticks_left)},{_as_signed_int(line.ticks_right)},{line.flags % _U16}"
    )


def format_gyro_line(line: GyroLine) -> bytes:
    """Return the bytes of one line of a gyro, with counters modulo 2^32."""
    head = f"GBG,{GYRO_VERSION},{line.boot_id % _U32},{line.sequence % _U32},{line.t_us % _U32},{line.period_us}"
    return _seal(",".join([head, *map(str, line.yaw_rates_urad_s)]))


def _seal(body: str) -> bytes:
    data = body.encode("ascii")
    return b"$%s*%04X\r\n" % (data, crc16(data))


class EncoderParser:
    """Parser that finds intact lines in a stream of bytes with arbitrary bytes between them.

    Attributes:
        accepted: number of lines returned so far.
        rejected: number of pieces between line ends that are not an intact line, or begin with other bytes. The piece
            before the first line end is not counted, because a connection may start in the middle of a line.
        last_rejected: the newest of these pieces, of each at most the last `LINE_LIMIT_BYTES`.
    """

    def __init__(self) -> None:
        self.accepted = 0
        self.rejected = 0
        self.last_rejected: deque[bytes] = deque(maxlen=_REJECTED_KEPT)
        self._rest = b""
        self._overlong = False
        self._in_step = False

    def feed(self, data: bytes) -> list[WheelLine | GyroLine]:
        """Return the lines completed by `data`, in order."""
        pieces = (self._rest + data).split(_NEWLINE)
        rest = pieces.pop()
        lines: list[WheelLine | GyroLine] = []
        for piece in pieces:
            line = parse_line(piece)
            if line is not None:
                self.accepted += 1
                lines.append(line)
                noise = piece[: piece.rfind(b"$")]
            else:
                noise = piece.rstrip(b"\r")
            if noise or self._overlong:
                self._reject(noise)
            self._overlong = False
            self._in_step = True
        if len(rest) > LINE_LIMIT_BYTES:  # only the bytes from the last $ on can still become a line
            start = rest.rfind(b"$", -LINE_LIMIT_BYTES)
            rest = rest[start:] if start >= 0 else b""
            self._overlong = True
        self._rest = rest
        return lines

    def restart(self) -> None:
        """Discard the incomplete line of a lost connection."""
        self._rest = b""
        self._overlong = False
        self._in_step = False

    def _reject(self, piece: bytes) -> None:
        if not self._in_step:
            return
        self.rejected += 1
        self.last_rejected.append(piece[-LINE_LIMIT_BYTES:])


def parse_line(piece: bytes) -> WheelLine | GyroLine | None:
    """Return the line at the end of `piece` (bytes before a line feed), or None if there is no intact line."""
    start = piece.rfind(b"$")
    match = _LINE.fullmatch(piece, max(start, 0))
    if match is None:
        return _parse_gyro_line(piece, max(start, 0))
    if crc16(match[1]) != int(match[8], 16):
        return None
    boot_id, sequence, t_us, left, right, flags = map(int, match.group(2, 3, 4, 5, 6, 7))
    unsigned_fit = boot_id < _U32 and sequence < _U32 and t_us < _U32 and flags < _U16
    if not (unsigned_fit and -_I32 <= left < _I32 and -_I32 <= right < _I32):
        return None
    return WheelLine(boot_id, sequence, t_us, left, right, flags)


def _parse_gyro_line(piece: bytes, start: int) -> GyroLine | None:
    match = _GYRO_LINE.fullmatch(piece, start)
    if match is None or crc16(match[1]) != int(match[7], 16):
        return None
    boot_id, sequence, t_us, period_us = map(int, match.group(2, 3, 4, 5))
    fields = match[6].decode("ascii").split(",")[1:]
    rates = tuple(Unmeasured(each) if each in ("S", "E") else int(each) for each in fields)
    counters_fit = boot_id < _U32 and sequence < _U32 and t_us < _U32
    times_fit = 0 < period_us <= _LONGEST_PERIOD_US and (len(rates) - 1) * period_us <= _LONGEST_BATCH_US
    rates_fit = all(abs(each) < _FASTEST_URAD_S for each in rates if isinstance(each, int))
    return GyroLine(boot_id, sequence, t_us, period_us, rates) if counters_fit and times_fit and rates_fit else None


class WheelUnwrapper:
    """Unwrapper of 32-bit counters.

    Attributes:
        repeated: number of lines dropped because they had arrived before.
        overtaken: number of lines dropped because newer ones had arrived before them.
        epochs: number of boots of the controller.
    """

    def __init__(self) -> None:
        self.repeated = 0
        self.overtaken = 0
        self.epochs = 0
        self._last: WheelReading | None = None
        self._last_host_ns = 0
        self._recent: deque[int] = deque(maxlen=_REMEMBERED_LINES)  # sequence numbers of accepted lines
        self._old: WheelLine | None = None  # last of the old lines in a row
        self._old_in_a_row = 0
        self._lives = 0  # restarts under one boot_id
        self._wire_boot_id = -1

    def unwrap(self, line: WheelLine, host_ns: int) -> WheelReading | None:
        """Return the reading, or None for a repeated or overtaken line.

        Args:
            line: the parsed line.
            host_ns: time of arrival, which determines how often the microseconds wrapped around in a long gap.
        """
        last = self._last
        if last is None or line.boot_id != self._wire_boot_id:
            return self._new_epoch(line, host_ns, lives=0)
        sequence = nearest(line.sequence, last.sequence)
        expected_us = last.device_time_us + (host_ns - self._last_host_ns) // 1000
        device_time_us = nearest(line.t_us, expected_us)
        if sequence > last.sequence and device_time_us <= last.device_time_us - _RESTART_US:
            return self._new_epoch(
                line, host_ns, lives=self._lives + 1
            )  # the clock went back, but the sequence did not
        if sequence <= last.sequence:
            if self._has_restarted(line, last, device_time_us):
                return self._new_epoch(line, host_ns, lives=self._lives + 1)
            if sequence in self._recent:
                self.repeated += 1
            else:
                self.overtaken += 1
            return None
        reading = WheelReading(
            last.boot_id,
            sequence,
            device_time_us,
            nearest(line.ticks_left, last.ticks_left),
            nearest(line.ticks_right, last.ticks_right),
            line.flags,
            new_epoch=False,
            lost=sequence - last.sequence - 1,
        )
        return self._take(reading, host_ns)

    def expected_time_us(self, boot_id: int, host_ns: int) -> int | None:
        """Return the device time at an arrival, in the present epoch; None if `boot_id` is not that of its lines."""
        if self._last is None or boot_id != self._wire_boot_id:
            return None
        return self._last.device_time_us + (host_ns - self._last_host_ns) // 1000

    def _new_epoch(self, line: WheelLine, host_ns: int, lives: int) -> WheelReading:
        self.epochs += 1
        self._lives = lives
        self._wire_boot_id = line.boot_id
        self._recent.clear()
        boot_id = (line.boot_id + lives * _NEXT_LIFE) % _U32
        return self._take(WheelReading(boot_id, *line[1:], new_epoch=True, lost=0), host_ns)

    def _take(self, reading: WheelReading, host_ns: int) -> WheelReading:
        self._last, self._last_host_ns = reading, host_ns
        self._recent.append(reading.sequence)
        self._old, self._old_in_a_row = None, 0
        return reading

    def _has_restarted(self, line: WheelLine, last: WheelReading, device_time_us: int) -> bool:
        """Return whether enough old lines have arrived in order, as after a restart of the controller."""
        follows = self._old is not None and self._old.sequence < line.sequence and self._old.t_us < line.t_us
        self._old_in_a_row = self._old_in_a_row + 1 if follows else 1
        self._old = line
        return self._old_in_a_row >= _RESTART_LINES and device_time_us <= last.device_time_us - _RESTART_US


def nearest(wrapped: int, expected: int) -> int:
    """Return the number equal to `wrapped` modulo 2^32 that is nearest to `expected`."""
    return expected + (wrapped - expected + _I32) % _U32 - _I32


def _as_signed_int(value: int) -> int:
    return (value + _I32) % _U32 - _I32
