"""Nested dissection of segments; see `arrowhead.tree`."""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.foundation import IntVector, njit

_LEAF_POSES: Final = 30
_LEAVES_IN_MIDDLE: Final = 8
_MIDDLES_IN_LARGE: Final = 4
LARGE: Final = 2  # level of a large node, after leaf and middle
LEVELS: Final = LARGE + 3  # the next level is that of whole segments, the last that of the top
# Of more segments each has a node of its own, since the separators between the large nodes of a hundred drives make the
# top, a dense matrix, three times as large. Of fewer segments, the parent of a large node is the top.
MOST_WITHOUT_OWN: Final = 8


class DissectionPieces(NamedTuple):
    """The elimination tree of the poses.

    Attributes:
        level, parent, segment, first, end, left, right: (N,) as in `arrowhead.tree.Tree`.
        pose_level: (P,) level at which each pose is eliminated.
    """

    level: IntVector
    parent: IntVector
    segment: IntVector
    first: IntVector
    end: IntVector
    left: IntVector
    right: IntVector
    pose_level: IntVector


def cut(segment_start: IntArray, top_segments: IntArray) -> DissectionPieces:
    """Cut each segment evenly into leaves and join these; first poses of `top_segments` are in the top."""
    n_poses = int(segment_start[-1])
    pose_level = np.zeros(n_poses, dtype=np.int64)
    in_top = set(top_segments.tolist())
    n_levels = LARGE + 1 + (len(segment_start) - 1 > MOST_WITHOUT_OWN)
    rows = []  # level, segment, cut on the left, cut on the right
    for segment, (first, end) in enumerate(zip(segment_start[:-1].tolist(), segment_start[1:].tolist(), strict=True)):
        # A cut is a separator pose. The outer cuts are outside of the segment, or at a first pose that is in the top.
        is_top = segment in in_top
        pose_level[first : first + is_top] = LEVELS - 1
        cuts = _thin(np.arange(first - 1 + is_top, end + 1), _LEAF_POSES + 1)
        for level, n_joined in zip(range(n_levels), (_LEAVES_IN_MIDDLE, _MIDDLES_IN_LARGE, n_poses, 1), strict=False):
            pose_level[cuts[1:-1]] = level + 1 if level + 1 < n_levels else LEVELS - 1
            n = len(cuts) - 1
            rows.append(np.stack([np.full(n, level), np.full(n, segment), cuts[:-1], cuts[1:]]))
            cuts = _thin(cuts, n_joined)
    level, segment_of, left, right = np.concatenate(rows, axis=1)
    order = np.lexsort([level, right])
    level, segment_of, left, right = level[order], segment_of[order], left[order], right[order]
    top = len(level)
    parent = np.full(top, top)
    for lower in range(n_levels - 1):
        above = np.flatnonzero(level == lower + 1)
        children = np.flatnonzero(level == lower)
        parent[children] = above[np.searchsorted(above, children)]
    return DissectionPieces(
        level=np.append(level, LEVELS - 1),
        parent=np.append(parent, top),
        segment=np.append(segment_of, -1),
        first=np.append(left + 1, 0),
        end=np.append(right, n_poses),
        left=np.append(np.where(left < segment_start[segment_of], -1, left), -1),
        right=np.append(np.where(right == segment_start[segment_of + 1], -1, right), -1),
        pose_level=pose_level,
    )


def _thin(cuts: IntArray, n_joined: int) -> IntArray:
    """Return the first cut, the last, and evenly spaced ones between, such that about `n_joined` pieces become one."""
    n = max(1, round((len(cuts) - 1) / n_joined))
    return cuts[(np.arange(n + 1) * (len(cuts) - 1)) // n]


@njit
def nodes_of_poses(level: IntVector, first: IntVector, end: IntVector, pose_level: IntVector) -> IntArray:
    """Return the node (P, LEVELS) of each level that contains a pose; -1 below the level at which it is eliminated."""
    node_of = np.full((len(pose_level), LEVELS), -1)
    for node in range(len(level)):
        for pose in range(first[node], end[node]):
            if pose_level[pose] <= level[node]:
                node_of[pose, level[node]] = node
    return node_of
