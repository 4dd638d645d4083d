"""Metres driven, tags seen and seen again, while the drive is recorded."""

import numpy as np
import pytest

from groundsbot.calib.robot.robot_yaml import Wheels
from groundsbot.onboard.detection.tag_detector import Detection
from groundsbot.onboard.recorder.drive_progress import DriveProgress, Progress
from groundsbot.onboard.wheels.intake import StampedReading
from groundsbot.onboard.wheels.protocol import WheelReading

S = 1_000_000_000
WHEELS = Wheels(radius_left_m=0.05, radius_right_m=0.05, track_m=0.3, ticks_per_turn=1000)
M_PER_TICK = 2.0 * np.pi * 0.05 / 1000


def reading(stamp_ns: int, left: int, right: int, *, new_epoch: bool = False) -> StampedReading:
    return StampedReading(WheelReading(1, 0, 0, left, right, 0, new_epoch, 0), stamp_ns, stamp_ns)


def tag(tag_id: int) -> Detection:
    return Detection("tag36h11", tag_id, 0, 80.0, np.zeros((4, 2)))


def drive(progress: DriveProgress, begin_s: float, seconds: float, ticks_per_s: int) -> None:
    """Straight ahead, with a hundred readings a second."""
    for k in range(round(100 * seconds) + 1):
        ticks = round(k * ticks_per_s / 100)
        progress.note_wheels(reading(round((begin_s + k / 100) * S), ticks, ticks, new_epoch=k == 0))


def test_the_way_is_that_of_the_middle_between_the_wheels() -> None:
    progress = DriveProgress(WHEELS)
    drive(progress, 0.0, 10.0, 1000)
    assert progress.now.driven_m == pytest.approx(10_000 * M_PER_TICK)
    for k in range(100):  # a turn on the spot
        progress.note_wheels(reading((10 + k) * S, 10_000 + 20 * k, 10_000 - 20 * k))
    assert progress.now.driven_m == pytest.approx(10_000 * M_PER_TICK)


def test_a_reset_of_the_counters_is_no_way() -> None:
    progress = DriveProgress(WHEELS)
    drive(progress, 0.0, 1.0, 1000)
    drive(progress, 5.0, 1.0, 1000)
    assert progress.now.driven_m == pytest.approx(2000 * M_PER_TICK)


def test_a_standing_wheel_that_flickers_does_not_drive() -> None:
    progress = DriveProgress(WHEELS)
    for k in range(1000):
        progress.note_wheels(reading(k * S // 1000, k % 2, k % 2))
    assert progress.now.driven_m < 20 * M_PER_TICK


def test_a_tag_is_seen_again_after_a_way_and_a_time() -> None:
    progress = DriveProgress(WHEELS)
    progress.note_wheels(reading(0, 0, 0))
    progress.note_tags([tag(1), tag(2)], 0)
    progress.note_tags([tag(1)], 20 * S)  # the robot has not moved
    assert progress.now[1:] == (2, 0)
    drive(progress, 20.0, 5.0, 1000)
    progress.note_tags([tag(1)], 25 * S)  # 5 s after it was last in view
    assert progress.now[1:] == (2, 0)
    progress.note_tags([tag(2)], 26 * S)
    progress.note_tags([tag(2)], 50 * S)
    assert progress.now[1:] == (2, 1)


def test_without_wheels_the_time_decides() -> None:
    progress = DriveProgress(WHEELS)
    progress.note_tags([tag(1)], 0)
    progress.note_tags([tag(1)], 11 * S)
    assert progress.now == Progress(0.0, 1, 1)
