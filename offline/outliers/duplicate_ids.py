"""Two tags with one id in one picture: they stay two observations, and two tags for as long as they are followed.

An id hangs in one place, or so a solve takes it; and an average of two places is none. Within a picture quads that do
not overlap are different tags. From picture to picture each observation belongs to the tag whose last observation is
nearest, no two of one picture to one tag. Whoever passes by once more follows them anew: which of them is which, and
whether one was a false detection, the evidence of all observations tells (`outliers.outliers`).
"""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.optimize import linear_sum_assignment

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.measurements import GAP_M, Observations, Segment

# Beside its covariance, how far an observation is off from what the last one made expect.
_SLACK_M: Final = 0.01


def split_duplicates(segment: Segment) -> Segment:
    """The segment with as many instances of an id as were seen at once, under names that no other segment has."""
    observations, tags = segment.observations, segment.tags
    if len(segment.run.positions.tag) or not len(
        observations
    ):  # imported: several observations of a keyframe may be of one tag
        return segment
    pairs, count = np.unique(observations.keyframe * len(tags) + observations.tag, return_counts=True)
    several = np.unique(pairs[count > 1] % len(tags))
    if not len(several):
        return segment
    keys = [tags[i] for i in observations.tag]
    for tag in several.tolist():
        own = np.flatnonzero(observations.tag == tag)
        for observation, number in zip(own.tolist(), _follow(segment, own), strict=True):
            keys[observation] = tags[tag]._replace(instance=f"{segment.name} {number}")
    apart = tuple(sorted(set(keys)))
    index = {tag: i for i, tag in enumerate(apart)}
    tag_of = np.array([index[key] for key in keys], dtype=np.int64)
    return replace(segment, tags=apart, observations=replace(observations, tag=tag_of))


def _follow(segment: Segment, own: IntArray) -> list[int]:
    """Return the number of the tag of each observation `own` of one id, in order of time, followed by odometry."""
    observations = segment.observations
    poses = se2.compose(chain_motions(segment.odometry.motion, np.zeros(3)), segment.T_base_camera)
    along_m = segment.along_m
    keyframe = observations.keyframe[own]
    range_m, bearing = observations.value[own].T
    in_camera = np.stack([range_m * np.cos(bearing), range_m * np.sin(bearing)], axis=-1)
    places = se2.apply(poses[keyframe], in_camera)
    numbers: list[int] = [0] * len(own)
    last: dict[int, int] = {}  # of each tag that is followed, its last observation
    n_tags = 0
    for now in np.unique(keyframe).tolist():
        here = np.flatnonzero(keyframe == now)
        last = {tag: i for tag, i in last.items() if along_m[now] - along_m[keyframe[i]] <= GAP_M}
        followed = list(last)
        of: dict[int, int] = {}
        if followed:
            off_m = [[places[i] - places[last[tag]] for tag in followed] for i in here.tolist()]
            cost = [
                [_apart(observations, int(own[i]), off, poses[now]) for off in row]
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


def _apart(observations: Observations, observation: int, off_m: FloatArray, T_camera: FloatArray) -> float:
    """Squared sigmas between an observation's place and another one's, as if both were as uncertain as this one."""
    range_m, bearing = observations.value[observation]
    cos, sin = np.cos(bearing + T_camera[2]), np.sin(bearing + T_camera[2])
    turn = np.array([[cos, -range_m * sin], [sin, range_m * cos]])
    covariance = 2.0 * turn @ observations.covariance[observation] @ turn.T + _SLACK_M**2 * np.eye(2)
    return float(off_m @ np.linalg.solve(covariance, off_m))
