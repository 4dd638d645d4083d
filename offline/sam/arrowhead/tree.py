"""The elimination tree: nested dissection of segments, with each tag in the lowest node that contains its observations.

Separators cut a segment of poses into leaves of about 30 poses. Eight leaves form a middle node, four middle nodes a
large one. The remaining separators are in the top, or, of many segments, in a node of each. Nodes are numbered children
first. A node eliminates the separators inside of it and the tags that are observed nowhere else. Its front contains
these, then the columns that they are coupled with: the separators at both ends, the calibration of the segment, and
tags that are observed elsewhere too. Calibration is in the top, but for that of one segment alone, which the node of
this segment eliminates, if there is one and its first pose is not in the top.

A segment's first pose and any tag can be assigned to the top, so that tape measurements between them couple columns of
the top only.

Columns are numbered 3 for each pose, 2 for each tag, then 1 for each free calibration parameter.
"""

from typing import NamedTuple

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.foundation import IntVector, inner
from groundsbot.offline.sam.arrowhead.dissection import LEVELS, cut, nodes_of_poses
from groundsbot.offline.sam.arrowhead.fronts import (
    CalibrationSlots,
    Fronts,
    Lists,
    fronts_of,
    homes_of_tags,
    places_of,
    tags_in_nodes,
)


class Tree(NamedTuple):
    """The nodes, children first. Lists of all nodes are concatenated, with the start of each list in `*_start`.

    Attributes:
        level: (N,) 0 for a leaf, LEVELS - 1 for the top, which is the last node.
        parent: (N,) parent node; the top is its own parent.
        segment: (N,) segment of the node; -1 for the top.
        first, end: (N,) poses first to end - 1 are in the node; a leaf eliminates all of them.
        left, right: (N,) separator poses at both ends; -1 at a segment's ends.
        n_eliminated: (N,) number of eliminated columns, the first ones of the front; 0 for a leaf, whose own poses are
            not in its front.
        front_start, front: columns of each node's front.
        up: position of each entry of `front` in the parent's front; -1 where eliminated.
        calibration_at: (N,) position of the first calibration column in the front.
        separator_start, separators: poses that a node above the leaves eliminates, in the order of the front.
        separator_segment: segment of each of `separators`.
        tag_start, tags: tags that a node eliminates, after the separators, in the order of the front.
        rows_start: (N,) start of a node's rows of R in `SquareRootFactor.inner`.
        workspace_start: (LEVELS,) start of the front of each level in `SquareRootFactor.workspace`.
        observation_start: (P + 1,) start of the observations of each pose.
        observation_tag: (M,) tag of each observation.
        observation_at: (M,) position of the tag in the front of the node that eliminates the pose.
        slot_start, slots: indices of the free calibration parameters that each segment is coupled with.
        n_own_slots: (S,) number of them, the first ones, that the segment's node eliminates.
        calibration_in_top: (C,) position of each free parameter among those of the top; -1 if it is not there.
        tag_segment_start: (T + 1,) start of the segments that observe each tag.
        tag_segments: (Q,) these segments, ascending for each tag.
        segment_start: first pose of each segment, then the number of poses.
        n_poses, n_tags, n_calibration: numbers of poses, tags and free calibration parameters.
        n_slots: length of the longest list in `slots`.
    """

    level: IntVector
    parent: IntVector
    segment: IntVector
    first: IntVector
    end: IntVector
    left: IntVector
    right: IntVector
    n_eliminated: IntVector
    front_start: IntVector
    front: IntVector
    calibration_at: IntVector
    up: IntVector
    separator_start: IntVector
    separators: IntVector
    separator_segment: IntVector
    tag_start: IntVector
    tags: IntVector
    rows_start: IntVector
    workspace_start: IntVector
    observation_start: IntVector
    observation_tag: IntVector
    observation_at: IntVector
    slot_start: IntVector
    slots: IntVector
    n_own_slots: IntVector
    calibration_in_top: IntVector
    tag_segment_start: IntVector
    tag_segments: IntVector
    segment_start: IntVector
    n_poses: int
    n_tags: int
    n_calibration: int
    n_slots: int


@inner
def n_slots_of(tree: Tree, node: int) -> int:
    """Return the number of calibration parameters that the segment of a node is coupled with."""
    segment = tree.segment[node]
    return int(tree.slot_start[segment + 1] - tree.slot_start[segment])


class Couplings(NamedTuple):
    """The couplings between poses, tags and calibration.

    Attributes:
        segment_start: (S + 1,) first pose of each segment, then the number of poses.
        observation_pose: (M,) pose of each observation, in ascending order.
        observation_tag: (M,) tag of each observation.
        slot_start, slots, n_own_slots, calibration_in_top, tag_segment_start, tag_segments: as in `Tree`.
        n_tags, n_free: numbers of tags and of free calibration parameters.
        top_segments: segments whose first pose is eliminated in the top.
        top_tags: tags that are eliminated in the top.
    """

    segment_start: IntArray
    observation_pose: IntArray
    observation_tag: IntArray
    slot_start: IntArray
    slots: IntArray
    n_own_slots: IntArray
    calibration_in_top: IntArray
    tag_segment_start: IntArray
    tag_segments: IntArray
    n_tags: int
    n_free: int
    top_segments: IntArray
    top_tags: IntArray


def build_tree(couplings: Couplings) -> Tree:
    """Build the elimination tree."""
    segment_start, observation_pose, observation_tag = couplings[:3]
    pieces = cut(segment_start, couplings.top_segments)
    n_nodes = len(pieces.level)
    node_of = nodes_of_poses(pieces.level, pieces.first, pieces.end, pieces.pose_level)
    home = homes_of_tags(node_of, n_nodes - 1, observation_pose, observation_tag, couplings.n_tags)
    home[couplings.top_tags] = n_nodes - 1
    inner_poses = np.flatnonzero(pieces.pose_level > 0)
    separators = _group(node_of[inner_poses, pieces.pose_level[inner_poses]], inner_poses, n_nodes)
    tags = _group(home, np.arange(couplings.n_tags), n_nodes)
    shared_tags = _group(*tags_in_nodes(node_of, observation_pose, observation_tag, home), n_nodes)
    calibration = CalibrationSlots(
        couplings.slot_start, couplings.slots, couplings.n_own_slots, np.flatnonzero(couplings.calibration_in_top >= 0)
    )
    n_poses = int(segment_start[-1])
    fronts = fronts_of(pieces, separators, tags, shared_tags, calibration, n_poses, couplings.n_tags)
    up, observation_at = _places(
        pieces.parent, fronts, node_of[observation_pose, pieces.pose_level[observation_pose]], couplings
    )
    size = np.diff(fronts.front_start)
    widest = [int(size[pieces.level == level].max(initial=0)) for level in range(LEVELS)]
    return Tree(
        *pieces[:7],
        *fronts,
        up=up,
        separator_start=separators.start,
        separators=separators.values,
        separator_segment=np.searchsorted(segment_start, separators.values, side="right") - 1,
        tag_start=tags.start,
        tags=tags.values,
        rows_start=np.concatenate([[0], np.cumsum((fronts.n_eliminated * size)[:-1])]),
        workspace_start=np.concatenate([[0], np.cumsum(np.square(widest))]),
        observation_start=np.concatenate([[0], np.cumsum(np.bincount(observation_pose, minlength=n_poses))]),
        observation_tag=observation_tag,
        observation_at=observation_at,
        slot_start=couplings.slot_start,
        slots=couplings.slots,
        n_own_slots=couplings.n_own_slots,
        calibration_in_top=couplings.calibration_in_top,
        tag_segment_start=couplings.tag_segment_start,
        tag_segments=couplings.tag_segments,
        segment_start=segment_start,
        n_poses=n_poses,
        n_tags=couplings.n_tags,
        n_calibration=couplings.n_free,
        n_slots=int(np.diff(couplings.slot_start).max(initial=0)),
    )


def _places(
    parent: IntArray, fronts: Fronts, home_of_observation: IntArray, couplings: Couplings
) -> tuple[IntArray, IntArray]:
    """Return `Tree.up` and `Tree.observation_at`."""
    first_tag = 3 * int(couplings.segment_start[-1])
    up, observation_at = places_of(
        parent,
        np.argsort(parent[:-1], kind="stable"),
        fronts.front_start,
        fronts.front,
        home_of_observation,
        np.argsort(home_of_observation, kind="stable"),
        first_tag + 2 * couplings.observation_tag,
        first_tag + 2 * couplings.n_tags + couplings.n_free,
    )
    up[_within(fronts.front_start, fronts.n_eliminated)] = -1
    return up, observation_at


def _group(node: IntArray, values: IntArray, n_nodes: int) -> Lists:
    """Group values by node, in their order."""
    start = np.concatenate([[0], np.cumsum(np.bincount(node, minlength=n_nodes))])
    return Lists(start, values[np.argsort(node, kind="stable")])


def _within(start: IntArray, length: IntArray) -> IntArray:
    """Return the indices of the first `length` members of each list."""
    return np.repeat(start[:-1] - np.cumsum(length) + length, length) + np.arange(int(length.sum()))
