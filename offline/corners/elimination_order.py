"""Order of elimination of the bundle adjustment: nested dissection of each segment, then shared variables."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.corners.factors import SpatialColumns
from groundsbot.offline.sam import EliminationFronts, OdometryFactors, Priors, build_fronts, common_ancestor

_LEAF: Final = 12  # poses of a leaf, between two separators
_FAN: Final = 6  # children of an inner node
# Consecutive poses without observations are coupled with their two neighbours and the wheels only. They are eliminated
# first, so many in one node.
_BLIND: Final = 8


def corner_order(
    columns: SpatialColumns,
    kinds: Sequence[IntArray],
    odometry: OdometryFactors,
    measured: Priors,
    pose: IntArray,
    tag: IntArray,
) -> EliminationFronts:
    """Assign variables to the nodes of an elimination tree, and lay out its fronts.

    Poses are in leaves and separators, a tag is in the lowest common ancestor of the poses that observe it, and
    calibration and first poses of segments are in the root.

    Args:
        columns: columns of all variables.
        kinds: columns (M, k) of each kind of factor.
        odometry: odometry factors, which connect consecutive poses.
        measured: priors; their poses and tags are in the root.
        pose: (M,) pose of each detection and observation.
        tag: (M,) tag of each detection and observation.
    """
    starts, distances = measured.starts, measured.distances
    ends = np.concatenate([starts.pose, distances.pose_a, distances.pose_b])
    ends = ends[ends >= 0]
    pose_node, parent = _segments(len(columns.poses), odometry, np.concatenate([pose, ends]), ends)
    root = len(parent) - 1
    seen = np.unique(tag * (root + 1) + pose_node[pose])
    nodes_of: list[list[int]] = [[] for _ in columns.tags]
    for key in seen.tolist():
        nodes_of[key // (root + 1)].append(key % (root + 1))
    tag_node = np.array([common_ancestor(nodes, parent) if nodes else root for nodes in nodes_of], dtype=np.int64)
    tag_node[measured.tags] = root
    node_of = np.full(columns.n, root, dtype=np.int64)
    for variable, node in (
        (columns.poses, pose_node[:, None]),
        (columns.tags, tag_node[:, None]),
        (columns.heights, tag_node),
        (columns.turns, tag_node[:, None]),
    ):
        node = np.broadcast_to(node, variable.shape)
        node_of[variable[variable >= 0]] = node[variable >= 0]
    return build_fronts(columns.n, node_of, parent, kinds)


def _segments(n_poses: int, odometry: OdometryFactors, seeing: IntArray, ends: IntArray) -> tuple[IntArray, IntArray]:
    """Return the node (P,) of each pose and the parent (N,) of each node.

    Nodes of consecutive poses without observations come first, then the nested dissection of the other poses of each
    segment. First poses of segments, and `ends`, are in the root.
    """
    begins = np.ones(n_poses, dtype=np.bool_)
    begins[odometry.first + 1] = False
    is_blind = ~begins
    is_blind[seeing] = False
    at = np.arange(n_poses)
    since = at - np.maximum.accumulate(np.where(is_blind, 0, at))  # 1 for the first of consecutive blind poses
    is_blind &= since % (_BLIND + 1) != 0
    first_blind = np.flatnonzero(is_blind & (since % (_BLIND + 1) == 1))
    n_blind = len(first_blind)
    pose_node = np.cumsum(is_blind & (since % (_BLIND + 1) == 1)) - 1
    parent = [-1] * n_blind
    segment, tops = np.cumsum(begins) - 1, []
    others = np.flatnonzero(~is_blind & ~begins)
    for own in np.split(others, np.flatnonzero(np.diff(segment[others])) + 1):
        if len(own):
            tops.append(_segment(own, pose_node, parent))
    root = len(parent)
    for top in tops:
        parent[top] = root
    pose_node[begins] = root
    pose_node[ends] = root
    # The neighbours of a blind node are on one path to the root; its parent is the lower one.
    last_blind = np.flatnonzero(is_blind & ~np.append(is_blind[1:] & (since[1:] % (_BLIND + 1) != 1), [False]))
    before = pose_node[first_blind - 1]
    has_next = last_blind + 1 < n_poses
    after = np.where(has_next, last_blind + 1, 0)
    after = np.where(has_next & ~begins[after], pose_node[after], root)
    nodes = np.array([*parent, -1], dtype=np.int64)
    nodes[:n_blind] = np.minimum(before, after)
    return pose_node, nodes


def _segment(own: IntArray, pose_node: IntArray, parent: list[int]) -> int:
    """Add the nodes of the poses (n,) of a segment; return the topmost one."""
    nodes, separators = [], []
    for begin in range(0, len(own), _LEAF + 1):
        pose_node[own[begin : begin + _LEAF]] = len(parent)
        nodes.append(len(parent))
        parent.append(-1)
        if begin + _LEAF < len(own):
            separators.append(int(own[begin + _LEAF]))
    while len(nodes) > 1:
        above, between = [], []
        for i in range(0, len(nodes), _FAN):
            branch = len(parent)
            parent.append(-1)
            for node in nodes[i : i + _FAN]:
                parent[node] = branch
            inside = separators[i : min(i + _FAN, len(nodes)) - 1]
            pose_node[inside] = branch
            between += separators[i + len(inside) : i + len(inside) + 1]
            above.append(branch)
        nodes, separators = above, between
    for separator in separators:  # a segment may end with a separator
        pose_node[separator] = nodes[0]
    return nodes[0]
