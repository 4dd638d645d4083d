"""Observations of tags that are not there: a tag that hangs somewhere is read again from where it was read.

From poses near that of an observation a tag shows the same face at the same size, so a detector that saw it there sees
it there again, but for what happens to stand between. How often is taken from tags that were sighted twice or more in
one place: of a hundred such tracks the worst counts. A track of few observations that would have been more by that is a
false detection.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.stats import binom

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.outliers.tracks import Tracks
from groundsbot.offline.sam import Graph, State

# "Read once or a few times."
MOST_OBSERVATIONS: Final = 3
# A view is much the same up to these.
_NEAR_RANGE: Final = 0.25
_NEAR_BEARING_RAD: Final = np.radians(10.0)
# Keyframes before and after the track.
_WINDOW: Final = 100
_AT_ONCE: Final = 500
_WORST_SHARE: Final = 0.01
# Fewer tracks say too little of how often a tag is read.
_LEAST_CONFIRMED: Final = 20


@dataclass(frozen=True)
class Views:
    """Of S tracks: from how many near views the tag was read, and how many there were; none where not counted."""

    read: IntArray
    near: IntArray


def views_of(graph: Graph, state: State, tracks: Tracks) -> Views:
    """Counts near views, in runs that tell when pictures were taken that showed nothing."""
    n = len(tracks)
    views = Views(np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64))
    tells = np.array([len(segment.run.picture_stamps_ns) > 0 for segment in graph.segments], dtype=np.bool_)
    counted = np.flatnonzero(tells[tracks.segment])
    for begin in range(0, len(counted), _AT_ONCE):
        some = counted[begin : begin + _AT_ONCE]
        views.read[some], views.near[some] = _count_views(graph, state, tracks, some)
    return views


def _count_views(graph: Graph, state: State, tracks: Tracks, which: IntArray) -> tuple[IntArray, IntArray]:
    """From how many poses tags were read in some tracks (s,), and how many poses have a near view (s,)."""
    observations, n = graph.problem.observations, len(which)
    number = np.full(len(tracks), -1, dtype=np.int64)
    number[which] = np.arange(n)
    own = np.flatnonzero(number[tracks.of_observation] >= 0)
    own = own[np.lexsort((observations.pose[own], number[tracks.of_observation[own]]))]
    of = number[tracks.of_observation[own]]  # rising
    pose, n_observations = observations.pose[own], np.bincount(of, minlength=n)
    begins = np.cumsum(n_observations) - n_observations
    place = np.add.reduceat(observations.places_in_map(state)[own], begins) / n_observations[:, None]
    again = np.append(False, (np.diff(pose) == 0) & (np.diff(of) == 0))
    # Poses before and after the track, in the same run.
    segment = tracks.segment[which]
    ends = graph.first_pose[segment] + np.array([len(each.stamps_ns) for each in graph.segments])[segment]
    first = np.maximum(graph.first_pose[segment], pose[begins] - _WINDOW)
    n_around = np.minimum(ends, pose[begins + n_observations - 1] + _WINDOW + 1) - first
    around, of_around = _ranges(first, n_around)
    mount = observations.mount[own[begins]]
    seen, at = (_view(state.poses[p], mount[s], place[s]) for p, s in ((around, of_around), (pose, of)))
    near = np.zeros(n, dtype=np.int64)
    views = np.split(seen, np.cumsum(n_around)[:-1]), np.split(at, np.cumsum(n_observations)[:-1])
    for i, (here, there) in enumerate(zip(*views, strict=True)):
        alike = np.abs(here[:, :1] / np.maximum(there[:, 0], 1e-6) - 1.0) < _NEAR_RANGE
        alike &= here[:, 1:] @ there[:, 1:].T > np.cos(_NEAR_BEARING_RAD)
        near[i] = np.count_nonzero(alike.any(axis=1))
    return np.bincount(of[~again], minlength=n), near


def _ranges(first: IntArray, length: IntArray) -> tuple[IntArray, IntArray]:
    """Numbers from each first (n,) on, so many, one range after the other; and the range that each is of."""
    of = np.repeat(np.arange(len(first)), length)
    return np.arange(len(of)) - np.repeat(np.cumsum(length) - length, length) + first[of], of


def chances(tracks: Tracks, place: IntArray, views: Views) -> FloatArray:
    """(S,) how likely a tag that hangs there is read from so few of the near views; 1 where that says nothing.

    Args:
        tracks: S of them.
        place: (S,) equal where tracks are of one tag.
        views: of them.
    """
    n_tracks = np.bincount(place)[place]
    confirmed = (n_tracks > 1) & (views.near > 0)
    found = np.ones(len(tracks))
    if confirmed.sum() < _LEAST_CONFIRMED:
        return found
    share = float(np.quantile(views.read[confirmed] / views.near[confirmed], _WORST_SHARE))
    few = (n_tracks == 1) & (tracks.n_observations <= MOST_OBSERVATIONS) & (views.near > 0)
    # It was read once, or nobody would ask.
    none = binom.pmf(0, views.near[few], share)
    found[few] = (binom.cdf(views.read[few], views.near[few], share) - none) / np.maximum(1.0 - none, 1e-300)
    return found


def _view(poses: FloatArray, mount: FloatArray, place_m: FloatArray) -> FloatArray:
    """(K, 3) range of places (K, 2) about sensors (K, 3) of poses (K, 3), and the direction."""
    seen = se2.apply(se2.inverse(se2.compose(poses, mount)), place_m)
    range_m = np.hypot(seen[:, 0], seen[:, 1])
    return np.column_stack([range_m, seen / np.maximum(range_m, 1e-12)[:, None]])
