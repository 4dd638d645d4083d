"""A problem cut into windows of a few metres, each with its own start and tags."""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, IntArray
from groundsbot.calib.geometry import chain_motions
from groundsbot.calib.robot import CAMERA_PARAMETERS, TIME_OFFSET
from groundsbot.offline.sam import Columns, ObservationFactors, Problem, State

# Long enough for a pass of a tag, short enough that dead reckoning is in the right basin.
WINDOW_M: Final = 10.0


def in_windows(problem: Problem, window_m: float = WINDOW_M) -> Problem:
    """Return the same poses cut into windows: no motion connects two windows, and each has its own tags."""
    window = window_of_pose(problem, window_m)
    odometry, observations = problem.odometry, problem.observations
    inside: BoolArray = window[odometry.first] == window[odometry.first + 1]
    tag = track_numbers(window[observations.pose], observations.tag)
    _, first_observation = np.unique(tag, return_index=True)
    return Problem(
        odometry=odometry.part(inside),
        observations=replace(observations, tag=tag),
        prior=problem.prior,
        columns=_columns(window, len(first_observation), problem.columns.calibration >= 0),
        anchor=observations.pose[first_observation],
    )


def window_of_pose(problem: Problem, window_m: float) -> IntArray:
    """Return (P,) increasing window numbers, a new one at each segment's start."""
    n_poses = len(problem.columns.poses)
    driven_m, follows = np.zeros(n_poses), np.zeros(n_poses, dtype=np.bool_)
    after = problem.odometry.first + 1
    driven_m[after] = np.hypot(problem.odometry.motion[:, 0], problem.odometry.motion[:, 1])
    follows[after] = True
    starts = np.flatnonzero(~follows)
    along_m = np.cumsum(driven_m)
    along_m -= np.repeat(along_m[starts], np.diff(np.append(starts, n_poses)))
    number = (along_m / window_m).astype(np.int64)
    begins = ~follows
    begins[1:] |= number[1:] != number[:-1]
    return np.cumsum(begins) - 1


def track_numbers(part: IntArray, tag: IntArray) -> IntArray:
    """Return (M,) a number for each tag in each part of the path, from 0 without gaps."""
    _, number = np.unique(part * (int(tag.max(initial=0)) + 1) + tag, return_inverse=True)
    return np.asarray(number, dtype=np.int64)


def camera_numbers(observations: ObservationFactors) -> IntArray:
    """Return (M,) a number for each camera of the observations of one robot, by its parameters."""
    return observations.camera_parameters[:, CAMERA_PARAMETERS.index(TIME_OFFSET)].astype(np.int64)


def _columns(window: IntArray, n_tags: int, calibrated: BoolArray) -> Columns:
    """Return the columns of free variables; each window's first pose is fixed."""
    free = np.append(False, window[1:] == window[:-1])
    poses = np.where(free[:, None], 3 * (np.cumsum(free) - 1)[:, None] + np.arange(3), -1)
    n = 3 * int(free.sum())
    tags = n + np.arange(2 * n_tags).reshape(n_tags, 2)
    n += 2 * n_tags
    return Columns(poses, tags, np.where(calibrated, n + np.cumsum(calibrated) - 1, -1), n + int(calibrated.sum()))


def dead_reckon(problem: Problem, windows: Problem) -> State:
    """Return the state of dead reckoning at nominal calibration, with tags at the mean of their observations."""
    first, motion = problem.odometry.first, problem.odometry.motion
    poses = np.zeros((len(problem.columns.poses), 3))
    for part in np.split(np.arange(len(first)), np.flatnonzero(np.diff(first) != 1) + 1):
        if len(part):
            poses[first[part[0]] : first[part[-1]] + 2] = chain_motions(motion[part], np.zeros(3))
    observations = windows.observations
    n_tags = len(windows.columns.tags)
    state = State(poses, np.zeros((n_tags, 2)), np.zeros(len(problem.prior.sigma)))
    places, n = observations.places_in_map(state), np.bincount(observations.tag, minlength=n_tags)
    mean = [np.bincount(observations.tag, places[:, axis], n_tags) / n for axis in (0, 1)]
    return State(poses, np.stack(mean, axis=-1), state.calibration)
