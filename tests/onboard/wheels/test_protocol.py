"""All intact lines come out of any bytes, and only those; counters never jump."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundsbot.onboard.wheels.protocol import (
    LINE_LIMIT_BYTES,
    EncoderParser,
    WheelLine,
    WheelUnwrapper,
    crc16,
    format_line,
)
from tests.support.paths import ROOT

LINES = st.builds(
    WheelLine,
    boot_id=st.integers(0, 2**32 - 1),
    sequence=st.integers(0, 2**32 - 1),
    t_us=st.integers(0, 2**32 - 1),
    ticks_left=st.integers(-(2**31), 2**31 - 1),
    ticks_right=st.integers(-(2**31), 2**31 - 1),
    flags=st.integers(0, 2**16 - 1),
)
LINE = WheelLine(9, 1, 2, 3, -4, 0)


def test_the_checksum_is_the_one_documented() -> None:
    assert crc16(b"123456789") == 0x29B1
    assert format_line(LINE) == b"$GBW,1,9,1,2,3,-4,0*CF74\r\n"
    documented = (ROOT / "docs" / "wheel_protocol.md").read_text()
    assert format_line(LINE).decode().strip() in documented
    assert "0x29B1" in documented


@given(st.lists(LINES, max_size=6), st.lists(st.integers(1, 200), max_size=40))
def test_lines_survive_being_cut_anywhere(lines: list[WheelLine], cuts: list[int]) -> None:
    data = b"".join(map(format_line, lines))
    parser, found = EncoderParser(), []
    for size in cuts:
        found += parser.feed(data[:size])
        data = data[size:]
    assert found + parser.feed(data) == lines
    assert parser.rejected == 0


@given(st.lists(st.tuples(st.binary(max_size=300), LINES), max_size=5))
def test_intact_lines_come_out_of_noise(pieces: list[tuple[bytes, WheelLine]]) -> None:
    parser = EncoderParser()
    found = [line for noise, good in pieces for line in parser.feed(noise) + parser.feed(format_line(good))]
    assert found == [good for _, good in pieces]


def test_cut_and_glued_lines_cost_themselves_only() -> None:
    good = [LINE._replace(sequence=index) for index in range(4)]
    cut = format_line(LINE)[:17]
    parser = EncoderParser()
    data = (
        cut
        + b"\r\n"
        + format_line(good[0])
        + cut
        + format_line(good[1])
        + format_line(good[2]).rstrip()
        + format_line(good[3])
    )
    assert parser.feed(data) == [good[0], good[1], good[3]]
    assert parser.rejected == 2  # what came before the first line end is not counted
    assert parser.last_rejected[-1] == format_line(good[2]).rstrip()


@given(LINES, st.data())
def test_a_changed_byte_is_never_a_reading(line: WheelLine, data: st.DataObject) -> None:
    sent = bytearray(format_line(line))
    at = data.draw(st.integers(0, len(sent) - 1))
    anything = st.sampled_from(b"0123456789$*,-\r\n") | st.integers(0, 255)
    sent[at] = data.draw(anything.filter(lambda byte: byte != sent[at]))
    assert EncoderParser().feed(bytes(sent)) == []


def test_megabytes_of_noise_take_no_memory_and_make_no_reading() -> None:
    chance = random.Random(5)
    parser = EncoderParser()
    for _ in range(500):
        assert parser.feed(chance.randbytes(4096)) == []
        assert parser.feed(b"x$" * 2048) == []
        assert len(parser._rest) <= LINE_LIMIT_BYTES
    assert all(len(each) <= LINE_LIMIT_BYTES for each in parser.last_rejected)
    assert parser.feed(b"\r\n" + format_line(LINE)) == [LINE]


@pytest.mark.parametrize(
    "body",
    [
        b"GBW,2,9,1,2,3,-4,0",  # another version
        b"GBW,1,9,1,2,3,-4",  # a field short
        b"GBW,1,4294967296,1,2,3,-4,0",  # boot id over 32 bits
        b"GBW,1,9,1,2,2147483648,-4,0",  # ticks over 31 bits
        b"GBW,1,9,1,2,3,-4,65536",  # flags over 16 bits
        b"GBW,1,9,1,2,+3,-4,0",
        b"GBW,1,9,-1,2,3,-4,0",
    ],
)
def test_a_right_checksum_does_not_save_a_wrong_line(body: bytes) -> None:
    assert EncoderParser().feed(b"$%s*%04X\r\n" % (body, crc16(body))) == []


@given(st.lists(st.tuples(st.integers(1, 1000), st.integers(-(2**30), 2**30)), min_size=1, max_size=30), LINES)
def test_counters_go_on_where_they_wrap_around(steps: list[tuple[int, int]], start: WheelLine) -> None:
    unwrapper = WheelUnwrapper()
    first = unwrapper.unwrap(start, 0)
    assert first is not None
    assert first.new_epoch
    sequence, t_us, left, host_ns = start.sequence, start.t_us, start.ticks_left, 0
    for ahead, ticks in steps:
        sequence, t_us, left, host_ns = (
            sequence + ahead,
            t_us + ahead * 10_000,
            left + ticks,
            host_ns + ahead * 10_000_000,
        )
        wire = start._replace(sequence=sequence % 2**32, t_us=t_us % 2**32, ticks_left=(left + 2**31) % 2**32 - 2**31)
        reading = unwrapper.unwrap(wire, host_ns)
        assert reading is not None
        assert (reading.sequence, reading.device_time_us, reading.ticks_left) == (sequence, t_us, left)
        assert reading.lost == ahead - 1
        assert not reading.new_epoch


def test_a_silence_longer_than_the_microseconds_last() -> None:
    unwrapper = WheelUnwrapper()
    unwrapper.unwrap(LINE._replace(t_us=100), 0)
    three_hours_us = 3 * 3600 * 1_000_000
    reading = unwrapper.unwrap(
        LINE._replace(sequence=2, t_us=(100 + three_hours_us) % 2**32), three_hours_us * 1000 + 7
    )
    assert reading is not None
    assert reading.device_time_us == 100 + three_hours_us


def lines_of_a_life(n: int, boot_id: int = 9, start_us: int = 0) -> list[WheelLine]:
    return [WheelLine(boot_id, index, start_us + index * 10_000, 7 * index, 8 * index, 0) for index in range(n)]


def test_a_controller_that_keeps_its_boot_id_over_a_reset_begins_a_new_epoch_all_the_same() -> None:
    unwrapper = WheelUnwrapper()
    for index, line in enumerate(lines_of_a_life(1000)):
        unwrapper.unwrap(line, index * 10_000_000)
    again = [unwrapper.unwrap(line, (1100 + i) * 10_000_000) for i, line in enumerate(lines_of_a_life(300))]
    taken = [reading for reading in again if reading is not None]
    assert taken[0].new_epoch
    assert not any(reading.new_epoch for reading in taken[1:])
    assert len(taken) > 200
    assert {reading.boot_id for reading in taken}.isdisjoint({9})
    assert unwrapper.epochs == 2


def test_a_count_that_goes_on_while_the_clock_goes_back_is_a_reset_too() -> None:
    unwrapper = WheelUnwrapper()
    for index, line in enumerate(lines_of_a_life(1000)):  # ten seconds
        unwrapper.unwrap(line, index * 10_000_000)
    unheard = lines_of_a_life(1100)[1001:]  # a new life of which the first lines were missed
    late = [line._replace(t_us=line.t_us - 9_000_000) for line in unheard]
    first = unwrapper.unwrap(late[0], 20_000_000_000)
    assert first is not None
    assert first.new_epoch


def test_a_replay_of_a_second_and_a_host_that_slept_are_no_reset() -> None:
    unwrapper = WheelUnwrapper()
    lines = lines_of_a_life(2000)
    for index, line in enumerate(lines[:1000]):
        unwrapper.unwrap(line, index * 10_000_000)
    for line in lines[900:1000]:
        assert unwrapper.unwrap(line, 10_000_000_000) is None
    asleep_ns = 60_000_000_000
    readings = [unwrapper.unwrap(line, asleep_ns) for line in lines[1000:]]
    assert all(reading is not None and not reading.new_epoch for reading in readings)
    assert (unwrapper.epochs, unwrapper.repeated, unwrapper.overtaken) == (1, 100, 0)
