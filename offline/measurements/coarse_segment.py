"""A segment with fewer keyframes: enough to find the right valley, in a fraction of the time."""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.measurements.motion_model.motion_model import SegmentOdometry
from groundsbot.offline.measurements.segment import Segment

# Keyframes at least this far apart where tags are read, and where none is. Turns count like arcs of half a metre.
_OBSERVATION_SPACING_M: Final = 0.25
_EMPTY_SPACING_M: Final = 2.0
_TURN_RADIUS_M: Final = 0.5
# Over longer ways a composed motion is no longer linear in what the wheels err: headings that wander by 2 degrees a
# root metre bend 20 m without a tag by more than its covariance, which is straight, can say.
_COMPOSED_M: Final = 0.5


def coarse_keyframes(segment: Segment, share: float = 1.0) -> IntArray:
    """(k,) the first and the last keyframe of a segment and some in between, rising; at this share of the spacings."""
    n_keyframes = len(segment.stamps_ns)
    along_m = _along_m(segment)
    reads = np.bincount(segment.observations.keyframe, minlength=n_keyframes) > 0
    chosen, last_m = [0], 0.0
    for keyframe, (here_m, has_observations) in enumerate(zip(along_m.tolist(), reads.tolist(), strict=True)):
        if here_m - last_m >= share * (_OBSERVATION_SPACING_M if has_observations else _EMPTY_SPACING_M):
            chosen.append(keyframe)
            last_m = here_m
    if chosen[-1] != n_keyframes - 1:
        chosen.append(n_keyframes - 1)
    return np.array(chosen, dtype=np.int64)


def telling_keyframes(segment: Segment) -> IntArray:
    """(k,) keyframes that say all that a segment does, rising: those that read tags, and one each half metre."""
    cell = (_along_m(segment) / _COMPOSED_M).astype(np.int64)
    enters = np.flatnonzero(np.diff(cell, prepend=-1))
    return np.union1d(segment.observations.keyframe, np.append(enters, len(segment.stamps_ns) - 1))


def coarsen(segment: Segment, keyframes: IntArray) -> Segment:
    """The segment at some of its keyframes, the first one and the last among them; other observations are passed over.

    Args:
        segment: as driven.
        keyframes: (k,) rising.
    """
    new_index = np.full(len(segment.stamps_ns), -1)
    new_index[keyframes] = np.arange(len(keyframes))
    kept = segment.observations.where(new_index[segment.observations.keyframe] >= 0)
    seen, tag = np.unique(kept.tag, return_inverse=True)
    return replace(
        segment,
        stamps_ns=segment.stamps_ns[keyframes],
        odometry=_compose(segment.odometry, keyframes),
        tags=tuple(segment.tags[i] for i in seen),
        observations=replace(kept, keyframe=new_index[kept.keyframe], tag=tag),
    )


def _along_m(segment: Segment) -> FloatArray:
    """(K,) the way to each keyframe."""
    turned_m = _TURN_RADIUS_M * np.abs(segment.odometry.motion[:, 2])
    return np.concatenate([[0.0], np.cumsum(np.maximum(segment.odometry.distance_m, turned_m))])


def refine_poses(segment: Segment, keyframes: IntArray, poses: FloatArray, corrections: FloatArray) -> FloatArray:
    """(K, 3) poses of all keyframes from those of some (k, 3): dead reckoning on from each to the next."""
    driven = segment.odometry.dead_reckon(corrections)
    before = np.searchsorted(keyframes, np.arange(len(driven)), side="right") - 1
    return se2.compose(poses[before], se2.between(driven[keyframes[before]], driven))


def _compose(odometry: SegmentOdometry, keyframes: IntArray) -> SegmentOdometry:
    """Motions from each of some keyframes to the next; covariances and Jacobians carried to the step's end."""
    if len(keyframes) < 2:
        return odometry.part(0, 0)
    first = keyframes[:-1]
    poses = chain_motions(odometry.motion, np.zeros(3))
    end = np.repeat(keyframes[1:], np.diff(keyframes))
    to_end = se2.adjoint(se2.between(poses[end], poses[1:]))

    def carry(covariance: FloatArray) -> FloatArray:
        total: FloatArray = np.add.reduceat(to_end @ covariance @ to_end.swapaxes(-1, -2), first, axis=-3)
        return total

    return SegmentOdometry(
        motion=se2.between(poses[first], poses[keyframes[1:]]),
        covariance=carry(odometry.covariance),
        parts=replace(odometry.parts, unit=carry(odometry.parts.unit), rest=carry(odometry.parts.rest)),
        jacobian=np.add.reduceat(to_end @ odometry.jacobian, first, axis=0),
        distance_m=np.add.reduceat(odometry.distance_m, first),
        differences=odometry.differences
        and odometry.differences.at_steps(np.repeat(np.arange(len(first)), np.diff(keyframes))),
    )
