"""One segment as the model sees it: the poses that it needs, the motions between them, and its readings."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import CAMERA_PARAMETERS, EDGE_SHIFT, NoiseParameters
from groundsbot.offline.measurements import (
    STAMP_NOISE,
    Segment,
    WheelSegment,
    coarsen,
    compose_odometry,
    tag_rates,
    value_rates,
)

# A composed motion is linear in its errors over this distance, turn and time; and a slip in it is one motion's.
_MOST_M: Final = 0.5
_MOST_RAD: Final = 0.35
_MOST_S: Final = 20.0
# Readings of a tag within such a motion, without a longer break, are a pass: what is systematic in them is the same.
_PASS_M: Final = 1.0
_PASS_RAD: Final = 1.0
_PASS_S: Final = 3.0
# A turn on the spot moves base too, and by this share of a metre a radian: no centre of rotation is quite between the
# wheels. A shift by a tenth of a millimetre, and a turn by as many radians, are below any encoder.
_METRES_PER_RAD: Final = 0.1
_FLOOR: Final = 1e-4
_LEAST_DELAY_S: Final = 1e-3  # in which no robot changes its velocity by more than cm/s, and so its place by 0.01 mm
_LINEAR: Final = [CAMERA_PARAMETERS.index(name) for name in ("mount_roll_rad", "mount_pitch_rad", EDGE_SHIFT)]


@dataclass(frozen=True)
class Drive:
    """A segment reduced to the poses of its readings, and to some between them where these are far apart.

    Attributes:
        segment: the reduced segment.
        keyframes: (K,) its poses among the keyframes of the whole segment.
        wheels: its wheel readings, to compose motions anew at other times; None where these are gone.
        delay_s: by which poses are earlier than the stamps of the segment's keyframes, but for the first pose.
        velocity: (K, 3) of base at the poses: m/s forward and to the left, rad/s.
        passes: (M,) pass of each reading.
    """

    segment: Segment
    keyframes: IntArray
    wheels: WheelSegment | None
    delay_s: float
    velocity: FloatArray
    passes: IntArray

    @staticmethod
    def of(segment: Segment) -> "Drive":
        """Return the drive of a whole segment."""
        single = replace(segment, observations=segment.observations.where(_one_a_stand(segment)))
        keyframes = _needed_keyframes(single)
        wheels = _wheels_of(segment)
        reduced = coarsen(single, keyframes)
        velocity = _velocities(reduced, wheels, reduced.stamps_ns)
        return Drive(reduced, keyframes, wheels, 0.0, velocity, _passes_of(reduced))

    def with_delay(self, delay_s: float) -> "Drive":
        """Return the drive with its motions composed for pictures that were taken so long before their stamps.

        Of smaller changes readings know by the velocity.
        """
        wheels, odometry = self.wheels, self.segment.odometry
        if wheels is None or odometry.differences is not None or abs(delay_s - self.delay_s) < _LEAST_DELAY_S:
            return self
        stamps_ns = _delay_stamps(self.segment.stamps_ns, wheels, delay_s)
        track_m = self.segment.run.robot.wheels.track_m
        composed = compose_odometry(wheels, stamps_ns, track_m, NoiseParameters())
        segment = replace(self.segment, odometry=composed)
        velocity = _velocities(segment, wheels, stamps_ns)
        return Drive(segment, self.keyframes, wheels, delay_s, velocity, self.passes)

    def thin(self, most: int) -> "Drive":
        """Return the drive with at most so many readings: of each tag every n-th."""
        observations = self.segment.observations
        every = -(-len(observations) // most)
        if every <= 1:
            return self
        order = np.argsort(observations.tag, kind="stable")
        kept = np.zeros(len(order), dtype=np.bool_)
        kept[order[::every]] = True
        single = replace(self.segment, observations=observations.where(kept))
        needed = _needed_keyframes(single)
        reduced = coarsen(single, needed)
        return Drive(
            reduced, self.keyframes[needed], self.wheels, self.delay_s, self.velocity[needed], self.passes[kept]
        )

    def prefix(self, n: int) -> "Drive":
        """Return the drive's first poses, with their readings."""
        first = self.segment.observations.keyframe < n
        return Drive(
            self.segment.part(0, n), self.keyframes[:n], self.wheels, self.delay_s, self.velocity[:n],
            self.passes[first],
        )  # fmt: skip

    @property
    def stamps_ns(self) -> IntArray:
        """(K,) times of the poses on the wheels' clock."""
        return (
            _delay_stamps(self.segment.stamps_ns, self.wheels, self.delay_s) if self.wheels else self.segment.stamps_ns
        )

    @property
    def n_poses(self) -> int:
        """Number of poses."""
        return len(self.segment.stamps_ns)

    @property
    def extents(self) -> FloatArray:
        """(K - 1, 2) metres driven and radians turned of each motion, at least the tenth of a millimetre."""
        odometry = self.segment.odometry
        turned = np.maximum(
            odometry.parts.of(("sigma_heading_rad_per_sqrt_rad",))[0, :, 2, 2], abs(odometry.motion[:, 2])
        )
        return np.stack([odometry.distance_m, turned], axis=-1)


def _delay_stamps(stamps_ns: IntArray, wheels: WheelSegment, delay_s: float) -> IntArray:
    """Return the stamps (K,) but for the first earlier by a delay, still increasing and within the wheels' readings."""
    moved = stamps_ns - round(delay_s * 1e9)
    moved[0] = stamps_ns[0]
    steps = np.arange(len(moved))
    moved = np.minimum(np.maximum(moved, wheels.stamps_ns[0] + steps), wheels.stamps_ns[-1] - steps[::-1])
    return np.asarray(np.maximum.accumulate(moved - steps) + steps)


def _passes_of(segment: Segment) -> IntArray:
    """Return (M,) the pass of each reading, numbered by tag and then in time."""
    odometry, observations = segment.odometry, segment.observations
    moved = odometry.distance_m / _PASS_M + np.abs(odometry.motion[:, 2]) / _PASS_RAD
    along, seconds = np.append(0.0, np.cumsum(moved)), (segment.stamps_ns - segment.stamps_ns[0]) * 1e-9
    found = np.empty(len(observations), dtype=np.int64)
    number, tag, first_at, last_s = -1, -1, 0.0, 0.0
    for i in np.lexsort((observations.keyframe, observations.tag)).tolist():
        at = observations.keyframe[i]
        if observations.tag[i] != tag or along[at] - first_at > 1.0 or seconds[at] - last_s > _PASS_S:
            number, tag, first_at = number + 1, int(observations.tag[i]), float(along[at])
        last_s = float(seconds[at])
        found[i] = number
    return found


def wheel_jacobian(drive: Drive) -> FloatArray:
    """Return (K - 1, 3, 4 + P) the change of each motion's right tangent by the model's parameters of the wheels.

    These are the logarithms of turns to the left and to the right by wheels of given travel, a turn per metre (rad/m,
    times the track), the distance lost per turn (m/rad), and the gyro's parameters, if any. The last but these is by
    the share of the base's travel in that of the outer wheel: a turn on the spot moves the base nowhere.
    """
    odometry = drive.segment.odometry
    _, by_ratio, by_track = odometry.jacobian[:, :, :3].transpose(2, 0, 1)
    is_left = odometry.motion[:, 2, None] > 0.0
    driven_m, turned_rad = drive.extents.T
    outer_m = driven_m + 0.5 * drive.segment.run.robot.wheels.track_m * turned_rad
    lost = np.zeros_like(by_ratio)
    lost[:, 0] = -turned_rad * driven_m / np.maximum(outer_m, _FLOOR)
    turns = [np.where(is_left, -by_track, 0.0), np.where(is_left, 0.0, -by_track), by_ratio, lost]
    return np.concatenate([np.stack(turns, axis=-1), odometry.jacobian[:, :, 3:]], axis=-1)


def motion_variances(extents: FloatArray) -> FloatArray:
    """Return (4, M, 3) variances of motions in their own axes for unit noise, by ODOMETRY_NOISE."""
    driven_m, turned_rad = extents.T
    by_place = driven_m + _METRES_PER_RAD * turned_rad
    unit = np.zeros((4, len(extents), 3))
    unit[0, :, 0] = unit[1, :, 1] = by_place + _FLOOR
    unit[2, :, 2], unit[3, :, 2] = driven_m + _FLOOR, turned_rad + _FLOOR
    return unit


def reading_variances(drive: Drive) -> tuple[tuple[str, ...], FloatArray]:
    """Return the noise parameters of a drive's readings, and (K, M, 2, 2) variances for unit noise.

    ReadingArrays whose log gives a covariance have one factor on it, `given`.
    """
    observations = drive.segment.observations
    parts = observations.parts
    names, units = list(parts.names), [*parts.unit]
    if STAMP_NOISE not in names:
        by_time = rates_of_readings(drive)
        names.append(STAMP_NOISE)
        units.append(by_time[:, :, None] * by_time[:, None, :])
    if np.any(np.trace(parts.rest, axis1=-2, axis2=-1) > 0.0):
        names.append("given")
        units.append(parts.rest)
    return tuple(names), np.array(units)


def rates_of_readings(drive: Drive) -> FloatArray:
    """Return (M, 2) the rate of change of each reading while the robot moves."""
    observations, mount = drive.segment.observations, drive.segment.T_base_sensor
    value = observations.value
    ahead = value[:, :1] * np.stack([np.cos(value[:, 1]), np.sin(value[:, 1])], axis=-1)
    in_sensor = np.where(observations.polar[:, None], ahead, value)
    rates = tag_rates(se2.apply(mount, in_sensor), drive.velocity[observations.keyframe])
    turned = np.column_stack([np.zeros((len(mount), 2)), -mount[:, 2]])
    return value_rates(in_sensor, observations.polar, se2.apply(turned, rates))


def linear_of_readings(drive: Drive) -> FloatArray:
    """Return (M, 2, 3) the derivative of each value by roll, pitch and edge shift of its camera."""
    return np.ascontiguousarray(drive.segment.observations.by_camera[:, :, _LINEAR])


def _one_a_stand(segment: Segment) -> BoolArray:
    """Return (M,) which readings stay: of those of a tag from one keyframe, the one of median range.

    A robot that stands reads the same error again and again.
    """
    observations = segment.observations
    range_m = np.where(observations.polar, observations.value[:, 0], np.hypot(*observations.value.T))
    order = np.lexsort((range_m, observations.tag, observations.camera, observations.keyframe))
    key = np.stack([observations.keyframe, observations.camera, observations.tag])[:, order]
    begins = np.flatnonzero(np.append(True, (np.diff(key) != 0).any(axis=0))) if len(order) else order
    count = np.diff(np.append(begins, len(order)))
    kept = np.zeros(len(order), dtype=np.bool_)
    kept[order[begins + count // 2]] = True
    return kept


def _needed_keyframes(segment: Segment) -> IntArray:
    """Return (k,) increasing indices of keyframes: those with readings, the first, the last, and some in between."""
    odometry = segment.odometry
    seconds = (segment.stamps_ns - segment.stamps_ns[0]) * 1e-9
    shares = (odometry.distance_m / _MOST_M, np.abs(odometry.motion[:, 2]) / _MOST_RAD, np.diff(seconds) / _MOST_S)
    along = np.append(0.0, np.cumsum(np.sum(shares, axis=0)))
    enters = np.flatnonzero(np.diff(along.astype(np.int64), prepend=-1))
    return np.union1d(segment.observations.keyframe, np.append(enters, len(seconds) - 1))


def _wheels_of(segment: Segment) -> WheelSegment | None:
    """Return the wheel readings that a segment is made of."""
    for each in segment.run.wheel_segments:
        if each.stamps_ns[0] == segment.stamps_ns[0]:
            return each
    return None


def _velocities(segment: Segment, wheels: WheelSegment | None, stamps_ns: IntArray) -> FloatArray:
    if wheels is not None:
        return wheels.twist_at(stamps_ns, segment.run.robot.wheels.track_m)
    seconds = np.maximum(np.diff(segment.stamps_ns) * 1e-9, 1e-3)[:, None]
    rates = se2.log(segment.odometry.motion) / seconds
    return np.concatenate([rates, rates[-1:]]) if len(rates) else np.zeros((len(stamps_ns), 3))
