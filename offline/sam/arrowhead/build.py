"""Sets up the arrowhead system of a problem, and that of its skeleton: factors by pose, order of elimination."""

from dataclasses import replace

import numpy as np

from groundsbot.calib.foundation import BoolArray, IntArray
from groundsbot.offline.sam.arrowhead.preintegration import add_moments, compose
from groundsbot.offline.sam.arrowhead.prior_blocks import ends_in_top, prior_blocks
from groundsbot.offline.sam.arrowhead.system import Arrowhead, Skeleton
from groundsbot.offline.sam.arrowhead.tree import Couplings, build_tree
from groundsbot.offline.sam.factors.odometry_and_readings import (
    CalibrationPrior,
    Columns,
    OdometryFactors,
    ReadingFactors,
)
from groundsbot.offline.sam.factors.priors import NO_PRIORS, Priors
from groundsbot.offline.sam.linearisation.kernels import Free, ObservationArrays, OdometryArrays


def build_arrowhead(
    odometry: OdometryFactors,
    readings: ReadingFactors,
    prior: CalibrationPrior,
    columns: Columns,
    measured: Priors = NO_PRIORS,
) -> Arrowhead:
    """Sorts factors by pose and settles the order of elimination.

    Poses that odometry joins to the next one form a segment.
    """
    n_poses, n_tags = len(columns.poses), len(columns.tags)
    starts_segment = np.ones(n_poses + 1, dtype=np.bool_)
    starts_segment[odometry.first + 1] = False
    segment_start = np.flatnonzero(starts_segment)
    segment_of = np.cumsum(starts_segment[:-1]) - 1
    is_free = columns.calibration >= 0
    free_calibration = np.where(is_free, np.cumsum(is_free) - 1, -1)
    by_pose = _sorted_readings(readings)
    motions = compiled_motions(odometry, np.argsort(odometry.first, kind="stable"))
    first, parameters = motions.first, motions.parameters
    uses = np.zeros((len(segment_start) - 1, int(is_free.sum()) + 1), dtype=np.bool_)
    for segment, used in ((segment_of[first], parameters), (segment_of[by_pose.pose], by_pose.parameters)):
        uses[segment[:, None], free_calibration[used]] = True
    uses[:, -1] = False  # where held
    slot = np.where(uses, np.cumsum(uses, axis=1) - 1, -1)
    slot_start = np.concatenate([[0], np.cumsum(uses.sum(axis=1))])
    segments_in_top, tags_in_top = ends_in_top(measured, segment_start)
    tree = build_tree(
        Couplings(
            segment_start=segment_start,
            reading_pose=by_pose.pose,
            reading_tag=by_pose.tag,
            slot_start=slot_start,
            slots=np.nonzero(uses)[1],
            n_tags=n_tags,
            n_free=int(is_free.sum()),
            top_segments=segments_in_top,
            top_tags=tags_in_top,
        )
    )
    free = _free(columns.poses >= 0, columns.tags >= 0, free_calibration, by_pose)
    return Arrowhead(
        tree=tree,
        odometry=motions._replace(slots=slot[segment_of[first][:, None], free_calibration[parameters]]),
        readings=by_pose._replace(slots=slot[segment_of[by_pose.pose][:, None], free_calibration[by_pose.parameters]]),
        prior_sigma=prior.sigma,
        free=free,
        tangent=_tangent_order(columns),
        measured=prior_blocks(measured, tree, free),
    )


def compiled_motions(odometry: OdometryFactors, in_order: IntArray) -> OdometryArrays:
    """For compiled functions, in an order (M,); without slots."""
    first, motion = odometry.first[in_order], odometry.motion[in_order]
    motions = OdometryArrays(
        first=first,
        motion=np.column_stack([motion, np.cos(motion[:, 2]), np.sin(motion[:, 2])]),
        information=np.empty((len(first), 3, 3)),
        covariance=np.empty((len(first), 3, 3)),
        jacobian=np.ascontiguousarray(odometry.jacobian[in_order]),
        parameters=odometry.parameters[in_order],
        slots=np.full((len(first), 3), -1),
    )
    add_moments(motions, np.ascontiguousarray(odometry.whitening[in_order]))
    return motions


def reweigh(arrowhead: Arrowhead, odometry: OdometryFactors, readings: ReadingFactors) -> Arrowhead:
    """The same factors with the whitenings that these have."""
    own = arrowhead.odometry._replace(
        information=np.empty_like(arrowhead.odometry.information),
        covariance=np.empty_like(arrowhead.odometry.covariance),
    )
    add_moments(own, np.ascontiguousarray(odometry.whitening[np.argsort(odometry.first, kind="stable")]))
    in_order = readings.whitening[np.argsort(readings.pose, kind="stable")]
    return replace(arrowhead, odometry=own, readings=arrowhead.readings._replace(whitening=in_order))


def build_skeleton(whole: Arrowhead) -> Skeleton:
    """Keeps the poses that read something, those that are held in part, and the first of each segment."""
    tree, odometry, readings = whole.tree, whole.odometry, whole.readings
    is_kept = np.diff(tree.reading_start) > 0
    is_kept[whole.free.held_poses] = True
    is_kept[tree.segment_start[:-1]] = True
    if whole.measured is not None:
        is_kept[whole.measured.factors.starts.pose] = True
    index = np.where(is_kept, np.cumsum(is_kept) - 1, -1)
    segment_start = np.concatenate([index[tree.segment_start[:-1]], [int(is_kept.sum())]])
    n = int(is_kept.sum())
    # From each kept pose to the next, but for the last of a segment; the parameters are those of its motions.
    first = np.delete(np.arange(n), segment_start[1:] - 1)
    begins = np.searchsorted(odometry.first, np.flatnonzero(is_kept)[first])
    composed = OdometryArrays(
        first=first,
        motion=np.empty((len(first), 5)),
        information=np.empty((len(first), 3, 3)),
        covariance=np.empty((len(first), 3, 3)),
        jacobian=np.empty((len(first), 3, 3)),
        parameters=odometry.parameters[begins],
        slots=odometry.slots[begins],
    )
    compose(odometry, index, composed)
    places = _as_places(readings)._replace(pose=index[readings.pose])
    measured = NO_PRIORS if whole.measured is None else whole.measured.factors.among(index)
    segments_in_top, tags_in_top = ends_in_top(measured, segment_start)
    own_tree = build_tree(
        Couplings(
            segment_start=segment_start,
            reading_pose=places.pose,
            reading_tag=places.tag,
            slot_start=tree.slot_start,
            slots=tree.slots,
            n_tags=tree.n_tags,
            n_free=tree.n_calibration,
            top_segments=segments_in_top,
            top_tags=tags_in_top,
        )
    )
    free = _free(whole.free.poses[is_kept] > 0.0, whole.free.tags > 0.0, whole.free.calibration, places)
    own = Arrowhead(
        tree=own_tree,
        odometry=composed,
        readings=places,
        prior_sigma=whole.prior_sigma,
        free=free,
        tangent=np.arange(3 * n + 2 * tree.n_tags + tree.n_calibration),
        measured=prior_blocks(measured, own_tree, free),
    )
    return Skeleton(own, whole, index)


def _sorted_readings(readings: ReadingFactors) -> ObservationArrays:
    """By rising pose; slots are still missing."""
    order = np.argsort(readings.pose, kind="stable")
    parameters = np.column_stack([readings.mount_parameters, readings.scale_parameter, readings.camera_parameters])
    return ObservationArrays(
        pose=readings.pose[order],
        tag=readings.tag[order],
        value=readings.value[order],
        polar=readings.polar[order],
        whitening=readings.whitening[order],
        mount=readings.mount[order],
        by_camera=readings.by_camera[order],
        parameters=parameters[order],
        slots=parameters[order],
    )


def _free(poses: BoolArray, tags: BoolArray, calibration: IntArray, readings: ObservationArrays) -> Free:
    held_pose, held_tag = np.any(~poses, axis=1), np.any(~tags, axis=1)
    return Free(
        poses=poses.astype(np.float64),
        tags=tags.astype(np.float64),
        calibration=calibration,
        held_poses=np.flatnonzero(held_pose),
        held_tags=np.flatnonzero(held_tag),
        held_readings=np.flatnonzero(held_pose[readings.pose] | held_tag[readings.tag]),
    )


def _as_places(readings: ObservationArrays) -> ObservationArrays:
    """The same as places (x, y), with the covariance that the reading had there."""
    first, second = readings.value.T
    range_m, cos, sin = np.maximum(first, 1e-6), np.cos(second), np.sin(second)
    x_m, y_m = first * cos, first * sin
    by_place = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1) / range_m[:, None]], axis=-2)
    place_by = np.stack([np.stack([cos, sin], -1), np.stack([-y_m, x_m], -1)], axis=-1)
    polar = readings.polar[:, None]
    return readings._replace(
        value=np.where(polar, np.column_stack([x_m, y_m]), readings.value),
        by_camera=np.where(polar[..., None], place_by @ readings.by_camera, readings.by_camera),
        polar=np.zeros_like(readings.polar),
        whitening=np.where(polar[..., None], readings.whitening @ by_place, readings.whitening),
    )


def _tangent_order(columns: Columns) -> IntArray:
    """(n,) the arrowhead's column of each column of the tangent vector."""
    tangent = np.empty(columns.n, dtype=np.int64)
    is_free = columns.calibration >= 0
    all_columns = np.concatenate([columns.poses.reshape(-1), columns.tags.reshape(-1), columns.calibration[is_free]])
    free = all_columns >= 0
    tangent[all_columns[free]] = np.flatnonzero(free)
    return tangent
