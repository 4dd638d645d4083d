"""Nested dissection of segments; see `arrowhead.tree`."""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import BoolArray, IntArray
from groundsbot.offline.foundation import BoolVector, IntVector, inner, njit

# Poses of a leaf and its separator, leaves of a middle node, and middle nodes of a large one.
_JOINED: Final = (31, 8, 4)
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
    is_top = np.zeros(len(segment_start) - 1, dtype=np.bool_)
    is_top[top_segments] = True
    return _cut(segment_start, is_top, LARGE + 1 + (len(is_top) > MOST_WITHOUT_OWN), _JOINED)


@njit
def _cut(segment_start: IntVector, is_top: BoolVector, n_levels: int, joined: tuple[int, int, int]) -> DissectionPieces:
    """Return the pieces of `n_levels` levels and the top; `joined` as `_JOINED`.

    A cut is a separator pose. The outer cuts are outside of the segment, or at a first pose that is in the top. The
    cuts of a level are evenly spaced ones of the level below. Nodes are in order of right cuts, then of levels.
    """
    n_segments, n_pieces = len(is_top), _count_pieces(segment_start, is_top, n_levels, joined)
    top = n_pieces.sum()
    level_of, segment_of = np.full(top + 1, LEVELS - 1), np.full(top + 1, -1)
    first, end = np.zeros(top + 1, np.int64), np.full(top + 1, segment_start[n_segments])
    left, right = np.full(top + 1, -1), np.full(top + 1, -1)
    pose_level, node = np.zeros(segment_start[n_segments], np.int64), 0
    for s in range(n_segments):
        outer, n_poses = segment_start[s] - 1 + is_top[s], segment_start[s + 1] - segment_start[s] + 1 - is_top[s]
        if is_top[s]:
            pose_level[segment_start[s]] = LEVELS - 1
        last, done = np.full(LEVELS, outer), np.zeros(LEVELS, np.int64)
        for leaf in range(1, n_pieces[s, 0] + 1):
            at, place, level = outer + leaf * n_poses // n_pieces[s, 0], leaf, 0
            while True:
                level_of[node], segment_of[node], first[node], end[node] = level, s, last[level] + 1, at
                left[node] = last[level] if last[level] >= segment_start[s] else -1
                right[node] = at if at < segment_start[s + 1] else -1
                last[level], done[level], node, level = at, place, node + 1, level + 1
                if level == n_levels or (done[level] + 1) * n_pieces[s, level - 1] // n_pieces[s, level] != place:
                    break
                place = done[level] + 1
            if at < segment_start[s + 1]:
                pose_level[at] = level if level < n_levels else LEVELS - 1
    return DissectionPieces(level_of, _parents_of(level_of, n_levels), segment_of, first, end, left, right, pose_level)


@inner
def _count_pieces(segment_start: IntArray, is_top: BoolArray, n_levels: int, joined: tuple[int, int, int]) -> IntArray:
    """Return the number of pieces (S, LEVELS) of each segment in each level."""
    n_pieces = np.zeros((len(is_top), LEVELS), np.int64)
    for s in range(len(is_top)):
        n = segment_start[s + 1] - segment_start[s] + 1 - is_top[s]
        for level in range(n_levels):
            n = max(1, int(np.rint(n / joined[level]))) if level < len(joined) else 1
            n_pieces[s, level] = n
    return n_pieces


@inner
def _parents_of(level: IntArray, n_levels: int) -> IntArray:
    """Return the parent (N,) of each node: the next one of the level above, or the top, which is the last node."""
    top = len(level) - 1
    parent, following = np.full(len(level), top), np.full(LEVELS, top)
    for node in range(top - 1, -1, -1):
        if level[node] + 1 < n_levels:
            parent[node] = following[level[node] + 1]
        following[level[node]] = node
    return parent


@njit
def nodes_of_poses(level: IntVector, first: IntVector, end: IntVector, pose_level: IntVector) -> IntArray:
    """Return the node (P, LEVELS) of each level that contains a pose; -1 below the level at which it is eliminated."""
    node_of = np.full((len(pose_level), LEVELS), -1)
    for node in range(len(level)):
        for pose in range(first[node], end[node]):
            if pose_level[pose] <= level[node]:
                node_of[pose, level[node]] = node
    return node_of
