"""Yaw rates of a gyro: how far the robot turned between two times, and how that depends on the gyro's calibration.

The model of an inexpensive gyro (IEEE Std 952-1997; Titterton and Weston, "Strapdown inertial navigation technology",
2004): measured = rate / (1 + scale) + bias(t) + white noise, with a bias that walks at random. The bias is linear
between nodes, which are close enough for what it walks between them to stay below the white noise, or 16 at most; the
rest of the walk counts as white noise. Stamps are late by a time offset. A tilt of the axis by an angle a makes the
scale smaller by 1 - cos(a), and is part of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray, plural
from groundsbot.calib.robot import Gyro, Robot
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.measurements.plausibility import check_stamps

# Before the nodes of the bias, in the order of the columns.
GYRO_PARAMETERS: Final = ("gyro_scale", "gyro_time_offset_s")
GYRO_BIAS: Final = "gyro_bias_rad_s"
# Where samples are missing for more than so many of their periods, the turn in between is not known.
_GAP_PERIODS: Final = 3.5
# No robot turns faster; degrees taken for radians would.
_FASTEST_RAD_S: Final = 50.0
_LEAST_SAMPLES: Final = 10
_FROZEN_NS: Final = 1_000_000_000
_LEAST_NODE_S: Final = 10.0
_MOST_NODES: Final = 16
_NODE_SHARE: Final = 0.3  # of the white noise's sigma that what walks between nodes may add


@dataclass(frozen=True)
class GyroSamples:
    """Yaw rates as measured.

    Attributes:
        stamps_ns: (N,) strictly increasing, N at least two.
        yaw_rate_rad_s: (N,) to the left.
    """

    stamps_ns: IntArray
    yaw_rate_rad_s: FloatArray

    def turns(self, stamps_ns: IntArray, node_stamps_ns: IntArray) -> "GyroTurns":
        """Integrate between neighbours of some times (K,), with a bias that is linear between nodes (n,)."""
        zero_ns = self.stamps_ns[0]
        samples_s, times_s, nodes_s = (
            np.asarray(each - zero_ns, dtype=np.float64) * 1e-9 for each in (self.stamps_ns, stamps_ns, node_stamps_ns)
        )
        heading_rad = _integral(samples_s, self.yaw_rate_rad_s, times_s)
        rate_rad_s = np.interp(times_s, samples_s, self.yaw_rate_rad_s)
        hats = np.eye(len(nodes_s))
        fine_s = np.union1d(nodes_s, times_s)
        by_bias = [_integral(fine_s, np.interp(fine_s, nodes_s, hat), times_s) for hat in hats]
        turn_rad = np.diff(heading_rad)
        gaps = np.flatnonzero(np.diff(samples_s) > _GAP_PERIODS * np.median(np.diff(samples_s)))
        return GyroTurns(
            turn_rad=turn_rad,
            jacobian=np.column_stack([turn_rad, np.diff(rate_rad_s), *(-np.diff(each) for each in by_bias)]),
            duration_s=np.diff(times_s),
            is_known=_is_covered(times_s, samples_s, gaps),
        )


def gyro_samples(
    readings: Sequence[tuple[int, float]], robot: Robot, where: str
) -> tuple[GyroSamples | None, list[str]]:
    """Return the yaw rates of one log by its robot's file, None where there are too few, and warnings.

    Args:
        readings: stamp in ns and yaw rate in rad/s of each message, in order.
        robot: whose gyro's time offset and scale are applied.
        where: names file and topic in errors.

    Raises:
        OfflineError: a stamp or a rate is none that a gyro can have given.
    """
    if not readings:
        return None, []
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in readings], dtype=np.int64)
    rates = np.array([rate for _, rate in readings], dtype=np.float64)
    check_stamps(stamps_ns, where)
    wrong = np.flatnonzero(~(np.abs(rates) < _FASTEST_RAD_S))
    if len(wrong):
        raise OfflineError(
            f"{where}: yaw_rate_rad_s is {rates[wrong[0]]:g} in reading {wrong[0] + 1}, must be a number below "
            f"{_FASTEST_RAD_S:g} rad/s; were degrees recorded?"
        )
    later = stamps_ns > np.concatenate([[stamps_ns[0] - 1], np.maximum.accumulate(stamps_ns)[:-1]])
    warnings = []
    if not later.all():
        warnings.append(f"{plural(int((~later).sum()), 'gyro reading')} not later than the one before; left out")
    stamps_ns, rates = stamps_ns[later], rates[later]
    frozen = _is_frozen(stamps_ns, rates)
    if frozen.any():
        warnings.append(f"{plural(int(frozen.sum()), 'gyro reading')} of one value for a second or longer; left out")
        stamps_ns, rates = stamps_ns[~frozen], rates[~frozen]
    if len(rates) < _LEAST_SAMPLES:
        return None, [*warnings, f"{where} has {len(rates)} readings, too few to use; the map is by the wheels"]
    gyro = robot.gyro or Gyro()
    late_ns = round(gyro.time_offset_s * 1e9)
    return GyroSamples(stamps_ns - late_ns, (1.0 + gyro.scale) * rates), warnings


def _is_frozen(stamps_ns: IntArray, rates: FloatArray) -> BoolArray:
    """(N,) readings that repeat one value for `_FROZEN_NS` or longer, as no gyro with noise does."""
    run = np.cumsum(np.diff(rates, prepend=np.nan) != 0.0) - 1
    first, last = np.flatnonzero(np.diff(run, prepend=-1)), np.flatnonzero(np.diff(run, append=run[-1] + 1))
    return np.asarray((stamps_ns[last] - stamps_ns[first] >= _FROZEN_NS)[run])


@dataclass(frozen=True)
class HeadingDifferences:
    """Turns by the gyro less those by the wheels, as a linear factor |rows c + values|^2 on a calibration correction c.

    Attributes:
        step: (N,) index of the motion that each difference belongs to, rising.
        rows: (N, P) derivatives by the parameters of `SegmentOdometry.jacobian`, over the sigma of the difference.
        values: (N,) differences under nominal calibration, over their sigmas.
        walk_rows: (n - 1, P) of the bias from each node to the next, over the sigma of its random walk.
        owner: whose bias it is.
    """

    step: IntArray
    rows: FloatArray
    values: FloatArray
    walk_rows: FloatArray
    owner: str

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Of the columns after those of the wheels: the gyro's own, then its bias at each node."""
        return (*GYRO_PARAMETERS, *(f"{GYRO_BIAS}_{i}" for i in range(len(self.walk_rows) + 1)))

    def at_steps(self, step: IntArray) -> "HeadingDifferences":
        """The same where motion i has become motion step[i]; of none where that is negative."""
        new = step[self.step]
        there = new >= 0
        return replace(self, step=new[there], rows=self.rows[there], values=self.values[there])


@dataclass(frozen=True)
class GyroTurns:
    """How far the robot turned in each of M intervals, by the gyro.

    Attributes:
        turn_rad: (M,)
        jacobian: (M, 2 + n) of the turn by GYRO_PARAMETERS and by the bias at its n nodes.
        duration_s: (M,)
        is_known: (M,) whether samples cover the interval.
    """

    turn_rad: FloatArray
    jacobian: FloatArray
    duration_s: FloatArray
    is_known: BoolArray


def bias_nodes(first_ns: int, last_ns: int, gyro: Gyro) -> IntArray:
    """(n,) stamps of the nodes of the bias of one segment, the first and the last at its ends."""
    spacing_s = _NODE_SHARE * 12.0**0.5 * gyro.noise_rad_per_sqrt_s / gyro.bias_walk_rad_s_per_sqrt_s
    n = int(np.ceil((last_ns - first_ns) * 1e-9 / max(spacing_s, _LEAST_NODE_S)))
    return np.linspace(first_ns, last_ns, min(max(n, 1), _MOST_NODES) + 1).astype(np.int64)


def noise_density(gyro: Gyro, node_stamps_ns: IntArray) -> float:
    """Variance in rad^2 that the turn gains in a second: white noise, and what the bias walks between its nodes.

    A random walk that is held at both ends of an interval T errs in its integral by walk^2 T^3 / 12 (Brownian bridge).
    """
    spacing_s = float(np.diff(node_stamps_ns).max()) * 1e-9
    return gyro.noise_rad_per_sqrt_s**2 + gyro.bias_walk_rad_s_per_sqrt_s**2 * spacing_s**2 / 12.0


def _integral(x: FloatArray, y: FloatArray, at: FloatArray) -> FloatArray:
    """Integral of a piecewise linear function through (x, y), constant outside, from x[0] to each of some places."""
    sums = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(x))])
    inside = np.clip(at, x[0], x[-1])
    i = np.clip(np.searchsorted(x, inside, side="right") - 1, 0, len(x) - 2)
    along = inside - x[i]
    slope = (y[i + 1] - y[i]) / (x[i + 1] - x[i])
    return np.asarray(sums[i] + along * (y[i] + 0.5 * slope * along) + np.where(at < x[0], y[0], y[-1]) * (at - inside))


def _is_covered(times_s: FloatArray, samples_s: FloatArray, gaps: IntArray) -> BoolArray:
    """(K-1,) whether the interval from each time to the next lies within the samples and touches no gap."""
    covered = (times_s[:-1] >= samples_s[0]) & (times_s[1:] <= samples_s[-1])
    begin, end = samples_s[gaps], samples_s[gaps + 1]
    # Gaps that begin before the interval's end, less those that end before its beginning.
    n_touching = np.searchsorted(begin, times_s[1:]) - np.searchsorted(end, times_s[:-1], side="right")
    return np.asarray(covered & (n_touching == 0))
