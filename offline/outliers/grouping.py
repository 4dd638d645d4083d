"""Grouping of tracks where a drive passes a tag hundreds of times.

The work for a tag grows with the square of its number of tracks. The root of the joint covariance grows with the number
of tracks in one piece of the elimination order. Separate tracks do not help there, since a tag that moved did so for
many of its tracks. So tracks that begin in one piece of the elimination order are grouped. The pieces have 30, 250 or
1,000 keyframes, or twice or four times as many; the smallest that leave few enough tracks are taken. A part of the
tracks that the search splits off is grouped again in smaller pieces, or not at all. A move is so found to the track.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.outliers.tracks import Tracks, split_places
from groundsbot.offline.sam import LARGE, Graph, Tree

# Largest number of tracks of one tag. The search among these takes as long as a few linearisations. Drives of the
# project's worlds, and of the paper, pass a tag two to ten times.
_MOST_OF_A_TAG: Final = 128
# Largest number of tracks of all tags together: this many, and one per 16 keyframes. A drive begins a track about every
# fifty keyframes, or every twenty where tags are dense.
_FREE: Final = 2048
_KEYFRAMES_A_TRACK: Final = 16
_LEVELS: Final = LARGE + 1  # of the order of elimination, whose pieces are these


def few_of_each_tag(graph: Graph, tracks: Tracks) -> Tracks:
    """Return the tracks, grouped for tags that have very many; the same object if no tag has."""
    tag = split_places(graph.segments, tracks)
    most = _most_of_each(np.bincount(tag), _FREE + len(graph.problem.columns.poses) // _KEYFRAMES_A_TRACK)
    if np.bincount(tag, minlength=1).max() <= most:
        return tracks
    tree = graph.problem.arrowhead.tree
    pose = np.full(len(tracks), tree.n_poses)
    np.minimum.at(pose, tracks.of_observation, graph.problem.observations.pose)
    group = np.arange(len(tracks))
    is_many, level = np.bincount(tag)[tag] > most, 0
    while is_many.any() and level <= _LEVELS + int(tree.n_poses).bit_length():
        keys = np.column_stack([tag, tracks.segment, _piece_of(tree, level)[pose]])
        found = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1)
        group[is_many] = (level + 1) * len(tracks) + found[is_many]  # distinct from the groups of earlier levels
        is_many &= _n_groups(tag, group)[tag] > most
        level += 1
    return _merge_groups(tracks, group)


def _most_of_each(n_of_tag: IntArray, most_of_all: int) -> int:
    """Return the largest number of tracks of each tag with which all tags (T,) have at most `most_of_all` together."""
    n_available, n_tags = most_of_all, len(n_of_tag)
    for n in np.sort(np.minimum(n_of_tag, _MOST_OF_A_TAG)).tolist():
        if n * n_tags > n_available:
            return max(1, n_available // n_tags)
        n_available, n_tags = n_available - n, n_tags - 1
    return _MOST_OF_A_TAG


def _piece_of(tree: Tree, level: int) -> IntArray:
    """Return the piece (P,) of the elimination order of each pose, from 0.

    Beyond the levels of the order, each further level joins two pieces in one.
    """
    ends = tree.end[tree.level == min(level, _LEVELS - 1)]
    return np.searchsorted(np.sort(ends), np.arange(tree.n_poses), side="right") >> max(0, level - _LEVELS + 1)


def _n_groups(tag: IntArray, group: IntArray) -> IntArray:
    """Return the number of groups (T,) of each tag, by the tag (S,) and the group (S,) of each track."""
    pairs = np.unique(np.column_stack([tag, group]), axis=0)
    return np.bincount(pairs[:, 0])


def _merge_groups(tracks: Tracks, group: IntArray) -> Tracks:
    """Return one track for each group (S,); the tracks of a group are of one tag in one segment."""
    _, one, number = np.unique(group, return_index=True, return_inverse=True)
    first_ns, last_ns = tracks.first_ns[one], tracks.last_ns[one]
    np.minimum.at(first_ns, number, tracks.first_ns)
    np.maximum.at(last_ns, number, tracks.last_ns)
    n_observations = np.zeros(len(one), dtype=np.int64)
    np.add.at(n_observations, number, tracks.n_observations)
    order = np.lexsort((first_ns, tracks.segment[one], tracks.id[one]))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return replace(
        tracks,
        of_observation=rank[number][tracks.of_observation],
        id=tracks.id[one][order],
        segment=tracks.segment[one][order],
        first_ns=first_ns[order],
        last_ns=last_ns[order],
        n_observations=n_observations[order],
        tag=tracks.tag[one][order],
    )
