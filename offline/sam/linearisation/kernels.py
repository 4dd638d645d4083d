"""Arrays and elementary functions of the compiled linearisation, fixed variables, and the compiled retraction."""

from typing import NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import (
    BoolVector,
    FloatBlocks,
    FloatMatrix,
    FloatVector,
    IndexMatrix,
    IntVector,
    inline,
    inner,
    njit,
)
from groundsbot.offline.sam.linearisation.blocks import NormalEquations


class Values(NamedTuple):
    """The values of all variables, as in `State`."""

    poses: FloatMatrix
    tags: FloatMatrix
    calibration: FloatVector


class Free(NamedTuple):
    """The free directions of the tangent space.

    Attributes:
        poses, tags: (P, 3) and (T, 2), 1.0 where free and 0.0 where fixed.
        calibration: (C,) index among the free parameters, -1 where fixed.
        held_poses, held_tags: indices of poses and tags with a fixed direction.
        held_observations: indices of observations from such poses or of such tags.
    """

    poses: FloatMatrix
    tags: FloatMatrix
    calibration: IntVector
    held_poses: IntVector
    held_tags: IntVector
    held_observations: IntVector


class OdometryArrays(NamedTuple):
    """`OdometryFactors` in order of poses.

    Attributes:
        motion: (M, 5) x, y, heading, cosine and sine of the heading.
        information: (M, 3, 3) information in the motion's right tangent space.
        parameters: (M, P) indices into the calibration.
        slots: (M, P) index of each parameter in the calibration of its segment, -1 where fixed.
    """

    first: IntVector
    motion: FloatMatrix
    information: FloatBlocks
    jacobian: FloatBlocks
    parameters: IndexMatrix
    slots: IndexMatrix


class ObservationArrays(NamedTuple):
    """`ObservationFactors` in order of poses; parameters (M, 9) are those of mount, tag scale and camera.

    `slots` (M, 9) index the calibration of the pose's segment, `tag_segment` (M,) is an index into `Tree.tag_segments`.
    """

    pose: IntVector
    tag: IntVector
    value: FloatMatrix
    polar: BoolVector
    whitening: FloatBlocks
    mount: FloatMatrix
    by_camera: FloatBlocks
    parameters: IndexMatrix
    slots: IndexMatrix
    tag_segment: IntVector


@njit
def clear(system: NormalEquations) -> None:
    """Set all blocks to zero, except those that linearisation overwrites."""
    for blocks in (system.pose, system.pose_next, system.pose_calibration, system.tag, system.tag_calibration):
        blocks[:] = 0.0
    system.calibration[:] = 0.0
    system.gradient[:] = 0.0


@njit
def hold(
    observation_pose: IntVector,
    observation_tag: IntVector,
    tag_segment_start: IntVector,
    free: Free,
    system: NormalEquations,
) -> None:
    """Replace the rows and columns of fixed directions by those of the identity, which makes their step zero."""
    for pose in free.held_poses:
        for i in range(3):
            if free.poses[pose, i] == 0.0:
                _hold_one(system.pose[pose], i)
                system.pose_next[pose, i, :] = 0.0
                if pose > 0:
                    system.pose_next[pose - 1, :, i] = 0.0
                system.pose_calibration[pose, i, :] = 0.0
                system.gradient[3 * pose + i] = 0.0
    _hold_tags(tag_segment_start, free, system)
    for m in free.held_observations:
        pose, tag = free.poses[observation_pose[m]], free.tags[observation_tag[m]]
        for i in range(3):
            system.pose_tag[m, i, 0] *= pose[i] * tag[0]
            system.pose_tag[m, i, 1] *= pose[i] * tag[1]


@inner
def _hold_tags(tag_segment_start: IntVector, free: Free, system: NormalEquations) -> None:
    for tag in free.held_tags:
        for i in range(2):
            if free.tags[tag, i] == 0.0:
                _hold_one(system.tag[tag], i)
                for tag_segment in range(tag_segment_start[tag], tag_segment_start[tag + 1]):
                    system.tag_calibration[tag_segment, i, :] = 0.0
                system.gradient[3 * len(free.poses) + 2 * tag + i] = 0.0


@inner
def _hold_one(block: FloatArray, i: int) -> None:
    block[i, :] = 0.0
    block[:, i] = 0.0
    block[i, i] = 1.0


@inner
def wrap(angle: float) -> float:
    """Return the angle in [-pi, pi]."""
    return float(angle - 2.0 * np.pi * np.rint(angle * (0.5 / np.pi)))


# Reciprocals, since a division would take as long as all else in a term.


@inner
def half_angle_cotangent(omega: float) -> float:
    """Return (w/2) cot(w/2)."""
    if abs(omega) < 0.2:
        s = omega * omega
        return 1.0 - s * (1 / 12) * (
            1.0 + s * (1 / 60) * (1.0 + s * (1 / 42) * (1.0 + s * (1 / 40) * (1.0 + s * (5 / 198))))
        )
    return float(0.5 * omega * np.cos(0.5 * omega) / np.sin(0.5 * omega))


@inner
def series(omega: float) -> tuple[float, float, float]:
    """Return sin(w)/w, (1 - cos w)/w^2 and (w - sin w)/w^2 of an angle w in rad: coefficients of the SE(2) exponential.

    Below 0.5 rad they are Taylor series, which are exact to rounding and have the limits 1, 1/2 and 0 at zero.
    """
    s = omega * omega
    if abs(omega) < 0.5:
        rest = 1.0 - s * (1 / 42) * (1.0 - s * (1 / 72) * (1.0 - s * (1 / 110) * (1.0 - s * (1 / 156))))
        sixth = (1 / 6) * (1.0 - s * (1 / 20) * rest)
        rest = 1.0 - s * (1 / 56) * (1.0 - s * (1 / 90) * (1.0 - s * (1 / 132) * (1.0 - s * (1 / 182))))
        return 1.0 - s * sixth, 0.5 - s * (1 / 24) * (1.0 - s * (1 / 30) * rest), omega * sixth
    return np.sin(omega) / omega, (1.0 - np.cos(omega)) / s, (omega - np.sin(omega)) / s


@inner
def multiply(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """Set out to A B, all (3, 3)."""
    for i in range(3):
        for j in range(3):
            out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@inline
def advance(pose: FloatArray, d0: float, d1: float, omega: float, out: FloatArray) -> None:
    """Set out (3,) to T o exp(d) of a pose T (3,)."""
    along, even, _ = series(omega)
    across = omega * even
    x, y = along * d0 - across * d1, across * d0 + along * d1
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    out[0], out[1], out[2] = pose[0] + cos * x - sin * y, pose[1] + sin * x + cos * y, wrap(pose[2] + omega)


@inline
def go_along(
    tag: FloatArray,
    before: FloatArray,
    after: FloatArray,
    d0: float,
    d1: float,
    omega: float,
    own_0: float,
    own_1: float,
    out: FloatArray,
) -> None:
    """Set out (2,) to the position of a tag that moves rigidly with its anchor, plus the remainder of its own step.

    Args:
        tag: (2,) position in map before the step.
        before: (3,) pose of the anchor before the step.
        after: (3,) pose of the anchor after the step.
        d0: x of the anchor's step, in its right tangent space.
        d1: y of it.
        omega: angle of it.
        own_0: x of the tag's step, in map.
        own_1: y of it.
        out: (2,) result.
    """
    cos, sin = np.cos(before[2]), np.sin(before[2])
    dx, dy = tag[0] - before[0], tag[1] - before[1]
    x, y = cos * dx + sin * dy, cos * dy - sin * dx
    x, y = x + (cos * own_0 + sin * own_1 - (d0 - omega * y)), y + (cos * own_1 - sin * own_0 - (d1 + omega * x))
    cos, sin = np.cos(after[2]), np.sin(after[2])
    out[0], out[1] = after[0] + cos * x - sin * y, after[1] + sin * x + cos * y


@njit
def retract(values: Values, step: FloatVector, anchor: IntVector, out: Values) -> None:
    """Apply `solver.Problem.retract` to poses and tags, with a step in the arrowhead's order."""
    n_poses = len(values.poses)
    for pose in range(n_poses):
        at = 3 * pose
        advance(values.poses[pose], step[at], step[at + 1], step[at + 2], out.poses[pose])
    for tag in range(len(values.tags)):
        at, column, before = 3 * anchor[tag], 3 * n_poses + 2 * tag, values.poses[anchor[tag]]
        go_along(
            values.tags[tag], before, out.poses[anchor[tag]], step[at], step[at + 1], step[at + 2], step[column],
            step[column + 1], out.tags[tag],
        )  # fmt: skip


@njit
def diagonal_square(system: NormalEquations, step: FloatVector) -> float:
    """Return step^T diag(H) step."""
    total = 0.0
    n_poses, n_tags = len(system.pose), len(system.tag)
    for pose in range(n_poses):
        for i in range(3):
            total += system.pose[pose, i, i] * step[3 * pose + i] ** 2
    for tag in range(n_tags):
        for i in range(2):
            total += system.tag[tag, i, i] * step[3 * n_poses + 2 * tag + i] ** 2
    for a in range(len(system.calibration)):
        total += system.calibration[a, a] * step[3 * n_poses + 2 * n_tags + a] ** 2
    return total
