"""What must hold for any bytes that reach the port, judged by a second, slow parser."""

import random
from itertools import pairwise

from groundsbot.onboard.process import clock
from groundsbot.onboard.wheels import gyro, protocol
from groundsbot.onboard.wheels import intake as wheel_intake
from groundsbot.onboard.wheels.intake import StampedGyro, StampedReading, WheelIntake
from groundsbot.onboard.wheels.protocol import (
    LINE_LIMIT_BYTES,
    EncoderParser,
    GyroLine,
    Unmeasured,
    WheelLine,
    format_gyro_line,
    format_line,
)
from tests.support.guided_fuzz import Target

MODULES = [str(module.__file__) for module in (protocol, gyro, wheel_intake, clock)]
_FIELDS = ((0, 2**32 - 1), (0, 2**32 - 1), (0, 2**32 - 1), (-(2**31), 2**31 - 1), (-(2**31), 2**31 - 1), (0, 2**16 - 1))
_LONGEST_FIELDS = (10, 10, 10, 10, 10, 5)
_HOST_NS = 1_800_000_000_000_000_000


def seeds() -> list[bytes]:
    """A short drive, one across the wrap of all counters, a reset with and without a new boot_id, and noise."""
    steady = [WheelLine(7, index, 10_000 * index, 5 * index, -6 * index, index % 3) for index in range(12)]
    wrap = [
        WheelLine(7, 2**32 - 3 + i, 2**32 - 30_000 + 10_000 * i, 2**31 - 9 + 5 * i, -(2**31) + 9 - 5 * i, 0)
        for i in range(8)
    ]
    reset = steady[:6] + [line._replace(boot_id=8) for line in steady[:6]] + steady[:3]
    old = steady[-3:] + [WheelLine(7, index, 10_000 * index, index, index, 0) for index in range(60)]
    late = [steady[0], steady[2], steady[1], steady[2], steady[5]]
    streams = [b"\x00" + b"".join(map(format_line, lines)) for lines in (steady, wrap, reset, old, late)]
    turns = [
        GyroLine(7, 4 * index, 10_000 * index + 20, 2_500, (index, -500 * index, Unmeasured.SATURATED, 49_999_999))
        for index in range(12)
    ]
    both = b"".join(format_line(line) + format_gyro_line(turn) for line, turn in zip(steady, turns, strict=True))
    again = format_line(steady[0]) + b"".join(map(format_gyro_line, (*turns[:4], turns[2], *turns[8:3:-1])))
    streams += [b"\x01" + both, b"\x02" + again]
    return [*streams, b"\x05$GBW,1,9,1,2,3,-4,0*CF74\r\n$GBW,1$$\r\r\n\n*", b"\x03" + b"$" * 300, b""]


def seal(data: bytes, chance: random.Random) -> bytes:
    """Gives the lines new checksums, so that what was changed in them gets past."""
    del chance
    pieces = data.split(b"\n")
    for index, piece in enumerate(pieces):
        start, star = piece.rfind(b"$"), piece.rfind(b"*")
        if 0 <= start < star:
            body = piece[start + 1 : star]
            pieces[index] = piece[:star] + b"*%04X\r" % slow_crc16(body)
    return b"\n".join(pieces)


def renumber(data: bytes, chance: random.Random) -> bytes:
    """Puts another number into one field of one line."""
    pieces = data.split(b",")
    at = chance.randrange(len(pieces))
    number = chance.choice(
        (0, 1, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**32, chance.getrandbits(32), -chance.getrandbits(31))
    )
    return b",".join([*pieces[:at], b"%d" % number, *pieces[at + 1 :]])


def check(data: bytes) -> None:
    """Raises if the parser or what follows it does anything wrong with the bytes; the first one says how to cut."""
    chance = random.Random(data[0] if data else 0)
    stream = data[1:]
    parser, intake = EncoderParser(), WheelIntake()
    found: list[WheelLine | GyroLine] = []
    readings: list[StampedReading | StampedGyro] = []
    at, now_ns = 0, _HOST_NS
    while at < len(stream):
        piece = stream[at : at + chance.choice((1, 3, 20, 64, 500))]
        at += len(piece)
        now_ns += chance.choice((0, 1_000_000, 50_000_000, 700_000_000))
        found += parser.feed(piece)
        assert len(parser._rest) <= LINE_LIMIT_BYTES
        readings += intake.feed(piece, now_ns)
    readings += intake.release_all()
    assert found == slow_lines(stream)
    assert parser.accepted == len(found)
    wheels = [each for each in readings if isinstance(each, StampedReading)]
    _check_readings(wheels, intake, sum(isinstance(line, WheelLine) for line in found))
    samples = [each for each in readings if isinstance(each, StampedGyro)]
    first = next((k for k, line in enumerate(found) if isinstance(line, WheelLine)), len(found))
    turns = [line for line in found[first:] if isinstance(line, GyroLine)]
    _check_samples(samples, intake, sum(len(line.yaw_rates_urad_s) for line in turns))


def _check_samples(samples: list[StampedGyro], intake: WheelIntake, n_sent: int) -> None:
    counts = intake.gyro
    left_out = counts.out_of_order + counts.unplaced + counts.saturated + counts.unreadable
    assert len(samples) + left_out == n_sent
    for before, after in pairwise(samples):
        assert after.stamp_ns > before.stamp_ns
        assert after.host_ns >= before.host_ns
        if after.reading.boot_id == before.reading.boot_id:
            assert after.reading.device_time_us > before.reading.device_time_us
            assert after.reading.sequence >= before.reading.sequence + 1 + after.reading.lost


def _check_readings(readings: list[StampedReading], intake: WheelIntake, n_lines: int) -> None:
    left_out = intake.unwrapper.repeated + intake.unwrapper.overtaken
    assert len(readings) + left_out == n_lines
    for before, after in pairwise(readings):
        assert after.stamp_ns > before.stamp_ns
        assert after.host_ns >= before.host_ns
        if not after.reading.new_epoch:
            assert after.reading.boot_id == before.reading.boot_id
            assert after.reading.sequence == before.reading.sequence + 1 + after.reading.lost
            assert abs(after.reading.ticks_left - before.reading.ticks_left) <= 2**31


def slow_lines(stream: bytes) -> list[WheelLine | GyroLine]:
    """The intact lines, found another way."""
    lines: list[WheelLine | GyroLine] = []
    for piece in stream.split(b"\n")[:-1]:
        _, dollar, line = piece.rpartition(b"$")
        body, star, check_sum = line.partition(b"*")
        fields = body.split(b",")
        if not (dollar and star and check_sum == b"%04X\r" % slow_crc16(body)):
            continue
        if fields[:2] == [b"GBG", b"2"]:
            lines += _slow_gyro_lines(fields[2:])
        if len(fields) != 8 or fields[:2] != [b"GBW", b"1"]:
            continue
        numbers = [_number(*each) for each in zip(fields[2:], _FIELDS, _LONGEST_FIELDS, strict=True)]
        known = [number for number in numbers if number is not None]
        if len(known) == len(numbers):
            lines.append(WheelLine(*known))
    return lines


def _slow_gyro_lines(fields: list[bytes]) -> list[GyroLine]:
    """The line, if it is one."""
    limits, longest = ((0, 2**32 - 1),) * 3 + ((1, 1_000_000),), (10, 10, 10, 7)
    numbers = [_number(*each) for each in zip(fields[:4], limits, longest, strict=False)]
    rates: list[int | Unmeasured | None] = [
        Unmeasured(each.decode()) if each in (b"S", b"E") else _number(each, (-49_999_999, 49_999_999), 8)
        for each in fields[4:]
    ]
    head, measured = [each for each in numbers if each is not None], [each for each in rates if each is not None]
    if len(head) < 4 or not 1 <= len(rates) <= 20 or len(measured) < len(rates):
        return []
    boot_id, sequence, t_us, period_us = head
    line = GyroLine(boot_id, sequence, t_us, period_us, tuple(measured))
    return [line] if (len(rates) - 1) * period_us <= 100_000 else []


def _number(text: bytes, limits: tuple[int, int], longest: int) -> int | None:
    digits = text[1:] if text[:1] == b"-" and limits[0] < 0 else text
    if not 1 <= len(digits) <= longest or any(byte not in b"0123456789" for byte in digits):
        return None
    return int(text) if limits[0] <= int(text) <= limits[1] else None


def slow_crc16(data: bytes) -> int:
    """CRC-16/CCITT-FALSE, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021) & 0xFFFF if crc & 0x8000 else crc << 1
    return crc


TARGET = Target(check, seeds(), MODULES, (seal, renumber))
