"""Retraction of a step: pose by pose, or motion by motion along each segment."""

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.sam.arrowhead import relative_retraction
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.linearisation import kernels
from groundsbot.offline.sam.linearisation.kernels import Values


def retract(state: State, step: FloatArray, anchor: IntArray, is_free: BoolArray) -> State:
    """Return the state after a step pose by pose; tags move with their anchor poses.

    Args:
        state: before the step.
        step: (3P + 2T + C,) of poses, tags and free calibration.
        anchor: (T,) pose index with which each tag moves.
        is_free: mask of the free calibration parameters.
    """
    values = Values(state.poses, state.tags, state.calibration)
    out = Values(np.empty_like(state.poses), np.empty_like(state.tags), state.calibration.copy())
    kernels.retract(values, step, anchor, out)
    out.calibration[is_free] += step[3 * len(state.poses) + 2 * len(state.tags) :]
    return State(*out)


def retract_relative(before: State, step: FloatArray, anchor: IntArray, segment_start: IntArray, moved: State) -> State:
    """Return the state after the same step as `moved`, motion by motion along each segment.

    Args:
        before: before the step.
        step: as for `retract`.
        anchor: as for `retract`.
        segment_start: (S + 1,) first pose of each segment, then the number of poses.
        moved: after `retract`.
    """
    values = Values(before.poses, before.tags, before.calibration)
    by_pose = Values(moved.poses, moved.tags, moved.calibration)
    out = Values(np.empty_like(moved.poses), np.empty_like(moved.tags), moved.calibration)
    relative_retraction.retract_relative(values, step, anchor, segment_start, by_pose, out)
    return State(*out)
