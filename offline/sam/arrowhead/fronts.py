"""Layout of the fronts of the elimination tree; see `arrowhead.tree`."""

from typing import NamedTuple

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.foundation import IndexMatrix, IntMatrix, IntVector, inner, njit
from groundsbot.offline.sam.arrowhead.dissection import LEVELS, DissectionPieces


class Lists(NamedTuple):
    """One list for each node: entries of `values` from start[node] to start[node + 1]."""

    start: IntVector
    values: IntVector


class CalibrationSlots(NamedTuple):
    """The calibration of each segment, with the fields of `Tree`, and the parameters of the top."""

    slot_start: IntVector
    slots: IntVector
    n_own_slots: IntVector
    in_top: IntVector


class Fronts(NamedTuple):
    """The fronts of all nodes, with the fields of `Tree`."""

    n_eliminated: IntArray
    front_start: IntArray
    front: IntArray
    calibration_at: IntArray


@njit
def fronts_of(
    pieces: DissectionPieces,
    separators: Lists,
    tags: Lists,
    shared_tags: Lists,
    calibration: CalibrationSlots,
    n_poses: int,
    n_tags: int,
) -> Fronts:
    """Lay out each front: separators, own tags, left separator, calibration, tags of ancestors, right separator.

    The node of a segment that eliminates calibration has no left separator.
    """
    n_nodes = len(pieces.level)
    n_eliminated, calibration_at = np.empty(n_nodes, dtype=np.int64), np.empty(n_nodes, dtype=np.int64)
    start, front = np.zeros(n_nodes + 1, dtype=np.int64), np.empty(0, dtype=np.int64)
    first_tag, first_free = 3 * n_poses, 3 * n_poses + 2 * n_tags
    slots = Lists(calibration.slot_start, calibration.slots)
    for is_filling in (False, True):  # the first pass counts
        at = 0
        for node in range(n_nodes):
            at = _add_columns(separators, node, 0, 3, front, at, is_filling)
            at = _add_columns(tags, node, first_tag, 2, front, at, is_filling)
            n_eliminated[node] = at - start[node]
            at = _add_pose(pieces.left[node], front, at, is_filling)
            calibration_at[node] = at - start[node]
            segment = pieces.segment[node]
            if segment >= 0:
                at = _add_columns(slots, segment, first_free, 1, front, at, is_filling)
                if pieces.level[node] == LEVELS - 2:
                    n_eliminated[node] += calibration.n_own_slots[segment]
            else:
                n_eliminated[node] += len(calibration.in_top)
                for a in range(len(calibration.in_top)):
                    if is_filling:
                        front[at + a] = first_free + calibration.in_top[a]
                at += len(calibration.in_top)
            at = _add_columns(shared_tags, node, first_tag, 2, front, at, is_filling)
            at = _add_pose(pieces.right[node], front, at, is_filling)
            start[node + 1] = at
        if not is_filling:
            front = np.empty(at, dtype=np.int64)
    return Fronts(n_eliminated, start, front, calibration_at)


@inner
def _add_columns(lists: Lists, member: int, base: int, width: int, front: IntArray, at: int, is_filling: bool) -> int:
    """Add the columns of a list's variables, each `width` wide; return the end."""
    for k in range(lists.start[member], lists.start[member + 1]):
        if is_filling:
            for i in range(width):
                front[at + i] = base + width * lists.values[k] + i
        at += width
    return at


@inner
def _add_pose(pose: int, front: IntArray, at: int, is_filling: bool) -> int:
    """Add the columns of a separator, if there is one; return the end."""
    if pose < 0:
        return at
    if is_filling:
        for i in range(3):
            front[at + i] = 3 * pose + i
    return at + 3


@njit
def places_of(
    parent: IntVector,
    children: IntVector,
    front_start: IntVector,
    front: IntVector,
    home_of_observation: IntVector,
    observations: IntVector,
    column_of_observation: IntVector,
    n_columns: int,
) -> tuple[IntArray, IntArray]:
    """Return positions of front columns in the parent's front, and of observed tags in the front of the pose's node.

    `children` must be sorted by parent and `observations` by node; compiling a sort would take a second.
    """
    n_nodes = len(parent)
    place = np.full(n_columns, -1)
    up = np.full(len(front), -1)
    observation_at = np.empty(len(home_of_observation), dtype=np.int64)
    next_child, next_observation = 0, 0
    for node in range(n_nodes):
        for i in range(front_start[node], front_start[node + 1]):
            place[front[i]] = i - front_start[node]
        while next_observation < len(observations) and home_of_observation[observations[next_observation]] == node:
            observation_at[observations[next_observation]] = place[
                column_of_observation[observations[next_observation]]
            ]
            next_observation += 1
        while next_child < len(children) and parent[children[next_child]] == node:
            child = children[next_child]
            for i in range(front_start[child], front_start[child + 1]):
                up[i] = place[front[i]]
            next_child += 1
    return up, observation_at


@njit
def homes_of_tags(
    node_of: IntMatrix, top: int, observation_pose: IntVector, observation_tag: IntVector, n_tags: int
) -> IntArray:
    """Return the lowest node (T,) above the leaves that contains all observations of a tag."""
    common = np.full((n_tags, LEVELS), -2)
    for m in range(len(observation_pose)):
        for level in range(1, LEVELS - 1):
            node, tag = node_of[observation_pose[m], level], observation_tag[m]
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


@njit
def tag_segments_of(
    segment_start: IntVector, observation_pose: IntVector, observation_tag: IntVector, n_tags: int
) -> tuple[IntArray, IntArray, IntArray]:
    """Return each observation's index (M,) into `Tree.tag_segments`, then `Tree.tag_segment_start` and these.

    Args:
        segment_start: first pose of each segment, then the number of poses.
        observation_pose: (M,) in ascending order.
        observation_tag: (M,) tags.
        n_tags: number of tags.
    """
    tag_segment, segment_of = np.empty(len(observation_pose), np.int64), np.empty(len(observation_pose), np.int64)
    last, start = np.full(n_tags, -1), np.zeros(n_tags + 1, np.int64)
    segment = 0
    for m in range(len(observation_pose)):
        while segment_start[segment + 1] <= observation_pose[m]:
            segment += 1
        segment_of[m] = segment
        if last[observation_tag[m]] != segment:
            last[observation_tag[m]] = segment
            start[observation_tag[m] + 1] += 1
    for tag in range(n_tags):
        start[tag + 1] += start[tag]
        last[tag] = start[tag] - 1
    tag_segments = np.full(start[n_tags], -1)
    for m in range(len(observation_pose)):
        tag = observation_tag[m]
        if last[tag] < start[tag] or tag_segments[last[tag]] != segment_of[m]:
            last[tag] += 1
            tag_segments[last[tag]] = segment_of[m]
        tag_segment[m] = last[tag]
    return tag_segment, start, tag_segments


@njit
def fill_slots(
    segment_start: IntVector,
    pose: IntVector,
    parameters: IndexMatrix,
    column: IntVector,
    slot: IndexMatrix,
    slots: IndexMatrix,
    is_filling: bool,
) -> None:
    """Set the slots of the parameters of factors; the first pass marks with 0 which parameters segments depend on.

    Args:
        segment_start: first pose of each segment, then the number of poses.
        pose: (M,) pose of each factor, in ascending order.
        parameters: (M, k) indices of the calibration parameters of each factor, fixed ones included.
        column: index of each parameter among the free ones; -1 if it is fixed.
        slot: (S, C) slot of each free parameter in each segment; written in the first pass, read in the second.
        slots: (M, k) -1, but for free parameters after the second pass.
        is_filling: whether this is the second pass.
    """
    segment = 0
    for m in range(len(pose)):
        while segment_start[segment + 1] <= pose[m]:
            segment += 1
        for k in range(parameters.shape[1]):
            free = column[parameters[m, k]]
            if free >= 0 and is_filling:
                slots[m, k] = slot[segment, free]
            elif free >= 0:
                slot[segment, free] = 0


@njit
def tags_in_nodes(
    node_of: IntMatrix, observation_pose: IntVector, observation_tag: IntVector, home: IntVector
) -> tuple[IntArray, IntArray]:
    """Return nodes and tags, in order of first observation, of tags in fronts that do not eliminate them."""
    n_tags = len(home)
    n_found = 0
    node = np.empty(LEVELS * len(observation_pose), dtype=np.int64)
    tag = np.empty(LEVELS * len(observation_pose), dtype=np.int64)
    for level in range(LEVELS - 1):
        last_seen = np.full(n_tags, -1)
        for m in range(len(observation_pose)):
            here, seen = node_of[observation_pose[m], level], observation_tag[m]
            if here >= 0 and last_seen[seen] != here:
                last_seen[seen] = here
                if home[seen] > here:
                    node[n_found], tag[n_found] = here, seen
                    n_found += 1
    return node[:n_found].copy(), tag[:n_found].copy()
