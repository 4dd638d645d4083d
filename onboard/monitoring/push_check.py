"""Check of wheels and encoders by pushing the robot: wiring, ticks per turn and track, as robot.yaml has them."""

import math
from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from groundsbot.calib.robot import Wheels, Wiring
from groundsbot.onboard.errors import OnboardError
from groundsbot.onboard.monitoring.check import DeviceCheck
from groundsbot.onboard.process import RunClock
from groundsbot.onboard.recorder import RobotFiles
from groundsbot.onboard.wheels import EncoderPort, PortLostError, StampedReading, WheelIntake

_NS_PER_S: Final = 1_000_000_000
_PUSH_M: Final = 1.0
_TURN_RAD: Final = 2.0 * math.pi
_PATIENCE_NS: Final = 60 * _NS_PER_S  # until the robot begins to move
_STILL_NS: Final = 2 * _NS_PER_S  # a motion has ended
_FLICKER_TICKS: Final = 2  # of an encoder at rest
_LEAST_TICKS: Final = 20  # fewer are a nudge; wheels of 10 cm with 20 ticks a turn count 64 in a metre
# An encoder that counts less than this share of the other does not count.
_LEAST_SHARE: Final = 0.1
# A person pushes 1 m to 5 cm and turns to 10 degrees; counting one edge instead of two is a factor of 2.
_PUSH_TOLERANCE: Final = 0.15
_TURN_TOLERANCE: Final = 0.1


class Motion(NamedTuple):
    """Ticks that the controller's left and right count have grown by."""

    left: int
    right: int


class MotionWatch:
    """Finds a motion by hand: from the first tick until the wheels have been still for 2 s."""

    def __init__(self, begin_ns: int) -> None:
        self._begin_ns = begin_ns
        self._first: Motion | None = None
        self._last = Motion(0, 0)
        self._moved_ns: int | None = None

    def add(self, now_ns: int, readings: list[StampedReading]) -> Motion | None:
        """Return the motion as soon as it has ended.

        Args:
            now_ns: time of arrival.
            readings: that have arrived; may be none.

        Raises:
            OnboardError: nothing moves, or the controller restarts.
        """
        for each in readings:
            counts = Motion(each.reading.ticks_left, each.reading.ticks_right)
            if each.reading.new_epoch and self._first is not None:
                raise OnboardError("the controller restarted; check its power supply, and push again")
            if self._first is None:
                self._first = self._last = counts
            if _most(counts, self._last) > _FLICKER_TICKS:
                self._last, self._moved_ns = counts, now_ns
        if self._moved_ns is not None and now_ns - self._moved_ns > _STILL_NS and self._first is not None:
            if _most(self._last, self._first) >= _LEAST_TICKS:
                return Motion(self._last.left - self._first.left, self._last.right - self._first.right)
            self._first, self._moved_ns = self._last, None
        if self._moved_ns is None and now_ns - self._begin_ns > _PATIENCE_NS:
            raise OnboardError(
                f"no encoder counted for {_PATIENCE_NS // _NS_PER_S} s; check the encoders' supply and cables, and "
                "that the wheels turn when it is pushed"
            )
        return None


def _most(a: Motion, b: Motion) -> int:
    return max(abs(a.left - b.left), abs(a.right - b.right))


def check_push(files: RobotFiles, say: Callable[[str], None]) -> Iterator[DeviceCheck]:
    """Ask a person to push the robot and to turn it, and yield what the encoders say of it.

    Args:
        files: the robot.
        say: prints what to do.
    """
    devices = files.robot.devices
    if devices.encoder_port is None:
        yield DeviceCheck("push", False, "devices.encoder_port is not set; without encoders there is nothing to check")
        return
    port = EncoderPort(str(files.path.parent / devices.encoder_port), devices.encoder_baud)
    try:
        port.open()
        say("Push the robot 1 m straight ahead, by a tape on the floor, and let it stand.")
        push = _watch(port)
        say("Now turn it on the spot to its left, once all round, until it looks ahead again.")
        turn = _watch(port)
    except PortLostError as error:
        yield DeviceCheck("push", False, f"{error}; check the cable and devices.encoder_port")
        return
    except OnboardError as error:
        yield DeviceCheck("push", False, str(error))
        return
    finally:
        port.close()
    yield from judge_motions(files.robot.wheels, push, turn)


def _watch(port: EncoderPort) -> Motion:
    clock, intake = RunClock(), WheelIntake()
    watch = MotionWatch(clock.now_ns())
    while True:
        data = port.read(0.1)
        now_ns = clock.now_ns()
        readings = [each for each in intake.feed(data, now_ns) if isinstance(each, StampedReading)]
        motion = watch.add(now_ns, readings)
        if motion is not None:
            return motion


def judge_motions(wheels: Wheels, push: Motion, turn: Motion) -> list[DeviceCheck]:
    """Return what a push of 1 m ahead and a turn once to the left say of robot.yaml's wheels.

    Args:
        wheels: wheels of robot.yaml.
        push: as the controller counted it.
        turn: likewise.
    """
    for side, own, other in (("left", 0, 1), ("right", 1, 0)):
        if abs(push[own]) < _LEAST_SHARE * abs(push[other]):
            text = f"the controller's {side} count stood still in the push ({push.left}, {push.right} ticks)"
            return [DeviceCheck("wiring", False, f"{text}; check that encoder's cable and supply, and push again")]
    signs = [1 if ticks > 0 else -1 for ticks in push]
    ahead_left, ahead_right = signs[0] * turn.left, signs[1] * turn.right
    if abs(ahead_right - ahead_left) <= abs(ahead_right + ahead_left):
        text = f"both wheels rolled the same way in the turn ({turn.left}, {turn.right} ticks)"
        return [DeviceCheck("wiring", False, f"{text}; turn it on the spot, with no push ahead")]
    exchanged = ahead_right < ahead_left  # in a turn to the left the right wheel rolls forward
    wiring = Wiring(exchanged, False, False)
    left_sign, right_sign = wiring.order(*signs)
    wiring = Wiring(exchanged, left_sign < 0, right_sign < 0)
    tick_m = wheels.metres_per_tick
    push_m = [abs(ticks) * each for ticks, each in zip(wiring.order(*push), tick_m, strict=True)]
    turn_m = [sign * ticks * each for sign, ticks, each in zip(wiring.signs, wiring.order(*turn), tick_m, strict=True)]
    found = [_judge_wiring(wiring, wheels.wiring), _judge_ticks(wheels, *push_m)]
    scale = 1.0 if found[-1].passed else 2.0 * _PUSH_M / sum(push_m)
    return [*found, _judge_track(wheels, scale * (turn_m[1] - turn_m[0]))]


def _judge_wiring(needed: Wiring, present: Wiring) -> DeviceCheck:
    if needed == present:
        return DeviceCheck("wiring", True, needed.words())
    return DeviceCheck("wiring", False, f"{needed.words()}: set {needed.settings(present)} in robot.yaml")


def _judge_ticks(wheels: Wheels, left_m: float, right_m: float) -> DeviceCheck:
    found = f"{_PUSH_M:g} m ahead is {left_m:.3f} m by the left wheel and {right_m:.3f} m by the right one"
    if abs(left_m - right_m) > _PUSH_TOLERANCE * max(left_m, right_m):
        way_out = "push straight; if it stays so, one encoder counts other edges or its wheel has another radius"
        return DeviceCheck("ticks", False, f"{found}; {way_out}")
    mean_m = (left_m + right_m) / 2.0
    if abs(mean_m - _PUSH_M) > _PUSH_TOLERANCE * _PUSH_M:
        fitting = wheels.ticks_per_turn * mean_m / _PUSH_M
        way_out = f"wheels.ticks_per_turn is {wheels.ticks_per_turn:g}, and about {fitting:.4g} would fit"
        return DeviceCheck("ticks", False, f"{found}; {way_out}, if the radii are right")
    return DeviceCheck("ticks", True, found)


def _judge_track(wheels: Wheels, apart_m: float) -> DeviceCheck:
    turned_rad = apart_m / wheels.track_m
    found = f"once to the left is {math.degrees(turned_rad):.0f} degrees by the wheels"
    if abs(turned_rad - _TURN_RAD) > _TURN_TOLERANCE * _TURN_RAD:
        fitting_m = apart_m / _TURN_RAD
        way_out = f"wheels.track_m is {wheels.track_m:g}, and about {fitting_m:.3g} would fit"
        return DeviceCheck("track", False, f"{found}; {way_out}, if it turned once")
    return DeviceCheck("track", True, found)
