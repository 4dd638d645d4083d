"""Compiled parts of `corners.initial_tag_poses`: candidate poses and their fit."""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.corners.kernels.lens import CENTRE, distort
from groundsbot.offline.corners.kernels.planar_pose import ray_through, square_poses
from groundsbot.offline.corners.kernels.step import turn_by
from groundsbot.offline.corners.kernels.view import (
    CameraPose,
    CornerObservations,
    SpatialValues,
    base_before,
    set_mount,
)
from groundsbot.offline.corners.kernels.view_selection import ByTag
from groundsbot.offline.foundation import borrow, inline, inner, njit
from groundsbot.offline.sam import Loss, eliminate_columns, loss_and_weight, multiply

# Yaw of the two upright candidates from the line of sight. Most tags are mounted upright, and a detection with little
# perspective may have no planar pose.
_YAW_RAD: Final = 0.6
POSES: Final = 4  # candidates of a detection: two planar poses, two upright ones
SAME_RAD: Final = 0.01  # fits with closer rotations are the same local minimum
_STEPS: Final = 5
_DAMPING: Final = 1e-6
# In squared sigmas: precise enough to select a candidate and to start a solve.
_TOLERANCE: Final = 1e-4
_SETTLED: Final = 0.01  # predicted decrease relative to the loss, below which the local minimum is known
_ROW: Final = 8  # columns of the normal equations, padded with zeros for vectorisation


@njit
def rays_of(detections: CornerObservations, lenses: FloatArray, which: IntArray, out: FloatArray) -> None:
    """Set unit rays (C, 4, 3) to the corners of some detections; NaN where none was found."""
    detections = borrow(detections)
    for i in range(len(which)):
        for k in range(4):
            ray_through(lenses[detections.camera[which[i]]], detections.corners_px[which[i], k], out[i, k])


@njit
def candidate_poses(
    detections: CornerObservations,
    values: SpatialValues,
    which: IntArray,
    rays: FloatArray,
    places: FloatArray,
    turns: FloatArray,
) -> None:
    """Set positions (C, 4, 3) and rotations (C, 4, 3, 3) in map of candidate tag poses for rays (C, 4, 3).

    Each detection has two planar poses, NaN if there are none, and two upright ones at the planar distance of the tag.
    """
    detections, values = borrow(detections), borrow(values)
    eye = CameraPose(np.full(6, np.nan), np.empty((3, 3)), np.empty((3, 3)))
    W, place, in_map = np.empty((3, 3)), np.empty(3), np.empty(3)
    in_camera, seen = np.empty((2, 3)), np.empty((2, 3, 3))
    for i in range(len(which)):
        m = which[i]
        set_mount(detections, m, values.calibration, eye)
        pose = values.poses[detections.pose[m]]
        _camera_at(eye, pose[0], pose[1], pose[2], W, place)
        if square_poses(rays[i], detections.side_m[m], seen, in_camera):
            for s in range(2):
                for a in range(3):
                    places[i, s, a] = (
                        W[0, a] * in_camera[s, 0] + W[1, a] * in_camera[s, 1] + W[2, a] * in_camera[s, 2] + place[a]
                    )
                    for b in range(3):
                        turns[i, s, a, b] = W[0, a] * seen[s, 0, b] + W[1, a] * seen[s, 1, b] + W[2, a] * seen[s, 2, b]
        else:
            places[i, :2], turns[i, :2] = np.nan, np.nan
        for a in range(3):
            in_map[a] = 0.0
            for k in range(4):
                in_map[a] += 0.25 * (W[0, a] * rays[i, k, 0] + W[1, a] * rays[i, k, 1] + W[2, a] * rays[i, k, 2])
        tag = values.tags[detections.tag[m]]
        away = np.hypot(tag[0] - place[0], tag[1] - place[1]) / np.hypot(in_map[0], in_map[1])
        for s in range(2):
            yaw = np.arctan2(-in_map[1], -in_map[0]) + (_YAW_RAD if s else -_YAW_RAD)
            cos, sin, R = np.cos(yaw), np.sin(yaw), turns[i, 2 + s]
            R[0, 0], R[0, 1], R[0, 2] = -sin, 0.0, cos
            R[1, 0], R[1, 1], R[1, 2] = cos, 0.0, sin
            R[2, 0], R[2, 1], R[2, 2] = 0.0, 1.0, 0.0
            for a in range(3):
                places[i, 2 + s, a] = place[a] + away * in_map[a]


@inner
def _camera_at(eye: CameraPose, x: float, y: float, heading: float, W: FloatArray, place: FloatArray) -> None:
    """Set R_camera_map (3, 3) and the position of the camera in map (3,) for a base pose (x, y, heading)."""
    cos, sin, mount = np.cos(heading), np.sin(heading), eye.mount
    for a in range(3):
        forward, left = eye.rotation[0, a], eye.rotation[1, a]
        W[a, 0], W[a, 1], W[a, 2] = cos * forward - sin * left, sin * forward + cos * left, eye.rotation[2, a]
    place[0], place[1] = x + cos * mount[0] - sin * mount[1], y + sin * mount[0] + cos * mount[1]
    place[2] = mount[2]


@njit
def fit(
    detections: CornerObservations,
    lenses: FloatArray,
    loss: Loss,
    values: SpatialValues,
    selected: ByTag,
    tags: IntArray,
    places: FloatArray,
    turns: FloatArray,
) -> FloatArray:
    """Fit candidate poses of tags (C,), positions (C, 3) and rotations (C, 3, 3), each to some detections of its tag.

    Robot poses and calibration are fixed.

    Returns:
        The losses (C,). They are infinite where a lens has no image of a corner, and for a candidate that converges to
        the same local minimum as an earlier one of its tag.
    """
    detections, values, selected = borrow(detections), borrow(values), borrow(selected)
    axes, eyes = _camera_poses(detections, values, selected.order)
    losses, is_settled = np.full(len(tags), np.inf), np.zeros(len(tags), dtype=np.bool_)
    normal, rows, step = np.empty((7, _ROW)), np.zeros((8, _ROW)), np.empty(6)
    p, R, turn = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    for c in range(len(tags)):
        p[:], R[:] = places[c], turns[c]
        for _ in range(_STEPS):
            if _is_duplicate(tags, turns, is_settled, c, R):
                losses[c] = np.inf
                break
            total = 0.0
            normal[:] = 0.0
            for i in range(selected.begin[tags[c]], selected.begin[tags[c] + 1]):
                total += _add_detection(
                    detections,
                    lenses,
                    loss,
                    values.calibration,
                    selected.order[i],
                    axes[i],
                    eyes[i],
                    p,
                    R,
                    rows,
                    normal,
                )
            if not total < losses[c]:
                break
            losses[c], places[c], turns[c] = total, p, R
            for a in range(6):
                normal[a, a] *= 1.0 + _DAMPING
            if eliminate_columns(normal, 6) >= 0:
                break
            decrease = _substitute_back(normal, step)
            is_settled[c] = decrease < _SETTLED * total
            if decrease < _TOLERANCE:
                break
            turn_by(step[3], step[4], step[5], turn)
            multiply(turns[c], turn, R)
            for a in range(3):
                p[a] += step[a]
    return losses


@inner
def _is_duplicate(tags: IntArray, turns: FloatArray, is_settled: BoolArray, c: int, R: FloatArray) -> bool:
    """Return whether an earlier candidate of the same tag converged to the current rotation R of candidate c."""
    for other in range(c - 1, -1, -1):
        if tags[other] != tags[c]:
            break
        square = 0.0  # 8 sin(angle / 2)^2
        for a in range(3):
            for b in range(3):
                square += (R[a, b] - turns[other, a, b]) ** 2
        if is_settled[other] and square < 2.0 * SAME_RAD * SAME_RAD:
            return True
    return False


@inner
def _substitute_back(R: FloatArray, step: FloatArray) -> float:
    """Set the step (6,) by R and right-hand side (6, 7); return the predicted decrease of the cost."""
    decrease = 0.0
    for a in range(5, -1, -1):
        value = R[a, 6]
        decrease += 0.5 * value * value
        for b in range(a + 1, 6):
            value += R[a, b] * step[b]
        step[a] = -value / R[a, a]
    return decrease


@inner
def _camera_poses(
    detections: CornerObservations, values: SpatialValues, which: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Return R_camera_map (J, 4, 3, 3) and camera positions (J, 4, 3) at the readout of each corner's row."""
    axes, places = np.empty((len(which), 4, 3, 3)), np.empty((len(which), 4, 3))
    eye = CameraPose(np.full(6, np.nan), np.empty((3, 3)), np.empty((3, 3)))
    for i in range(len(which)):
        camera_poses_of(detections, values, which[i], eye, axes[i], places[i])
    return axes, places


@inline
def camera_poses_of(
    detections: CornerObservations, values: SpatialValues, m: int, eye: CameraPose, axes: FloatArray, places: FloatArray
) -> None:
    """Set R_camera_map (4, 3, 3) and camera positions (4, 3) at the readout of each corner's row of a detection.

    `eye` caches the mount between calls, as in `set_mount`.
    """
    set_mount(detections, m, values.calibration, eye)
    late = values.calibration[detections.time_parameter[m]]
    omega = detections.twist[m, 2]
    back_x, back_y, _, _ = base_before(detections.twist[m, 0], detections.twist[m, 1], omega, late)
    pose = values.poses[detections.pose[m]]
    cos_h, sin_h = np.cos(pose[2]), np.sin(pose[2])
    for k in range(4):
        moved, last = detections.moved[m, k], detections.moved[m, max(k - 1, 0)]
        if k > 0 and moved[0] == last[0] and moved[1] == last[1] and moved[2] == last[2]:  # global shutter
            for a in range(3):
                places[k, a] = places[k - 1, a]
                for b in range(3):
                    axes[k, a, b] = axes[k - 1, a, b]
            continue
        cos_m, sin_m = np.cos(moved[2]), np.sin(moved[2])
        x, y = moved[0] + cos_m * back_x - sin_m * back_y, moved[1] + sin_m * back_x + cos_m * back_y
        _camera_at(
            eye, pose[0] + cos_h * x - sin_h * y, pose[1] + sin_h * x + cos_h * y,
            pose[2] + moved[2] - late * omega, axes[k], places[k],
        )  # fmt: skip


@inner
def _add_detection(
    detections: CornerObservations,
    lenses: FloatArray,
    loss: Loss,
    calibration: FloatArray,
    m: int,
    axes: FloatArray,
    eyes: FloatArray,
    p: FloatArray,
    R: FloatArray,
    rows: FloatArray,
    normal: FloatArray,
) -> float:
    """Add J^T W J and J^T W r (6, 7) by a tag's position and rotation; return the loss. Rows (8, 8) is a work array."""
    lens = lenses[detections.camera[m]]
    half = 0.5 * detections.side_m[m] * (1.0 + calibration[detections.scale_parameter[m]])
    focal, by_pixel, square = 1.0 + calibration[detections.focal_parameter[m]], 1.0 / detections.sigma_px[m], 0.0
    shift = calibration[detections.edge_parameter[m]]
    for k in range(4):
        u = -half if k == 0 or k == 3 else half
        v = half if k < 2 else -half
        x = p[0] + R[0, 0] * u + R[0, 1] * v - eyes[k, 0]
        y = p[1] + R[1, 0] * u + R[1, 1] * v - eyes[k, 1]
        z = p[2] + R[2, 0] * u + R[2, 1] * v - eyes[k, 2]
        W = axes[k]
        c2 = W[2, 0] * x + W[2, 1] * y + W[2, 2] * z
        px, py, d00, d01, d11, nx, ny = distort(
            lens, W[0, 0] * x + W[0, 1] * y + W[0, 2] * z, W[1, 0] * x + W[1, 1] * y + W[1, 2] * z, c2
        )
        for axis in range(2):
            row, distorted = rows[2 * k + axis], px if axis == 0 else py
            scaled = by_pixel * lens[axis] * focal
            seen = detections.corners_px[m, k, axis] - shift * detections.outward[m, k, axis]
            off = scaled * distorted + by_pixel * (lens[CENTRE + axis] - seen)
            square += off * off
            gain = scaled / c2
            j0, j1 = gain * (d00 if axis == 0 else d01), gain * (d01 if axis == 0 else d11)
            j2 = -(j0 * nx + j1 * ny)
            m0 = j0 * W[0, 0] + j1 * W[1, 0] + j2 * W[2, 0]
            m1 = j0 * W[0, 1] + j1 * W[1, 1] + j2 * W[2, 1]
            m2 = j0 * W[0, 2] + j1 * W[1, 2] + j2 * W[2, 2]
            t0 = m0 * R[0, 0] + m1 * R[1, 0] + m2 * R[2, 0]
            t1 = m0 * R[0, 1] + m1 * R[1, 1] + m2 * R[2, 1]
            t2 = m0 * R[0, 2] + m1 * R[1, 2] + m2 * R[2, 2]
            row[0], row[1], row[2], row[3], row[4] = m0, m1, m2, t2 * v, -t2 * u
            row[5], row[6] = t1 * u - t0 * v, off
    rho, w = loss_and_weight(loss, square)
    for i in range(8):
        for a in range(6):
            f, row, out = w * rows[i, a], rows[i], normal[a]
            for b in range(len(row)):
                out[b] += f * row[b]
    return rho
