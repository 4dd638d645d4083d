"""Composes the wheel readings between keyframes into one motion with its covariance and Jacobian.

All readings are used: the motion from reading to reading is an exact arc, and the noise of each is propagated to the
next keyframe. Robots that also move laterally follow a constant twist exp(d, l, turn) from reading to reading.
Notation: T_start_base is the dead-reckoned pose in the frame of the segment's first wheel reading.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import chain_motions, se2, wheels
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.measurements.covariance_components import CovarianceParts, propagate
from groundsbot.offline.measurements.motion_model.gyro import HeadingDifferences

ODOMETRY_NOISE: Final = (
    "sigma_distance_m_per_sqrt_m",
    "sigma_lateral_m_per_sqrt_m",
    "sigma_heading_rad_per_sqrt_m",
    "sigma_heading_rad_per_sqrt_rad",
)

# In a longer gap between readings, the cumulative counts determine distance and turn but not the path. The error of a
# turn at an unknown time, uniformly distributed in the gap, has this sigma per metre and per distance between the unit
# vectors of both headings; curves to and fro add another.
GAP_NS: Final = 500_000_000
_GAP_SIGMA_PER_M: Final = 0.1
_GAP_SIGMA_PER_TURN: Final = 12.0**-0.5
# Readings that always come this rarely are no gaps, and neither is one in which no wheel moved by more than this.
_GAP_INTERVALS: Final = 5.0
_GAP_LEAST_M: Final = 0.02
_HALF_WINDOW_NS: Final = 25_000_000  # of velocities
# Quantisation is one percent of a distance of this many ticks.
_MANY_TICKS: Final = 100.0

# Finer than any encoder; keeps the information of a step without motion finite.
_SMALLEST_QUANTUM_M: Final = 1e-4


@dataclass(frozen=True)
class WheelSegment:
    """Wheel readings of one segment as cumulative distances.

    Attributes:
        stamps_ns: (N,) strictly increasing.
        left_m, right_m: (N,) cumulative, by the nominal radii.
        quantum_m: distance of one encoder tick; 0 where unknown.
        lateral_m: (N,) cumulative motion to base's left; None for robots that cannot move that way.
        covariance: (N, 3, 3) of the right tangent of the step that ends at each reading; NaN where the noise model is
            used, None where it is used for all.
    """

    stamps_ns: IntArray
    left_m: FloatArray
    right_m: FloatArray
    quantum_m: float = 0.0
    covariance: FloatArray | None = None
    lateral_m: FloatArray | None = None

    @cached_property
    def _since_first_s(self) -> FloatArray:
        return _seconds(self.stamps_ns, self.stamps_ns[0])

    def at(self, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Return cumulative (left_m, right_m) at other times, with constant speeds between readings."""
        times = _seconds(stamps_ns, self.stamps_ns[0])
        return np.interp(times, self._since_first_s, self.left_m), np.interp(times, self._since_first_s, self.right_m)

    def lateral_at(self, stamps_ns: IntArray) -> FloatArray:
        """Return the cumulative motion to the left at other times, in metres."""
        if self.lateral_m is None:
            return np.zeros(np.shape(stamps_ns))
        return np.interp(_seconds(stamps_ns, self.stamps_ns[0]), self._since_first_s, self.lateral_m)

    def every(self, step: int) -> "WheelSegment":
        """Return the segment with every `step`-th reading; unchanged where readings have covariances of their own."""
        if step == 1 or self.covariance is not None:
            return self
        return replace(
            self,
            stamps_ns=self.stamps_ns[::step],
            left_m=self.left_m[::step],
            right_m=self.right_m[::step],
            lateral_m=None if self.lateral_m is None else self.lateral_m[::step],
        )

    def after(self, stamp_ns: int) -> "WheelSegment":
        """Return the segment from a time within it on; its first reading is interpolated, unless it is one of them."""
        later = self.stamps_ns > stamp_ns
        at = np.array([stamp_ns])
        left_m, right_m = self.at(at)
        lateral_m = self.lateral_at(at)
        return replace(
            self,
            stamps_ns=np.append(at, self.stamps_ns[later]),
            left_m=np.append(left_m, self.left_m[later]),
            right_m=np.append(right_m, self.right_m[later]),
            lateral_m=None if self.lateral_m is None else np.append(lateral_m, self.lateral_m[later]),
            covariance=None,
        )

    @cached_property
    def gaps_ns(self) -> IntArray:
        """(G, 2) begin and end of the gaps between readings in which the robot moved on an unknown path."""
        interval_ns = np.diff(self.stamps_ns)
        moved_m = np.maximum(np.abs(np.diff(self.left_m)), np.abs(np.diff(self.right_m)))
        usual_ns = float(np.median(interval_ns)) if len(interval_ns) else 0.0
        is_gap = (interval_ns > max(GAP_NS, _GAP_INTERVALS * usual_ns)) & (moved_m > _GAP_LEAST_M)
        return np.stack([self.stamps_ns[:-1][is_gap], self.stamps_ns[1:][is_gap]], axis=-1)

    def motions(self, from_ns: IntArray, to_ns: IntArray, track_m: float) -> FloatArray:
        """Return (..., 3) motions by a constant twist between pairs of times, each pair within one step."""
        before, after = self.at(from_ns), self.at(to_ns)
        left_m, right_m = after[0] - before[0], after[1] - before[1]
        if self.lateral_m is None:
            return wheels.advance(left_m, right_m, track_m)
        return se2.exp(_twists(left_m, right_m, self.lateral_at(to_ns) - self.lateral_at(from_ns), track_m))

    def twist_at(self, stamps_ns: IntArray, track_m: float) -> FloatArray:
        """Return (K, 3) velocities of base (m/s forward, m/s to the left, rad/s) by central differences over 50 ms."""
        before = np.maximum(stamps_ns - _HALF_WINDOW_NS, self.stamps_ns[0])
        after = np.minimum(stamps_ns + _HALF_WINDOW_NS, self.stamps_ns[-1])
        left_m, right_m = (m[1] - m[0] for m in self.at(np.stack([before, after])))
        seconds = np.maximum(after - before, 1) * 1e-9
        speed_m_s, turning_rad_s = 0.5 * (left_m + right_m) / seconds, (right_m - left_m) / (track_m * seconds)
        lateral_m = self.lateral_at(after) - self.lateral_at(before)
        return np.stack([speed_m_s, lateral_m / seconds, turning_rad_s], axis=-1)


@dataclass(frozen=True)
class SegmentOdometry:
    """The motions from each of K keyframes to the next.

    Attributes:
        motion: (K-1, 3) T_k_k+1 by the nominal calibration.
        covariance: (K-1, 3, 3) of the motion's right tangent.
        parts: the components of the covariance.
        jacobian: (K-1, 3, P) derivative of that tangent with respect to WHEEL_PARAMETERS, followed by the gyro's
            parameters where there are `differences`.
        distance_m: (K-1,) driven.
        differences: differences of a gyro's turns from the wheels', where the headings are fused.
    """

    motion: FloatArray
    covariance: FloatArray
    parts: CovarianceParts
    jacobian: FloatArray
    distance_m: FloatArray
    differences: HeadingDifferences | None = None

    def __len__(self) -> int:
        """Number of motions."""
        return len(self.motion)

    def part(self, first: int, end: int) -> "SegmentOdometry":
        """Return motions first to end - 1."""
        steps, differences = slice(first, end), self.differences
        if differences is not None:
            index = np.arange(len(self)) - first
            differences = differences.at_steps(np.where((index >= 0) & (index < end - first), index, -1))
        return SegmentOdometry(
            self.motion[steps],
            self.covariance[steps],
            self.parts.where(steps),
            self.jacobian[steps],
            self.distance_m[steps],
            differences,
        )

    def with_noise(self, noise: NoiseParameters) -> "SegmentOdometry":
        """Return the motions with covariances for other noise parameters."""
        return replace(self, covariance=self.parts.under(noise))

    def dead_reckon(self, calibration: FloatArray | None = None, start: FloatArray | None = None) -> FloatArray:
        """Return (K, 3) poses by the motions alone.

        Args:
            calibration: (P,) correction of the parameters of `jacobian`.
            start: (3,) first pose; the identity where None.
        """
        motion = self.motion
        if calibration is not None:
            motion = se2.compose(motion, se2.exp(self.jacobian @ calibration))
        return chain_motions(motion, np.zeros(3) if start is None else start)


def compose_odometry(
    wheel_segment: WheelSegment, keyframe_stamps_ns: IntArray, track_m: float, noise: NoiseParameters
) -> SegmentOdometry:
    """Compose all wheel readings between keyframes.

    Args:
        wheel_segment: wheel segment with the readings.
        keyframe_stamps_ns: (K,) strictly increasing, within the segment.
        track_m: nominal distance between the wheels.
        noise: sigmas per square root of a metre and of a radian.
    """
    if len(keyframe_stamps_ns) < 2:
        none = np.zeros((0, 3, 3))
        parts = CovarianceParts(ODOMETRY_NOISE, np.zeros((len(ODOMETRY_NOISE), 0, 3, 3)), none)
        return SegmentOdometry(np.zeros((0, 3)), none, parts, none, np.zeros(0))
    inner = wheel_segment.stamps_ns[
        (wheel_segment.stamps_ns >= keyframe_stamps_ns[0]) & (wheel_segment.stamps_ns <= keyframe_stamps_ns[-1])
    ]
    grid_ns = np.union1d(inner, keyframe_stamps_ns)
    left_m, right_m = wheel_segment.at(grid_ns)
    left_m, right_m, lateral_m = np.diff(left_m), np.diff(right_m), np.diff(wheel_segment.lateral_at(grid_ns))
    forward_m = 0.5 * (left_m + right_m)
    if wheel_segment.lateral_m is None:
        pieces, d_wheels, d_track = wheels.advance_with_jacobians(left_m, right_m, track_m)
        by_parameters = _by_wheel_parameters(d_wheels, d_track, left_m, right_m, track_m)
        jacobian = se2.right_tangent_from_coordinates(pieces) @ by_parameters
    else:
        twists = _twists(left_m, right_m, lateral_m, track_m)
        pieces = se2.exp(twists)
        jacobian = se2.right_jacobian(twists) @ _twists_by_wheel_parameters(twists, track_m)
    poses = chain_motions(pieces, np.zeros(3))

    ends = np.searchsorted(grid_ns, keyframe_stamps_ns)
    step_of_piece = np.repeat(np.arange(len(ends) - 1), np.diff(ends))
    # Maps a tangent at the end of a piece to one at the end of its step.
    to_step_end = se2.adjoint(se2.between(poses[ends[1:]][step_of_piece], poses[1:]))

    duration_s = np.diff(grid_ns).astype(np.float64) * 1e-9
    path_m = 0.5 * (np.abs(left_m) + np.abs(right_m)) + np.abs(lateral_m)
    window = _windows(step_of_piece, path_m, wheel_segment.quantum_m)
    net_forward_m, net_lateral_m = (_smooth(each, duration_s, window) for each in (forward_m, lateral_m))
    net_turn_rad = np.abs(_smooth(right_m - left_m, duration_s, window)) / track_m
    unit = _piece_covariances(net_forward_m, net_lateral_m, net_turn_rad)
    in_gap = _gap_covariances(np.hypot(forward_m, lateral_m), (right_m - left_m) / track_m, duration_s)
    known = _logged_covariances(wheel_segment, grid_ns)
    is_given = np.isfinite(known).all((-1, -2))
    unit[:, is_given] = 0.0
    known[~is_given] = 0.0
    parts = CovarianceParts(
        ODOMETRY_NOISE,
        np.stack([_sum_by_step(propagate(to_step_end, each), ends) for each in unit]),
        _sum_by_step(propagate(to_step_end, in_gap + known), ends)
        + np.diag(_quantisation_variance(wheel_segment.quantum_m, track_m)),
    )
    return SegmentOdometry(
        motion=se2.between(poses[ends[:-1]], poses[ends[1:]]),
        covariance=parts.under(noise),
        parts=parts,
        jacobian=_sum_by_step(to_step_end @ jacobian, ends),
        distance_m=_sum_by_step(np.hypot(forward_m, lateral_m), ends),
    )


def _logged_covariances(wheel_segment: WheelSegment, grid_ns: IntArray) -> FloatArray:
    """Return (N, 3, 3) covariances of pieces: those of the readings, divided by duration; NaN where there are none."""
    if wheel_segment.covariance is None:
        return np.full((len(grid_ns) - 1, 3, 3), np.nan)
    reading = np.searchsorted(wheel_segment.stamps_ns, grid_ns[1:])
    share = np.diff(grid_ns) / (wheel_segment.stamps_ns[reading] - wheel_segment.stamps_ns[reading - 1])
    return np.asarray(share[:, None, None] * wheel_segment.covariance[reading])


def _windows(step_of_piece: IntArray, path_m: FloatArray, quantum_m: float) -> IntArray:
    """Return (N,) window numbers: successive pieces within one step and `_MANY_TICKS` share a window."""
    along_m = np.cumsum(path_m)
    along_m -= along_m[np.searchsorted(step_of_piece, step_of_piece)]
    part = np.floor(along_m / max(_MANY_TICKS * quantum_m, _SMALLEST_QUANTUM_M))
    begins = (np.diff(step_of_piece, prepend=-1) != 0) | (np.diff(part, prepend=0.0) != 0.0)
    return np.asarray(np.cumsum(begins) - 1)


def _smooth(moved: FloatArray, duration_s: FloatArray, window: IntArray) -> FloatArray:
    """Return (N,) the net motion of each window, divided among its pieces by duration.

    Sums of absolute values of single pieces would contain quantisation noise, and the net motion of a longer window
    would lose what was driven forth and back.
    """
    whole = np.bincount(window, moved)
    duration = np.bincount(window, duration_s)
    return np.asarray(whole[window] * duration_s / duration[window])


def _gap_covariances(distance_m: FloatArray, turn_rad: FloatArray, duration_s: FloatArray) -> FloatArray:
    """Return (N, 3, 3) covariances of the unknown paths of pieces that are longer than a gap."""
    sigma_m = distance_m * np.hypot(_GAP_SIGMA_PER_M, 2.0 * _GAP_SIGMA_PER_TURN * np.sin(0.5 * turn_rad))
    covariance = np.zeros((len(distance_m), 3, 3))
    covariance[:, 0, 0] = covariance[:, 1, 1] = (duration_s > GAP_NS * 1e-9) * sigma_m**2
    return covariance


def _piece_covariances(forward_m: FloatArray, lateral_m: FloatArray, net_turn_rad: FloatArray) -> FloatArray:
    """Return the covariances (4, N, 3, 3) of the pieces' right tangents by ODOMETRY_NOISE.

    Noise is white along a piece: distance noise in the direction of motion, lateral noise perpendicular to it.
    """
    distance_m = np.hypot(forward_m, lateral_m)
    heading = np.zeros((len(forward_m), 3, 3))
    # A heading error at a distance u before the end displaces the end laterally by u times the error. The factors 1/3
    # and 1/2 are the means of u^2 and u over a piece of unit length.
    across = np.stack([-lateral_m, forward_m], axis=-1)
    heading[:, :2, :2] = across[:, :, None] * across[:, None, :] / 3.0
    heading[:, :2, 2] = heading[:, 2, :2] = across / 2.0
    heading[:, 2, 2] = 1.0
    unit = np.zeros((len(ODOMETRY_NOISE), len(forward_m), 3, 3))
    across /= np.where(distance_m > 0.0, distance_m, 1.0)[:, None]
    along = np.stack([across[:, 1], -across[:, 0]], axis=-1)
    for k, axis in enumerate((along, across)):
        unit[k, :, :2, :2] = distance_m[:, None, None] * axis[:, :, None] * axis[:, None, :]
    unit[2] = distance_m[:, None, None] * heading
    unit[3] = net_turn_rad[:, None, None] * heading
    return unit


def _by_wheel_parameters(
    d_wheels: FloatArray, d_track: FloatArray, left_m: FloatArray, right_m: FloatArray, track_m: float
) -> FloatArray:
    """Return (N, 3, 3) the derivative of the pieces' coordinates with respect to WHEEL_PARAMETERS."""
    by_left, by_right = d_wheels[..., 0] * left_m[:, None], d_wheels[..., 1] * right_m[:, None]
    return np.stack([by_left + by_right, 0.5 * (by_right - by_left), d_track * track_m], axis=-1)


def _twists(left_m: FloatArray, right_m: FloatArray, lateral_m: FloatArray, track_m: float) -> FloatArray:
    """Return (..., 3) the twists of the pieces."""
    return np.stack([0.5 * (left_m + right_m), lateral_m, (right_m - left_m) / track_m], axis=-1)


def _twists_by_wheel_parameters(twists: FloatArray, track_m: float) -> FloatArray:
    """Return the Jacobian (N, 3, 3) of the twists with respect to WHEEL_PARAMETERS; lateral motion has the scale."""
    forward_m, _, turn_rad = twists.T
    none = np.zeros_like(turn_rad)
    by_ratio = np.stack([0.25 * track_m * turn_rad, none, forward_m / track_m], axis=-1)
    by_track = np.stack([none, none, -turn_rad], axis=-1)
    return np.stack([twists, by_ratio, by_track], axis=-1)


def _quantisation_variance(quantum_m: float, track_m: float) -> FloatArray:
    """Return (3,) the variances of a step from the quantisation of each wheel's two readings to one tick."""
    quantum = max(quantum_m, _SMALLEST_QUANTUM_M)
    wheel = quantum**2 / 6.0
    return np.array([wheel / 2.0, wheel / 2.0, 2.0 * wheel / track_m**2])


def _sum_by_step(values: FloatArray, ends: IntArray) -> FloatArray:
    """Sum (N, ...) over the pieces of each step."""
    summed: FloatArray = np.add.reduceat(values, ends[:-1], axis=0)
    return summed


def _seconds(stamps_ns: IntArray, zero_ns: int) -> FloatArray:
    return np.asarray(stamps_ns - zero_ns, dtype=np.float64) * 1e-9
