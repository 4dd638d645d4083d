"""Check of a gyro before a drive: its rate, its bias and noise while the robot stands, and its turn against wheels."""

import itertools
import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from groundsbot.calib.foundation import plural
from groundsbot.calib.robot import Gyro, Robot
from groundsbot.onboard.wheels import GyroUnwrapper, StampedGyro, StampedReading

_US_PER_S: Final = 1e6
_STILL_S: Final = 0.25  # wheels stand at a sample if they do so for this long before and after it
_LEAST_STILL_S: Final = 0.5
_BLOCK_S: Final = 0.1  # for the noise, which a gyro's own filter makes too small from sample to sample
_LEAST_STEPS: Final = 5  # give the noise to a third
_TURN_BLOCK_S: Final = 0.5
_LEAST_TURN_RAD: Final = 0.5  # root sum of squares over blocks; a quarter turn by hand is twice that
_RATIOS: Final = (0.3, 3.0)  # a map does not use a gyro outside of this; that of tracked robots is about one half
_BIAS_SIGMAS: Final = 4.0
_NOISE_TIMES: Final = 10.0  # a map fits the noise, with a factor of 3 as prior sigma

Floats = NDArray[np.float64]


class Standing(NamedTuple):
    """Bias and noise of a gyro's yaw rate while the robot stands."""

    bias_rad_s: float
    noise_rad_per_sqrt_s: float | None  # None if it stood too briefly
    is_frozen: bool


def describe_gyro(
    wheels: Sequence[StampedReading], samples: Sequence[StampedGyro], counts: GyroUnwrapper, robot: Robot
) -> tuple[bool, str] | None:
    """Return whether the gyro can be used, and the findings as text; None if there is none and robot.yaml has none.

    Args:
        wheels: wheel readings received during the check.
        samples: gyro samples received during the check.
        counts: unwrapper of the gyro's time and sequence, which counts the samples that it left out.
        robot: content of robot.yaml.
    """
    unmeasured = counts.saturated + counts.unreadable
    if not samples and not unmeasured:
        missing = "robot.yaml has a gyro, but the controller sends no lines of one; check the firmware and its wires"
        return None if robot.gyro is None else (False, missing)
    found = f"{_rate_hz(samples):.0f} samples/s"
    if unmeasured:
        words = f"{plural(counts.saturated, 'sample')} saturated, {counts.unreadable} unreadable"
        return False, f"{found}, {words}; check its range and wires"
    if counts.unplaced or counts.out_of_order or counts.renumbered:
        wrong_time = plural(counts.unplaced + counts.out_of_order, "sample")
        wrong_sequence = plural(counts.renumbered, "line")
        words = f"{wrong_time} with a wrong time, {wrong_sequence} with a wrong sequence number"
        return False, f"{found}, {words}; check the firmware"
    standing = measure_standing(wheels, samples)
    problem, words = _standing_in_words(standing, robot.gyro or Gyro())
    if problem is None:
        problem, turns = _turns_in_words(turn_ratio(wheels, samples, robot, standing.bias_rad_s if standing else 0.0))
        words = f"{words}; {turns}"
    return problem is None, "; ".join(each for each in (f"{found}, {words}", problem) if each)


def _rate_hz(samples: Sequence[StampedGyro]) -> float:
    if len(samples) < 2:
        return 0.0
    elapsed_us = samples[-1].reading.device_time_us - samples[0].reading.device_time_us
    return (len(samples) - 1) * _US_PER_S / elapsed_us


def _standing_in_words(found: Standing | None, gyro: Gyro) -> tuple[str | None, str]:
    """Return a problem or None, and the bias and noise."""
    if found is None:
        return None, "bias and noise not measured, as the robot moves"
    words = f"bias {math.degrees(found.bias_rad_s):+.2f} deg/s"
    if found.is_frozen:
        return "the value never changes: the gyro is frozen; restart it", words
    if abs(found.bias_rad_s) > _BIAS_SIGMAS * gyro.bias_rad_s_sigma:
        limit = f"{_BIAS_SIGMAS:g} times gyro.bias_rad_s_sigma {gyro.bias_rad_s_sigma:g}"
        return f"the bias is beyond {limit}; check range and unit, or raise it in robot.yaml", words
    if found.noise_rad_per_sqrt_s is None:
        return None, words
    words += f", noise {math.degrees(found.noise_rad_per_sqrt_s):.3f} deg per root s"
    if found.noise_rad_per_sqrt_s > _NOISE_TIMES * gyro.noise_rad_per_sqrt_s:
        limit = f"{_NOISE_TIMES:g} times gyro.noise_rad_per_sqrt_s {gyro.noise_rad_per_sqrt_s:g}"
        return f"the noise is beyond {limit}; check that the robot stands, filter and unit, or raise it", words
    return None, words


def measure_standing(wheels: Sequence[StampedReading], samples: Sequence[StampedGyro]) -> Standing | None:
    """Return bias and noise of the samples during which the wheels stand; None if they stand too briefly.

    The noise is from differences of successive block means (Allan variance).
    """
    t_s, rates = _samples(samples)
    moves_s = [
        after.device_time_us / _US_PER_S
        for before, after in itertools.pairwise(each.reading for each in wheels)
        if (before.ticks_left, before.ticks_right) != (after.ticks_left, after.ticks_right)
    ]
    bounds_s = np.array([-np.inf, *moves_s, np.inf])
    after = np.searchsorted(bounds_s, t_s)
    is_still = np.minimum(t_s - bounds_s[after - 1], bounds_s[after] - t_s) > _STILL_S
    period_s = float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0
    if is_still.sum() * period_s < _LEAST_STILL_S:
        return None
    edges = np.flatnonzero(np.diff(is_still)) + 1
    starts = is_still[[0, *edges]]
    stretches = [each for each, still in zip(np.split(rates, edges), starts, strict=True) if still]
    n = max(1, round(_BLOCK_S / period_s))
    means = [each[: len(each) // n * n].reshape(-1, n).mean(axis=1) for each in stretches]
    steps = np.concatenate([np.diff(each) for each in means])
    noise = math.sqrt(0.5 * float(np.mean(steps**2)) * n * period_s) if len(steps) >= _LEAST_STEPS else None
    return Standing(float(rates[is_still].mean()), noise, is_frozen=bool(np.ptp(rates[is_still]) == 0.0))


def _turns_in_words(ratio: float | None) -> tuple[str | None, str]:
    """Return a problem or None, and how the gyro turns against the wheels."""
    if ratio is None:
        return None, "sign not checked: turn the robot meanwhile, with --listen-s 10"
    words = f"turns {ratio:.2f} times as far as the wheels"
    if ratio < 0.0:
        return "the other way round; turn its sign in the firmware", words
    if not _RATIOS[0] < ratio < _RATIOS[1]:
        return "check its axis and unit, and wheels.track_m", words
    return None, words


def turn_ratio(
    wheels: Sequence[StampedReading], samples: Sequence[StampedGyro], robot: Robot, bias_rad_s: float
) -> float | None:
    """Return the slope of the regression of the gyro's turns on the wheels'; None if the wheels turn too little."""
    t_s, rates = _samples(samples)
    wiring, metres = robot.wheels.wiring, robot.wheels.metres_per_tick
    left_m, right_m = (sign * each for sign, each in zip(wiring.signs, metres, strict=True))
    counts = (wiring.order(each.reading.ticks_left, each.reading.ticks_right) for each in wheels)
    headings = np.array([(right_m * right - left_m * left) / robot.wheels.track_m for left, right in counts])
    wheels_s = np.array([each.reading.device_time_us / _US_PER_S for each in wheels])
    if len(t_s) < 2 or len(wheels_s) < 2:
        return None
    ends_s = np.arange(max(t_s[0], wheels_s[0]), min(t_s[-1], wheels_s[-1]), _TURN_BLOCK_S)
    turned = np.concatenate([[0.0], np.cumsum((0.5 * (rates[1:] + rates[:-1]) - bias_rad_s) * np.diff(t_s))])
    by_wheels, by_gyro = (np.diff(np.interp(ends_s, *each)) for each in ((wheels_s, headings), (t_s, turned)))
    if float(np.linalg.norm(by_wheels)) < _LEAST_TURN_RAD:
        return None
    return float(by_wheels @ by_gyro / (by_wheels @ by_wheels))


def _samples(samples: Sequence[StampedGyro]) -> tuple[Floats, Floats]:
    """Return device times in s and rates in rad/s."""
    t_s = np.array([each.reading.device_time_us / _US_PER_S for each in samples])
    return t_s, np.array([each.reading.yaw_rate_rad_s for each in samples])
