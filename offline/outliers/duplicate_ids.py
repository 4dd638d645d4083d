"""Separation of tags with one id that appear in one picture.

A solve assumes one place for each tag, and the mean of two places is wrong for both. Detections of one id that do not
overlap in a picture are different tags. From picture to picture each observation is assigned to the tag whose last
observation is nearest, at most one observation of a picture to each tag. Each pass is followed by itself. Which of its
tags is which tag of another pass, and which are false detections, is decided from all observations
(`outliers.outliers`).
"""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.measurements import GAP_M, Observations, Segment

# Sigma of the drift of odometry between two observations of a tag.
_SLACK_M: Final = 0.01


def split_duplicates(segment: Segment) -> Segment:
    """Return the segment with an instance for each tag of a duplicated id, under names that no other segment has.

    A segment without two observations of an id in one picture is returned unchanged. So is an imported segment: several
    observations at its keyframes may be of one tag.
    """
    observations, tags = segment.observations, segment.tags
    if len(segment.run.positions.tag) or not len(observations):
        return segment
    pairs, count = np.unique(_pictures(segment) * len(tags) + observations.tag, return_counts=True)
    several = np.unique(pairs[count > 1] % len(tags))
    if not len(several):
        return segment
    keys = [tags[i] for i in observations.tag]
    for tag in several.tolist():
        own = np.flatnonzero(observations.tag == tag)
        for observation, number in zip(own.tolist(), _follow(segment, own), strict=True):
            keys[observation] = tags[tag]._replace(instance=f"{segment.name} {number}")
    instances = tuple(sorted(set(keys)))
    index = {tag: i for i, tag in enumerate(instances)}
    tag_of = np.array([index[key] for key in keys], dtype=np.int64)
    return replace(segment, tags=instances, observations=replace(observations, tag=tag_of))


def _pictures(segment: Segment) -> IntArray:
    """Return (M,) the picture of each observation, in order of keyframes, then of cameras."""
    observations = segment.observations
    return np.asarray(observations.keyframe * len(segment.run.robot.camera_names) + observations.camera)


def _follow(segment: Segment, own: IntArray) -> list[int]:
    """Return the number of the tag of each observation `own` (m,) of one id, tracked over time with odometry."""
    observations = segment.observations
    keyframe, picture = observations.keyframe[own], _pictures(segment)[own]
    bases = chain_motions(segment.odometry.motion, np.zeros(3))[keyframe]
    sensors = se2.compose(bases, segment.T_base_sensor[own])
    along_m = segment.along_m
    from scipy.optimize import linear_sum_assignment  # takes a tenth of a second to load, and is rarely needed

    range_m, bearing = observations.value[own].T
    in_camera = np.stack([range_m * np.cos(bearing), range_m * np.sin(bearing)], axis=-1)
    places = se2.apply(sensors, in_camera)
    numbers: list[int] = [0] * len(own)
    last: dict[int, int] = {}  # the last observation of each tag that is followed
    n_tags = 0
    for now in np.unique(picture).tolist():
        here = np.flatnonzero(picture == now)
        last = {tag: i for tag, i in last.items() if along_m[keyframe[here[0]]] - along_m[keyframe[i]] <= GAP_M}
        followed = list(last)
        of: dict[int, int] = {}
        if followed:
            cost = [
                [
                    _squared_sigmas(observations, int(own[i]), places[i] - places[last[tag]], sensors[i])
                    for tag in followed
                ]
                for i in here.tolist()
            ]
            rows, columns = linear_sum_assignment(np.array(cost))
            of = {int(row): followed[int(column)] for row, column in zip(rows, columns, strict=True)}
        for row, i in enumerate(here.tolist()):
            if row not in of:
                of[row], n_tags = n_tags, n_tags + 1
            numbers[i] = of[row]
            last[of[row]] = i
    return numbers


def _squared_sigmas(observations: Observations, observation: int, offset_m: FloatArray, T_camera: FloatArray) -> float:
    """Return the squared Mahalanobis length of the offset (2,) of an observation's place from another observation's.

    Both observations are given the covariance of the first.
    """
    range_m, bearing = observations.value[observation]
    cos, sin = np.cos(bearing + T_camera[2]), np.sin(bearing + T_camera[2])
    jacobian = np.array([[cos, -range_m * sin], [sin, range_m * cos]])
    covariance = 2.0 * jacobian @ observations.covariance[observation] @ jacobian.T + _SLACK_M**2 * np.eye(2)
    return float(offset_m @ np.linalg.solve(covariance, offset_m))
