"""Tracks: the observations of a tag in one pass of a run.

The search for outliers tests tracks. One place for all tracks of a tag raises the cost only if the tag moved between
them. Within a track the tag did not move, and odometry alone connects its observations closely.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, IntArray
from groundsbot.offline.measurements import Segment, TagKey, passes_of

_INSTANCES: Final = "abcdefghijklmnopqrstuvwxyz"


@dataclass(frozen=True)
class Tracks:
    """S tracks of the tags of some segments, in order of id, segment and time.

    Attributes:
        ids: N observed ids, sorted, without instances.
        of_observation: (M,) track of each observation; the observations of the segments follow one another.
        ungrouped: (M,) the same before tracks were grouped (`grouping`).
        id: (S,) index into `ids`.
        segment: (S,) index of the segment.
        first_ns, last_ns: (S,) stamps of the first and the last observation.
        n_observations: (S,)
        tag: (S,) index into the segment's own tags.
    """

    ids: tuple[TagKey, ...]
    of_observation: IntArray
    ungrouped: IntArray
    id: IntArray
    segment: IntArray
    first_ns: IntArray
    last_ns: IntArray
    n_observations: IntArray
    tag: IntArray

    def __len__(self) -> int:
        """Return the number of tracks."""
        return len(self.id)

    @cached_property
    def in_time(self) -> IntArray:
        """Indices (S,) that sort the tracks by id, then by the beginning of the segment, then by time."""
        begin_ns = np.full(int(self.segment.max(initial=-1)) + 1, np.iinfo(np.int64).max)
        np.minimum.at(begin_ns, self.segment, self.first_ns)
        return np.lexsort((self.first_ns, self.segment, begin_ns[self.segment], self.id))

    @cached_property
    def rank(self) -> IntArray:
        """Rank (S,) of each track in that order."""
        rank = np.empty(len(self), dtype=np.int64)
        rank[self.in_time] = np.arange(len(self))
        return rank

    def of_ids(self) -> list[IntArray]:
        """Return the indices of the tracks of each id, in order of time."""
        ends = np.cumsum(np.bincount(self.id, minlength=len(self.ids)))
        return np.split(self.in_time, ends[:-1]) if len(ends) else []

    def one_after_the_other(self, members: IntArray) -> bool:
        """Return whether no two segments of these tracks overlap in time, judged by all their observations."""
        segments = np.unique(self.segment[members])
        spans = [(self.first_ns[self.segment == c].min(), self.last_ns[self.segment == c].max()) for c in segments]
        return all(before[1] < after[0] for before, after in pairwise(sorted(spans)))

    def came_back(self, members: IntArray, place: IntArray | BoolArray) -> bool:
        """Return whether a tag returned to an earlier place.

        Runs that overlap in time have no order, so each of them is judged by itself.

        Args:
            members: (m,) tracks of the tag, in order of time.
            place: (m,) label of the place of each.
        """
        parts = [members]
        if not self.one_after_the_other(members):
            parts = [members[self.segment[members] == c] for c in np.unique(self.segment[members])]
        at = dict(zip(members.tolist(), place.tolist(), strict=True))
        sequences = [without_repeats([at[s] for s in part.tolist()]) for part in parts]
        return any(len(set(each)) < len(each) for each in sequences)


def tracks_of(segments: Sequence[Segment], begins: BoolArray | None = None) -> Tracks:
    """Divide the observations of segments into tracks; instances of an id in a segment have separate tracks.

    Args:
        segments: segments with M observations together.
        begins: (M,) whether another track begins with an observation although the tag stayed in sight.
    """
    ids = tuple(sorted({tag.whole for segment in segments for tag in segment.tags}))
    index = {tag: i for i, tag in enumerate(ids)}
    rows, of_observation = [], []
    first, n_observations = 0, 0
    for number, segment in enumerate(segments):
        n = len(segment.observations)
        begins_here = np.zeros(n, dtype=np.bool_) if begins is None else begins[n_observations : n_observations + n]
        found, track = _of_segment(segment, begins_here)
        n_observations += n
        own_ids = np.array([index[tag.whole] for tag in segment.tags], dtype=np.int64)
        rows.append(np.column_stack([own_ids[found[:, 0]], np.full(len(found), number), found]))
        of_observation.append(first + track)
        first += len(found)
    table = np.concatenate(rows) if rows else np.zeros((0, 6), dtype=np.int64)
    order = np.lexsort((table[:, 3], table[:, 1], table[:, 0]))
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    own, segment_of, tag, first_ns, last_ns, count = table[order].T
    track_of = rank[np.concatenate(of_observation)]
    return Tracks(ids, track_of, track_of, own, segment_of, first_ns, last_ns, count, tag)


def _of_segment(segment: Segment, cut: BoolArray) -> tuple[IntArray, IntArray]:
    """Return (s, 4) tag, first and last stamp, number of observations of each track; (M,) track of each observation."""
    of_observation = passes_of(segment, cut)
    order = np.lexsort((segment.observations.keyframe, of_observation))
    count = np.bincount(of_observation)
    ends = np.cumsum(count) - 1
    first, last = order[ends - count + 1], order[ends]
    stamps_ns = segment.stamps_ns[segment.observations.keyframe]
    rows = [segment.observations.tag[first], stamps_ns[first], stamps_ns[last], count]
    return np.column_stack(rows).reshape(-1, 4), of_observation


def split_places(segments: Sequence[Segment], tracks: Tracks) -> IntArray:
    """Return labels (S,) of places, equal for tracks whose segments have them as one tag."""
    keys = [(*segments[c].tags[t],) for c, t in zip(tracks.segment, tracks.tag, strict=True)]
    number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
    return np.array([number[key] for key in keys], dtype=np.int64)


def instances(tracks: Tracks, place: IntArray, only_in: str = "") -> list[TagKey]:
    """Return the tag of each track: the id alone if it has one place, else with instances a, b, ... in order of time.

    Args:
        tracks: S tracks.
        place: (S,) label, equal for tracks of one tag.
        only_in: prefix of the letter, so that no other segment has a tag of that name.
    """
    names: dict[tuple[int, int], str] = {}
    n_places = np.zeros(len(tracks.ids), dtype=np.int64)
    for s in tracks.in_time.tolist():
        own, at = int(tracks.id[s]), int(place[s])
        if (own, at) not in names:
            names[own, at] = only_in + letters(int(n_places[own]))
            n_places[own] += 1
    return [
        tracks.ids[own]._replace(instance=names[own, at] if n_places[own] > 1 else "")
        for own, at in zip(tracks.id.tolist(), place.tolist(), strict=True)
    ]


def with_instances(segments: Sequence[Segment], tracks: Tracks, tag_of: Sequence[TagKey]) -> list[Segment]:
    """Return the segments with each observation assigned to the tag of its track (S,)."""
    relabelled = []
    first = 0
    for segment in segments:
        n = len(segment.observations)
        keys = [tag_of[s] for s in tracks.of_observation[first : first + n]]
        first += n
        tags = tuple(sorted(set(keys)))
        index = {tag: i for i, tag in enumerate(tags)}
        tag = np.array([index[key] for key in keys], dtype=np.int64)
        relabelled.append(replace(segment, tags=tags, observations=replace(segment.observations, tag=tag)))
    return relabelled


def without_repeats(sequence: Sequence[int]) -> tuple[int, ...]:
    """Return a sequence without repetitions in a row."""
    return tuple(at for i, at in enumerate(sequence) if i == 0 or at != sequence[i - 1])


def letters(number: int) -> str:
    """Return the name of an instance: a, b, ... z, aa, ab, ..."""
    tail = _INSTANCES[number % 26]
    return tail if number < 26 else letters(number // 26 - 1) + tail
