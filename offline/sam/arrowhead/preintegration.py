"""The skeleton of the segments: the poses that read tags, with the motions between them composed.

Where keyframes are dense, most of them read nothing. What the tags say about the shape of a drive is settled among
those that do; how a composed motion's error divides among its parts, their covariances say. Compare the pre-integrated
factors of Lupton and Sukkarieh, "Visual-inertial-aided navigation for high-dynamic motion" (2012).
"""

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import borrow, inner, njit
from groundsbot.offline.sam.linearisation.kernels import OdometryArrays, multiply, wrap
from groundsbot.offline.sam.linearisation.odometry import motion_at, wheel_correction


@njit
def add_moments(odometry: OdometryArrays, whitening: FloatArray) -> None:
    """Sets information W^T W and covariance (M, 3, 3) of each motion."""
    for m in range(len(whitening)):
        W = whitening[m]
        for i in range(3):
            for j in range(3):
                odometry.information[m, i, j] = W[0, i] * W[0, j] + W[1, i] * W[1, j] + W[2, i] * W[2, j]
        _invert(odometry.information[m], odometry.covariance[m])


@inner
def _invert(A: FloatArray, out: FloatArray) -> None:
    """Out <- A^-1 (3, 3), symmetric."""
    out[0, 0], out[0, 1] = A[1, 1] * A[2, 2] - A[1, 2] * A[1, 2], A[0, 2] * A[1, 2] - A[0, 1] * A[2, 2]
    out[0, 2], out[1, 1] = A[0, 1] * A[1, 2] - A[0, 2] * A[1, 1], A[0, 0] * A[2, 2] - A[0, 2] * A[0, 2]
    out[1, 2], out[2, 2] = A[0, 1] * A[0, 2] - A[0, 0] * A[1, 2], A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    inverse = 1.0 / (A[0, 0] * out[0, 0] + A[0, 1] * out[0, 1] + A[0, 2] * out[0, 2])
    for i in range(3):
        for j in range(i, 3):
            out[i, j] *= inverse
            out[j, i] = out[i, j]


@njit
def compose(odometry: OdometryArrays, index: IntArray, out: OdometryArrays) -> None:
    """Composes the motions from each kept pose to the next: M_1 o M_2 o ... with covariance and derivatives.

    Args:
        odometry: of all poses.
        index: (P,) of each pose in the skeleton, -1 where it is not kept; the first of a segment is.
        out: its motion, covariance, information and jacobian are set.
    """
    odometry, index, out = borrow(odometry), borrow(index), borrow(out)
    motion, blocks, scratch = np.empty(5), np.empty((2, 3, 3)), np.empty((2, 3, 3))
    at = 0
    for m in range(len(odometry.first)):
        first = odometry.first[m]
        if index[first] >= 0:
            for i in range(5):
                motion[i] = odometry.motion[m, i]
            _copy(odometry.covariance[m], blocks[0])
            _copy(odometry.jacobian[m], blocks[1])
        else:
            _append(odometry, m, motion, blocks, scratch)
        if index[first + 1] >= 0:
            for i in range(5):
                out.motion[at, i] = motion[i]
            _copy(blocks[0], out.covariance[at])
            _copy(blocks[1], out.jacobian[at])
            _invert(blocks[0], out.information[at])
            at += 1


@inner
def _copy(block: FloatArray, out: FloatArray) -> None:
    for i in range(3):
        for j in range(3):
            out[i, j] = block[i, j]


@inner
def _append(odometry: OdometryArrays, m: int, motion: FloatArray, blocks: FloatArray, scratch: FloatArray) -> None:
    """M <- M o M_m, C <- A C A^T + C_m, K <- A K + K_m, with A the adjoint of M_m^-1."""
    x, y, turn, cos, sin = odometry.motion[m]
    A, product = scratch[0], scratch[1]
    A[0, 0], A[0, 1], A[0, 2] = cos, sin, sin * x - cos * y
    A[1, 0], A[1, 1], A[1, 2] = -sin, cos, cos * x + sin * y
    A[2, 0], A[2, 1], A[2, 2] = 0.0, 0.0, 1.0
    multiply(A, blocks[0], product)
    for i in range(3):
        for j in range(3):
            blocks[0, i, j] = odometry.covariance[m, i, j]
            for k in range(3):
                blocks[0, i, j] += product[i, k] * A[j, k]
    multiply(A, blocks[1], product)
    for i in range(3):
        for j in range(3):
            blocks[1, i, j] = product[i, j] + odometry.jacobian[m, i, j]
    c, s = motion[3], motion[4]
    motion[0], motion[1] = motion[0] + c * x - s * y, motion[1] + s * x + c * y
    motion[2] = wrap(motion[2] + turn)
    motion[3], motion[4] = c * cos - s * sin, s * cos + c * sin


@njit
def expand(
    odometry: OdometryArrays,
    index: IntArray,
    composed: OdometryArrays,
    kept: FloatArray,
    calibration: FloatArray,
    out: FloatArray,
) -> None:
    """Lays the poses that were left out between those that were kept, where they are likeliest.

    What a composed motion is off by pulls at its end with a force and a moment; each part gives way by its covariance
    times these, the moment being that about the part's own end.

    Args:
        odometry: of all poses.
        index: (P,) of each pose in the skeleton, -1 where it is not kept.
        composed: motions of the skeleton.
        kept: (S, 3) its poses.
        calibration: (C,).
        out: (P, 3) takes all poses.
    """
    odometry, index, composed = borrow(odometry), borrow(index), borrow(composed)
    for pose in range(len(index)):
        if index[pose] >= 0:
            for i in range(3):
                out[pose, i] = kept[index[pose], i]
    at, x_j, y_j, force_x, force_y, moment = 0, 0.0, 0.0, 0.0, 0.0, 0.0
    for m in range(len(odometry.first)):
        first = odometry.first[m]
        if index[first] >= 0:
            force_x, force_y, moment = 0.0, 0.0, 0.0
            if at < len(composed.first) and composed.first[at] == index[first]:
                if index[first + 1] < 0:
                    x_j, y_j = kept[index[first] + 1, 0], kept[index[first] + 1, 1]
                    force_x, force_y, moment = _pull(composed, at, kept, calibration)
                at += 1
        if index[first + 1] < 0:
            x, y, turn, _, _ = motion_at(odometry, m, wheel_correction(odometry, m, calibration))
            cos, sin = np.cos(out[first, 2]), np.sin(out[first, 2])
            x, y = out[first, 0] + cos * x - sin * y, out[first, 1] + sin * x + cos * y
            theta = out[first, 2] + turn
            cos, sin = np.cos(theta), np.sin(theta)
            here = moment + (x_j - x) * force_y - (y_j - y) * force_x
            along, across = cos * force_x + sin * force_y, cos * force_y - sin * force_x
            C, T = odometry.covariance[m], out[first + 1]
            give_x = C[0, 0] * along + C[0, 1] * across + C[0, 2] * here
            give_y = C[1, 0] * along + C[1, 1] * across + C[1, 2] * here
            T[0], T[1] = x + cos * give_x - sin * give_y, y + sin * give_x + cos * give_y
            T[2] = wrap(theta + C[2, 0] * along + C[2, 1] * across + C[2, 2] * here)


@inner
def _pull(composed: OdometryArrays, at: int, kept: FloatArray, calibration: FloatArray) -> tuple[float, float, float]:
    """Force and moment at the end of a composed motion: its information times what it is off by; the force in map."""
    x, y, turn, cos, sin = motion_at(composed, at, wheel_correction(composed, at, calibration))
    before, after = kept[composed.first[at]], kept[composed.first[at] + 1]
    c, s = np.cos(before[2]), np.sin(before[2])
    dx, dy = after[0] - before[0], after[1] - before[1]
    dx, dy = c * dx + s * dy - x, c * dy - s * dx - y
    dx, dy, turned = cos * dx + sin * dy, cos * dy - sin * dx, wrap(after[2] - before[2] - turn)
    L = composed.information[at]
    along = L[0, 0] * dx + L[0, 1] * dy + L[0, 2] * turned
    across = L[1, 0] * dx + L[1, 1] * dy + L[1, 2] * turned
    c, s = np.cos(after[2]), np.sin(after[2])
    return c * along - s * across, s * along + c * across, L[2, 0] * dx + L[2, 1] * dy + L[2, 2] * turned
