"""Gyros on simulated drives: what one measures while a robot of `simulate` drives."""

from dataclasses import dataclass, replace

import numpy as np

from groundsbot.calib.robot import Gyro
from groundsbot.fixtures.drives import true_tag_sizes_m
from groundsbot.fixtures.recording.session import Options, Session, prepare
from groundsbot.fixtures.worlds import load_world, tags_of
from groundsbot.offline.evaluation.truth import Truth
from groundsbot.offline.measurements.motion_model.gyro import GyroSamples
from groundsbot.offline.measurements.run import Run
from tests.support.data.simulated_runs import simulated_runs

_NS_PER_S = 1_000_000_000


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
