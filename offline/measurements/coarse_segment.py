"""Segments with fewer keyframes, whose solution lies near the right local minimum and takes a fraction of the time."""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.measurements.covariance_components import propagate
from groundsbot.offline.measurements.motion_model.motion_model import SegmentOdometry
from groundsbot.offline.measurements.segment import Segment, index_observed_tags

# Least distance between keyframes with observations, and between those without. A turn counts as an arc of this radius.
_OBSERVATION_SPACING_M: Final = 0.25
_EMPTY_SPACING_M: Final = 2.0
_TURN_RADIUS_M: Final = 0.5
# Over longer distances a composed motion is not linear in the errors of the wheels: with heading noise of 2 degrees per
# root metre, 20 m without a tag bend by more than a Gaussian in the tangent space can represent.
_COMPOSED_M: Final = 0.5


def coarse_keyframes(segment: Segment, share: float = 1.0) -> IntArray:
    """Return (k,) increasing indices of keyframes: the first, the last, and some in between.

    Args:
        segment: to choose from.
        share: factor on the distances between keyframes.
    """
    n_keyframes = len(segment.stamps_ns)
    along_m = _along_m(segment)
    is_observing = np.bincount(segment.observations.keyframe, minlength=n_keyframes) > 0
    chosen, last_m = [0], 0.0
    for keyframe, (here_m, has_observations) in enumerate(zip(along_m.tolist(), is_observing.tolist(), strict=True)):
        if here_m - last_m >= share * (_OBSERVATION_SPACING_M if has_observations else _EMPTY_SPACING_M):
            chosen.append(keyframe)
            last_m = here_m
    if chosen[-1] != n_keyframes - 1:
        chosen.append(n_keyframes - 1)
    return np.array(chosen, dtype=np.int64)


def informative_keyframes(segment: Segment) -> IntArray:
    """Return (k,) increasing indices of the keyframes with observations, and of one in each half metre.

    A segment coarsened to these has the same information on tags as the whole.
    """
    cell = (_along_m(segment) / _COMPOSED_M).astype(np.int64)
    enters = np.flatnonzero(np.diff(cell, prepend=-1))
    return np.union1d(segment.observations.keyframe, np.append(enters, len(segment.stamps_ns) - 1))


def coarsen(segment: Segment, keyframes: IntArray) -> Segment:
    """Return the segment reduced to some of its keyframes; observations from other keyframes are left out.

    Args:
        segment: segment with all keyframes.
        keyframes: (k,) increasing indices, including the first and the last keyframe.
    """
    new_index = np.full(len(segment.stamps_ns), -1)
    new_index[keyframes] = np.arange(len(keyframes))
    kept = segment.observations.where(new_index[segment.observations.keyframe] >= 0)
    tags, kept = index_observed_tags(segment.tags, kept)
    return replace(
        segment,
        stamps_ns=segment.stamps_ns[keyframes],
        odometry=_compose(segment.odometry, keyframes),
        tags=tags,
        observations=replace(kept, keyframe=new_index[kept.keyframe]),
    )


def _along_m(segment: Segment) -> FloatArray:
    """Return (K,) the distance driven to each keyframe, where a turn on the spot counts as an arc."""
    arc_m = _TURN_RADIUS_M * np.abs(segment.odometry.motion[:, 2])
    return np.concatenate([[0.0], np.cumsum(np.maximum(segment.odometry.distance_m, arc_m))])


def refine_poses(segment: Segment, keyframes: IntArray, poses: FloatArray, corrections: FloatArray) -> FloatArray:
    """Return (K, 3) poses of all keyframes, by dead reckoning from the nearest earlier one of known pose.

    Args:
        segment: segment with all K keyframes.
        keyframes: (k,) increasing indices of those whose poses are known.
        poses: (k, 3) of these.
        corrections: (3,) of the wheels, as in `SegmentOdometry.dead_reckon`.
    """
    dead_reckoned = segment.odometry.dead_reckon(corrections)
    before = np.searchsorted(keyframes, np.arange(len(dead_reckoned)), side="right") - 1
    return se2.compose(poses[before], se2.between(dead_reckoned[keyframes[before]], dead_reckoned))


def _compose(odometry: SegmentOdometry, keyframes: IntArray) -> SegmentOdometry:
    """Compose the motions between successive keyframes; covariances and Jacobians are in the tangent at its end."""
    if len(keyframes) < 2:
        return odometry.part(0, 0)
    first = keyframes[:-1]
    poses = chain_motions(odometry.motion, np.zeros(3))
    end = np.repeat(keyframes[1:], np.diff(keyframes))
    to_end = se2.adjoint(se2.between(poses[end], poses[1:]))

    def sum_at_end(covariance: FloatArray) -> FloatArray:
        total: FloatArray = np.add.reduceat(propagate(to_end, covariance), first, axis=-3)
        return total

    return SegmentOdometry(
        motion=se2.between(poses[first], poses[keyframes[1:]]),
        covariance=sum_at_end(odometry.covariance),
        parts=replace(odometry.parts, unit=sum_at_end(odometry.parts.unit), rest=sum_at_end(odometry.parts.rest)),
        jacobian=np.add.reduceat(to_end @ odometry.jacobian, first, axis=0),
        distance_m=np.add.reduceat(odometry.distance_m, first),
        differences=odometry.differences
        and odometry.differences.at_steps(np.repeat(np.arange(len(first)), np.diff(keyframes))),
    )
