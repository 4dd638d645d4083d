"""Observations of a tag in passes: what a drive saw of it while it passed by once."""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, IntArray
from groundsbot.offline.measurements.segment import Segment

# Longer out of sight, by the way driven or by the clock, and it is another pass.
GAP_M: Final = 2.0
_GAP_S: Final = 10.0
# A pass of no more observations may be of another tag, mistaken for this one.
FEW_OBSERVATIONS: Final = 2
# Of a drive's observations, more than any detector takes for other tags.
MOST_MISREAD: Final = 0.05
# Over so much of the way observations of a tag are taken from much the same side.
_CELL_M: Final = 2.5


def passes_of(segment: Segment, cut: BoolArray | None = None) -> IntArray:
    """(M,) the pass of each observation, from 0 without gaps, in order of tag and time.

    Args:
        segment: whose M observations.
        cut: (M,) observations with which another pass begins though the tag was not out of sight.
    """
    observations = segment.observations
    order = np.lexsort((observations.keyframe, observations.tag))
    tag, keyframe = observations.tag[order], observations.keyframe[order]
    begins = np.ones(len(order), dtype=np.bool_)
    begins[1:] = (
        (np.diff(tag) != 0)
        | (np.diff(segment.along_m[keyframe]) > GAP_M)
        | (np.diff(segment.stamps_ns[keyframe]) > _GAP_S * 1e9)
    )
    if cut is not None:
        begins[1:] |= cut[order][1:]
    number = np.empty(len(order), dtype=np.int64)
    number[order] = np.cumsum(begins) - 1
    return number


def without_unconfirmed_tracks(segment: Segment) -> Segment:
    """The segment without passes of one or two observations of tags that have passes of more.

    A detector that takes one tag for another does so in a picture or two; tags that pass by are read in several. Where
    more of the observations are alone than codes are misread, the sensor reads seldom, and all stay.
    """
    observations, pass_of = segment.observations, passes_of(segment)
    if not len(observations):
        return segment
    n_in_pass = np.bincount(pass_of)[pass_of]
    most = np.zeros(len(segment.tags), dtype=np.int64)
    np.maximum.at(most, observations.tag, n_in_pass)
    is_alone = (n_in_pass <= FEW_OBSERVATIONS) & (most[observations.tag] > FEW_OBSERVATIONS)
    return segment if is_alone.mean() > MOST_MISREAD else segment.with_observations(~is_alone)


def cells_of(segment: Segment) -> IntArray:
    """(M,) of each observation: a number for each tag in each 2.5 m of the way, from 0 without gaps."""
    part = (segment.along_m[segment.observations.keyframe] / _CELL_M).astype(np.int64)
    _, cell = np.unique(part * len(segment.tags) + segment.observations.tag, return_inverse=True)
    return np.asarray(cell, dtype=np.int64)
