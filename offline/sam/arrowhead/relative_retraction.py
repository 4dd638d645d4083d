"""Retraction of a step motion by motion along each segment, instead of pose by pose.

A retraction pose by pose preserves the motion between consecutive poses to first order only. Odometry has sigmas of a
millimetre. If a segment of a hundred metres bends by a metre, its second-order residuals dominate the cost, and only
tiny steps would lower it. Here each motion is changed by its own part of the step, and the poses are recomputed from
the start of the segment. Odometry residuals then follow their linear model closely, and second-order errors appear
only in observations of tags that are revisited.
"""

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.foundation import FloatVector, IntVector, inner, njit
from groundsbot.offline.sam.linearisation.kernels import Values


@njit
def retract_relative(
    values: Values, step: FloatVector, anchor: IntVector, segment_start: IntVector, moved: Values, out: Values
) -> None:
    """Retract a step motion by motion.

    Args:
        values: values before the step.
        step: (3 P + 2 T + C,) step in the arrowhead's order.
        anchor: (T,) pose index with which each tag moves.
        segment_start: (S + 1,) first pose of each segment, then the number of poses.
        moved: values after the same step pose by pose; tags keep their positions relative to their anchors.
        out: resulting poses and tags.
    """
    for segment in range(len(segment_start) - 1):
        first = segment_start[segment]
        for i in range(3):
            out.poses[first, i] = moved.poses[first, i]
        for pose in range(first, segment_start[segment + 1] - 1):
            _retract_motion(values.poses[pose], values.poses[pose + 1], step[3 * pose : 3 * pose + 6], out.poses, pose)
    for tag in range(len(moved.tags)):
        before, after = moved.poses[anchor[tag]], out.poses[anchor[tag]]
        turn = after[2] - before[2]
        cos, sin = np.cos(turn), np.sin(turn)
        x, y = moved.tags[tag, 0] - before[0], moved.tags[tag, 1] - before[1]
        out.tags[tag, 0] = after[0] + cos * x - sin * y
        out.tags[tag, 1] = after[1] + sin * x + cos * y


@inner
def _retract_motion(here: FloatArray, there: FloatArray, step: FloatArray, poses: FloatArray, pose: int) -> None:
    """Set T_j to T_i o M o exp(d_j - Ad(M^-1) d_i), with M = T_i^-1 o T_j before the step."""
    cos, sin = np.cos(here[2]), np.sin(here[2])
    x, y = there[0] - here[0], there[1] - here[1]
    x, y, turn = cos * x + sin * y, cos * y - sin * x, there[2] - here[2]
    cos, sin = np.cos(turn), np.sin(turn)
    # Translation of T_j by d_i, in the axes of T_i.
    carried_x, carried_y = step[0] - step[2] * y, step[1] + step[2] * x
    own_x = step[3] - (cos * carried_x + sin * carried_y)
    own_y = step[4] - (cos * carried_y - sin * carried_x)
    own_turn = step[5] - step[2]
    # exp as a chord, rotated by half of the angle.
    half = 0.5 * own_turn
    chord = np.sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
    c, s = chord * np.cos(half), chord * np.sin(half)
    own_x, own_y = c * own_x - s * own_y, s * own_x + c * own_y
    x, y = x + cos * own_x - sin * own_y, y + sin * own_x + cos * own_y
    theta = poses[pose, 2]
    cos, sin = np.cos(theta), np.sin(theta)
    poses[pose + 1, 0] = poses[pose, 0] + cos * x - sin * y
    poses[pose + 1, 1] = poses[pose, 1] + sin * x + cos * y
    theta += turn + own_turn
    poses[pose + 1, 2] = theta - 2.0 * np.pi * np.ceil((theta - np.pi) / (2.0 * np.pi))
