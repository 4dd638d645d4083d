"""Lines of a gyro: intact ones come out whole, wrong ones not at all, and samples keep their order and time."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from groundsbot.onboard.wheels.gyro import GyroUnwrapper
from groundsbot.onboard.wheels.intake import StampedGyro, WheelIntake
from groundsbot.onboard.wheels.protocol import (
    LINE_LIMIT_BYTES,
    EncoderParser,
    GyroLine,
    Unmeasured,
    WheelLine,
    crc16,
    format_gyro_line,
    format_line,
)
from tests.support.paths import ROOT

MS = 1_000_000
LINE = GyroLine(9, 40, 1_000_000, 5_000, (17453, -12, Unmeasured.SATURATED, Unmeasured.UNREADABLE))
SAMPLES = st.integers(-49_999_999, 49_999_999) | st.sampled_from(Unmeasured)
LINES = st.builds(
    GyroLine,
    boot_id=st.integers(0, 2**32 - 1),
    sequence=st.integers(0, 2**32 - 1),
    t_us=st.integers(0, 2**32 - 1),
    period_us=st.integers(1, 5_000),
    yaw_rates_urad_s=st.lists(SAMPLES, min_size=1, max_size=20).map(tuple),
)


def test_the_documented_line_is_the_one_that_is_sent() -> None:
    assert EncoderParser().feed(format_gyro_line(LINE)) == [LINE]
    assert format_gyro_line(LINE).decode().strip() in (ROOT / "docs" / "wheel_protocol.md").read_text()


@given(st.lists(LINES, max_size=4), st.lists(st.integers(1, 300), max_size=40))
def test_lines_survive_being_cut_anywhere(lines: list[GyroLine], cuts: list[int]) -> None:
    wheels = WheelLine(9, 1, 2, 3, -4, 0)
    data = b"".join(format_gyro_line(line) + format_line(wheels) for line in lines)
    parser, found = EncoderParser(), list[GyroLine | WheelLine]()
    for size in cuts:
        found += parser.feed(data[:size])
        data = data[size:]
    found += parser.feed(data)
    assert found[::2] == lines
    assert found[1::2] == [wheels] * len(lines)
    assert parser.rejected == 0


def test_the_longest_line_is_not_noise() -> None:
    line = GyroLine(2**32 - 1, 2**32 - 1, 2**32 - 1, 5_263, (-49_999_999,) * 20)
    data = format_gyro_line(line)
    assert len(data) == 251
    parser = EncoderParser()
    assert [each for byte in data for each in parser.feed(bytes([byte]))] == [line]
    assert len(data) <= LINE_LIMIT_BYTES


@pytest.mark.parametrize(
    "body",
    [
        b"GBG,1,9,1,2,5000,3",  # another version
        b"GBG,2,9,1,2,5000",  # no sample
        b"GBG,2,9,1,2,1000" + b",3" * 21,  # too many
        b"GBG,2,4294967296,1,2,5000,3",  # boot id over 32 bits
        b"GBG,2,9,1,2,0,3",  # no period
        b"GBG,2,9,1,2,1000001,3",
        b"GBG,2,9,1,2,50001,3,4,5",  # a batch of more than 0.1 s
        b"GBG,2,9,1,2,5000,50000000",  # a map refuses such a rate
        b"GBG,2,9,1,2,5000,",
        b"GBG,2,9,1,2,5000,3.5",
        b"GBG,2,9,1,2,5000,+3",
    ],
)
def test_a_right_checksum_does_not_save_a_wrong_line(body: bytes) -> None:
    assert EncoderParser().feed(b"$%s*%04X\r\n" % (body, crc16(body))) == []


@given(LINES, st.data())
def test_a_changed_byte_is_never_a_sample(line: GyroLine, data: st.DataObject) -> None:
    sent = bytearray(format_gyro_line(line))
    at = data.draw(st.integers(0, len(sent) - 1))
    anything = st.sampled_from(b"0123456789$*,-SE\r\n") | st.integers(0, 255)
    sent[at] = data.draw(anything.filter(lambda byte: byte != sent[at]))
    assert EncoderParser().feed(bytes(sent)) == []


def test_each_sample_has_its_own_time_and_number() -> None:
    readings = GyroUnwrapper().unwrap(LINE, 9, 1_000_000)
    assert [(each.sequence, each.device_time_us, each.lost) for each in readings] == [
        (40, 1_000_000, 0),
        (41, 1_005_000, 0),
    ]
    assert [each.yaw_rate_rad_s for each in readings] == pytest.approx([0.017453, -0.000012])


@given(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1), st.lists(st.integers(0, 300), max_size=30))
def test_counters_go_on_where_they_wrap_around(sequence: int, t_us: int, missing: list[int]) -> None:
    unwrapper = GyroUnwrapper()
    unwrapper.unwrap(GyroLine(9, sequence, t_us, 1_000, (1, 2)), 9, t_us)
    for n in missing:
        sequence, t_us = sequence + 2 + n, t_us + 1_000 * (2 + n)
        line = GyroLine(9, sequence % 2**32, t_us % 2**32, 1_000, (1, 2))
        first, second = unwrapper.unwrap(line, 9, t_us - 700)
        assert (first.sequence, first.device_time_us, first.lost) == (sequence, t_us, n)
        assert (second.sequence, second.device_time_us, second.lost) == (sequence + 1, t_us + 1_000, 0)
    assert unwrapper.renumbered == 0


def test_missing_samples_are_counted_across_batches_without_a_measurement() -> None:
    unwrapper = GyroUnwrapper()
    unwrapper.unwrap(GyroLine(9, 0, 0, 1_000, (1, 2)), 9, 0)
    assert unwrapper.unwrap(GyroLine(9, 5, 5_000, 1_000, (Unmeasured.UNREADABLE,) * 2), 9, 5_000) == []
    (reading,) = unwrapper.unwrap(GyroLine(9, 7, 7_000, 1_000, (4,)), 9, 7_000)
    assert (reading.sequence, reading.lost, unwrapper.unreadable) == (7, 3, 2)


def test_gyro_and_wheels_have_one_clock() -> None:
    """Whatever the line's delay, readings measured at one moment have one stamp."""
    intake, stamps = WheelIntake(), dict[int, dict[str, int]]()
    for index in range(300):
        t_us, now_ns = 10_000 * index, 10 * MS * index + (2 + index % 7) * MS
        data = format_line(WheelLine(7, index, t_us, 0, 0, 0)) + format_gyro_line(GyroLine(7, index, t_us, 5_000, (5,)))
        for each in intake.feed(data, now_ns):
            kind = "gyro" if isinstance(each, StampedGyro) else "wheels"
            stamps.setdefault(each.reading.device_time_us, {})[kind] = each.stamp_ns
    both = [each for each in stamps.values() if len(each) == 2]
    assert len(both) > 290
    assert all(abs(each["gyro"] - each["wheels"]) < 1_000 for each in both)


def test_batches_that_overlap_cost_the_samples_that_do() -> None:
    """As of a controller that stamps its batches when it sends them."""
    unwrapper = GyroUnwrapper()
    unwrapper.unwrap(GyroLine(9, 0, 0, 1_000, (1, 2, 3, 4)), 9, 0)
    readings = unwrapper.unwrap(GyroLine(9, 4, 1_500, 1_000, (5, 6, 7, 8)), 9, 4_000)
    assert [(each.sequence, each.device_time_us) for each in readings] == [(6, 3_500), (7, 4_500)]
    assert unwrapper.out_of_order == 2
