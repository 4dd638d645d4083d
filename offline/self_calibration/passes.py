"""Passes of tags: short runs of observations of one tag, with the wheel readings of that time.

Wheels err little within a pass, so its observations calibrate the sensor without a map: each pass has a tag position of
its own. Passes are selected by stamps alone, and only selected observations are computed: a log may have millions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import NoiseParameters
from groundsbot.offline.measurements import Observations, Run, read_detections, read_positions

# A pass ends after a gap, or at these lengths.
_GAP_S: Final = 2.0
_PASS_S: Final = 20.0
_PASS_M: Final = 3.0
_PASS_RAD: Final = 1.5

_FEWEST_OBSERVATIONS: Final = 3  # two determine the tag position
_MOST_OBSERVATIONS: Final = 8  # of a pass: errors of neighbours are correlated
_LEAST_MOTION_M: Final = 0.1
_M_PER_RAD: Final = 0.5  # weight of a turn relative to distance
# Evenly spread over the drives: sigma falls only with the root of their number, and the time grows with it.
_MOST_PASSES: Final = 200

REACH_S: Final = 1.0  # largest time offset searched, so wheels must be known this long before and after an observation
_BETWEEN_SEGMENTS_S: Final = 10.0
_RATE_OVER_S: Final = 0.05  # longer than an encoder tick, shorter than a change of speed
_STATION_S: Final = 0.25

# Lower bounds on observation sigmas; covariances of imported positions can have any size.
_LEAST_SIGMA: Final = (0.005, 0.002)  # m, rad


@dataclass(frozen=True)
class WheelAxis:
    """Wheel readings of all segments on one time axis, separated by unused pauses of 10 s.

    Attributes:
        time_s: (N,) increasing.
        motion: (N, 6) cumulative distances of the left and of the right wheel and to base's left in m, and the three
            speeds in m/s.
        begins_s: start of each segment on this axis, in order of runs and of their segments.
        track_m: distance between the wheels, by robot.yaml.
    """

    time_s: FloatArray
    motion: FloatArray
    begins_s: tuple[float, ...]
    track_m: float

    def at(self, time_s: FloatArray) -> FloatArray:
        """Return (K, 6) motion at the given times, linearly interpolated."""
        index = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, len(self.time_s) - 2)
        begin_s = self.time_s[index]
        share = np.clip((time_s - begin_s) / (self.time_s[index + 1] - begin_s), 0.0, 1.0)[:, None]
        return np.asarray((1.0 - share) * self.motion[index] + share * self.motion[index + 1])

    def twist_at(self, time_s: FloatArray) -> FloatArray:
        """Return (K, 3) velocity of base (m/s forward, m/s to the left, rad/s) at the given times."""
        left_m_s, right_m_s, lateral_m_s = self.at(time_s)[:, 3:].T
        turning_rad_s = (right_m_s - left_m_s) / self.track_m
        return np.stack([0.5 * (left_m_s + right_m_s), lateral_m_s, turning_rad_s], axis=-1)


@dataclass(frozen=True)
class Passes:
    """M observations in G passes of tags, ordered by pass; passes are ordered by their start.

    A station is a time at which the robot's pose is computed: that of each observation, and others between, at most
    0.25 s apart.

    Attributes:
        wheels: wheel readings of the drives.
        group: (M,) the pass of each observation.
        first: (G,) the first observation of each pass.
        value: (M, 2) range in m and bearing in rad about the sensor, positive to the left.
        sigma: (M, 2) of these, including the wheels' error since the middle of the pass.
        sensor: (M, 3) position and yaw of the sensor in base, by robot.yaml.
        stations_s: (S,) on the time axis of the wheels, by stamps of the observations.
        station_group: (S,) the pass of each station.
        first_station: (G,) the first station of each pass.
        at: (M,) the station of each observation.
    """

    wheels: WheelAxis
    group: IntArray
    first: IntArray
    value: FloatArray
    sigma: FloatArray
    sensor: FloatArray
    stations_s: FloatArray
    station_group: IntArray
    first_station: IntArray
    at: IntArray

    def __len__(self) -> int:
        """Number of passes."""
        return len(self.first)


@dataclass(frozen=True)
class _Stamps:
    """M observations by their stamps alone: time, tag, and position in their run."""

    time_s: FloatArray
    way_m: FloatArray  # distance driven until then
    turn_rad: FloatArray  # absolute angle turned until then
    tag: IntArray
    run: IntArray
    index: IntArray  # into its positions, and after these into its detections

    def where(self, which: BoolArray | IntArray) -> "_Stamps":
        return _Stamps(
            self.time_s[which],
            self.way_m[which],
            self.turn_rad[which],
            self.tag[which],
            self.run[which],
            self.index[which],
        )


def find_passes(runs: Sequence[Run], most: int = _MOST_PASSES) -> Passes | None:
    """Return the passes of tags in some runs of one robot; None if the robot moves or turns in none of them.

    Args:
        runs: all with the same robot.yaml.
        most: passes to choose.
    """
    wheels = _wheel_axis(runs)
    if wheels is None:
        return None
    looks, group = _choose_tracks(_stamps(runs, wheels), most)
    value, sigma, sensor = np.full((len(group), 2), np.nan), np.ones((len(group), 2)), np.zeros((len(group), 3))
    twist = wheels.twist_at(looks.time_s)
    for number, run in enumerate(runs):
        own = np.flatnonzero(looks.run == number)
        for observations in _read_observations(run, looks.index[own], twist[own]):
            at = own[observations.keyframe]
            value[at], sigma[at] = _polar(observations)
            mount = run.robot.mount
            sensor[at] = np.where(observations.in_camera[:, None], [mount.x_m, mount.y_m, mount.yaw_rad], 0.0)
    good = np.isfinite(value).all(-1) & np.isfinite(sigma).all(-1)
    good &= (np.bincount(group, good) >= _FEWEST_OBSERVATIONS)[group] if len(group) else False
    if not good.any():
        return None
    group = np.unique(group[good], return_inverse=True)[1]
    return _passes(wheels, looks.where(good), group, value[good], sigma[good], sensor[good])


def _wheel_axis(runs: Sequence[Run]) -> WheelAxis | None:
    times, wheels, begins_s, end_s = [], [], [], 0.0
    for wheel_segment in (wheel_segment for run in runs for wheel_segment in run.wheel_segments):
        begins_s.append(end_s)
        if len(wheel_segment.stamps_ns):
            times.append(end_s + _since_s(wheel_segment.stamps_ns, wheel_segment.stamps_ns[0]))
            lateral_m = wheel_segment.lateral_at(wheel_segment.stamps_ns)
            wheels.append(np.stack([wheel_segment.left_m, wheel_segment.right_m, lateral_m]))
            end_s = times[-1][-1] + _BETWEEN_SEGMENTS_S
    if sum(map(len, times)) < 2:
        return None
    time_s, wheels_m = np.concatenate(times), np.concatenate(wheels, axis=1)
    later, earlier = (
        np.stack([np.interp(time_s + apart_s, time_s, each) for each in wheels_m])
        for apart_s in (_RATE_OVER_S, -_RATE_OVER_S)
    )
    speeds_m_s = (later - earlier) / (2.0 * _RATE_OVER_S)
    motion = np.concatenate([wheels_m, speeds_m_s]).T.copy()  # contiguous by time, as lookups need it
    return WheelAxis(time_s, motion, tuple(begins_s), runs[0].robot.wheels.track_m)


def _stamps(runs: Sequence[Run], wheels: WheelAxis) -> _Stamps:
    """Return all observations around which wheel readings are known."""
    left_m, right_m, lateral_m = np.diff(wheels.motion[:, :3], axis=0, prepend=wheels.motion[:1, :3]).T
    way_m = np.cumsum(np.hypot((left_m + right_m) / 2, lateral_m))
    turn_rad = np.cumsum(np.abs(right_m - left_m) / wheels.track_m)
    moved: list[FloatArray] = [np.zeros((3, 0))]
    names: list[IntArray] = [np.zeros((3, 0), dtype=np.int64)]
    begins_s, reach_ns = iter(wheels.begins_s), round(REACH_S * 1e9)
    for number, run in enumerate(runs):
        stamps_ns = np.concatenate([run.positions.stamps_ns, run.detections.stamps_ns])
        tag = np.concatenate([run.positions.tag, run.detections.tag])
        for wheel_segment, begin_s in zip(run.wheel_segments, begins_s, strict=False):
            if not len(wheel_segment.stamps_ns):
                continue
            first_ns, last_ns = wheel_segment.stamps_ns[0] + reach_ns, wheel_segment.stamps_ns[-1] - reach_ns
            index = np.flatnonzero((stamps_ns >= first_ns) & (stamps_ns <= last_ns))
            time_s = begin_s + _since_s(stamps_ns[index], wheel_segment.stamps_ns[0])
            where = (np.interp(time_s, wheels.time_s, each) for each in (way_m, turn_rad))
            moved.append(np.stack([time_s, *where]))
            names.append(np.stack([tag[index], np.full(len(index), number), index]))
    return _Stamps(*np.concatenate(moved, axis=1), *np.concatenate(names, axis=1))


def _choose_tracks(looks: _Stamps, most: int) -> tuple[_Stamps, IntArray]:
    """Return the observations of informative passes, ordered by pass, and the pass of each; passes by their start."""
    looks = looks.where(np.lexsort((looks.time_s, looks.tag)))
    begins = np.ones(len(looks.tag), dtype=np.bool_)
    begins[1:] = (np.diff(looks.tag) != 0) | (np.diff(looks.time_s) > _GAP_S) | (np.diff(looks.run) != 0)
    for each, longest in ((looks.way_m, _PASS_M), (looks.turn_rad, _PASS_RAD), (looks.time_s, _PASS_S)):
        begins[1:] |= np.diff(np.floor(each / longest)) != 0
    first = np.flatnonzero(begins)
    n = np.diff(first, append=len(begins))
    last = first + n - 1
    moved_m = looks.way_m[last] - looks.way_m[first] + _M_PER_RAD * (looks.turn_rad[last] - looks.turn_rad[first])
    passes = np.flatnonzero((n >= _FEWEST_OBSERVATIONS) & (moved_m > _LEAST_MOTION_M))
    passes = passes[np.argsort(looks.time_s[first[passes]], kind="stable")]
    if len(passes) > most:
        passes = passes[np.linspace(0, len(passes) - 1, most).astype(int)]
    first, n = first[passes], n[passes]
    group = np.repeat(np.arange(len(passes)), n)
    step = np.arange(len(group)) - np.repeat(np.cumsum(n) - n, n)
    share = step * (_MOST_OBSERVATIONS - 1) // np.maximum(n - 1, 1)[group]
    keep = (n <= _MOST_OBSERVATIONS)[group] | (step == 0) | (np.diff(share, prepend=0) > 0)
    return looks.where((first[group] + step)[keep]), group[keep]


def _read_observations(run: Run, index: IntArray, twist: FloatArray) -> list[Observations]:
    """Return observations of a run; each has its index in `index` as its keyframe, so that none are averaged."""
    noise, n = NoiseParameters(), len(run.positions.stamps_ns)
    order = np.argsort(index)
    of_positions, of_detections = np.split(order, [int((index < n).sum())])
    used = np.zeros(n + len(run.detections.stamps_ns), dtype=np.bool_)
    used[index] = True
    found = []
    if len(of_positions):
        found.append(read_positions(run.robot, run.positions.where(used[:n]), of_positions, twist, noise)[0])
    if len(of_detections):
        found.append(read_detections(run, run.detections.where(used[n:]), of_detections, twist, noise)[0])
    return found


def _polar(observations: Observations) -> tuple[FloatArray, FloatArray]:
    """Return (M, 2) range and bearing of observations in either form, and (M, 2) their sigmas."""
    x, y = observations.value.T
    range_m = np.maximum(np.hypot(x, y), 1e-6)
    along = np.stack([x, y], axis=-1) / range_m[:, None]
    across = np.stack([-y, x], axis=-1) / range_m[:, None] ** 2
    turned = np.stack([along, across], axis=1)
    covariance = np.where(
        observations.polar[:, None, None],
        observations.covariance,
        turned @ observations.covariance @ turned.swapaxes(-1, -2),
    )
    value = np.where(observations.polar[:, None], observations.value, np.stack([range_m, np.arctan2(y, x)], axis=-1))
    return value, np.hypot(np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)), _LEAST_SIGMA)


def _passes(
    wheels: WheelAxis, looks: _Stamps, group: IntArray, value: FloatArray, sigma: FloatArray, sensor: FloatArray
) -> Passes:
    """Return the passes with stations added and the sigmas increased by the wheels' error."""
    noise, n = NoiseParameters(), np.bincount(group)
    first = np.cumsum(n) - n
    middle = (first + n // 2)[group]
    way_m, turn_rad = np.abs(looks.way_m - looks.way_m[middle]), np.abs(looks.turn_rad - looks.turn_rad[middle])
    by_heading = noise.sigma_heading_rad_per_sqrt_m**2 * way_m + noise.sigma_heading_rad_per_sqrt_rad**2 * turn_rad
    by_wheels = np.stack([noise.sigma_distance_m_per_sqrt_m**2 * way_m, by_heading], axis=-1)
    since_s = np.diff(looks.time_s, prepend=0.0)
    steps = np.maximum(np.ceil(since_s / _STATION_S), 1.0).astype(int)
    steps[first] = 1
    at = np.cumsum(steps) - 1
    of_observation = np.repeat(np.arange(len(steps)), steps)
    missing = at[of_observation] - np.arange(len(of_observation))
    stations_s = looks.time_s[of_observation] - missing * (since_s / steps)[of_observation]
    return Passes(
        wheels,
        group,
        first,
        np.stack([value[:, 0], se2.wrap_angle(value[:, 1])], axis=-1),
        np.sqrt(sigma**2 + by_wheels),
        sensor,
        stations_s,
        group[of_observation],
        at[first],
        at,
    )


def _since_s(stamps_ns: IntArray, first_ns: np.int64) -> FloatArray:
    return np.asarray((stamps_ns - first_ns) * 1e-9)
