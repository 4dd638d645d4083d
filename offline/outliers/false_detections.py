"""Test for false detections: a tag is detected again from poses with about the same view of it.

From such a near view a tag has about the same direction and size, so it is detected again unless something hides it.
The share of near views with a detection is taken from tags with several tracks at one place, as the 1 % quantile over
these tracks. A track whose observations are too few for this share is a false detection.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import bdtr

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.outliers.tracks import Tracks
from groundsbot.offline.sam import Graph, State

# Only tracks with at most this many observations may be false detections.
MOST_OBSERVATIONS: Final = 3
# Largest differences of near views: relative in range, and in bearing.
_NEAR_RANGE: Final = 0.25
_NEAR_BEARING_RAD: Final = np.radians(10.0)
# Number of keyframes before and after the track in which near views are counted.
_WINDOW: Final = 100
_AT_ONCE: Final = 500
_WORST_SHARE: Final = 0.01
# Least number of tracks that determine the share of near views with a detection.
_LEAST_CONFIRMED: Final = 20


@dataclass(frozen=True)
class Views:
    """Near views of the tags of S tracks: from keyframes with about the track's range (25 %) and bearing (10 degrees).

    Attributes:
        detected: (S,) number of keyframes of the track.
        near: (S,) number of keyframes with a near view; 0 where not counted.
    """

    detected: IntArray
    near: IntArray


def views_of(graph: Graph, state: State, tracks: Tracks) -> Views:
    """Count the keyframes from which a tag should have been detected again, for S tracks.

    Only runs whose logs contain the stamps of pictures without tags are counted; the counts of others are 0.
    """
    n = len(tracks)
    views = Views(np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64))
    has_pictures = np.array([len(segment.run.picture_stamps_ns) > 0 for segment in graph.segments], dtype=np.bool_)
    counted = np.flatnonzero(has_pictures[tracks.segment])
    for begin in range(0, len(counted), _AT_ONCE):
        some = counted[begin : begin + _AT_ONCE]
        views.detected[some], views.near[some] = _count_views(graph, state, tracks, some)
    return views


def _count_views(graph: Graph, state: State, tracks: Tracks, which: IntArray) -> tuple[IntArray, IntArray]:
    """Return the number of keyframes (n,) of each of some tracks (n,), and the number with a near view (n,)."""
    observations, n = graph.problem.observations, len(which)
    number = np.full(len(tracks), -1, dtype=np.int64)
    number[which] = np.arange(n)
    own = np.flatnonzero(number[tracks.of_observation] >= 0)
    own = own[np.lexsort((observations.pose[own], number[tracks.of_observation[own]]))]
    of = number[tracks.of_observation[own]]
    pose, n_observations = observations.pose[own], np.bincount(of, minlength=n)
    begins = np.cumsum(n_observations) - n_observations
    place = np.add.reduceat(observations.places_in_map(state)[own], begins) / n_observations[:, None]
    again = np.append(False, (np.diff(pose) == 0) & (np.diff(of) == 0))
    segment = tracks.segment[which]
    ends = graph.first_pose[segment] + np.array([len(each.stamps_ns) for each in graph.segments])[segment]
    first = np.maximum(graph.first_pose[segment], pose[begins] - _WINDOW)
    n_around = np.minimum(ends, pose[begins + n_observations - 1] + _WINDOW + 1) - first
    around, of_around = _ranges(first, n_around)
    mount = observations.mount[own[begins]]
    of_poses, of_track = (_view(state.poses[p], mount[s], place[s]) for p, s in ((around, of_around), (pose, of)))
    near = np.zeros(n, dtype=np.int64)
    views = np.split(of_poses, np.cumsum(n_around)[:-1]), np.split(of_track, np.cumsum(n_observations)[:-1])
    for i, (candidates, observed) in enumerate(zip(*views, strict=True)):
        is_near = np.abs(candidates[:, :1] / np.maximum(observed[:, 0], 1e-6) - 1.0) < _NEAR_RANGE
        is_near &= candidates[:, 1:] @ observed[:, 1:].T > np.cos(_NEAR_BEARING_RAD)
        near[i] = np.count_nonzero(is_near.any(axis=1))
    return np.bincount(of[~again], minlength=n), near


def _ranges(first: IntArray, length: IntArray) -> tuple[IntArray, IntArray]:
    """Return the concatenated ranges of integers from each first (n,), of given length (n,), and the range of each."""
    of = np.repeat(np.arange(len(first)), length)
    return np.arange(len(of)) - np.repeat(np.cumsum(length) - length, length) + first[of], of


def chances(tracks: Tracks, place: IntArray, views: Views) -> FloatArray:
    """Return the probability (S,) that a real tag is detected from so few of its near views.

    It is 1 for tracks that are not tested: with many observations, of tags with other tracks, or without near views. It
    is 1 for all if too few tracks determine how often tags are detected.

    Args:
        tracks: S tracks.
        place: (S,) label, equal for tracks of one tag.
        views: near views of the tracks.
    """
    n_tracks = np.bincount(place)[place]
    confirmed = (n_tracks > 1) & (views.near > 0)
    found = np.ones(len(tracks))
    if confirmed.sum() < _LEAST_CONFIRMED:
        return found
    share = float(np.quantile(views.detected[confirmed] / views.near[confirmed], _WORST_SHARE))
    few = (n_tracks == 1) & (tracks.n_observations <= MOST_OBSERVATIONS) & (views.near > 0)
    # The probability is conditional on at least one detection, without which there would be no track.
    none = (1.0 - share) ** views.near[few]
    so_few = bdtr(np.minimum(views.detected[few], views.near[few]), views.near[few], share)
    found[few] = (so_few - none) / np.maximum(1.0 - none, 1e-300)
    return found


def _view(poses: FloatArray, mount: FloatArray, place_m: FloatArray) -> FloatArray:
    """Return the range and the unit direction (K, 3) of places (K, 2) in the frames of sensors.

    Args:
        poses: (K, 3) of the robot.
        mount: (K, 3) pose of each sensor in the robot's frame.
        place_m: (K, 2) in the frame of the poses.
    """
    in_sensor_m = se2.apply(se2.inverse(se2.compose(poses, mount)), place_m)
    range_m = np.hypot(in_sensor_m[:, 0], in_sensor_m[:, 1])
    return np.column_stack([range_m, in_sensor_m / np.maximum(range_m, 1e-12)[:, None]])
