"""What must hold for any bytes that reach the port, judged by a second, slow parser."""

import random
from itertools import pairwise

from groundsbot.onboard.process import clock
from groundsbot.onboard.wheels import intake as wheel_intake
from groundsbot.onboard.wheels import protocol
from groundsbot.onboard.wheels.intake import StampedReading, WheelIntake
from groundsbot.onboard.wheels.protocol import LINE_LIMIT_BYTES, EncoderParser, WheelLine, format_line
from tests.support.guided_fuzz import Target

MODULES = [str(module.__file__) for module in (protocol, wheel_intake, clock)]
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
    again = steady[-3:] + [WheelLine(7, index, 10_000 * index, index, index, 0) for index in range(60)]
    late = [steady[0], steady[2], steady[1], steady[2], steady[5]]
    streams = [b"\x00" + b"".join(map(format_line, lines)) for lines in (steady, wrap, reset, again, late)]
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
    found: list[WheelLine] = []
    readings: list[StampedReading] = []
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
    _check_readings(readings, intake, len(found))


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


def slow_lines(stream: bytes) -> list[WheelLine]:
    """The intact lines, found another way."""
    lines = []
    for piece in stream.split(b"\n")[:-1]:
        _, dollar, line = piece.rpartition(b"$")
        body, star, check_sum = line.partition(b"*")
        fields = body.split(b",")
        if not (dollar and star and check_sum == b"%04X\r" % slow_crc16(body)):
            continue
        if len(fields) != 8 or fields[:2] != [b"GBW", b"1"]:
            continue
        numbers = [_number(*each) for each in zip(fields[2:], _FIELDS, _LONGEST_FIELDS, strict=True)]
        known = [number for number in numbers if number is not None]
        if len(known) == len(numbers):
            lines.append(WheelLine(*known))
    return lines


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
