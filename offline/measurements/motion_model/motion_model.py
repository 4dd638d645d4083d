"""Wheel readings between keyframes -> one motion, its covariance and its dependence on the wheel calibration.

No reading is thinned out: exact arcs from reading to reading, composed, with the noise of each carried to the
keyframe's end. Robots that also move sideways go by a constant twist from reading to reading instead, exp(d, l, turn).
Notation: T_start_base is the dead-reckoned pose in the frame of the segment's first wheel reading.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import chain_motions, se2, wheels
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.measurements.covariance_components import CovarianceParts
from groundsbot.offline.measurements.motion_model.gyro import HeadingDifferences

# In the order of the unit covariances below.
ODOMETRY_NOISE: Final = (
    "sigma_distance_m_per_sqrt_m",
    "sigma_lateral_m_per_sqrt_m",
    "sigma_heading_rad_per_sqrt_m",
    "sigma_heading_rad_per_sqrt_rad",
)

# Where readings are missing for longer, cumulative counts still give distance and turn, not the path between.
GAP_NS: Final = 500_000_000
_GAP_SIGMA_PER_M: Final = 0.1
_WHILE_NS: Final = 25_000_000
# Over so many one more or less counts for a percent.
_MANY_TICKS: Final = 100.0

# Below what any encoder resolves; keeps the information of a step that measured no motion finite.
_SMALLEST_QUANTUM_M: Final = 1e-4


@dataclass(frozen=True)
class WheelSegment:
    """Wheel readings of one segment: unbroken cumulative distances.

    Attributes:
        stamps_ns: (N,) strictly increasing.
        left_m, right_m: (N,) cumulative, by the nominal radii.
        quantum_m: distance of one encoder tick; 0 where unknown.
        lateral_m: (N,) cumulative motion to base's left; None for robots that cannot move that way.
        covariance: (N, 3, 3) of the right tangent of the step that ends at each reading; NaN where the noise model
            tells, None where it tells for all.
    """

    stamps_ns: IntArray
    left_m: FloatArray
    right_m: FloatArray
    quantum_m: float = 0.0
    covariance: FloatArray | None = None
    lateral_m: FloatArray | None = None

    @cached_property
    def _since_first_s(self) -> FloatArray:
        """(N,) of the readings."""
        return _seconds(self.stamps_ns, self.stamps_ns[0])

    def at(self, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray]:
        """Cumulative (left_m, right_m) at other times: speeds are constant between readings."""
        times = _seconds(stamps_ns, self.stamps_ns[0])
        return np.interp(times, self._since_first_s, self.left_m), np.interp(times, self._since_first_s, self.right_m)

    def lateral_at(self, stamps_ns: IntArray) -> FloatArray:
        """Cumulative motion to the left at other times, in metres."""
        if self.lateral_m is None:
            return np.zeros(np.shape(stamps_ns))
        return np.interp(_seconds(stamps_ns, self.stamps_ns[0]), self._since_first_s, self.lateral_m)

    def motions(self, from_ns: IntArray, to_ns: IntArray, track_m: float) -> FloatArray:
        """(..., 3) motions between times within one step each, by a constant twist."""
        before, after = self.at(from_ns), self.at(to_ns)
        left_m, right_m = after[0] - before[0], after[1] - before[1]
        if self.lateral_m is None:
            return wheels.advance(left_m, right_m, track_m)
        return se2.exp(_twists(left_m, right_m, self.lateral_at(to_ns) - self.lateral_at(from_ns), track_m))

    def twist_at(self, stamps_ns: IntArray, track_m: float) -> FloatArray:
        """(K, 3) velocity of base (m/s forward, m/s to the left, rad/s) by differences over a short while."""
        before = np.maximum(stamps_ns - _WHILE_NS, self.stamps_ns[0])
        after = np.minimum(stamps_ns + _WHILE_NS, self.stamps_ns[-1])
        left_m, right_m = (m[1] - m[0] for m in self.at(np.stack([before, after])))
        seconds = np.maximum(after - before, 1) * 1e-9
        speed_m_s, turning_rad_s = 0.5 * (left_m + right_m) / seconds, (right_m - left_m) / (track_m * seconds)
        lateral_m = self.lateral_at(after) - self.lateral_at(before)
        return np.stack([speed_m_s, lateral_m / seconds, turning_rad_s], axis=-1)


@dataclass(frozen=True)
class SegmentOdometry:
    """Motion from each of K keyframes to the next.

    Attributes:
        motion: (K-1, 3) T_k_k+1 by the nominal calibration.
        covariance: (K-1, 3, 3) of the motion's right tangent.
        parts: what the covariance is made of.
        jacobian: (K-1, 3, 3) derivative of that tangent by WHEEL_PARAMETERS.
        distance_m: (K-1,) driven.
        differences: of a gyro from the wheels, where the headings are by both; the jacobian then has columns of the
            gyro's parameters after those of the wheels.
    """

    motion: FloatArray
    covariance: FloatArray
    parts: CovarianceParts
    jacobian: FloatArray
    distance_m: FloatArray
    differences: HeadingDifferences | None = None

    def __len__(self) -> int:
        """Number of steps."""
        return len(self.motion)

    def part(self, first: int, end: int) -> "SegmentOdometry":
        """Steps first to end - 1 only."""
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
        """The same motions under other noise."""
        return replace(self, covariance=self.parts.under(noise))

    def dead_reckon(self, calibration: FloatArray | None = None, start: FloatArray | None = None) -> FloatArray:
        """Return poses (K, 3) by the motions alone, from `start` (3,) on; `calibration` (P,) corrects the motions."""
        motion = self.motion
        if calibration is not None:
            motion = se2.compose(motion, se2.exp(self.jacobian @ calibration))
        return chain_motions(motion, np.zeros(3) if start is None else start)


def compose_odometry(
    wheel_segment: WheelSegment, keyframe_stamps_ns: IntArray, track_m: float, noise: NoiseParameters
) -> SegmentOdometry:
    """Composes all wheel readings between keyframes.

    Args:
        wheel_segment: its readings.
        keyframe_stamps_ns: (K,) strictly increasing, within the segment.
        track_m: nominal distance between the wheels.
        noise: what is added per metre and per radian.
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
    # A disturbance at a piece's end, seen from the keyframe at the step's end.
    to_step_end = se2.adjoint(se2.between(poses[ends[1:]][step_of_piece], poses[1:]))

    duration_s = np.diff(grid_ns).astype(np.float64) * 1e-9
    rolled_m = 0.5 * (np.abs(left_m) + np.abs(right_m)) + np.abs(lateral_m)
    while_of_piece = _whiles(step_of_piece, rolled_m, wheel_segment.quantum_m)
    net_forward_m, net_lateral_m = (_net(each, duration_s, while_of_piece) for each in (forward_m, lateral_m))
    net_turn_rad = np.abs(_net(right_m - left_m, duration_s, while_of_piece)) / track_m
    unit, in_gap = _piece_covariances(net_forward_m, net_lateral_m, net_turn_rad, duration_s)
    known = _logged_covariances(wheel_segment, grid_ns)
    is_given = np.isfinite(known).all((-1, -2))
    unit[:, is_given] = 0.0
    known[~is_given] = 0.0
    parts = CovarianceParts(
        ODOMETRY_NOISE,
        np.stack([_sum_by_step(_carry(to_step_end, each), ends) for each in unit]),
        _sum_by_step(_carry(to_step_end, in_gap + known), ends)
        + np.diag(_quantisation_variance(wheel_segment.quantum_m, track_m)),
    )
    return SegmentOdometry(
        motion=se2.between(poses[ends[:-1]], poses[ends[1:]]),
        covariance=parts.under(noise),
        parts=parts,
        jacobian=_sum_by_step(to_step_end @ jacobian, ends),
        distance_m=_sum_by_step(np.hypot(forward_m, lateral_m), ends),
    )


def _carry(to_step_end: FloatArray, covariance: FloatArray) -> FloatArray:
    carried: FloatArray = to_step_end @ covariance @ to_step_end.swapaxes(-1, -2)
    return carried


def _logged_covariances(wheel_segment: WheelSegment, grid_ns: IntArray) -> FloatArray:
    """(N, 3, 3) covariances of pieces as the readings have them, shared out by duration; NaN where they have none."""
    if wheel_segment.covariance is None:
        return np.full((len(grid_ns) - 1, 3, 3), np.nan)
    reading = np.searchsorted(wheel_segment.stamps_ns, grid_ns[1:])
    share = np.diff(grid_ns) / (wheel_segment.stamps_ns[reading] - wheel_segment.stamps_ns[reading - 1])
    return np.asarray(share[:, None, None] * wheel_segment.covariance[reading])


def _whiles(step_of_piece: IntArray, rolled_m: FloatArray, quantum_m: float) -> IntArray:
    """(N,) rising numbers: pieces that follow each other within a step and some ticks have the same."""
    rolled = np.cumsum(rolled_m)
    rolled -= rolled[np.searchsorted(step_of_piece, step_of_piece)]
    part = np.floor(rolled / max(_MANY_TICKS * quantum_m, _SMALLEST_QUANTUM_M))
    begins = (np.diff(step_of_piece, prepend=-1) != 0) | (np.diff(part, prepend=0.0) != 0.0)
    return np.asarray(np.cumsum(begins) - 1)


def _net(moved: FloatArray, duration_s: FloatArray, while_of_piece: IntArray) -> FloatArray:
    """(N,) what came of each while in the end, spread over its pieces by duration.

    Quantised readings taken one by one would add up ways and turns that never were, as would many of them together lose
    what was driven there and back.
    """
    whole = np.bincount(while_of_piece, moved)
    duration = np.bincount(while_of_piece, duration_s)
    return np.asarray(whole[while_of_piece] * duration_s / duration[while_of_piece])


def _piece_covariances(
    forward_m: FloatArray, lateral_m: FloatArray, net_turn_rad: FloatArray, duration_s: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """(4, N, 3, 3) by ODOMETRY_NOISE, of the pieces' right tangents, and (N, 3, 3) what a gap adds.

    Noise comes in all along a piece; that of the distance along its direction, lateral noise across it.
    """
    distance_m = np.hypot(forward_m, lateral_m)
    heading = np.zeros((len(forward_m), 3, 3))
    # A heading error made u before the end moves the end across by u times it: means of u^2 and u over the piece.
    across = np.stack([-lateral_m, forward_m], axis=-1)
    heading[:, :2, :2] = across[:, :, None] * across[:, None, :] / 3.0
    heading[:, :2, 2] = heading[:, 2, :2] = across / 2.0
    heading[:, 2, 2] = 1.0
    unit = np.zeros((len(ODOMETRY_NOISE), len(forward_m), 3, 3))
    across /= np.where(distance_m > 0.0, distance_m, 1.0)[:, None]
    along = np.stack([across[:, 1], -across[:, 0]], axis=-1)
    for of_unit, axis in ((unit[0], along), (unit[1], across)):
        of_unit[:, :2, :2] = distance_m[:, None, None] * axis[:, :, None] * axis[:, None, :]
    unit[2] = distance_m[:, None, None] * heading
    unit[3] = net_turn_rad[:, None, None] * heading
    in_gap = np.zeros((len(forward_m), 3, 3))
    in_gap[:, 0, 0] = in_gap[:, 1, 1] = (duration_s > GAP_NS * 1e-9) * (_GAP_SIGMA_PER_M * distance_m) ** 2
    return unit, in_gap


def _by_wheel_parameters(
    d_wheels: FloatArray, d_track: FloatArray, left_m: FloatArray, right_m: FloatArray, track_m: float
) -> FloatArray:
    """(N, 3, 3) derivative of the pieces' coordinates by WHEEL_PARAMETERS."""
    by_left, by_right = d_wheels[..., 0] * left_m[:, None], d_wheels[..., 1] * right_m[:, None]
    return np.stack([by_left + by_right, 0.5 * (by_right - by_left), d_track * track_m], axis=-1)


def _twists(left_m: FloatArray, right_m: FloatArray, lateral_m: FloatArray, track_m: float) -> FloatArray:
    """(..., 3) right tangents of the pieces."""
    return np.stack([0.5 * (left_m + right_m), lateral_m, (right_m - left_m) / track_m], axis=-1)


def _twists_by_wheel_parameters(twists: FloatArray, track_m: float) -> FloatArray:
    """(N, 3, 3) derivative of the pieces' twists by WHEEL_PARAMETERS; the scale is of motion to the left too."""
    forward_m, _, turn_rad = twists.T
    none = np.zeros_like(turn_rad)
    by_ratio = np.stack([0.25 * track_m * turn_rad, none, forward_m / track_m], axis=-1)
    by_track = np.stack([none, none, -turn_rad], axis=-1)
    return np.stack([twists, by_ratio, by_track], axis=-1)


def _quantisation_variance(quantum_m: float, track_m: float) -> FloatArray:
    """(3,) of a step: each wheel's two readings are known to a tick."""
    quantum = max(quantum_m, _SMALLEST_QUANTUM_M)
    wheel = quantum**2 / 6.0
    return np.array([wheel / 2.0, wheel / 2.0, 2.0 * wheel / track_m**2])


def _sum_by_step(values: FloatArray, ends: IntArray) -> FloatArray:
    """Sums (N, ...) over the pieces of each step."""
    summed: FloatArray = np.add.reduceat(values, ends[:-1], axis=0)
    return summed


def _seconds(stamps_ns: IntArray, zero_ns: int) -> FloatArray:
    return np.asarray(stamps_ns - zero_ns, dtype=np.float64) * 1e-9
