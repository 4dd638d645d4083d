"""Construction of the arrowhead system of a problem: factors in order of poses, and the order of elimination."""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.sam.arrowhead.dissection import MOST_WITHOUT_OWN
from groundsbot.offline.sam.arrowhead.fronts import fill_slots, tag_segments_of
from groundsbot.offline.sam.arrowhead.prior_blocks import ends_in_top, prior_blocks
from groundsbot.offline.sam.arrowhead.system import Arrowhead
from groundsbot.offline.sam.arrowhead.tree import Couplings, build_tree
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    Columns,
    ObservationFactors,
    OdometryFactors,
)
from groundsbot.offline.sam.factors.priors import NO_PRIORS, Priors
from groundsbot.offline.sam.linearisation.kernels import Free, ObservationArrays, OdometryArrays
from groundsbot.offline.sam.linearisation.odometry import information_of


class Kept(NamedTuple):
    """What is to be eliminated in the top, besides the ends of measured distances and the tags of a joint prior.

    Attributes:
        segments: segments whose first pose is, in the order of poses.
        tags: tags that are.
    """

    segments: IntArray
    tags: IntArray


NONE_KEPT: Final = Kept(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))


def build_arrowhead(
    odometry: OdometryFactors,
    observations: ObservationFactors,
    prior: CalibrationPrior,
    columns: Columns,
    measured: Priors = NO_PRIORS,
    kept: Kept = NONE_KEPT,
) -> Arrowhead:
    """Sort the factors by pose and compute the order of elimination.

    Consecutive poses that are connected by odometry form a segment.
    """
    n_poses, n_tags = len(columns.poses), len(columns.tags)
    segment_start = segment_starts(odometry, n_poses)
    is_free = columns.calibration >= 0
    free_calibration, n_free = np.where(is_free, np.cumsum(is_free) - 1, -1), int(is_free.sum())
    by_pose = _sorted_observations(observations)
    motions = compiled_motions(odometry, _order(odometry.first))
    slot = np.full((len(segment_start) - 1, n_free), -1, dtype=np.int32)
    fill_slots(segment_start, motions.first, motions.parameters, free_calibration, slot, motions.slots, False)
    fill_slots(segment_start, by_pose.pose, by_pose.parameters, free_calibration, slot, by_pose.slots, False)
    uses = slot >= 0
    segments_in_top, tags_in_top = ends_in_top(measured, segment_start)
    top_segments = np.union1d(segments_in_top, kept.segments)
    is_own = _own_calibration(uses, top_segments, is_free, prior, measured)
    own_first = np.argsort(~is_own, kind="stable")
    in_order = uses[:, own_first]
    slot[:, own_first] = np.where(in_order, np.cumsum(in_order, axis=1) - 1, -1)
    slot_start = np.concatenate([[0], np.cumsum(uses.sum(axis=1))])
    tag_segment, tag_segment_start, tag_segments = tag_segments_of(segment_start, by_pose.pose, by_pose.tag, n_tags)
    tree = build_tree(
        Couplings(
            segment_start=segment_start,
            observation_pose=by_pose.pose,
            observation_tag=by_pose.tag,
            slot_start=slot_start,
            slots=own_first[np.nonzero(in_order)[1]],
            n_own_slots=(uses & is_own).sum(axis=1),
            calibration_in_top=np.where(is_own, -1, np.cumsum(~is_own) - 1),
            tag_segment_start=tag_segment_start,
            tag_segments=tag_segments,
            n_tags=n_tags,
            n_free=n_free,
            top_segments=top_segments,
            top_tags=np.union1d(tags_in_top, kept.tags),
        )
    )
    free = _free(columns.poses >= 0, columns.tags >= 0, free_calibration, by_pose)
    fill_slots(segment_start, motions.first, motions.parameters, free_calibration, slot, motions.slots, True)
    fill_slots(segment_start, by_pose.pose, by_pose.parameters, free_calibration, slot, by_pose.slots, True)
    return Arrowhead(
        tree=tree,
        odometry=motions,
        observations=by_pose._replace(tag_segment=tag_segment),
        prior=prior,
        free=free,
        tangent=_tangent_order(columns),
        measured=prior_blocks(measured, tree, free),
    )


def _own_calibration(
    uses: BoolArray, top_segments: IntArray, is_free: BoolArray, prior: CalibrationPrior, measured: Priors
) -> BoolArray:
    """Return whether each free calibration parameter (C,) is that of a segment alone, and eliminated by its node.

    Args:
        uses: (S, C) whether the factors of each segment depend on each parameter.
        top_segments: segments whose first pose, which is coupled with calibration, is in the top.
        is_free: whether each parameter is free, fixed ones included.
        prior: whose joint part couples parameters in the top.
        measured: likewise.
    """
    if len(uses) <= MOST_WITHOUT_OWN:
        return np.zeros(uses.shape[1], dtype=np.bool_)
    is_coupled = is_in_joint_prior(prior, measured)[is_free]
    return np.asarray((uses.sum(axis=0) == 1) & ~uses[top_segments].any(axis=0) & ~is_coupled)


def is_in_joint_prior(prior: CalibrationPrior, measured: Priors) -> BoolArray:
    """Return whether each calibration parameter (C,), fixed ones included, is in a joint prior with others."""
    is_coupled = np.zeros(len(prior.sigma), dtype=np.bool_)
    if len(prior.rows):
        is_coupled |= (prior.rows != 0.0).any(axis=0)
    is_coupled[measured.known.calibration] = True
    return is_coupled


def segment_starts(odometry: OdometryFactors, n_poses: int) -> IntArray:
    """Return the first pose of each segment, then the number of poses (S + 1,)."""
    starts_segment = np.ones(n_poses + 1, dtype=np.bool_)
    starts_segment[odometry.first + 1] = False
    return np.flatnonzero(starts_segment)


def compiled_motions(odometry: OdometryFactors, in_order: IntArray | slice) -> OdometryArrays:
    """Return the odometry factors in an order (M,) for compiled functions, without slots."""
    first, motion = odometry.first[in_order], odometry.motion[in_order]
    return OdometryArrays(
        first=first,
        motion=np.column_stack([motion, np.cos(motion[:, 2]), np.sin(motion[:, 2])]),
        information=_information(odometry.whitening[in_order]),
        jacobian=np.ascontiguousarray(odometry.jacobian[in_order]),
        parameters=np.ascontiguousarray(odometry.parameters[in_order], dtype=np.int32),
        slots=np.full(odometry.parameters.shape, -1, dtype=np.int32),
    )


def reweigh(arrowhead: Arrowhead, odometry: OdometryFactors, observations: ObservationFactors) -> Arrowhead:
    """Return the arrowhead with the whitenings of these factors, which must be otherwise the same."""
    whitening = odometry.whitening[_order(odometry.first)]
    own = arrowhead.odometry._replace(information=_information(whitening))
    in_order = np.ascontiguousarray(observations.whitening[_order(observations.pose)])
    return replace(arrowhead, odometry=own, observations=arrowhead.observations._replace(whitening=in_order))


def _information(whitening: FloatArray) -> FloatArray:
    """Return W^T W (M, 3, 3)."""
    return information_of(np.ascontiguousarray(whitening))


def _order(poses: IntArray) -> IntArray | slice:
    """Return the order of factors by their poses; all of them, without a copy, where they are in order already."""
    return slice(None) if (poses[1:] >= poses[:-1]).all() else np.argsort(poses, kind="stable")


def _sorted_observations(observations: ObservationFactors) -> ObservationArrays:
    """Return the factors in order of poses, without slots and tag segments."""
    order = _order(observations.pose)
    arrays = observations.arrays
    return ObservationArrays(*(np.ascontiguousarray(getattr(arrays, name)[order]) for name in arrays._fields))


def _free(poses: BoolArray, tags: BoolArray, calibration: IntArray, observations: ObservationArrays) -> Free:
    held_pose = ~(poses[:, 0] & poses[:, 1] & poses[:, 2])  # a reduction over so short an axis takes ten times as long
    held_tag = ~(tags[:, 0] & tags[:, 1])
    return Free(
        poses=poses.astype(np.float64),
        tags=tags.astype(np.float64),
        calibration=calibration,
        held_poses=np.flatnonzero(held_pose),
        held_tags=np.flatnonzero(held_tag),
        held_observations=np.flatnonzero(held_pose[observations.pose] | held_tag[observations.tag]),
    )


def _tangent_order(columns: Columns) -> IntArray:
    """Return the arrowhead's column (n,) of each column of the tangent vector."""
    tangent = np.empty(columns.n, dtype=np.int64)
    is_free = columns.calibration >= 0
    all_columns = np.concatenate([columns.poses.reshape(-1), columns.tags.reshape(-1), columns.calibration[is_free]])
    free = all_columns >= 0
    tangent[all_columns[free]] = np.flatnonzero(free)
    return tangent
