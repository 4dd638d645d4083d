"""The controller's clock on the host's: what delays and rates differ by must not reach the stamps."""

import random

import pytest

from groundsbot.onboard.process.clock import DeviceClockFilter, RunClock, read_clocks
from groundsbot.onboard.wheels.intake import WheelIntake
from groundsbot.onboard.wheels.protocol import WheelLine, format_line

HOST_NS = 1_800_000_000_000_000_000
MS = 1_000_000


@pytest.mark.parametrize("rate_ppm", [5000, -5000])
def test_a_ceramic_resonator_is_learned(rate_ppm: float) -> None:
    """Readings at 100 Hz that arrive 1 ms late at least, one in a hundred 20 ms later."""
    chance = random.Random(1)
    mapping = DeviceClockFilter()
    errors_ms = []
    for index in range(6000):
        measured_s = index * 0.01
        arrival_s = measured_s + 0.001 + abs(chance.gauss(0.0, 3e-4)) + (0.02 if chance.random() < 0.01 else 0.0)
        device_us = int(measured_s * (1e6 + rate_ppm)) + 123_456_789
        mapping.observe(device_us, HOST_NS + round(arrival_s * 1e9))
        errors_ms.append((mapping.stamp_ns(device_us) - HOST_NS) / 1e6 - measured_s * 1e3 - 1.0)
    assert max(map(abs, errors_ms[500:])) < 0.3


def test_a_stamp_is_never_after_the_arrival() -> None:
    chance = random.Random(2)
    mapping = DeviceClockFilter()
    for index in range(3000):
        arrival_ns = HOST_NS + index * 10 * MS + chance.randrange(40 * MS)
        mapping.observe(index * 10_000, arrival_ns)
        assert mapping.stamp_ns(index * 10_000) <= arrival_ns


def test_a_fixed_delay_and_exact_clocks_are_mapped_exactly() -> None:
    mapping = DeviceClockFilter()
    for index in range(5000):
        mapping.observe(index * 10_000, HOST_NS + index * 10 * MS)
        assert mapping.stamp_ns(index * 10_000) == HOST_NS + index * 10 * MS


def test_readings_that_lay_in_a_buffer_at_the_start_get_their_true_stamps() -> None:
    """A second of old lines comes at once on opening; only later lines show how old they were."""
    intake = WheelIntake()
    lines = [format_line(WheelLine(1, index, index * 10_000, 0, 0, 0)) for index in range(300)]
    ready = intake.feed(b"".join(lines[:100]), HOST_NS + 1000 * MS)
    assert ready == []
    for index in range(100, 300):
        ready += intake.feed(lines[index], HOST_NS + index * 10 * MS + MS)
    assert [each.reading.sequence for each in ready] == list(range(300))
    assert max(abs(each.stamp_ns - HOST_NS - each.reading.sequence * 10 * MS - MS) for each in ready) < MS
    stamps = [each.stamp_ns for each in ready]
    assert stamps == sorted(set(stamps))


def test_the_runs_clock_is_wall_clock_time_that_cannot_step() -> None:
    clock = RunClock()
    reading = read_clocks()
    assert clock.from_monotonic(reading.monotonic_ns) == reading.monotonic_ns + clock.run_epoch_ns
    assert abs(clock.from_realtime(reading.realtime_ns) - clock.from_monotonic(reading.monotonic_ns)) < 50 * MS
    earlier = clock.now_ns()
    assert clock.now_ns() >= earlier
