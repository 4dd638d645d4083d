"""A push of a metre and a turn to the left tell how encoders are wired, their ticks and the track, in words."""

import math
import sys
import threading
import time
from collections.abc import Callable
from itertools import takewhile
from pathlib import Path

import pytest

from groundsbot.calib.robot.robot_yaml import Wheels
from groundsbot.calib.robot.wiring import WIRINGS, Wiring
from groundsbot.fixtures.recording.devices import PtyPort, pace
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.monitoring.push_check import Motion, MotionWatch, judge_motions
from groundsbot.onboard.wheels.intake import StampedReading
from groundsbot.onboard.wheels.protocol import GyroLine, WheelLine, WheelReading, format_gyro_line, format_line
from tests.support.devices.live_recording import PATIENCE_S, robot_yaml
from tests.support.programs import running

S = 1_000_000_000
WHEELS = Wheels(radius_left_m=0.05, radius_right_m=0.05, track_m=0.4, ticks_per_turn=2000)
TICK_M = WHEELS.metres_per_tick[0]
AHEAD_M, LEFT_M = (1.0, 1.0), (-0.4 * math.pi, 0.4 * math.pi)
# A motion has ended after half a second without one.
PROGRAM = """
from groundsbot.onboard.cli import main
from groundsbot.onboard.monitoring import push_check
push_check._STILL_NS = 500_000_000
main()
"""
FIELDS = ("encoders_exchanged", "left_encoder_reversed", "right_encoder_reversed")


def counted(rolled_m: tuple[float, float], wiring: Wiring, tick_m: float = TICK_M) -> Motion:
    """What the controller counts."""
    ticks = [sign * round(each / tick_m) for sign, each in zip(wiring.signs, rolled_m, strict=True)]
    return Motion(*wiring.order(*ticks))


@pytest.mark.parametrize("true", WIRINGS)
def test_each_wiring_is_named_with_what_to_set(true: Wiring) -> None:
    push, turn = counted(AHEAD_M, true), counted(LEFT_M, true)
    for present in WIRINGS:
        wheels = WHEELS.model_copy(update=dict(zip(FIELDS, present, strict=True)))
        wiring, ticks, track = judge_motions(wheels, push, turn)
        assert (ticks.passed, track.passed) == (True, True)
        assert wiring.passed == (present == true)
        for field, is_now, should_be in zip(FIELDS, present, true, strict=True):
            assert (f"wheels.{field}: {str(should_be).lower()}" in wiring.text) == (is_now != should_be)


def test_ticks_and_track_that_would_fit_are_named() -> None:
    wired = Wiring()
    _, ticks, track = judge_motions(WHEELS, counted(AHEAD_M, wired, TICK_M / 4), counted(LEFT_M, wired, TICK_M / 4))
    assert not ticks.passed
    assert "is 2000, and about 8000 would fit" in ticks.text
    assert track.passed
    narrow = WHEELS.model_copy(update={"track_m": 0.3})
    _, ticks, track = judge_motions(narrow, counted(AHEAD_M, wired), counted(LEFT_M, wired))
    assert ticks.passed
    assert "480 degrees" in track.text
    assert "is 0.3, and about 0.4 would fit" in track.text
    _, ticks, _ = judge_motions(WHEELS, counted((1.0, 0.5), wired), counted(LEFT_M, wired))
    assert "0.500 m by the right one; push straight" in ticks.text


def test_a_person_need_not_be_exact() -> None:
    push, turn = counted((1.04, 1.06), Wiring()), counted((-1.15, 1.25), Wiring())
    assert all(each.passed for each in judge_motions(WHEELS, push, turn))


def test_a_dead_encoder_and_a_turn_that_is_none() -> None:
    (dead,) = judge_motions(WHEELS, Motion(0, 6366), Motion(0, 8000))
    assert not dead.passed
    assert "left count stood still" in dead.text
    (none,) = judge_motions(WHEELS, counted(AHEAD_M, Wiring()), counted((0.9, 1.0), Wiring()))
    assert not none.passed
    assert "rolled the same way" in none.text


def reading(left: int, right: int, *, new_epoch: bool = False) -> StampedReading:
    return StampedReading(WheelReading(1, 0, 0, left, right, 0, new_epoch, 0), 0, 0)


def test_a_motion_ends_when_the_wheels_are_still_and_a_nudge_is_none() -> None:
    watch, now_ns = MotionWatch(0), 0
    for left in [100] * 20 + [106] * 30 + list(range(106, 1106, 50)):
        now_ns += S // 10
        assert watch.add(now_ns, [reading(left, left)]) is None
    ended = [watch.add(now_ns + step * S // 10, [reading(1056 + step % 2, 1056)]) for step in range(22)]
    assert ended == [None] * 21 + [Motion(950, 950)]


def test_nothing_that_moves_and_a_restart_are_said() -> None:
    watch = MotionWatch(0)
    assert watch.add(59 * S, [reading(7, 7)]) is None
    with pytest.raises(OnboardError, match="no encoder counted for 60 s"):
        watch.add(61 * S, [])
    watch = MotionWatch(0)
    assert watch.add(S, [reading(7, 7, new_epoch=True)]) is None
    with pytest.raises(OnboardError, match="restarted"):
        watch.add(2 * S, [reading(0, 0, new_epoch=True)])


def test_the_program_asks_and_judges(tmp_path: Path, plug_in: Callable[..., PtyPort]) -> None:
    """Both encoders backward, and a gyro on the controller; the robot moves when it is asked to."""
    port = plug_in(tmp_path / "wheels")
    robot = robot_yaml(tmp_path, f"{{encoder_port: {tmp_path / 'wheels'}}}")
    ended, ticks = threading.Event(), [0, 0]

    def feed() -> None:
        for index in takewhile(lambda _: not ended.is_set(), pace(100.0)):
            now_us = time.monotonic_ns() // 1000 % 2**32
            turn = GyroLine(3, 2 * index, now_us, 5_000, (17_000, 18_000))
            port.send(format_line(WheelLine(3, index, now_us, ticks[0], ticks[1], 0)) + format_gyro_line(turn))

    feeder = threading.Thread(target=feed)
    feeder.start()
    try:
        with running([sys.executable, "-c", PROGRAM, "check", "--robot", robot, "--push"]) as process:
            assert process.stdout is not None
            said: list[str] = []
            for line in process.stdout:
                said.append(line)
                if line.startswith("Push"):
                    time.sleep(0.2)
                    ticks[:] = [-2000, -2010]
                if line.startswith("Now turn"):
                    time.sleep(0.2)
                    ticks[:] = [0, -4000]
            process.wait(PATIENCE_S)
    finally:
        ended.set()
        feeder.join()
    assert process.returncode == 1
    assert "FAIL wiring: both encoders count backward" in "".join(said)
    assert [line[5:].split(":")[0] for line in said[-3:]] == ["wiring", "ticks", "track"]
