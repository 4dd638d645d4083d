"""Integrates yaw rates of a gyro to turns, with their derivatives with respect to the gyro's calibration.

The model is that of an inexpensive gyro (IEEE Std 952-1997; Titterton and Weston, "Strapdown inertial navigation
technology", 2004): measured = rate / (1 + scale) + bias(t) + white noise, where the bias is a random walk. The bias is
approximated as linear between nodes. Their spacing keeps the random walk between nodes below the white noise, except
that there are 17 nodes at most; the remaining walk counts as white noise. Stamps are late by a time offset. A tilt of
the axis by an angle a reduces the scale by 1 - cos(a), which the scale contains.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray, plural
from groundsbot.calib.robot import Gyro, Robot
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.measurements.plausibility import check_stamps, find_repeated

# The columns before those of the bias nodes, in order.
GYRO_PARAMETERS: Final = ("gyro_scale", "gyro_time_offset_s")
GYRO_BIAS: Final = "gyro_bias_rad_s"
# A gap between samples of more than this many periods makes the turn in between unknown.
_GAP_PERIODS: Final = 3.5
# Where rates are derivatives of headings by time, they are means over this window. The floor disturbs headings like a
# random walk, of which the rate at one sample says nothing at offsets beyond half a period. A mean gives the right
# derivative for offsets up to half its window.
_RATE_WINDOW_S: Final = 0.1
# No robot turns faster; rates in degrees exceed this.
_FASTEST_RAD_S: Final = 50.0
_LEAST_SAMPLES: Final = 10
_FROZEN_NS: Final = 1_000_000_000
_LEAST_NODE_S: Final = 10.0
_MOST_INTERVALS: Final = 16
_WALK_SHARE: Final = 0.3  # of the white noise's sigma, that the random walk between two nodes may add


@dataclass(frozen=True)
class GyroSamples:
    """Measured yaw rates.

    Attributes:
        stamps_ns: (N,) strictly increasing, N at least two.
        yaw_rate_rad_s: (N,) positive to the left.
    """

    stamps_ns: IntArray
    yaw_rate_rad_s: FloatArray

    @property
    def period_s(self) -> float:
        """Median time between samples."""
        return float(np.median(np.diff(self.stamps_ns))) * 1e-9

    def yaw_rates(self, stamps_ns: IntArray, by_wheels: FloatArray, bias_rad_s: float | None = None) -> FloatArray:
        """Return the yaw rates (K,) at some times, those by the wheels where there are no samples.

        The derivatives of headings by the time offset of a camera and by that of the gyro must have the same rate. With
        the wheels' rate in the former, which lacks the floor's disturbances, the offset of the gyro alone would explain
        these, and take the error of the camera's offset.

        Args:
            stamps_ns: (K,) times.
            by_wheels: (K,) yaw rates by the wheels, in rad/s.
            bias_rad_s: bias of the gyro; None: the median of the differences from the wheels.
        """
        gap_ns = np.diff(self.stamps_ns)
        i = np.searchsorted(self.stamps_ns, stamps_ns, side="right") - 1
        inside = (i >= 0) & (i < len(gap_ns))
        is_known = inside & (gap_ns[np.clip(i, 0, len(gap_ns) - 1)] <= _GAP_PERIODS * np.median(gap_ns))
        zero_ns = self.stamps_ns[0]
        samples_s, times_s = (1e-9 * np.asarray(each - zero_ns) for each in (self.stamps_ns, stamps_ns))
        rates = _smooth_rates(samples_s, self.yaw_rate_rad_s, times_s)
        if bias_rad_s is None:
            bias_rad_s = float(np.median((rates - by_wheels)[is_known])) if is_known.any() else 0.0
        return np.where(is_known, rates - bias_rad_s, by_wheels)

    def turns(self, stamps_ns: IntArray, node_stamps_ns: IntArray) -> "GyroTurns":
        """Integrate the rates between successive times.

        Args:
            stamps_ns: (K,) times.
            node_stamps_ns: (n,) of the nodes of the bias.
        """
        zero_ns = self.stamps_ns[0]
        samples_s, times_s, nodes_s = (
            np.asarray(each - zero_ns, dtype=np.float64) * 1e-9 for each in (self.stamps_ns, stamps_ns, node_stamps_ns)
        )
        heading_rad = _integral(samples_s, self.yaw_rate_rad_s, times_s)
        rate_rad_s = _smooth_rates(samples_s, self.yaw_rate_rad_s, times_s)
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
    """Return the yaw rates of one log corrected by robot.yaml, None where there are too few, and warnings.

    Args:
        readings: stamp in ns and yaw rate in rad/s of each message, in order.
        robot: robot with the gyro's time offset and scale.
        where: file and topic, for errors and warnings.

    Raises:
        OfflineError: a stamp is negative, or a rate is not finite or too large.
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
            f"{_FASTEST_RAD_S:g} rad/s; record radians, not degrees"
        )
    keep, warnings = find_repeated(stamps_ns, "gyro reading")
    stamps_ns, rates = stamps_ns[keep], rates[keep]
    frozen = _is_frozen(stamps_ns, rates)
    if frozen.any():
        warnings.append(f"{plural(int(frozen.sum()), 'gyro reading')} of one value for a second or longer; left out")
        stamps_ns, rates = stamps_ns[~frozen], rates[~frozen]
    if len(rates) < _LEAST_SAMPLES:
        return None, [*warnings, f"{where} has {len(rates)} readings, too few to use; headings are by the wheels alone"]
    gyro = robot.gyro or Gyro()
    offset_ns = round(gyro.time_offset_s * 1e9)
    return GyroSamples(stamps_ns - offset_ns, (1.0 + gyro.scale) * rates), warnings


def _is_frozen(stamps_ns: IntArray, rates: FloatArray) -> BoolArray:
    """Return (N,) which readings repeat one value for `_FROZEN_NS` or longer, which a working gyro does not."""
    run = np.cumsum(np.diff(rates, prepend=np.nan) != 0.0) - 1
    first, last = np.flatnonzero(np.diff(run, prepend=-1)), np.flatnonzero(np.diff(run, append=run[-1] + 1))
    return np.asarray((stamps_ns[last] - stamps_ns[first] >= _FROZEN_NS)[run])


@dataclass(frozen=True)
class HeadingDifferences:
    """Turns by the gyro less those by the wheels, as a linear factor |rows c + values|^2 on a calibration correction c.

    Attributes:
        step: (N,) index of the motion that each difference belongs to, increasing.
        rows: (N, P) derivatives with respect to the parameters of `SegmentOdometry.jacobian`, over the sigma of the
            difference.
        values: (N,) differences under nominal calibration, over their sigmas.
        walk_rows: (n - 1, P) differences of successive bias nodes, over the sigma of the random walk between them.
        owner: the segment whose bias it is.
    """

    step: IntArray
    rows: FloatArray
    values: FloatArray
    walk_rows: FloatArray
    owner: str

    @property
    def n_nodes(self) -> int:
        """Number of nodes of the bias."""
        return len(self.walk_rows) + 1

    def at_steps(self, step: IntArray) -> "HeadingDifferences":
        """Return the differences with motion i renumbered to step[i]; those with a negative number are left out."""
        new = step[self.step]
        keep = new >= 0
        return replace(self, step=new[keep], rows=self.rows[keep], values=self.values[keep])


@dataclass(frozen=True)
class GyroTurns:
    """Changes of heading over M time intervals, integrated from the yaw rate of the gyro.

    Attributes:
        turn_rad: (M,) change of heading in rad, counterclockwise positive.
        jacobian: (M, 2 + n) derivative of `turn_rad` with respect to the two GYRO_PARAMETERS, then to the bias (rad/s)
            at each of n times (`bias_nodes`), between which it is interpolated linearly.
        duration_s: (M,) length of the interval.
        is_known: (M,) whether gyro samples cover the whole interval without a gap; other turns are not to be used.
    """

    turn_rad: FloatArray
    jacobian: FloatArray
    duration_s: FloatArray
    is_known: BoolArray


def bias_nodes(first_ns: int, last_ns: int, gyro: Gyro) -> IntArray:
    """Return (n,) stamps of the bias nodes of one segment, evenly spaced from its first to its last stamp."""
    spacing_s = _WALK_SHARE * 12.0**0.5 * gyro.noise_rad_per_sqrt_s / gyro.bias_walk_rad_s_per_sqrt_s
    n = int(np.ceil((last_ns - first_ns) * 1e-9 / max(spacing_s, _LEAST_NODE_S)))
    return np.linspace(first_ns, last_ns, min(max(n, 1), _MOST_INTERVALS) + 1).astype(np.int64)


def noise_density(gyro: Gyro, node_stamps_ns: IntArray) -> float:
    """Return the variance of the turn in rad^2 per second, from white noise and the random walk between bias nodes.

    The integral of a random walk that is known at both ends of an interval T has the variance walk^2 T^3 / 12 (Brownian
    bridge).
    """
    spacing_s = float(np.diff(node_stamps_ns).max(initial=0)) * 1e-9
    return gyro.noise_rad_per_sqrt_s**2 + gyro.bias_walk_rad_s_per_sqrt_s**2 * spacing_s**2 / 12.0


def _smooth_rates(samples_s: FloatArray, rates: FloatArray, times_s: FloatArray) -> FloatArray:
    """Return the mean rate about each time over `_RATE_WINDOW_S`."""
    half_s = 0.5 * _RATE_WINDOW_S
    after, before = (_integral(samples_s, rates, times_s + sign * half_s) for sign in (1.0, -1.0))
    return (after - before) / _RATE_WINDOW_S


def _integral(x: FloatArray, y: FloatArray, at: FloatArray) -> FloatArray:
    """Return the integral from x[0] to each of `at` of the linear interpolation of (x, y), constant outside."""
    sums = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(x))])
    inside = np.clip(at, x[0], x[-1])
    i = np.clip(np.searchsorted(x, inside, side="right") - 1, 0, len(x) - 2)
    dx = inside - x[i]
    slope = (y[i + 1] - y[i]) / (x[i + 1] - x[i])
    return np.asarray(sums[i] + dx * (y[i] + 0.5 * slope * dx) + np.where(at < x[0], y[0], y[-1]) * (at - inside))


def _is_covered(times_s: FloatArray, samples_s: FloatArray, gaps: IntArray) -> BoolArray:
    """Return (K-1,) whether the interval from each time to the next lies within the samples and overlaps no gap."""
    covered = (times_s[:-1] >= samples_s[0]) & (times_s[1:] <= samples_s[-1])
    begin, end = samples_s[gaps], samples_s[gaps + 1]
    # The gaps that begin before the interval's end, less those that end before it begins.
    n_touching = np.searchsorted(begin, times_s[1:]) - np.searchsorted(end, times_s[:-1], side="right")
    return np.asarray(covered & (n_touching == 0))
