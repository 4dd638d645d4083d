"""Tags that a drive passes hundreds of times: passings within one piece of the drive count as one track.

What is worked out about a tag grows with the square of its tracks, and the root of the covariance of them all by
how many fall into one piece of the order of elimination. Nothing is to be gained there: a tag that was moved was so for
many of its tracks. So those that begin in one leaf of that order are taken together, or in one of the larger pieces
(30, 250, 1,000 keyframes and twice, four times that), the smallest that leave few enough. What the search then gives a
place of its own has fewer tracks, is gathered in smaller pieces or not at all, and a move is so followed to the
passing.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.outliers.tracks import Tracks, split_places
from groundsbot.offline.sam import LEVELS, Graph, Tree

# Of one tag. A choice among so many takes as long as a few linearisations; drives of the project's worlds, and the
# paper's, pass a tag two to ten times.
_MOST_OF_A_TAG: Final = 128
# Of all tags together; a drive begins a track every fifty keyframes or so, every twenty where tags hang densely.
_FREE: Final = 2048
_KEYFRAMES_A_TRACK: Final = 16
_LEVELS: Final = LEVELS - 1  # below the top


def few_of_each_tag(graph: Graph, tracks: Tracks) -> Tracks:
    """The same observations in fewer tracks where a tag has very many; the same tracks where none has."""
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
        wanted = np.column_stack([tag, tracks.segment, _piece_of(tree, level)[pose]])
        found = np.unique(wanted, axis=0, return_inverse=True)[1].reshape(-1)
        group[is_many] = (level + 1) * len(tracks) + found[is_many]  # no number of a level before
        is_many &= _n_groups(tag, group)[tag] > most
        level += 1
    return _together(tracks, group)


def _most_of_each(n_of_tag: IntArray, most_of_all: int) -> int:
    """How many tracks a tag may have, so that all together have no more than is allowed."""
    left, n_left = most_of_all, len(n_of_tag)
    for n in np.sort(np.minimum(n_of_tag, _MOST_OF_A_TAG)).tolist():
        if n * n_left > left:
            return max(1, left // n_left)
        left, n_left = left - n, n_left - 1
    return _MOST_OF_A_TAG


def _piece_of(tree: Tree, level: int) -> IntArray:
    """(P,) the piece of the order of elimination that each pose lies in, from 0; beyond its levels two in one, ..."""
    ends = tree.end[tree.level == min(level, _LEVELS - 1)]
    return np.searchsorted(np.sort(ends), np.arange(tree.n_poses), side="right") >> max(0, level - _LEVELS + 1)


def _n_groups(tag: IntArray, group: IntArray) -> IntArray:
    """(T,) how many groups (of each track, S) each tag (of each) has."""
    pairs = np.unique(np.column_stack([tag, group]), axis=0)
    return np.bincount(pairs[:, 0])


def _together(tracks: Tracks, group: IntArray) -> Tracks:
    """With those (S,) of one group, all of one tag in one segment, in one; in the order of `Tracks`."""
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
