"""Drives of a skid-steer robot: what its wheels tell of a turn depends on the floor."""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.robot.robot_yaml import Robot
from groundsbot.offline.evaluation.truth import TrueRun, Truth
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.run import Run

# The track by the wheels over that between them; it is drawn anew for each square of the floor.
TIMES_TRACK: Final = (1.3, 1.8)
_SQUARE_M: Final = 5.0
_N_SQUARES: Final = 64  # along each side, from where they come again
# A robot.yaml whose owner knows that: the middle, and a sigma that covers both ends.
_NOMINAL_TIMES: Final = 1.55
_RELATIVE_SIGMA: Final = 0.15


def on_skid_steer(runs: list[Run], truth: Truth, seed: int) -> list[Run]:
    """The same true motions by wheels that skid in turns; robot.yaml has the track in the middle of `TIMES_TRACK`."""
    times = np.random.default_rng([seed, 31]).uniform(*TIMES_TRACK, (_N_SQUARES, _N_SQUARES))
    return [
        replace(
            run,
            robot=_with_wide_track(run.robot),
            wheel_segments=tuple(_skidding(each, truth.runs[run.name], times) for each in run.wheel_segments),
        )
        for run in runs
    ]


def _skidding(wheels: WheelSegment, true: TrueRun, times: FloatArray) -> WheelSegment:
    poses, _ = true.poses_at(wheels.stamps_ns)
    column, row = (np.floor(poses[1:, :2] / _SQUARE_M).astype(np.int64) % _N_SQUARES).T
    middle_m = 0.5 * (wheels.left_m + wheels.right_m)
    half_m = np.append(0.0, np.cumsum(0.5 * times[row, column] * np.diff(wheels.right_m - wheels.left_m)))
    return replace(wheels, left_m=middle_m - half_m, right_m=middle_m + half_m)


def _with_wide_track(robot: Robot) -> Robot:
    track_m = _NOMINAL_TIMES * robot.wheels.track_m
    wheels = robot.wheels.model_copy(update={"track_m": track_m, "track_m_sigma": _RELATIVE_SIGMA * track_m})
    return robot.model_copy(update={"wheels": wheels})
