r"""The wheel controller's line protocol: bytes in, readings out. For firmware: docs/wheel_protocol.md.

One line a reading, pushed by the controller:

    $GBW,<version>,<boot_id>,<sequence>,<t_us>,<ticks_left>,<ticks_right>,<flags>*<CRC16>\r\n

Nothing here knows of a port or a clock.
"""

import binascii
import re
from typing import Final, NamedTuple

PROTOCOL_VERSION: Final = 1
LINE_LIMIT_BYTES: Final = 96  # the longest line has 76

_U16: Final = 1 << 16
_U32: Final = 1 << 32
_I32: Final = 1 << 31
_NEWLINE: Final = b"\n"
_LINE: Final = re.compile(
    rb"\$(GBW,%d,(\d{1,10}),(\d{1,10}),(\d{1,10}),(-?\d{1,10}),(-?\d{1,10}),(\d{1,5}))\*([0-9A-F]{4})\r"
    % PROTOCOL_VERSION
)


class WheelLine(NamedTuple):
    """One line as the controller sent it; counters wrap around at 32 bits."""

    boot_id: int
    sequence: int
    t_us: int
    ticks_left: int
    ticks_right: int
    flags: int


class WheelReading(NamedTuple):
    """One reading with its counters unwrapped."""

    boot_id: int
    sequence: int
    device_time_us: int
    ticks_left: int
    ticks_right: int
    flags: int
    new_epoch: bool  # the first one of a boot: what was driven since the reading before is unknown
    lost: int  # readings missing before this one, by sequence number


def crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE: polynomial 0x1021, start 0xFFFF, not reflected; 0x29B1 for b"123456789"."""
    return binascii.crc_hqx(data, 0xFFFF)


def format_line(line: WheelLine) -> bytes:
    """The bytes of one line, counters taken modulo 2^32 (ticks into [-2^31, 2^31), flags modulo 2^16)."""
    body = (
        f"GBW,{PROTOCOL_VERSION},{line.boot_id % _U32},{line.sequence % _U32},{line.t_us % _U32},"
        f"{_signed(line.ticks_left)},{_signed(line.ticks_right)},{line.flags % _U16}"
    ).encode("ascii")
    return b"$%s*%04X\r\n" % (body, crc16(body))


class EncoderParser:
    """Finds the intact lines in a stream of bytes, whatever lies between them.

    Attributes:
        accepted: lines returned so far.
        rejected: pieces between line ends that were, or began with, something else than an intact line. What comes
            before the first line end after the start is not counted: whoever connects comes in mid-line.
        last_rejected: the bytes of the newest of these, at most `LINE_LIMIT_BYTES`.
    """

    def __init__(self) -> None:
        self.accepted = 0
        self.rejected = 0
        self.last_rejected = b""
        self._rest = b""
        self._overlong = False
        self._in_step = False

    def feed(self, data: bytes) -> list[WheelLine]:
        """The lines that these bytes complete, in order."""
        pieces = (self._rest + data).split(_NEWLINE)
        rest = pieces.pop()
        lines = []
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
        if len(rest) > LINE_LIMIT_BYTES:  # only what follows the last $ can still become a line
            start = rest.rfind(b"$", -LINE_LIMIT_BYTES)
            rest = rest[start:] if start >= 0 else b""
            self._overlong = True
        self._rest = rest
        return lines

    def restart(self) -> None:
        """Forgets the half line of a connection that was lost."""
        self._rest = b""
        self._overlong = False
        self._in_step = False

    def _reject(self, piece: bytes) -> None:
        if not self._in_step:
            return
        self.rejected += 1
        self.last_rejected = piece[-LINE_LIMIT_BYTES:]


def parse_line(piece: bytes) -> WheelLine | None:
    """The line at the end of `piece` (bytes up to, and without, a line feed), or None if there is no intact one."""
    start = piece.rfind(b"$")
    match = _LINE.fullmatch(piece, max(start, 0))
    if match is None or crc16(match[1]) != int(match[8], 16):
        return None
    boot_id, sequence, t_us, left, right, flags = (int(match[index]) for index in range(2, 8))
    unsigned_fit = boot_id < _U32 and sequence < _U32 and t_us < _U32 and flags < _U16
    if not (unsigned_fit and -_I32 <= left < _I32 and -_I32 <= right < _I32):
        return None
    return WheelLine(boot_id, sequence, t_us, left, right, flags)


class WheelUnwrapper:
    """Makes counters that wrap around into ones that do not.

    Attributes:
        repeated: lines dropped because their sequence number was not newer than the last one's.
        epochs: boots seen.
    """

    def __init__(self) -> None:
        self.repeated = 0
        self.epochs = 0
        self._last: WheelReading | None = None
        self._last_host_ns = 0

    def unwrap(self, line: WheelLine, host_ns: int) -> WheelReading | None:
        """The reading, or None for a duplicated or overtaken line.

        Args:
            line: as parsed.
            host_ns: when it arrived; tells how often the microseconds wrapped around in a long silence.
        """
        last = self._last
        if last is None or line.boot_id != last.boot_id:
            self.epochs += 1
            reading = WheelReading(*line, new_epoch=True, lost=0)
        else:
            sequence = _nearest(line.sequence, last.sequence)
            if sequence <= last.sequence:
                self.repeated += 1
                return None
            elapsed_us = (host_ns - self._last_host_ns) // 1000
            reading = WheelReading(
                line.boot_id,
                sequence,
                _nearest(line.t_us, last.device_time_us + elapsed_us),
                _nearest(line.ticks_left, last.ticks_left),
                _nearest(line.ticks_right, last.ticks_right),
                line.flags,
                new_epoch=False,
                lost=sequence - last.sequence - 1,
            )
        self._last, self._last_host_ns = reading, host_ns
        return reading


def _nearest(wrapped: int, expected: int) -> int:
    """The number equal to `wrapped` modulo 2^32 that lies nearest to `expected`."""
    return expected + (wrapped - expected + _I32) % _U32 - _I32


def _signed(value: int) -> int:
    return (value + _I32) % _U32 - _I32
