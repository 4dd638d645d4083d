"""Gyros on simulated drives: what one measures while a robot of `simulate` drives, and wheels that need one."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.robot import Gyro, Robot
from groundsbot.fixtures.drives import true_tag_sizes_m
from groundsbot.fixtures.recording.session import Options, Session, prepare
from groundsbot.fixtures.worlds import load_world, tags_of
from groundsbot.offline.evaluation.truth import TrueRun, Truth
from groundsbot.offline.measurements.motion_model.gyro import GyroSamples
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.run import Run
from tests.support.data.simulated_runs import simulated_runs

_NS_PER_S = 1_000_000_000
# The track by the wheels over that between them; it is drawn anew for each square of the floor.
TIMES_TRACK: Final = (1.3, 1.8)
_SQUARE_M: Final = 5.0
_N_SQUARES: Final = 64  # along each side, from where they come again
# A robot.yaml whose owner knows that: the middle, and a sigma that covers both ends.
_NOMINAL_TIMES: Final = 1.55
_RELATIVE_SIGMA: Final = 0.15


@dataclass(frozen=True)
class SimulatedGyro:
    """A gyro like an ICM-20948: noise and bias walk of its defaults, its bias and scale drawn.

    Attributes:
        times_walk: how many times as much the bias walks.
        n_gaps: how often 2 s of its observations are missing.
    """

    rate_hz: float = 200.0
    bias_sigma_rad_s: float = np.radians(1.0)
    scale_sigma: float = 0.01
    times_walk: float = 1.0
    n_gaps: int = 0

    def samples(self, session: Session, rng: np.random.Generator) -> GyroSamples:
        """What it measures in one drive: means of the true rate over each of its periods."""
        drive, nominal = session.drive, Gyro()
        period_ns = round(_NS_PER_S / self.rate_hz)
        ends_ns = np.arange(0, int(drive.stamps_ns[-1]), period_ns) - period_ns // 2
        rate = np.diff(np.unwrap(drive.at(ends_ns)[:, 2])) * self.rate_hz
        stamps_ns = ends_ns[:-1] + period_ns // 2
        n = len(rate)
        walk = nominal.bias_walk_rad_s_per_sqrt_s * self.times_walk * self.rate_hz**-0.5
        bias = self.bias_sigma_rad_s * rng.standard_normal() + walk * np.cumsum(rng.standard_normal(n))
        white = nominal.noise_rad_per_sqrt_s * self.rate_hz**0.5 * rng.standard_normal(n)
        measured = rate / (1.0 + self.scale_sigma * rng.standard_normal()) + bias + white
        kept = np.ones(n, dtype=np.bool_)
        for share in (np.arange(self.n_gaps) + 1.0) / (self.n_gaps + 1.0):
            since_ns = stamps_ns - share * stamps_ns[-1]
            kept &= (since_ns < 0.0) | (since_ns > 2.0 * _NS_PER_S)
        return GyroSamples((stamps_ns + session.on_log_clock(0))[kept], measured[kept])


def gyro_runs(world_name: str, seed: int, gyro: SimulatedGyro | None) -> tuple[list[Run], Truth]:
    """Unrendered drives of a world and a seed, with what a gyro measured in each, and the truth."""
    world, options = load_world(world_name), Options(seed)
    runs, truth = simulated_runs(world, seed)
    if gyro is None:
        return runs, truth
    tags = tags_of(world.tags, true_tag_sizes_m(world, seed, False, options.harsh))
    rng = np.random.default_rng([seed, 23])
    sessions = [prepare(world, world.robot(run.robot_id), tags, options) for run in runs]
    return [replace(run, gyro=gyro.samples(each, rng)) for run, each in zip(runs, sessions, strict=True)], truth


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
