"""In which order the arrowhead system is eliminated: chains cut into nested pieces, tags where their last reading is.

A chain of poses is cut by separators into leaves of some 30 poses, these are joined by eights and then by fours, and
what is left meets in the top. The nodes of this tree are numbered children first. A node eliminates the separators
inside of it and the tags that are read nowhere else; its front holds them, then what they are coupled to: the
separators at both ends, the calibration of the chain, tags that others read too.

Columns are numbered 3 for each pose, 2 for each tag, then the calibration that is free.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from calib.arrays import IntArray
from offline.jit import jitted

_LEAF_POSES: Final = 30
_LEAVES_IN_MIDDLE: Final = 8
_MIDDLES_IN_LARGE: Final = 4
LEVELS: Final = 4  # leaf, middle, large, top


class Tree(NamedTuple):
    """Nodes, children first; lists of several nodes lie one after the other with the start of each in `*_start`.

    Attributes:
        level: (N,) 0 for a leaf, LEVELS - 1 for the top, which is the last node.
        parent: (N,) node; the top's own index for the top.
        chain: (N,) whose calibration it is coupled to; -1 for the top.
        first, end: (N,) poses first to end - 1 lie in the node; in a leaf all of them are eliminated there.
        left, right: (N,) separator poses at both ends; -1 at a chain's ends.
        n_eliminated: (N,) columns, the first ones of the front; 0 for a leaf, whose own poses are not in its front.
        front_start, front: columns of each node's front.
        up: place of each of `front` in the parent's front; -1 where eliminated.
        calibration_at: (N,) place of the first calibration column in the front.
        separator_start, separators: poses that a node above the leaves eliminates, in the front's order;
            separator_chain: the chain of each.
        tag_start, tags: tags that a node eliminates, in the front's order after the separators.
        rows_start: (N,) where a node's eliminated rows are kept.
        workspace_start: (LEVELS,) where the front of each level is built up.
        reading_start: (P+1,) readings of each pose; reading_tag: (M,) tag of each; reading_at: (M,) its place in the
            front of the node that eliminates the pose.
        slot_start, slots: calibration that each chain is coupled to, as indices among what is free.
        chain_start: first pose of each chain, then the number of poses.
        n_poses, n_tags, n_calibration, n_slots: numbers of each; n_slots is the longest chain list.
    """

    level: IntArray
    parent: IntArray
    chain: IntArray
    first: IntArray
    end: IntArray
    left: IntArray
    right: IntArray
    n_eliminated: IntArray
    front_start: IntArray
    front: IntArray
    up: IntArray
    calibration_at: IntArray
    separator_start: IntArray
    separators: IntArray
    separator_chain: IntArray
    tag_start: IntArray
    tags: IntArray
    rows_start: IntArray
    workspace_start: IntArray
    reading_start: IntArray
    reading_tag: IntArray
    reading_at: IntArray
    slot_start: IntArray
    slots: IntArray
    chain_start: IntArray
    n_poses: int
    n_tags: int
    n_calibration: int
    n_slots: int


class _Pieces(NamedTuple):
    """The tree before tags: fields as in Tree, and the level (P,) at which each pose is eliminated."""

    level: IntArray
    parent: IntArray
    chain: IntArray
    first: IntArray
    end: IntArray
    left: IntArray
    right: IntArray
    pose_level: IntArray


def build_tree(
    chain_start: IntArray,
    reading_pose: IntArray,
    reading_tag: IntArray,
    n_tags: int,
    slots: list[IntArray],
    n_free: int,
) -> Tree:
    """The tree of a problem.

    Args:
        chain_start: (number of chains + 1,) first pose of each, then the number of poses.
        reading_pose: (M,) rising.
        reading_tag: (M,).
        n_tags: how many there are.
        slots: for each chain the free calibration that it is coupled to.
        n_free: how much calibration is free.
    """
    pieces = _cut(chain_start)
    n_poses, n_nodes = int(chain_start[-1]), len(pieces.level)
    slot_start, all_slots = _starts(slots), _joined(slots)
    node_of = _nodes_of_poses(pieces)
    home = _homes_of_tags(node_of, reading_pose, reading_tag, n_tags)
    inner = np.flatnonzero(pieces.pose_level > 0)
    separators = _grouped(node_of[inner, pieces.pose_level[inner]], inner, n_nodes)
    tags = _grouped(home, np.arange(n_tags), n_nodes)
    shared_tags = _grouped(*_tags_in_nodes(node_of, reading_pose, reading_tag, home), n_nodes)

    def calibration(node: int) -> IntArray:
        chain = pieces.chain[node]
        return np.arange(n_free) if chain < 0 else slots[chain]

    columns, n_eliminated, calibration_at = [], [], []
    for node in range(n_nodes):
        own = [_pose_columns(separators[node]), _tag_columns(tags[node], n_poses)]
        left, right = (_pose_columns(end[node : node + 1][end[node : node + 1] >= 0]) for end in pieces[5:7])
        n_eliminated.append(len(own[0]) + len(own[1]))
        calibration_at.append(n_eliminated[-1] + len(left))
        free = 3 * n_poses + 2 * n_tags + calibration(node)
        columns.append(np.concatenate([*own, left, free, _tag_columns(shared_tags[node], n_poses), right]))
    n_eliminated[-1] += n_free
    front_start, front = _starts(columns), _joined(columns)
    size = np.diff(front_start)
    eliminated = np.array(n_eliminated)
    home_of_reading = node_of[reading_pose, pieces.pose_level[reading_pose]]
    up, reading_at = _places(
        pieces.parent,
        front_start,
        front,
        home_of_reading,
        3 * n_poses + 2 * reading_tag,
        3 * n_poses + 2 * n_tags + n_free,
    )
    up[_within(front_start, eliminated)] = -1
    widest = [int(size[pieces.level == level].max(initial=0)) for level in range(LEVELS)]
    return Tree(
        *pieces[:7],
        n_eliminated=eliminated,
        front_start=front_start,
        front=front,
        up=up,
        calibration_at=np.array(calibration_at),
        separator_start=_starts(separators),
        separators=_joined(separators),
        separator_chain=np.searchsorted(chain_start, _joined(separators), side="right") - 1,
        tag_start=_starts(tags),
        tags=_joined(tags),
        rows_start=np.concatenate([[0], np.cumsum((eliminated * size)[:-1])]),
        workspace_start=np.concatenate([[0], np.cumsum(np.square(widest))]),
        reading_start=np.searchsorted(reading_pose, np.arange(n_poses + 1)).astype(np.int64),
        reading_tag=reading_tag,
        reading_at=reading_at,
        slot_start=slot_start,
        slots=all_slots,
        chain_start=chain_start,
        n_poses=n_poses,
        n_tags=n_tags,
        n_calibration=n_free,
        n_slots=int(np.diff(slot_start).max(initial=0)),
    )


def _starts(lists: Sequence[IntArray]) -> IntArray:
    return np.concatenate([[0], np.cumsum([len(own) for own in lists])]).astype(np.int64)


def _joined(lists: Sequence[IntArray]) -> IntArray:
    return np.concatenate([np.zeros(0, dtype=np.int64), *lists]).astype(np.int64)


def _pose_columns(poses: IntArray) -> IntArray:
    return (3 * poses[:, None] + np.arange(3)).reshape(-1)


def _tag_columns(tags: IntArray, n_poses: int) -> IntArray:
    return (3 * n_poses + 2 * tags[:, None] + np.arange(2)).reshape(-1)


def _within(start: IntArray, length: IntArray) -> IntArray:
    """Indices of the first `length` members of each list."""
    return np.repeat(start[:-1] - np.cumsum(length) + length, length) + np.arange(int(length.sum()))


@jitted
def _places(
    parent: IntArray,
    front_start: IntArray,
    front: IntArray,
    home_of_reading: IntArray,
    column_of_reading: IntArray,
    n_columns: int,
) -> tuple[IntArray, IntArray]:
    """Where each front's columns lie in the parent's front, and each reading's tag in the front of its pose's node."""
    n_nodes = len(parent)
    place = np.full(n_columns, -1)
    up = np.full(len(front), -1)
    reading_at = np.empty(len(home_of_reading), dtype=np.int64)
    children = np.argsort(parent[:-1], kind="mergesort")
    readings = np.argsort(home_of_reading, kind="mergesort")
    next_child, next_reading = 0, 0
    for node in range(n_nodes):
        for i in range(front_start[node], front_start[node + 1]):
            place[front[i]] = i - front_start[node]
        while next_reading < len(readings) and home_of_reading[readings[next_reading]] == node:
            reading_at[readings[next_reading]] = place[column_of_reading[readings[next_reading]]]
            next_reading += 1
        while next_child < len(children) and parent[children[next_child]] == node:
            child = children[next_child]
            for i in range(front_start[child], front_start[child + 1]):
                up[i] = place[front[i]]
            next_child += 1
    return up, reading_at


def _cut(chain_start: IntArray) -> _Pieces:
    """Cuts each chain evenly into leaves, and joins these."""
    n_poses = int(chain_start[-1])
    pose_level = np.zeros(n_poses, dtype=np.int64)
    rows = []  # level, chain, cut on the left, cut on the right
    for chain, (first, end) in enumerate(zip(chain_start[:-1].tolist(), chain_start[1:].tolist(), strict=True)):
        # A cut is a pose, a separator; those at the chain's ends lie outside of it.
        cuts = _thinned(np.arange(first - 1, end + 1), _LEAF_POSES + 1)
        for level, n_joined in enumerate((_LEAVES_IN_MIDDLE, _MIDDLES_IN_LARGE, 1)):
            pose_level[cuts[1:-1]] = level + 1
            n = len(cuts) - 1
            rows.append(np.stack([np.full(n, level), np.full(n, chain), cuts[:-1], cuts[1:]]))
            cuts = _thinned(cuts, n_joined)
    level, chain_of, left, right = np.concatenate(rows, axis=1)
    order = np.lexsort([level, right])
    level, chain_of, left, right = level[order], chain_of[order], left[order], right[order]
    top = len(level)
    parent = np.full(top, top)
    for lower in range(LEVELS - 2):
        above = np.flatnonzero(level == lower + 1)
        children = np.flatnonzero(level == lower)
        parent[children] = above[np.searchsorted(above, children)]
    return _Pieces(
        level=np.append(level, LEVELS - 1),
        parent=np.append(parent, top),
        chain=np.append(chain_of, -1),
        first=np.append(left + 1, 0),
        end=np.append(right, n_poses),
        left=np.append(np.where(left < chain_start[chain_of], -1, left), -1),
        right=np.append(np.where(right == chain_start[chain_of + 1], -1, right), -1),
        pose_level=pose_level,
    )


def _thinned(cuts: IntArray, n_joined: int) -> IntArray:
    """The first, the last and evenly some between, so that about `n_joined` pieces become one."""
    n = max(1, round((len(cuts) - 1) / n_joined))
    return cuts[(np.arange(n + 1) * (len(cuts) - 1)) // n]


def _nodes_of_poses(pieces: _Pieces) -> IntArray:
    """(P, LEVELS) node of each level that a pose lies in; -1 below the level at which it is eliminated."""
    node_of = np.full((len(pieces.pose_level), LEVELS), -1)
    for node, (level, first, end) in enumerate(zip(pieces.level, pieces.first, pieces.end, strict=True)):
        node_of[first:end, level] = node
    node_of[pieces.pose_level[:, None] > np.arange(LEVELS)] = -1
    return node_of


@jitted
def _homes_of_tags(node_of: IntArray, reading_pose: IntArray, reading_tag: IntArray, n_tags: int) -> IntArray:
    """(T,) the lowest node above the leaves in which all readings of a tag lie."""
    top = node_of.max()
    common = np.full((n_tags, LEVELS), -2)
    common[:, LEVELS - 1] = top
    for m in range(len(reading_pose)):
        for level in range(1, LEVELS - 1):
            node, tag = node_of[reading_pose[m], level], reading_tag[m]
            if common[tag, level] == -2:
                common[tag, level] = node
            elif common[tag, level] != node:
                common[tag, level] = -1
    home = np.full(n_tags, top)
    for tag in range(n_tags):
        for level in range(LEVELS - 1, 0, -1):
            if common[tag, level] >= 0:
                home[tag] = common[tag, level]
    return home


@jitted
def _tags_in_nodes(
    node_of: IntArray, reading_pose: IntArray, reading_tag: IntArray, home: IntArray
) -> tuple[IntArray, IntArray]:
    """Nodes and tags, in the order of first reading: which tags a front holds without eliminating them."""
    n_tags = len(home)
    n_found = 0
    node = np.empty(LEVELS * len(reading_pose), dtype=np.int64)
    tag = np.empty(LEVELS * len(reading_pose), dtype=np.int64)
    for level in range(LEVELS - 1):
        last_seen = np.full(n_tags, -1)
        for m in range(len(reading_pose)):
            here, seen = node_of[reading_pose[m], level], reading_tag[m]
            if here >= 0 and last_seen[seen] != here:
                last_seen[seen] = here
                if home[seen] > here:
                    node[n_found], tag[n_found] = here, seen
                    n_found += 1
    return node[:n_found].copy(), tag[:n_found].copy()


def _grouped(node: IntArray, values: IntArray, n_nodes: int) -> list[IntArray]:
    """Values by node, order kept."""
    order = np.argsort(node, kind="stable")
    return np.split(values[order], np.cumsum(np.bincount(node, minlength=n_nodes))[:-1])
