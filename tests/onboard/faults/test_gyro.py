"""What can happen to a gyro on the wheel controller, and what the map makes of it. Rows of the table of faults."""

import random
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.robot.robot_yaml import parse_robot_yaml
from groundsbot.offline.logs.info import describe_log
from groundsbot.offline.measurements.motion_model.gyro import GyroSamples, gyro_samples
from groundsbot.onboard.log.messages import EventKind, Gyro
from groundsbot.onboard.wheels.intake import StampedGyro, WheelIntake
from groundsbot.onboard.wheels.protocol import GyroLine, Unmeasured, WheelLine, format_gyro_line, format_line
from tests.support.devices.recorder_cores import (
    MS,
    PERIOD_NS,
    ROBOT_YAML,
    START_NS,
    S,
    events_of,
    gyro_line_of,
    gyro_of,
    gyro_rate_urad_s,
    line_of,
    make_core,
    send,
    send_both,
    wheels_of,
)

NOTHING = b""
SAMPLE_US = 2_500


def told_of(folder: Path, kind: EventKind) -> int:
    """How many things the events of one kind count."""
    return sum(event.count for event in events_of(folder / "run1", kind))


def check_samples(samples: Sequence[Gyro], sequences: Sequence[int]) -> None:
    """Each of these samples is there with its own rate and time, and no other."""
    assert [each.sequence for each in samples] == list(sequences)
    for each in samples:
        assert each.yaw_rate_rad_s == pytest.approx(gyro_rate_urad_s(each.sequence) * 1e-6)
        true_ns = START_NS + (each.sequence - 3) * SAMPLE_US * 1000 + MS  # and the least delay of the line
        assert abs(each.stamp_ns - true_ns) < MS // 10
    assert all(after.stamp_ns > before.stamp_ns for before, after in pairwise(samples))


def used_by_map(samples: Sequence[Gyro]) -> tuple[GyroSamples, list[str]]:
    """What a map uses of a log's yaw rates, and its warnings."""
    readings = [(each.stamp_ns, each.yaw_rate_rad_s) for each in samples]
    used, warnings = gyro_samples(readings, parse_robot_yaml(ROBOT_YAML, "robot.yaml"), "/gyro")
    assert used is not None
    return used, warnings


def known_turns(used: GyroSamples, stamps_s: Sequence[float]) -> list[bool]:
    """Whether the gyro measures the turn between times since the start."""
    stamps_ns = np.array([START_NS + round(at_s * S) for at_s in stamps_s])
    return [bool(each) for each in used.turns(stamps_ns, stamps_ns[[0, -1]]).is_known]


def test_a_gyro_beside_the_wheels_is_recorded_whole(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    for index in range(500):
        send_both(core, index)
    core.close(START_NS + 5 * S)
    check_samples(gyro_of(tmp_path / "run1"), range(2000))
    assert [each.sequence for each in wheels_of(tmp_path / "run1")] == list(range(500))
    assert not core.losses
    assert {each.boot_id for each in gyro_of(tmp_path / "run1")} == {7}


def test_row_45_lost_samples_are_counted_and_a_gap_is_reported_at_once(tmp_path: Path) -> None:
    chance = random.Random(45)
    core = make_core(tmp_path)
    lost = set(chance.sample(range(1, 999), 100)) | set(range(400, 600))
    for index in range(1000):
        send_both(core, index, NOTHING if index in lost else None)
    core.close(START_NS + 10 * S)
    samples = gyro_of(tmp_path / "run1")
    check_samples(samples, [4 * index + k for index in range(1000) if index not in lost for k in range(4)])
    assert core.losses == {"gyro samples": 4 * len(lost)}
    info = describe_log(tmp_path / "run1")
    assert info.n_gyro_samples_lost == 4 * len(lost)  # from the log alone
    assert f"{4 * len(lost)} gyro samples lost or not measured" in "\n".join(info.lines())
    gaps = events_of(tmp_path / "run1", EventKind.GYRO_GAP)
    (long_one,) = [each for each in gaps if each.text.startswith("no yaw rate for 2.")]
    assert 0 < long_one.stamp_ns - START_NS - 6 * S < 100 * MS
    assert sum(each.count for each in gaps if each is not long_one) == 4 * len(lost)  # counted once a second


def test_row_45_the_map_takes_the_turn_over_a_gap_from_the_wheels(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    for index in range(1000):
        send_both(core, index, NOTHING if 400 <= index < 600 else None)
    core.close(START_NS + 10 * S)
    used, _ = used_by_map(gyro_of(tmp_path / "run1"))
    assert known_turns(used, [1.0, 3.0, 3.9, 4.1, 5.0, 5.9, 6.1, 9.0]) == [True, True, False, False, False, False, True]


def test_row_46_repeated_and_late_samples_are_left_out(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    late = set(range(20, 480, 23))
    for index in range(500):
        turns = [index - 5] if index in late else [index]  # an old one in its place
        turns += [index] if index % 31 == 0 else []  # twice
        send_both(core, index, b"".join(format_gyro_line(gyro_line_of(each)) for each in turns))
    core.close(START_NS + 5 * S)
    there = [index for index in range(500) if index not in late or index % 31 == 0]
    check_samples(gyro_of(tmp_path / "run1"), [4 * index + k for index in there for k in range(4)])
    twice = sum(index % 31 == 0 for index in range(500) if index not in late)
    assert told_of(tmp_path, EventKind.GYRO_SEQUENCE) == 4 * (len(late) + twice)
    assert core.losses == {"gyro samples": 4 * (500 - len(there))}


def test_row_46_a_time_that_cannot_be_is_left_out(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    for index in range(500):
        line = gyro_line_of(index)
        wrong = line._replace(t_us=(line.t_us + 10_000_000) % 2**32)
        send_both(core, index, format_gyro_line(wrong if index % 100 == 50 else line))
    core.close(START_NS + 5 * S)
    there = [index for index in range(500) if index % 100 != 50]
    check_samples(gyro_of(tmp_path / "run1"), [4 * index + k for index in there for k in range(4)])
    assert core.losses == {"gyro samples without a time": 20, "gyro samples": 20}
    assert told_of(tmp_path, EventKind.GYRO_SEQUENCE) == 20


@pytest.mark.parametrize("ahead", [1_000_000, -1_000_000, -4])
def test_row_46_a_wrong_sequence_number_costs_no_sample_and_counts_none_as_lost(tmp_path: Path, ahead: int) -> None:
    """One line alone, and all from some moment on: the clock gives the number of samples."""
    core = make_core(tmp_path)
    for index in range(500):
        line = gyro_line_of(index)
        wrong = line._replace(sequence=(line.sequence + ahead) % 2**32)
        if index != 350:  # a true loss among them
            send_both(core, index, format_gyro_line(wrong if index == 100 or index >= 300 else line))
    core.close(START_NS + 5 * S)
    check_samples(gyro_of(tmp_path / "run1"), [4 * index + k for index in range(500) if index != 350 for k in range(4)])
    assert core.losses == {"gyro samples": 4, "wheel lines": 1}
    assert told_of(tmp_path, EventKind.GYRO_SEQUENCE) == 3  # there, back again, and there


@pytest.mark.parametrize("why", list(Unmeasured))
def test_row_47_samples_that_were_not_measured_are_none(tmp_path: Path, why: Unmeasured) -> None:
    core = make_core(tmp_path)
    for index in range(1000):
        line = gyro_line_of(index)
        turns = line._replace(yaw_rates_urad_s=(why,) * 4) if 400 <= index < 600 else line
        if index == 300:
            turns = line._replace(yaw_rates_urad_s=(*line.yaw_rates_urad_s[:2], why, line.yaw_rates_urad_s[3]))
        send_both(core, index, format_gyro_line(turns))
    core.close(START_NS + 10 * S)
    samples = gyro_of(tmp_path / "run1")
    check_samples(samples, [each for each in range(4000) if not 1600 <= each < 2400 and each != 1202])
    name, kind = {
        Unmeasured.SATURATED: ("gyro samples saturated", EventKind.GYRO_SATURATED),
        Unmeasured.UNREADABLE: ("gyro samples unreadable", EventKind.GYRO_UNREADABLE),
    }[why]
    assert core.losses == {name: 801}
    assert told_of(tmp_path, kind) == 801
    used, _ = used_by_map(samples)
    assert known_turns(used, [1.0, 2.9, 3.1, 3.9, 4.5, 5.5, 6.1, 9.0]) == [True, True, True, False, False, False, True]


def test_row_48_a_frozen_value_is_reported_and_the_map_leaves_it_out(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    for index in range(1000):
        line = gyro_line_of(index)
        frozen = line._replace(yaw_rates_urad_s=(1234,) * 4)
        send_both(core, index, format_gyro_line(frozen if 400 <= index < 600 or 700 <= index < 790 else line))
    core.close(START_NS + 10 * S)
    (told,) = events_of(tmp_path / "run1", EventKind.GYRO_FROZEN)  # 0.9 s may be chance
    assert 0 <= told.stamp_ns - START_NS - 5 * S < 50 * MS
    assert core.losses == {"times that the gyro froze": 1}
    samples = gyro_of(tmp_path / "run1")
    assert len(samples) == 4000  # what was sent is kept
    used, warnings = used_by_map(samples)
    assert len(used.stamps_ns) == 4000 - 800
    assert any("800 gyro readings of one value" in each for each in warnings)
    assert known_turns(used, [1.0, 3.9, 4.5, 5.5, 6.1, 9.0]) == [True, False, False, False, True]


@pytest.mark.parametrize("new_boot", [True, False])
def test_row_49_a_restart_of_the_controller_begins_anew(tmp_path: Path, new_boot: bool) -> None:
    core = make_core(tmp_path)
    for index in range(500):
        send_both(core, index)
    boot_id = 8 if new_boot else 7
    for index in range(500):
        now_ns = START_NS + 5500 * MS + index * PERIOD_NS
        data = format_line(line_of(index, boot_id)) + format_gyro_line(gyro_line_of(index, boot_id))
        core.on_serial_bytes(data, now_ns)
        core.tick(now_ns)
    core.close(START_NS + 11 * S)
    samples = gyro_of(tmp_path / "run1")
    check_samples(samples[:2000], range(2000))
    again = samples[2000:]
    n_unnoticed = 0 if new_boot else 49  # lines until an old boot_id counts as a restart
    assert [each.sequence for each in again] == list(range(4 * n_unnoticed, 2000))
    assert {each.boot_id for each in again}.isdisjoint({7})
    for each in again:
        assert each.yaw_rate_rad_s == pytest.approx(gyro_rate_urad_s(each.sequence) * 1e-6)
        assert abs(each.stamp_ns - (START_NS + 5500 * MS + (each.sequence - 3) * SAMPLE_US * 1000)) < MS // 10
    unnoticed = {"gyro samples without a time": 4 * n_unnoticed} if n_unnoticed else {}
    assert core.losses == {"wheel controller resets": 1} | unnoticed


def test_row_49_samples_of_another_boot_than_the_wheels_are_left_out(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    for index in range(200):
        send_both(core, index, format_gyro_line(gyro_line_of(index, 9 if index == 100 else 7)))
    core.close(START_NS + 2 * S)
    check_samples(gyro_of(tmp_path / "run1"), [4 * index + k for index in range(200) if index != 100 for k in range(4)])
    assert core.losses == {"gyro samples without a time": 4, "gyro samples": 4}


def test_row_49_time_and_sequence_wrap_around() -> None:
    intake, found = WheelIntake(), list[StampedGyro]()
    for index in range(400):
        t_us = 2**32 - 2_000_000 + 10_000 * index
        data = format_line(WheelLine(7, index, t_us % 2**32, 0, 0, 0))
        sequence = 2**32 - 801 + 4 * index
        data += format_gyro_line(GyroLine(7, sequence % 2**32, (t_us - 7_500) % 2**32, SAMPLE_US, (1, 2, 3, 4)))
        ready = intake.feed(data, START_NS + index * PERIOD_NS + MS)
        found += [each for each in ready if isinstance(each, StampedGyro)]
    assert len(found) == 1600
    for before, after in pairwise(found):
        assert after.reading.sequence - before.reading.sequence == 1
        assert after.reading.device_time_us - before.reading.device_time_us == SAMPLE_US
        assert abs(after.stamp_ns - before.stamp_ns - SAMPLE_US * 1000) < MS // 10


def test_row_50_a_gyro_that_falls_silent_is_reported_and_costs_no_wheel_reading(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    for index in range(1000):
        send_both(core, index, NOTHING if index >= 300 else None)
    core.close(START_NS + 10 * S)
    (told,) = events_of(tmp_path / "run1", EventKind.NO_GYRO_DATA)
    assert 2 * S < told.stamp_ns - START_NS - 3 * S <= 3 * S
    assert len(wheels_of(tmp_path / "run1")) == 1000
    assert core.losses == {"gyro silent at the end": 1}


@pytest.mark.parametrize("section", ["gyro: {}\n", ""])
def test_row_50_a_gyro_is_missed_where_robot_yaml_has_one(tmp_path: Path, section: str) -> None:
    core = make_core(tmp_path, text=ROBOT_YAML + section)
    for index in range(500):
        send(core, index)
    core.close(START_NS + 5 * S)
    told = events_of(tmp_path / "run1", EventKind.NO_GYRO_DATA)
    assert len(told) == bool(section)
    assert all(2 * S < each.stamp_ns - START_NS <= 3 * S for each in told)
    assert core.losses == ({"recording without a single yaw rate": 1} if section else {})


def test_row_50_a_gyro_without_wheels_is_reported_as_no_wheels(tmp_path: Path) -> None:
    core = make_core(tmp_path)
    for index in range(500):
        send(core, index, format_gyro_line(gyro_line_of(index)))
    core.close(START_NS + 5 * S)
    assert gyro_of(tmp_path / "run1") == []
    assert len(events_of(tmp_path / "run1", EventKind.NO_WHEEL_DATA)) == 1
    assert core.losses == {"recording without a single wheel reading": 1}
