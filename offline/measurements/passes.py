"""Tracks: the observations of a tag by one camera from one pass by it, whose errors are correlated."""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, IntArray
from groundsbot.offline.measurements.segment import Segment

# A track ends where its tag is not observed for longer than this, by distance or by time.
GAP_M: Final = 2.0
_GAP_S: Final = 10.0
# A track of no more observations may be of another tag that was decoded wrongly.
FEW_OBSERVATIONS: Final = 2
# The share of wrongly decoded observations in a drive is below this with any detector.
MOST_MISREAD: Final = 0.05
# Over this distance a tag is seen from nearly the same direction.
_CELL_M: Final = 2.5


def passes_of(segment: Segment, cut: BoolArray | None = None) -> IntArray:
    """Return (M,) the track of each observation, numbered from 0 in order of tag, camera and time.

    Args:
        segment: segment with M observations.
        cut: (M,) observations that begin another track although the tag stayed in view.
    """
    observations = segment.observations
    order = np.lexsort((observations.keyframe, observations.camera, observations.tag))
    keyframe = observations.keyframe[order]
    begins = np.ones(len(order), dtype=np.bool_)
    begins[1:] = (
        (np.diff(observations.tag[order]) != 0)
        | (np.diff(observations.camera[order]) != 0)
        | (np.diff(segment.along_m[keyframe]) > GAP_M)
        | (np.diff(segment.stamps_ns[keyframe]) > _GAP_S * 1e9)
    )
    if cut is not None:
        begins[1:] |= cut[order][1:]
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.cumsum(begins) - 1
    return number


def without_unconfirmed_tracks(segment: Segment) -> Segment:
    """Return the segment without tracks of one or two observations, for tags that have another track.

    A detector decodes a tag wrongly in one or two pictures, while a real tag is observed in several. A tag keeps its
    longest track, the first of equal ones: two codes that were misread as the same tag would join two places of the
    drive. Where more observations than `MOST_MISREAD` are in such tracks, the sensor observes tags rarely, and the
    segment is unchanged.
    """
    observations, track = segment.observations, passes_of(segment)
    if not len(observations):
        return segment
    n_in_track = np.bincount(track)
    tag_of = np.zeros(len(n_in_track), dtype=np.int64)
    tag_of[track] = observations.tag
    order = np.lexsort((-n_in_track, tag_of))
    is_longest = np.zeros(len(n_in_track), dtype=np.bool_)
    is_longest[order[np.unique(tag_of[order], return_index=True)[1]]] = True
    is_unconfirmed = ((n_in_track <= FEW_OBSERVATIONS) & ~is_longest)[track]
    return segment if is_unconfirmed.mean() > MOST_MISREAD else segment.with_observations(~is_unconfirmed)


def cells_of(segment: Segment) -> IntArray:
    """Return (M,) the cell of each observation: one for each tag, camera and 2.5 m driven, numbered from 0."""
    observations = segment.observations
    part = (segment.along_m[observations.keyframe] / _CELL_M).astype(np.int64)
    number = (part * len(segment.tags) + observations.tag) * (1 + observations.camera.max(initial=0))
    _, cell = np.unique(number + observations.camera, return_inverse=True)
    return np.asarray(cell, dtype=np.int64)
