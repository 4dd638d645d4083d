"""Warp of a drive onto tags: a rigid transform that changes along it, to take out what its odometry bent."""

from typing import Final, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import fit_transform, se2
from groundsbot.offline.measurements import Segment, TagKey

_LEAST_TAGS: Final = 3
# Passes of tags in a row, of which one transform is found: as few as a transform and its tags' errors allow.
_WINDOW: Final = 6


class Warp(NamedTuple):
    """Transforms along a drive, interpolated between.

    Attributes:
        keyframe: (n,) where each transform holds, not decreasing.
        T: (n, 3) from the old places to the new ones, in their common frame; n is at least 1.
    """

    keyframe: FloatArray
    T: FloatArray

    def apply_to_points(self, points: FloatArray, keyframe: IntArray) -> FloatArray:
        """Return points (N, 2) transformed as at one keyframe each."""
        before, after, share = self._between(keyframe)
        places: FloatArray = (1.0 - share)[:, None] * se2.apply(before, points) + share[:, None] * se2.apply(
            after, points
        )
        return places

    def apply_to_poses(self, poses: FloatArray) -> FloatArray:
        """Return the poses (K, 3) of all keyframes transformed."""
        keyframe = np.arange(len(poses))
        before, after, share = self._between(keyframe)
        turned_rad = poses[:, 2] + before[:, 2] + share * se2.wrap_angle(after[:, 2] - before[:, 2])
        return np.column_stack([self.apply_to_points(poses[:, :2], keyframe), se2.wrap_angle(turned_rad)])

    def _between(self, keyframe: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the transforms (N, 3) before and after keyframes, and the share of the way from one to the other."""
        after = np.clip(np.searchsorted(self.keyframe, keyframe), 0, len(self.keyframe) - 1)
        before = np.maximum(after - 1, 0)
        length = np.maximum(self.keyframe[after] - self.keyframe[before], 1e-9)
        return self.T[before], self.T[after], np.clip((keyframe - self.keyframe[before]) / length, 0.0, 1.0)


def find_warp(segment: Segment, tags_m: dict[TagKey, FloatArray], onto_m: dict[TagKey, FloatArray]) -> Warp:
    """Return the warp of a drive that moves tags where they are in another map.

    Args:
        segment: observations of the drive.
        tags_m: (2,) of its tags.
        onto_m: (2,) of tags in the other map.

    Returns:
        One transform for each window of passes of tags of both maps; a single one where they share few tags, and none
        at all, the identity, where they share less than three.
    """
    shared = [tag for tag in segment.tags if tag in onto_m]
    if len(shared) < _LEAST_TAGS:
        return Warp(np.zeros(1), np.zeros((1, 3)))
    here, there = (np.array([places[tag] for tag in shared]) for places in (tags_m, onto_m))
    number = np.full(len(segment.tags), -1)
    number[[tag in onto_m for tag in segment.tags]] = np.arange(len(shared))
    observations = segment.observations
    order = np.argsort(observations.keyframe, kind="stable")
    tag, keyframe = number[observations.tag[order]], observations.keyframe[order]
    tag, keyframe = tag[tag >= 0], keyframe[tag >= 0]
    begins = np.flatnonzero(np.append(True, tag[1:] != tag[:-1]))
    tag, keyframe = tag[begins], keyframe[begins]
    whole = Warp(np.zeros(1), fit_transform(there, here)[None])
    if len(tag) < _WINDOW:
        return whole
    # Windows of the same tags have the same transform: drives past few tags have thousands of such windows.
    windows = sliding_window_view(tag, _WINDOW)
    has_tag = np.zeros((len(windows), len(shared)), dtype=np.bool_)
    has_tag[np.arange(len(windows))[:, None], windows] = True
    combinations, of_window = np.unique(has_tag, axis=0, return_inverse=True)
    is_enough = combinations.sum(axis=1) >= _LEAST_TAGS
    T = np.zeros((len(combinations), 3))
    for i in np.flatnonzero(is_enough):
        T[i] = fit_transform(there[combinations[i]], here[combinations[i]])
    used = is_enough[of_window]
    if not used.any():
        return whole
    return Warp(sliding_window_view(keyframe, _WINDOW).mean(axis=1)[used], T[of_window[used]])
