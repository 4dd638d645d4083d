"""Starting values from one pass in order of time over all segments, like a filter that keeps no cross terms.

Each segment carries its newest pose with a 3 x 3 covariance, each tag a place with a 2 x 2 one, both of all that
drifted since the frame. Errors of pose and tag are correlated in ways that nobody books. So whichever is known clearly
better teaches the other, and near equals teach each other nothing: a tag that the pose itself has just placed leaves
its covariance honest, an older one pulls the pose back. What comes out is not the optimum, but a long drive comes out
unbent.

All errors are in map axes: there a motion carries the position over unturned, and a tag's covariance stays as it is.
"""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.offline.foundation import borrow, inline, njit
from groundsbot.offline.sam.arrowhead.tree import Tree
from groundsbot.offline.sam.linearisation.kernels import ObservationArrays, OdometryArrays, Values, wrap
from groundsbot.offline.sam.linearisation.odometry import motion_at, wheel_correction

# A reading farther off than this many sigmas is passed over.
_GATE: Final = 6.0
# How many times the other's variance is clearly worse.
_CLEARLY: Final = 2.0
# So many poses of a segment are taken at a time, for the sake of the processor's cache.
_BLOCK: Final = 16

_Covariance = tuple[float, float, float]  # xx, xy, yy


class _Filter(NamedTuple):
    """What the pass knows besides the values.

    Attributes:
        pose: (number of segments, 6) covariance of the newest pose: xx, xy, yy, x heading, y heading, heading.
        turn: (number of segments, 2) cosine and sine of its heading.
        tag: (T, 3) covariance xx, xy, yy; known: (T,) whether it has been placed.
    """

    pose: FloatArray
    turn: FloatArray
    tag: FloatArray
    known: BoolArray


def starting_pass(
    tree: Tree,
    odometry: OdometryArrays,
    readings: ObservationArrays,
    start: Values,
    start_variance: FloatArray,
    out: Values,
) -> None:
    """Runs all segments side by side, some poses of each at a time.

    Args:
        tree: the segments and who reads what.
        odometry: the motions; calibration is taken from `start`.
        readings: of tags, as places.
        start: its poses count at the start of each segment only.
        start_variance: (number of segments, 3) of each start's right tangent.
        out: takes the result.
    """
    n_segments = len(tree.segment_start) - 1
    known = _Filter(
        pose=np.zeros((n_segments, 6)),
        turn=np.empty((n_segments, 2)),
        tag=np.zeros((tree.n_tags, 3)),
        known=np.zeros(tree.n_tags, dtype=np.bool_),
    )
    out.calibration[:] = start.calibration
    out.tags[:] = start.tags
    _run(tree, odometry, readings, start, start_variance, known, out)


@njit
def _run(
    tree: Tree,
    odometry: OdometryArrays,
    readings: ObservationArrays,
    start: Values,
    start_variance: FloatArray,
    known: _Filter,
    out: Values,
) -> None:
    tree, odometry, readings = borrow(tree), borrow(odometry), borrow(readings)
    start, known, out = borrow(start), borrow(known), borrow(out)
    n_segments = len(tree.segment_start) - 1
    longest = 0
    for segment in range(n_segments):
        longest = max(longest, tree.segment_start[segment + 1] - tree.segment_start[segment])
    for block in range(0, longest, _BLOCK):
        for segment in range(n_segments):
            first, end = tree.segment_start[segment], tree.segment_start[segment + 1]
            for pose in range(first + block, min(first + block + _BLOCK, end)):
                P, turn = known.pose[segment], known.turn[segment]
                if pose == first:
                    for i in range(3):
                        out.poses[pose, i] = start.poses[pose, i]
                    _begin(start_variance[segment], start.poses[pose, 2], P, turn)
                else:
                    m = pose - 1 - segment  # one motion less than poses in each segment
                    _predict(odometry, m, start.calibration, out.poses[pose - 1], out.poses[pose], P, turn)
                for m in range(tree.reading_start[pose], tree.reading_start[pose + 1]):
                    _read(readings, m, out.calibration, out.poses[pose], P, turn, out.tags[readings.tag[m]], known)


@inline
def _begin(variance: FloatArray, heading: float, P: FloatArray, turn: FloatArray) -> None:
    turn[0], turn[1] = np.cos(heading), np.sin(heading)
    P[0], P[1], P[2] = rotate_covariance((variance[0], 0.0, variance[1]), turn[0], turn[1])
    P[3], P[4], P[5] = 0.0, 0.0, variance[2]


@inline
def rotate_covariance(C: _Covariance, cos: float, sin: float) -> _Covariance:
    """R C R^T with R the turn."""
    cross = 2.0 * cos * sin * C[1]
    return (
        cos * cos * C[0] - cross + sin * sin * C[2],
        cos * sin * (C[0] - C[2]) + (cos * cos - sin * sin) * C[1],
        sin * sin * C[0] + cross + cos * cos * C[2],
    )


@inline
def _predict(
    odometry: OdometryArrays,
    m: int,
    calibration: FloatArray,
    before: FloatArray,
    after: FloatArray,
    P: FloatArray,
    turn: FloatArray,
) -> None:
    """T <- T o M(c); P <- F P F^T + noise, where F moves the position by J d times the heading's error."""
    x, y, turned_by, _, _ = motion_at(odometry, m, wheel_correction(odometry, m, calibration))
    dx, dy = turn[0] * x - turn[1] * y, turn[1] * x + turn[0] * y
    after[0], after[1], after[2] = before[0] + dx, before[1] + dy, wrap(before[2] + turned_by)
    cos, sin = np.cos(after[2]), np.sin(after[2])
    turn[0], turn[1] = cos, sin
    C = odometry.covariance[m]
    xx, xy, yy = rotate_covariance((C[0, 0], C[0, 1], C[1, 1]), cos, sin)
    P[0], P[1], P[2] = P[0] + xx, P[1] + xy, P[2] + yy
    P[0] += dy * (dy * P[5] - 2.0 * P[3])
    P[1] += dx * P[3] - dy * P[4] - dx * dy * P[5]
    P[2] += dx * (dx * P[5] + 2.0 * P[4])
    P[3] += cos * C[0, 2] - sin * C[1, 2] - dy * P[5]
    P[4] += sin * C[0, 2] + cos * C[1, 2] + dx * P[5]
    P[5] += C[2, 2]


@inline
def _read(
    readings: ObservationArrays,
    m: int,
    calibration: FloatArray,
    pose: FloatArray,
    P: FloatArray,
    turn: FloatArray,
    tag: FloatArray,
    known: _Filter,
) -> None:
    """Fuses one reading into pose or tag, or places the tag."""
    x, y, R = _read_from_pose(readings, m, calibration, turn[0], turn[1])
    V = known.tag[readings.tag[m]]
    if not known.known[readings.tag[m]]:
        known.known[readings.tag[m]] = True
        _place(tag, V, pose[0] + x, pose[1] + y, _sum(_of_place(P, x, y), R))
        return
    seen_x, seen_y = tag[0] - pose[0], tag[1] - pose[1]
    A = _of_place(P, seen_x, seen_y)
    own, others = A[0] + A[2], V[0] + V[2]
    if others > _CLEARLY * (own + R[0] + R[2]):
        _place(tag, V, pose[0] + x, pose[1] + y, _sum(A, R))
    elif own > _CLEARLY * others:
        S = (A[0] + V[0] + R[0], A[1] + V[1] + R[1], A[2] + V[2] + R[2])
        off_x, off_y = seen_x - x, seen_y - y
        determinant = S[0] * S[2] - S[1] * S[1]
        # S^-1 times what is off, by the determinant.
        u, v = S[2] * off_x - S[1] * off_y, S[0] * off_y - S[1] * off_x
        if off_x * u + off_y * v <= _GATE**2 * determinant:
            _correct(pose, P, (-seen_y, seen_x), S, off_x, off_y)
            turn[0], turn[1] = np.cos(pose[2]), np.sin(pose[2])


@inline
def _read_from_pose(
    readings: ObservationArrays, m: int, calibration: FloatArray, cos: float, sin: float
) -> tuple[float, float, _Covariance]:
    """From the pose to where a reading puts its tag, and the covariance of that, in map axes."""
    parameters, mount = readings.parameters[m], readings.mount[m]
    scale = 1.0 + calibration[parameters[3]]
    yaw = mount[2] + calibration[parameters[2]]
    c, s = scale * np.cos(yaw), scale * np.sin(yaw)
    a, b = readings.value[m, 0], readings.value[m, 1]
    x = mount[0] + calibration[parameters[0]] + c * a - s * b
    y = mount[1] + calibration[parameters[1]] + s * a + c * b
    W = readings.whitening[m]
    inverse = 1.0 / (W[0, 0] * W[1, 1] - W[0, 1] * W[1, 0])
    inverse *= inverse
    noise = (
        inverse * (W[1, 1] * W[1, 1] + W[0, 1] * W[0, 1]),
        -inverse * (W[1, 1] * W[1, 0] + W[0, 1] * W[0, 0]),
        inverse * (W[1, 0] * W[1, 0] + W[0, 0] * W[0, 0]),
    )
    return cos * x - sin * y, sin * x + cos * y, rotate_covariance(noise, cos * c - sin * s, sin * c + cos * s)


@inline
def _of_place(P: FloatArray, x: float, y: float) -> _Covariance:
    """Covariance of what lies at (x, y) from the pose and moves with it."""
    return (
        P[0] + y * (y * P[5] - 2.0 * P[3]),
        P[1] + x * P[3] - y * P[4] - x * y * P[5],
        P[2] + x * (x * P[5] + 2.0 * P[4]),
    )


@inline
def _sum(A: _Covariance, B: _Covariance) -> _Covariance:
    return A[0] + B[0], A[1] + B[1], A[2] + B[2]


@inline
def _place(tag: FloatArray, V: FloatArray, x: float, y: float, C: _Covariance) -> None:
    tag[0], tag[1] = x, y
    V[0], V[1], V[2] = C


@inline
def _correct(
    pose: FloatArray, P: FloatArray, H: tuple[float, float], S: _Covariance, off_x: float, off_y: float
) -> None:
    """Kalman's update with innovation covariance S, of a place that a turn moves by H."""
    inverse = 1.0 / (S[0] * S[2] - S[1] * S[1])
    xx, xy, yx, yy = P[0] + H[0] * P[3], P[1] + H[1] * P[3], P[1] + H[0] * P[4], P[2] + H[1] * P[4]
    tx, ty = P[3] + H[0] * P[5], P[4] + H[1] * P[5]
    gxx, gxy = inverse * (xx * S[2] - xy * S[1]), inverse * (xy * S[0] - xx * S[1])
    gyx, gyy = inverse * (yx * S[2] - yy * S[1]), inverse * (yy * S[0] - yx * S[1])
    gtx, gty = inverse * (tx * S[2] - ty * S[1]), inverse * (ty * S[0] - tx * S[1])
    P[0] -= gxx * xx + gxy * xy
    P[1] -= gxx * yx + gxy * yy
    P[2] -= gyx * yx + gyy * yy
    P[3] -= gxx * tx + gxy * ty
    P[4] -= gyx * tx + gyy * ty
    P[5] -= gtx * tx + gty * ty
    pose[0] += gxx * off_x + gxy * off_y
    pose[1] += gyx * off_x + gyy * off_y
    pose[2] += gtx * off_x + gty * off_y
