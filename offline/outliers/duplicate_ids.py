"""Two tags with one id in one picture: they stay two readings, and two tags for as long as they are followed.

An id hangs in one place, or so a solve takes it; and an average of two places is none. Within a picture quads that do
not overlap are different tags. From picture to picture each reading belongs to the tag whose last reading is nearest,
no two of one picture to one tag. Whoever passes by once more follows them anew: which of them is which, and whether one
was a false detection, the evidence of all readings tells (`outliers.outliers`).
"""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.measurements import GAP_M, Readings, Segment

# Beside its covariance, how far a reading is off from what the last one made expect.
_SLACK_M: Final = 0.01


def split_duplicates(segment: Segment) -> Segment:
    """The segment with as many instances of an id as were seen at once, under names that no other segment has."""
    readings, tags = segment.readings, segment.tags
    if len(segment.run.positions.tag) or not len(
        readings
    ):  # imported: several readings of a keyframe may be of one tag
        return segment
    pairs, count = np.unique(readings.keyframe * len(tags) + readings.tag, return_counts=True)
    several = np.unique(pairs[count > 1] % len(tags))
    if not len(several):
        return segment
    keys = [tags[i] for i in readings.tag]
    for tag in several.tolist():
        own = np.flatnonzero(readings.tag == tag)
        for reading, number in zip(own.tolist(), _follow(segment, own), strict=True):
            keys[reading] = tags[tag]._replace(instance=f"{segment.name} {number}")
    apart = tuple(sorted(set(keys)))
    index = {tag: i for i, tag in enumerate(apart)}
    tag_of = np.array([index[key] for key in keys], dtype=np.int64)
    return replace(segment, tags=apart, readings=replace(readings, tag=tag_of))


def _follow(segment: Segment, own: IntArray) -> list[int]:
    """Numbers of the tags that readings `own` of one id are of, in order of time; the wheels tell where they hang."""
    readings = segment.readings
    poses = se2.compose(chain_motions(segment.odometry.motion, np.zeros(3)), segment.T_base_camera)
    along_m = segment.along_m
    keyframe = readings.keyframe[own]
    range_m, bearing = readings.value[own].T
    in_camera = np.stack([range_m * np.cos(bearing), range_m * np.sin(bearing)], axis=-1)
    places = se2.apply(poses[keyframe], in_camera)
    numbers: list[int] = [0] * len(own)
    last: dict[int, int] = {}  # of each tag that is followed, its last reading
    n_tags = 0
    for now in np.unique(keyframe).tolist():
        here = np.flatnonzero(keyframe == now)
        last = {tag: i for tag, i in last.items() if along_m[now] - along_m[keyframe[i]] <= GAP_M}
        followed = list(last)
        of: dict[int, int] = {}
        if followed:
            off_m = [[places[i] - places[last[tag]] for tag in followed] for i in here.tolist()]
            cost = [
                [_apart(readings, int(own[i]), off, poses[now]) for off in row]
                for i, row in zip(here.tolist(), off_m, strict=True)
            ]
            rows, columns = linear_sum_assignment(np.array(cost))
            of = {int(row): followed[int(column)] for row, column in zip(rows, columns, strict=True)}
        for row, i in enumerate(here.tolist()):
            if row not in of:
                of[row], n_tags = n_tags, n_tags + 1
            numbers[i] = of[row]
            last[of[row]] = i
    return numbers


def _apart(readings: Readings, reading: int, off_m: FloatArray, T_camera: FloatArray) -> float:
    """Squared sigmas between a reading's place and another one's, as if both were as uncertain as this one."""
    range_m, bearing = readings.value[reading]
    cos, sin = np.cos(bearing + T_camera[2]), np.sin(bearing + T_camera[2])
    turn = np.array([[cos, -range_m * sin], [sin, range_m * cos]])
    covariance = 2.0 * turn @ readings.covariance[reading] @ turn.T + _SLACK_M**2 * np.eye(2)
    return float(off_m @ np.linalg.solve(covariance, off_m))
