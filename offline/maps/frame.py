"""Change of a component's frame: everything is moved, and covariances are transformed to the new datum.

A covariance is that of errors relative to a frame, which something of the map itself holds: the start of a run, or some
tags. With G (N, 3) the Jacobian of all starts and tags with respect to a small rigid motion of the map, and L (3, N)
the motion that an error gives the frame (L G = I), the error relative to the frame is S e with S = I - G L, and its
covariance S C S^T (S-transformation: Baarda, "S-transformations and criterion matrices", 1973). A start's L takes that
start's own error. That of tags with weights W is (G^T W G)^-1 G^T W, their error's least-squares motion; with equal
weights the trace of the tags' covariance is the least of all frames (inner constraints).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.maps.archive import ArchivedCalibration
from groundsbot.offline.maps.datum import TagDatum, datum_centre
from groundsbot.offline.maps.result import Component, RunResult, StartToStart, TagPose

# With more runs, vectors between starts are those from the first one alone.
MOST_PAIRED_RUNS: Final = 50

# Derivative of a tag's height and rotation with respect to a shift and rotation of the map.
_ATTITUDE_BY_MOTION: Final = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class CrossCovariances(NamedTuple):
    """What a change of frame needs beside the joint covariance of R starts and T tags, in axes of the map.

    Attributes:
        calibration_with_starts: (C, 3 R).
        attitudes: (T, 4, 3 R + 2 T) of each tag's height and rotation with starts and tags; None without corners, or
            where they were not kept: covariances of tags' poses in space are then unknown in the new frame.
    """

    calibration_with_starts: FloatArray
    attitudes: FloatArray | None


def move_to_start(component: Component, run: str, cross: CrossCovariances) -> Component:
    """Return the component in the frame of a run's start."""
    index = [each.name for each in component.runs].index(run)
    T_map_start = component.runs[index].T_map_start
    motion_by_error = np.zeros((3, len(component.joint_covariance)))
    motion_by_error[:, 3 * index : 3 * index + 3] = np.eye(3)
    moved = _move(component, se2.inverse(T_map_start), motion_by_error, T_map_start[:2], cross)
    return replace(moved, frame_run=run, datum=None)


def move_to_tags(component: Component, datum: TagDatum, T_frame_map: FloatArray, cross: CrossCovariances) -> Component:
    """Return the component in a frame that tags hold.

    Args:
        component: component in any frame.
        datum: datum of the frame; its tags determine a rotation.
        T_frame_map: (3,) pose of the component's frame in it.
        cross: cross-covariance of the component.
    """
    centre, motion_by_error = _motion_of_tags(component, datum.weights)
    moved = _move(component, T_frame_map, motion_by_error, centre, cross)
    return replace(moved, frame_run=None, datum=datum)


def relative_to_tags(component: Component, weights: FloatArray) -> FloatArray:
    """Return the joint covariance (3 R + 2 T, 3 R + 2 T) of starts and tags relative to a mean of tags.

    Shift and rotation of the map are removed by least squares on tags with weights (T,). Axes are those of the map.
    """
    centre, motion_by_error = _motion_of_tags(component, weights)
    project = np.eye(len(component.joint_covariance)) - motion_jacobian(component, centre) @ motion_by_error
    return np.asarray(project @ component.joint_covariance @ project.T)


def tags_own_axes(component: Component) -> FloatArray:
    """Return T_frame_map (3,): origin at the tags' mean, x along their largest extent.

    Of the two directions of x the one within 90 degrees of the component's own.
    """
    places = _places(component)
    centre = places.mean(axis=0)
    along = np.linalg.eigh((places - centre).T @ (places - centre))[1][:, 1]
    along = -along if along[0] < 0.0 else along
    return se2.inverse(np.array([*centre, np.arctan2(along[1], along[0])]))


def motion_jacobian(component: Component, centre_m: FloatArray) -> FloatArray:
    """Return the derivative (3 R + 2 T, 3) of starts and tags by a shift, and a rotation about a point (2,)."""
    starts = np.array([run.T_map_start[:2] for run in component.runs]).reshape(-1, 2)
    of_starts = np.tile(np.eye(3), (len(starts), 1, 1))
    of_starts[:, :2, 2] = _perpendicular(starts - centre_m)
    of_tags = np.tile(np.eye(2, 3), (len(component.tags), 1, 1))
    of_tags[:, :, 2] = _perpendicular(_places(component) - centre_m)
    return np.concatenate([of_starts.reshape(-1, 3), of_tags.reshape(-1, 3)])


def start_vectors(runs: Sequence[RunResult], joint: FloatArray) -> tuple[StartToStart, ...]:
    """Return the vectors between all starts, from the joint covariance that begins with the starts.

    With more than `MOST_PAIRED_RUNS` only those from the first start, since pairs grow with the square of the runs.
    """
    found = []
    for i in range(len(runs) if len(runs) <= MOST_PAIRED_RUNS else 1):
        for j in range(i + 1, len(runs)):
            first, second = slice(3 * i, 3 * i + 2), slice(3 * j, 3 * j + 2)
            between = joint[first, second]
            covariance = joint[first, first] + joint[second, second] - between - between.T
            vector_m = runs[j].T_map_start[:2] - runs[i].T_map_start[:2]
            found.append(StartToStart(runs[i].name, runs[j].name, vector_m, covariance))
    return tuple(found)


def _motion_of_tags(component: Component, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the centre (2,) of tags, and the motion (3, 3 R + 2 T) about it that an error of theirs has at least."""
    centre = datum_centre(_places(component), weights)
    if centre is None:
        raise ValueError("the tags of the datum determine no rotation")
    weight = np.concatenate([np.zeros(3 * len(component.runs)), np.repeat(weights, 2)])
    weighted = motion_jacobian(component, centre) * weight[:, None]
    normal = weighted.T @ motion_jacobian(component, centre)
    return centre, np.asarray(np.linalg.solve(normal, weighted.T))


def _move(
    component: Component,
    T_new_map: FloatArray,
    motion_by_error: FloatArray,
    centre_m: FloatArray,
    cross: CrossCovariances,
) -> Component:
    old = component.joint_covariance
    jacobian = motion_jacobian(component, centre_m)
    to_new = _turn_blocks(component, T_new_map[2]) @ (np.eye(len(old)) - jacobian @ motion_by_error)
    of_motion = motion_by_error @ old @ motion_by_error.T
    joint = to_new @ old @ to_new.T
    joint = 0.5 * (joint + joint.T)
    runs = tuple(
        replace(
            run,
            T_map_start=se2.compose(T_new_map, run.T_map_start),
            covariance=joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3],
            T_map_base=se2.compose(T_new_map, run.T_map_base),
        )
        for i, run in enumerate(component.runs)
    )
    first = 3 * len(runs)
    tags = []
    for i, tag in enumerate(component.tags):
        rows = slice(first + 2 * i, first + 2 * i + 2)
        pose = tag.pose
        if pose is not None:
            covariance = np.full((6, 6), np.nan)
            if cross.attitudes is not None:
                with_motion = np.concatenate([old[rows], cross.attitudes[i]]) @ motion_by_error.T
                by_motion = np.concatenate([jacobian[rows], _ATTITUDE_BY_MOTION])
                left = with_motion @ by_motion.T
                covariance = pose.covariance - left - left.T + by_motion @ of_motion @ by_motion.T
            pose = _turn_pose(pose, covariance, T_new_map[2])
        place_m = se2.apply(T_new_map, tag.position_m)
        tags.append(replace(tag, position_m=place_m, covariance=joint[rows, rows], pose=pose))
    return replace(
        component,
        runs=runs,
        tags=tuple(tags),
        joint_covariance=joint,
        start_to_start=start_vectors(runs, joint),
        calibration=_move_calibration(component.calibration, cross, to_new, first),
    )


def _turn_pose(pose: TagPose, covariance: FloatArray, turn_rad: float) -> TagPose:
    """Return a tag's pose in the new frame, given its covariance (6, 6) relative to it in the old axes."""
    rotation = Rotation.from_rotvec([0.0, 0.0, turn_rad])
    axes = np.kron(np.eye(2), rotation.as_matrix())
    turned = axes @ covariance @ axes.T
    quaternion = (rotation * Rotation.from_quat(pose.quaternion_xyzw)).as_quat(canonical=True)
    return replace(pose, quaternion_xyzw=quaternion, covariance=0.5 * (turned + turned.T))


def _move_calibration(
    kept: ArchivedCalibration | None, cross: CrossCovariances, to_new: FloatArray, first_tag: int
) -> ArchivedCalibration | None:
    if kept is None:
        return None
    with_all = np.concatenate([cross.calibration_with_starts, kept.with_tags], axis=1)
    return replace(kept, with_tags=(with_all @ to_new.T)[:, first_tag:])


def _turn_blocks(component: Component, turn_rad: float) -> FloatArray:
    """Return the rotation (N, N) of the axes of all starts and tags."""
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    n_starts, n = 3 * len(component.runs), len(component.joint_covariance)
    x = np.concatenate([np.arange(0, n_starts, 3), np.arange(n_starts, n, 2)])
    turn = np.eye(n)
    turn[x, x] = turn[x + 1, x + 1] = cos
    turn[x, x + 1], turn[x + 1, x] = -sin, sin
    return turn


def _places(component: Component) -> FloatArray:
    return np.array([tag.position_m for tag in component.tags]).reshape(-1, 2)


def _perpendicular(vectors: FloatArray) -> FloatArray:
    """Return vectors (n, 2) rotated by 90 degrees."""
    return np.stack([-vectors[:, 1], vectors[:, 0]], axis=-1)
