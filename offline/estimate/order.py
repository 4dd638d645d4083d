"""Order of elimination: nested dissection of each drive, points where the poses that see them meet, the rest last."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, IntArray
from groundsbot.offline.sam import common_ancestor

_LEAF: Final = 7  # poses of a leaf, between two separators
_FAN: Final = 5  # children of an inner node


def nodes_of(
    lengths: Sequence[int], pose: IntArray, point: IntArray, is_shared: BoolArray
) -> tuple[IntArray, IntArray, IntArray]:
    """Return the node of each pose and of each point, and the parent of each node.

    Args:
        lengths: number of poses of each drive.
        pose: (M,) of each reading.
        point: (M,) of each reading.
        is_shared: (Q,) whether other drives have a part in a point, which is then in the root, the last node.
    """
    pose_node = np.empty(sum(lengths), dtype=np.int64)
    parent: list[int] = []
    tops = []
    begin = 0
    for n in lengths:
        tops.append(_dissect(np.arange(begin, begin + n), pose_node, parent))
        begin += n
    root = len(parent)
    for top in tops:
        parent[top] = root
    parents = np.array([*parent, -1], dtype=np.int64)
    point_node = np.full(len(is_shared), root, dtype=np.int64)
    pairs = np.unique(point * (root + 1) + pose_node[pose])
    points, nodes = pairs // (root + 1), pairs % (root + 1)
    ends = np.searchsorted(points, np.arange(len(is_shared) + 1))
    for k in np.flatnonzero(~is_shared):
        own = nodes[ends[k] : ends[k + 1]].tolist()
        if own:
            point_node[k] = common_ancestor(own, parents)
    return pose_node, point_node, parents


def _dissect(own: IntArray, pose_node: IntArray, parent: list[int]) -> int:
    """Add the nodes of the poses of a drive, children first; return the topmost one."""
    nodes, separators = [], []
    for begin in range(0, len(own), _LEAF + 1):
        pose_node[own[begin : begin + _LEAF]] = len(parent)
        nodes.append(len(parent))
        parent.append(-1)
        separators += own[begin + _LEAF : begin + _LEAF + 1].tolist()
    while len(nodes) > 1:
        above, between = [], []
        for i in range(0, len(nodes), _FAN):
            for node in nodes[i : i + _FAN]:
                parent[node] = len(parent)
            inside = separators[i : min(i + _FAN, len(nodes)) - 1]
            pose_node[inside] = len(parent)
            between += separators[i + len(inside) : i + len(inside) + 1]
            above.append(len(parent))
            parent.append(-1)
        nodes, separators = above, between
    pose_node[separators] = nodes[0]  # a drive may end with one
    return nodes[0]
