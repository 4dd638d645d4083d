"""Drives that could be repeated: parts of the paths of a map's runs, from one tag to another.

A repeated drive is assumed to measure what the original did, with independent errors: its poses are new variables, its
tags and calibration are those of the map.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.advice.information_gain import InformationGain, marginal_information
from groundsbot.offline.sam import Columns, Graph, State

# A repeated drive is short: at most this share of the longest run, and at most so long.
_LENGTH_SHARE: Final = 0.25
_MOST_LENGTH_M: Final = 50.0
# The advice must not take longer than the map: limits on the candidates, and on all their keyframes together.
MOST_REPEAT_DRIVES: Final = 40
_MOST_KEYFRAMES: Final = 20_000
# A few seconds; work is the sum over candidates of (2 tags)^3.
_MOST_WORK: Final = 2e9
# The cost of a candidate is cubic in the tags that it passes.
_MOST_TRACKS: Final = 60
# A tag that is observed again after so much driven distance begins a new track.
TRACK_GAP_M: Final = 2.5


class TagTrack(NamedTuple):
    """Track of one tag in one segment: the keyframes from which a passing robot observed it."""

    segment: int
    tag: int
    first: int  # keyframe of the segment
    last: int


class RepeatDrive(NamedTuple):
    """Keyframes first to last of a segment, from the tag observed first to the one observed last."""

    segment: int
    first: int
    last: int
    from_tag: int
    to_tag: int


def driven_distances_m(graph: Graph) -> list[FloatArray]:
    """Return the driven distance (K,) at the keyframes of each segment."""
    return [segment.along_m for segment in graph.segments]


def tag_tracks(graph: Graph, ways: list[FloatArray]) -> list[TagTrack]:
    """Return all tracks, segment by segment in the order in which they begin."""
    found: list[TagTrack] = []
    number = {tag: i for i, tag in enumerate(graph.tags)}
    for c, segment in enumerate(graph.segments):
        order = np.lexsort((segment.observations.keyframe, segment.observations.tag))
        keyframe, tag = segment.observations.keyframe[order], segment.observations.tag[order]
        if not len(order):
            continue
        begins = np.flatnonzero((np.diff(tag) != 0) | (np.diff(ways[c][keyframe]) > TRACK_GAP_M)) + 1
        own = [
            TagTrack(c, number[segment.tags[tag[part[0]]]], int(keyframe[part[0]]), int(keyframe[part[-1]]))
            for part in np.split(np.arange(len(order)), begins)
        ]
        found += sorted(own, key=lambda each: (each.first, each.last, each.tag))
    return found


def max_repeat_length_m(ways: list[FloatArray]) -> float:
    """Return the maximum length of a repeated drive."""
    return min(_LENGTH_SHARE * max(float(way[-1]) for way in ways), _MOST_LENGTH_M)


def repeat_drives(ways: list[FloatArray], tracks: list[TagTrack], most: int = MOST_REPEAT_DRIVES) -> list[RepeatDrive]:
    """Return one candidate per track, as long as allowed, thinned evenly to the limits on number and work.

    Args:
        ways: ways from `driven_distances_m`.
        tracks: tracks from `tag_tracks`.
        most: maximum number of candidates.
    """
    length_m = max_repeat_length_m(ways)
    found: list[RepeatDrive] = []
    for c, way in enumerate(ways):
        own = [each for each in tracks if each.segment == c]
        ends_m = way[[each.last for each in own]]
        for i, begin in enumerate(own):
            reached = i + 1 + np.flatnonzero(ends_m[i + 1 : i + 1 + _MOST_TRACKS] <= way[begin.first] + length_m)
            ends = [own[k] for k in reached.tolist() if own[k].tag != begin.tag]
            if ends:
                end = max(ends, key=lambda each: each.last)
                found.append(RepeatDrive(c, begin.first, end.last, begin.tag, end.tag))
    n_keyframes = sum(each.last - each.first + 1 for each in found)
    most = min(most, max(1, len(found) * _MOST_KEYFRAMES // max(n_keyframes, 1)))
    found = _thin(found, most)
    work = sum((2.0 * len(_tags_along(each, tracks))) ** 3 for each in found)
    return _thin(found, max(1, int(len(found) * _MOST_WORK / max(work, _MOST_WORK))))


def _thin(passes: list[RepeatDrive], most: int) -> list[RepeatDrive]:
    """Return at most `most` of them, evenly chosen."""
    if len(passes) <= most:
        return passes
    return [passes[i] for i in np.linspace(0, len(passes) - 1, most).round().astype(int)]


def _tags_along(wanted: RepeatDrive, tracks: list[TagTrack]) -> set[int]:
    """Return the tags that are observed during a candidate drive."""
    return {
        each.tag
        for each in tracks
        if each.segment == wanted.segment and each.first <= wanted.last and each.last >= wanted.first
    }


def repeat_drive_gain(graph: Graph, state: State, wanted: RepeatDrive) -> InformationGain:
    """Return the information of a repeated drive on the map's tags and calibration."""
    problem, offset = graph.problem, int(graph.first_pose[wanted.segment])
    first, last = offset + wanted.first, offset + wanted.last
    odometry, observations = problem.odometry, problem.observations
    driven = slice(*np.searchsorted(odometry.first, [first, last]))
    read = np.flatnonzero((observations.pose >= first) & (observations.pose <= last))
    odometry = replace(odometry, **{name: value[driven] for name, value in vars(odometry).items()})
    observations = replace(observations, **{name: value[read] for name, value in vars(observations).items()})
    own, columns = _own_columns(problem.columns, np.arange(first, last + 1), np.unique(observations.tag))
    return marginal_information(
        (odometry.linearise(state, own), observations.linearise(state, own)), 3 * (last - first + 1), columns
    )


def _own_columns(of_map: Columns, poses: IntArray, tags: IntArray) -> tuple[Columns, IntArray]:
    """Return columns of copied poses, then of the map's tags and calibration, and the map's indices of the latter."""
    n_own, n_tags = 3 * len(poses), 2 * len(tags)
    by_pose = np.full(of_map.poses.shape, -1)
    by_pose[poses] = np.arange(n_own).reshape(-1, 3)
    by_tag = np.full(of_map.tags.shape, -1)
    by_tag[tags] = n_own + np.arange(n_tags).reshape(-1, 2)
    free = of_map.calibration >= 0
    by_calibration = np.where(free, n_own + n_tags + np.cumsum(free) - 1, -1)
    columns = np.concatenate([of_map.tags[tags].reshape(-1), of_map.calibration[free]])
    return Columns(by_pose, by_tag, by_calibration, n_own + len(columns)), columns
