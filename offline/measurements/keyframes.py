"""Chooses which pictures of a drive become keyframes, the poses that are estimated."""

from math import radians
from typing import Final

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.foundation import FloatVector, IntVector, njit
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.run import Run

# A picture becomes a keyframe when the robot has moved this far since the last keyframe, or when the picture shows a
# tag that the last keyframe does not.
KEYFRAME_DISTANCE_M: Final = 0.02
KEYFRAME_TURN_RAD: Final = radians(1.0)
# A picture is assigned to the last keyframe when neither wheel has moved by more than the flicker of its encoder. The
# threshold is this small because a pose error of 1 mm or 0.1 degrees shifts an observation by several sigmas.
_STANDING_TICKS: Final = 1.5
_STANDING_M: Final = 1e-7  # rounding


def candidate_stamps(run: Run, wheel_segment: WheelSegment) -> IntArray:
    """Return (n,) the times that may become keyframes: pictures, or all stamps of an imported log, within the segment.

    The first wheel reading is always one of them. Within a gap of the readings there is none, since the wheels do not
    determine where the robot was.
    """
    stamps_ns = run.picture_stamps_ns
    if not len(stamps_ns):
        stamps_ns = np.union1d(wheel_segment.stamps_ns, run.positions.stamps_ns)
    inside = (stamps_ns >= wheel_segment.stamps_ns[0]) & (stamps_ns <= wheel_segment.stamps_ns[-1])
    begin_ns, end_ns = wheel_segment.gaps_ns.T
    if len(begin_ns):
        gap = np.searchsorted(begin_ns, stamps_ns) - 1  # the last that begins before
        inside &= (gap < 0) | (stamps_ns >= end_ns[gap])
    return np.asarray(np.union1d(wheel_segment.stamps_ns[:1], stamps_ns[inside]), dtype=np.int64)


def tags_at_candidates(run: Run, stamps_ns: IntArray) -> tuple[IntArray, IntArray]:
    """Return the tags of each of n candidates in compressed row form: (n + 1,) offsets and (m,) tags."""
    at, tag = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    indices = np.arange(len(stamps_ns))
    for source in (run.detections, run.positions):
        at = np.append(at, keyframe_at(source.stamps_ns, stamps_ns, indices))
        tag = np.append(tag, source.tag)
    order = np.argsort(at, kind="stable")
    at, tag = at[order], tag[order]
    begin = np.searchsorted(at, np.arange(len(stamps_ns) + 1))
    return begin - begin[0], tag[begin[0] :]


def cameras_at_candidates(run: Run, stamps_ns: IntArray) -> IntArray:
    """Return the camera of each of n candidates; the first of the robot where there is no picture."""
    found = np.zeros(len(stamps_ns), dtype=np.int64)
    if run.robot.cameras:
        at = keyframe_at(run.picture_stamps_ns, stamps_ns, np.arange(len(stamps_ns)))
        found[at[at >= 0]] = run.picture_camera[at >= 0]
    return found


def choose_keyframes(
    wheel_segment: WheelSegment,
    stamps_ns: IntArray,
    tags_at: tuple[IntArray, IntArray],
    camera: IntArray,
    track_m: float,
) -> tuple[IntArray, IntArray]:
    """Choose keyframes among candidates by motion and by new tags, since the last keyframe with the same camera.

    Args:
        wheel_segment: wheel readings of the segment.
        stamps_ns: (n,) of the candidates.
        tags_at: offsets and tags from `tags_at_candidates`.
        camera: (n,) that took each picture.
        track_m: distance between the wheels.

    Returns:
        (K,) stamps of the keyframes, and (n,) the keyframe of each candidate, -1 where it is not used.
    """
    left_m, right_m = wheel_segment.at(stamps_ns)
    ahead_m, lateral_m = 0.5 * (left_m + right_m), wheel_segment.lateral_at(stamps_ns)
    turn_rad = (right_m - left_m) / track_m
    standing_m = _STANDING_TICKS * wheel_segment.quantum_m + _STANDING_M
    keyframe_of = np.full(len(stamps_ns), -1, dtype=np.int64)
    chosen = np.empty(len(stamps_ns), dtype=np.int64)
    thresholds = KEYFRAME_DISTANCE_M, KEYFRAME_TURN_RAD, standing_m, 0.5 * track_m
    last_of: IntArray = np.full(int(camera.max(initial=0)) + 1, -1)
    n = _choose(ahead_m, lateral_m, turn_rad, *tags_at, camera, thresholds, last_of, keyframe_of, chosen)
    return stamps_ns[chosen[:n]], keyframe_of


@njit
def _choose(
    ahead_m: FloatVector,
    lateral_m: FloatVector,
    turn_rad: FloatVector,
    begin: IntVector,
    tag: IntVector,
    camera: IntVector,
    thresholds: tuple[float, float, float, float],
    last_of: IntVector,
    keyframe_of: IntVector,
    chosen: IntVector,
) -> int:
    distance_m, turn_least_rad, standing_m, half_track_m = thresholds
    n = 0
    for i in range(len(ahead_m)):
        last = chosen[n - 1] if n else i
        moved_m = np.hypot(ahead_m[i] - ahead_m[last], lateral_m[i] - lateral_m[last])
        turned_rad = abs(turn_rad[i] - turn_rad[last])
        standing = moved_m + half_track_m * turned_rad <= standing_m  # bounds the motion of either wheel
        own = last_of[camera[i]]
        if not standing and own >= 0 and own != last:
            last = own
            moved_m = np.hypot(ahead_m[i] - ahead_m[last], lateral_m[i] - lateral_m[last])
            turned_rad = abs(turn_rad[i] - turn_rad[last])
        is_keyframe = n == 0 or (not standing and own < 0) or moved_m >= distance_m or turned_rad >= turn_least_rad
        if not is_keyframe and not standing:
            for k in range(begin[i], begin[i + 1]):
                is_new = True
                for other in range(begin[last], begin[last + 1]):
                    is_new = is_new and tag[other] != tag[k]
                is_keyframe = is_keyframe or is_new
            if not is_keyframe:
                continue
        if is_keyframe:
            chosen[n] = i
            n += 1
        if is_keyframe or standing:
            last_of[camera[i]] = chosen[n - 1]
        keyframe_of[i] = n - 1
    return n


def keyframe_at(wanted_ns: IntArray, stamps_ns: IntArray, keyframe_of: IntArray) -> IntArray:
    """Return the keyframe of each wanted stamp, -1 where the stamp is not a candidate or the candidate is not used."""
    at = np.minimum(np.searchsorted(stamps_ns, wanted_ns), len(stamps_ns) - 1)
    return np.where(stamps_ns[at] == wanted_ns, keyframe_of[at], -1)
