"""What a serial line can do to its readings. Rows of the table of faults."""

import math
import random
import tracemalloc
from itertools import pairwise
from pathlib import Path

import pytest

from groundsbot.onboard.log.messages import EventKind
from groundsbot.onboard.wheels.intake import WheelIntake
from groundsbot.onboard.wheels.protocol import WheelLine, format_line
from tests.support.devices.recorder_cores import (
    MS,
    PERIOD_NS,
    START_NS,
    S,
    events_of,
    line_of,
    make_core,
    send,
    wheels_of,
)
from tests.support.guided_fuzz import fuzz
from tests.support.wheel_line_fuzz import TARGET

HOST_NS = START_NS


def test_row_23_ten_megabytes_of_noise(tmp_path: Path) -> None:
    chance = random.Random(23)
    core = make_core(tmp_path)
    tracemalloc.start()
    for index in range(2500):
        core.on_serial_bytes(chance.randbytes(4096), START_NS + index * 4 * MS)
        core.tick(START_NS + index * 4 * MS)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    now_ns = START_NS + 10 * S
    core.on_serial_bytes(b"\n" + format_line(line_of(0)), now_ns)  # and then the line is in order again
    core.close(now_ns)
    assert [reading.sequence for reading in wheels_of(tmp_path / "run1")] == [0]
    assert peak_bytes < 4_000_000  # the log's chunk included
    told = events_of(tmp_path / "run1", EventKind.WHEEL_LINE_REJECTED)
    assert 1 <= len(told) <= 12  # once a second


def test_row_23_fuzzing_finds_nothing() -> None:
    done = fuzz(TARGET, seed=23, runs=400)
    assert done.edges > 150


def test_row_24_all_intact_lines_come_out_of_noise_and_only_those(tmp_path: Path) -> None:
    chance = random.Random(24)
    core, intact = make_core(tmp_path), []
    for index in range(1500):
        whole = format_line(line_of(index))
        data = [whole, chance.randbytes(chance.randrange(60)).replace(b"\n", b"$") + whole][chance.randrange(2)]
        kind = chance.randrange(6)
        if kind == 0:  # cut: its end is missing, and what follows is glued to it
            data = whole[: chance.randrange(1, len(whole) - 2)]
        elif kind == 1:  # its beginning is missing
            data = whole[chance.randrange(1, 9) :]
        else:
            intact.append(index)
        send(core, index, data)
    core.close(START_NS + 20 * S)
    assert [reading.sequence for reading in wheels_of(tmp_path / "run1")] == intact
    assert core.losses["wheel lines"] == intact[-1] - intact[0] + 1 - len(intact)


def test_row_25_wrong_digits_are_rejected_counted_and_kept_now_and_then(tmp_path: Path) -> None:
    chance = random.Random(25)
    core, wrong = make_core(tmp_path), set(chance.sample(range(10, 990), 200))
    spoilt: list[bytes] = []
    for index in range(1000):
        data = format_line(line_of(index))
        if index in wrong:
            digits = [at for at in range(1, len(data) - 2) if chr(data[at]).isdigit()]
            at = chance.choice(digits)
            data = data[:at] + bytes([(data[at] - 47) % 10 + 48]) + data[at + 1 :]
            spoilt.append(data)
        send(core, index, data)
    core.close(START_NS + 10 * S)
    assert [reading.sequence for reading in wheels_of(tmp_path / "run1")] == sorted(set(range(1000)) - wrong)
    told = events_of(tmp_path / "run1", EventKind.WHEEL_LINE_REJECTED)
    assert sum(event.count for event in told) == 200
    assert len(told) <= 11  # once a second, however many
    assert all(any(repr(each.rstrip()) in event.text for each in spoilt) for event in told)


def test_row_26_lost_lines_lose_no_distance(tmp_path: Path) -> None:
    chance = random.Random(26)
    core = make_core(tmp_path)
    lost = set(chance.sample(range(1, 1999), 200))
    for index in range(2000):
        if index not in lost:
            send(core, index)
    core.close(START_NS + 20 * S)
    readings = wheels_of(tmp_path / "run1")
    assert readings[-1].ticks_left - readings[0].ticks_left == 13 * 1999
    assert readings[-1].ticks_right - readings[0].ticks_right == -14 * 1999
    assert sum(event.count for event in events_of(tmp_path / "run1", EventKind.WHEEL_GAP)) == 200
    assert core.losses == {"wheel lines": 200}


def test_row_27_duplicates_and_reordered_lines_move_nothing(tmp_path: Path) -> None:
    chance = random.Random(27)
    order = list(range(500))
    for at in range(20, 480, 23):  # swaps neighbours
        order[at], order[at + 1] = order[at + 1], order[at]
    for at in range(480, 20, -31):  # says some again, a little later
        order.insert(at + chance.randrange(1, 9), order[at])
    core, now_ns = make_core(tmp_path), START_NS
    for place, index in enumerate(order):
        now_ns = START_NS + place * PERIOD_NS
        core.on_serial_bytes(format_line(line_of(index)), now_ns)
        core.tick(now_ns)
    core.close(now_ns)
    readings = wheels_of(tmp_path / "run1")
    assert all(reading.ticks_left == 13 * reading.sequence for reading in readings)
    assert [reading.sequence for reading in readings] == sorted({reading.sequence for reading in readings})
    told = events_of(tmp_path / "run1", EventKind.WHEEL_SEQUENCE)
    assert sum(event.count for event in told) == len(order) - len(readings)
    assert any("repeated" in event.text for event in told)
    assert any(" 0 overtaken" not in event.text for event in told)
    assert not events_of(tmp_path / "run1", EventKind.WHEEL_RESET)


@pytest.mark.parametrize("slow_hz", [100, 2])
def test_row_28_time_and_ticks_wrap_around(tmp_path: Path, slow_hz: int) -> None:
    core = make_core(tmp_path)
    step_us, now_ns = 1_000_000 // slow_hz, START_NS
    for index in range(400):
        wire = WheelLine(
            7,
            (2**32 - 100 + index) % 2**32,
            (2**32 - 100 * step_us + index * step_us) % 2**32,
            (2**31 - 900 + 9 * index + 2**31) % 2**32 - 2**31,
            (-(2**31) + 900 - 9 * index + 2**31) % 2**32 - 2**31,
            0,
        )
        now_ns = START_NS + index * step_us * 1000
        core.on_serial_bytes(format_line(wire), now_ns)
    core.close(now_ns)
    readings = wheels_of(tmp_path / "run1")
    assert len(readings) == 400
    for before, after in pairwise(readings):
        assert after.sequence - before.sequence == 1
        assert after.device_time_us - before.device_time_us == step_us
        assert (after.ticks_left - before.ticks_left, after.ticks_right - before.ticks_right) == (9, -9)
        assert abs(after.stamp_ns - before.stamp_ns - step_us * 1000) < MS
    assert not core.losses


def test_row_30_a_wrong_baud_rate_is_reported_within_three_seconds(tmp_path: Path) -> None:
    chance = random.Random(30)
    core = make_core(tmp_path)
    core.on_port_connected("port", START_NS)
    for index in range(100):  # bits sampled at the wrong moments
        now_ns = START_NS + index * 50 * MS
        core.on_serial_bytes(chance.randbytes(40), now_ns)
        core.tick(now_ns)
    core.close(START_NS + 5 * S)
    (told,) = events_of(tmp_path / "run1", EventKind.NO_WHEEL_DATA)
    assert "no valid data" in told.text
    assert "baud" in told.text
    assert told.stamp_ns - START_NS <= 3 * S


def test_row_30_silence_is_reported_each_time_it_begins(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    for index in [*range(100), *range(600, 700)]:
        for idle in range(index - 499 if index == 600 else index, index):
            core.tick(START_NS + idle * PERIOD_NS)
        send(core, index)
    for tick in range(50):
        core.tick(START_NS + 7 * S + tick * 100 * MS)
    core.close(START_NS + 12 * S)
    told = events_of(tmp_path / "run1", EventKind.NO_WHEEL_DATA)
    assert [
        2 * S < each.stamp_ns - last <= 3 * S for each, last in zip(told, (START_NS + S, START_NS + 7 * S), strict=True)
    ]


@pytest.mark.parametrize("rate_ppm", [200, -200])
@pytest.mark.parametrize("burst_s", [0.0, 0.3])
def test_row_31_bursts_and_clocks_apart_stay_under_a_millisecond(rate_ppm: int, burst_s: float) -> None:
    chance = random.Random(31)
    intake, errors_ms, waiting = WheelIntake(), [], b""
    for index in range(12_000):  # two minutes at 100 Hz
        measured_s = index * 0.01
        device_us = int(measured_s * (1e6 + rate_ppm)) + 4_000_000_000  # it wraps on the way
        waiting += format_line(line_of(index)._replace(t_us=device_us % 2**32))
        if burst_s and (index + 1) % round(burst_s / 0.01):
            continue
        late_s = 0.002 + abs(chance.gauss(0.0, 2e-4)) + (0.03 if chance.random() < 0.01 else 0.0)
        arrival_ns = HOST_NS + math.ceil((measured_s + late_s) * 1e9)
        for each in intake.feed(waiting, arrival_ns):
            true_ms = each.reading.sequence * 10.0
            errors_ms.append((each.stamp_ns - HOST_NS) / 1e6 - true_ms - 2.0)
        waiting = b""
    assert len(errors_ms) > 11_900
    assert max(map(abs, errors_ms[200:])) < 1.0  # two seconds of warming up
