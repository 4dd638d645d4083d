"""In which order an estimate on corners is eliminated: each chain by nested dissection, then what chains share."""

from typing import TYPE_CHECKING, Final

import numpy as np

from calib.arrays import IntArray
from offline.fronts import Fronts, build_fronts, common_ancestor

if TYPE_CHECKING:
    from offline.corner_problem import CornerProblem

# Poses that one leaf eliminates, between two separators, and leaves or branches that meet in a branch.
_LEAF: Final = 12
_FAN: Final = 6


def corner_order(problem: "CornerProblem") -> Fronts:
    """Poses in leaves and separators, tags where all who saw them meet, calibration and starts at the root."""
    columns, kinds = problem.columns, problem.kinds()
    pose_node, parent = _chains(problem)
    root = len(parent) - 1
    starts, distances = problem.measured.starts, problem.measured.distances
    ends = np.concatenate([starts.pose, distances.pose_a, distances.pose_b])
    pose_node[ends[ends >= 0]] = root
    pose = np.concatenate([problem.corners.looks.pose, problem.readings.pose])
    tag = np.concatenate([problem.corners.looks.tag, problem.readings.tag])
    seen = np.unique(tag * (root + 1) + pose_node[pose])
    nodes_of: list[list[int]] = [[] for _ in columns.tags]
    for key in seen.tolist():
        nodes_of[key // (root + 1)].append(key % (root + 1))
    tag_node = np.array([common_ancestor(nodes, parent) if nodes else root for nodes in nodes_of], dtype=np.int64)
    tag_node[problem.measured.tags] = root
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


def _chains(problem: "CornerProblem") -> tuple[IntArray, IntArray]:
    """(P,) node of each pose and (N,) parent of each node; starts of chains are at the root."""
    n_poses = len(problem.columns.poses)
    begins = np.ones(n_poses + 1, dtype=np.bool_)
    begins[problem.odometry.first + 1] = False
    bounds = np.flatnonzero(begins)
    pose_node = np.empty(n_poses, dtype=np.int64)
    parent: list[int] = []
    tops = []
    for first, end in zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True):
        tops.append(_chain(first + 1, end, pose_node, parent))
    root = len(parent)
    for top in tops:
        if top >= 0:
            parent[top] = root
    pose_node[bounds[:-1]] = root
    return pose_node, np.array([*parent, -1], dtype=np.int64)


def _chain(first: int, end: int, pose_node: IntArray, parent: list[int]) -> int:
    """Adds the nodes of poses first to end - 1; its topmost node, -1 where there are no poses."""
    nodes, separators = [], []
    for begin in range(first, end, _LEAF + 1):
        pose_node[begin : min(begin + _LEAF, end)] = len(parent)
        nodes.append(len(parent))
        parent.append(-1)
        if begin + _LEAF < end:
            separators.append(begin + _LEAF)
    while len(nodes) > 1:
        above, left = [], []
        for i in range(0, len(nodes), _FAN):
            branch = len(parent)
            parent.append(-1)
            for node in nodes[i : i + _FAN]:
                parent[node] = branch
            inside = separators[i : min(i + _FAN, len(nodes)) - 1]
            pose_node[inside] = branch
            left += separators[i + len(inside) : i + len(inside) + 1]
            above.append(branch)
        nodes, separators = above, left
    for separator in separators:  # a chain may end in one
        pose_node[separator] = nodes[0]
    return nodes[0] if nodes else -1
