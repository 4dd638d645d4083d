"""In which order the arrowhead system is eliminated: chains cut into nested pieces, tags where their last reading is.

A chain of poses is cut by separators into leaves of some 30 poses, these are joined by eights and then by fours, and
what is left meets in the top. The nodes of this tree are numbered children first. A node eliminates the separators
inside of it and the tags that are read nowhere else; its front holds them, then what they are coupled to: the
separators at both ends, the calibration of the chain, tags that others read too.

Columns are numbered 3 for each pose, 2 for each tag, then the calibration that is free.
"""

from typing import NamedTuple

import numpy as np

from calib.arrays import IntArray
from offline.arrowhead_cut import LEVELS, Pieces, cut, nodes_of_poses
from offline.jit import inner, jitted


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
    calibration_at: IntArray
    up: IntArray
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


class _Lists(NamedTuple):
    """What belongs to each node, one list after the other: members of `values` from start[node] to start[node + 1]."""

    start: IntArray
    values: IntArray


class _Fronts(NamedTuple):
    """Fields as in Tree."""

    n_eliminated: IntArray
    front_start: IntArray
    front: IntArray
    calibration_at: IntArray


def build_tree(
    chain_start: IntArray,
    reading_pose: IntArray,
    reading_tag: IntArray,
    n_tags: int,
    slot_start: IntArray,
    slots: IntArray,
    n_free: int,
) -> Tree:
    """The tree of a problem.

    Args:
        chain_start: (number of chains + 1,) first pose of each, then the number of poses.
        reading_pose: (M,) rising.
        reading_tag: (M,).
        n_tags: how many there are.
        slot_start: (number of chains + 1,) where each chain's slots begin.
        slots: the free calibration that each chain is coupled to.
        n_free: how much calibration is free.
    """
    pieces = cut(chain_start)
    n_poses, n_nodes = int(chain_start[-1]), len(pieces.level)
    node_of = nodes_of_poses(pieces.level, pieces.first, pieces.end, pieces.pose_level)
    home = _homes_of_tags(node_of, n_nodes - 1, reading_pose, reading_tag, n_tags)
    inner = np.flatnonzero(pieces.pose_level > 0)
    separators = _grouped(node_of[inner, pieces.pose_level[inner]], inner, n_nodes)
    tags = _grouped(home, np.arange(n_tags), n_nodes)
    shared_tags = _grouped(*_tags_in_nodes(node_of, reading_pose, reading_tag, home), n_nodes)
    fronts = _fronts(pieces, separators, tags, shared_tags, _Lists(slot_start, slots), n_poses, n_tags, n_free)
    home_of_reading = node_of[reading_pose, pieces.pose_level[reading_pose]]
    column_of_reading, n_columns = 3 * n_poses + 2 * reading_tag, 3 * n_poses + 2 * n_tags + n_free
    up, reading_at = _places(
        pieces.parent,
        np.argsort(pieces.parent[:-1], kind="stable"),
        fronts.front_start,
        fronts.front,
        home_of_reading,
        np.argsort(home_of_reading, kind="stable"),
        column_of_reading,
        n_columns,
    )
    up[_within(fronts.front_start, fronts.n_eliminated)] = -1
    size = np.diff(fronts.front_start)
    widest = [int(size[pieces.level == level].max(initial=0)) for level in range(LEVELS)]
    return Tree(
        *pieces[:7],
        *fronts,
        up=up,
        separator_start=separators.start,
        separators=separators.values,
        separator_chain=np.searchsorted(chain_start, separators.values, side="right") - 1,
        tag_start=tags.start,
        tags=tags.values,
        rows_start=np.concatenate([[0], np.cumsum((fronts.n_eliminated * size)[:-1])]),
        workspace_start=np.concatenate([[0], np.cumsum(np.square(widest))]),
        reading_start=np.searchsorted(reading_pose, np.arange(n_poses + 1)),
        reading_tag=reading_tag,
        reading_at=reading_at,
        slot_start=slot_start,
        slots=slots,
        chain_start=chain_start,
        n_poses=n_poses,
        n_tags=n_tags,
        n_calibration=n_free,
        n_slots=int(np.diff(slot_start).max(initial=0)),
    )


def _grouped(node: IntArray, values: IntArray, n_nodes: int) -> _Lists:
    """Values by node, order kept."""
    start = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=n_nodes))])
    return _Lists(start, values[np.argsort(node, kind="stable")])


@jitted
def _fronts(
    pieces: Pieces,
    separators: _Lists,
    tags: _Lists,
    shared_tags: _Lists,
    slots: _Lists,
    n_poses: int,
    n_tags: int,
    n_free: int,
) -> _Fronts:
    """Lays out each front: separators, own tags, separator on the left, calibration, others' tags, right separator."""
    n_nodes = len(pieces.level)
    n_eliminated, calibration_at = np.empty(n_nodes, dtype=np.int64), np.empty(n_nodes, dtype=np.int64)
    start, front = np.zeros(n_nodes + 1, dtype=np.int64), np.empty(0, dtype=np.int64)
    first_tag, first_free = 3 * n_poses, 3 * n_poses + 2 * n_tags
    for is_filling in (False, True):  # counted first
        at = 0
        for node in range(n_nodes):
            at = _add_columns(separators, node, 0, 3, front, at, is_filling)
            at = _add_columns(tags, node, first_tag, 2, front, at, is_filling)
            n_eliminated[node] = at - start[node]
            at = _add_pose(pieces.left[node], front, at, is_filling)
            calibration_at[node] = at - start[node]
            if pieces.chain[node] >= 0:
                at = _add_columns(slots, pieces.chain[node], first_free, 1, front, at, is_filling)
            else:
                n_eliminated[node] += n_free
                for a in range(n_free):
                    if is_filling:
                        front[at + a] = first_free + a
                at += n_free
            at = _add_columns(shared_tags, node, first_tag, 2, front, at, is_filling)
            at = _add_pose(pieces.right[node], front, at, is_filling)
            start[node + 1] = at
        if not is_filling:
            front = np.empty(at, dtype=np.int64)
    return _Fronts(n_eliminated, start, front, calibration_at)


@inner
def _add_columns(lists: _Lists, member: int, base: int, width: int, front: IntArray, at: int, is_filling: bool) -> int:
    """The columns of a list's variables, each `width` wide; returns where the next go."""
    for k in range(lists.start[member], lists.start[member + 1]):
        if is_filling:
            for i in range(width):
                front[at + i] = base + width * lists.values[k] + i
        at += width
    return at


@inner
def _add_pose(pose: int, front: IntArray, at: int, is_filling: bool) -> int:
    """The columns of a separator at an end, unless it is a chain's end."""
    if pose < 0:
        return at
    if is_filling:
        for i in range(3):
            front[at + i] = 3 * pose + i
    return at + 3


def _within(start: IntArray, length: IntArray) -> IntArray:
    """Indices of the first `length` members of each list."""
    return np.repeat(start[:-1] - np.cumsum(length) + length, length) + np.arange(int(length.sum()))


@jitted
def _places(
    parent: IntArray,
    children: IntArray,
    front_start: IntArray,
    front: IntArray,
    home_of_reading: IntArray,
    readings: IntArray,
    column_of_reading: IntArray,
    n_columns: int,
) -> tuple[IntArray, IntArray]:
    """Where each front's columns lie in the parent's front, and each reading's tag in the front of its pose's node.

    `children` are sorted by their parents, `readings` by their homes: sorting takes a second to compile.
    """
    n_nodes = len(parent)
    place = np.full(n_columns, -1)
    up = np.full(len(front), -1)
    reading_at = np.empty(len(home_of_reading), dtype=np.int64)
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


@jitted
def _homes_of_tags(node_of: IntArray, top: int, reading_pose: IntArray, reading_tag: IntArray, n_tags: int) -> IntArray:
    """(T,) the lowest node above the leaves in which all readings of a tag lie."""
    common = np.full((n_tags, LEVELS), -2)
    for m in range(len(reading_pose)):
        for level in range(1, LEVELS - 1):
            node, tag = node_of[reading_pose[m], level], reading_tag[m]
            if common[tag, level] == -2:
                common[tag, level] = node
            elif common[tag, level] != node:
                common[tag, level] = -1
    home = np.full(n_tags, top)
    for tag in range(n_tags):
        for level in range(LEVELS - 2, 0, -1):
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
