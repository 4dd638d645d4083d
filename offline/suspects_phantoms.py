"""Readings of tags that are not there: a tag that hangs somewhere is read again from where it was read.

From poses near that of a reading a tag shows the same face at the same size, so a detector that saw it there sees it
there again, but for what happens to stand between. How often is taken from tags that were sighted twice or more in one
place: of a hundred such sightings the worst counts. A sighting of few readings that would have been more by that is a
false detection.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.stats import binom

from calib import se2
from calib.arrays import FloatArray, IntArray
from offline.factors import State
from offline.graph import Graph
from offline.suspects_sightings import Sightings

# "Read once or a few times."
MOST_READINGS: Final = 3
# A view is much the same up to these.
_NEAR_RANGE: Final = 0.25
_NEAR_BEARING_RAD: Final = np.radians(10.0)
# Keyframes before and after the sighting.
_WINDOW: Final = 100
_WORST_SHARE: Final = 0.01
# Fewer sightings say too little of how often a tag is read.
_LEAST_CONFIRMED: Final = 20


@dataclass(frozen=True)
class Views:
    """Of S sightings: from how many near views the tag was read, and how many there were; none where not counted."""

    read: IntArray
    near: IntArray


def views_of(graph: Graph, state: State, sightings: Sightings) -> Views:
    """Counts near views, in runs that tell when pictures were taken that showed nothing."""
    readings = graph.problem.readings
    places = readings.places_in_map(state)
    read, near = np.zeros(len(sightings), dtype=np.int64), np.zeros(len(sightings), dtype=np.int64)
    order = np.argsort(sightings.of_reading, kind="stable")
    parts = np.split(order, np.cumsum(sightings.n_readings)[:-1]) if len(sightings) else []
    for s, own in enumerate(parts):
        chain = int(sightings.chain[s])
        if not len(graph.chains[chain].run.picture_stamps_ns):
            continue
        first = int(graph.first_pose[chain])
        poses = readings.pose[own]
        begin = max(first, int(poses.min()) - _WINDOW)
        end = min(first + len(graph.chains[chain].stamps_ns), int(poses.max()) + _WINDOW + 1)
        views = _view(state.poses[begin:end], readings.mount[own[0]], places[own].mean(axis=0))
        at = views[poses - begin]
        alike = np.abs(views[:, None, 0] / np.maximum(at[:, 0], 1e-6) - 1.0) < _NEAR_RANGE
        alike &= np.abs(se2.wrap_angle(views[:, None, 1] - at[:, 1])) < _NEAR_BEARING_RAD
        read[s], near[s] = len(np.unique(poses)), int(alike.any(axis=1).sum())
    return Views(read, near)


def chances(sightings: Sightings, place: IntArray, views: Views) -> FloatArray:
    """(S,) how likely a tag that hangs there is read from so few of the near views; 1 where that says nothing.

    Args:
        sightings: S of them.
        place: (S,) equal where sightings are of one tag.
        views: of them.
    """
    n_sightings = np.bincount(place)[place]
    confirmed = (n_sightings > 1) & (views.near > 0)
    found = np.ones(len(sightings))
    if confirmed.sum() < _LEAST_CONFIRMED:
        return found
    share = float(np.quantile(views.read[confirmed] / views.near[confirmed], _WORST_SHARE))
    few = (n_sightings == 1) & (sightings.n_readings <= MOST_READINGS) & (views.near > 0)
    # It was read once, or nobody would ask.
    none = binom.pmf(0, views.near[few], share)
    found[few] = (binom.cdf(views.read[few], views.near[few], share) - none) / np.maximum(1.0 - none, 1e-300)
    return found


def _view(poses: FloatArray, mount: FloatArray, place_m: FloatArray) -> FloatArray:
    """(K, 2) range and bearing of a place about a sensor."""
    seen = se2.apply(se2.inverse(se2.compose(poses, mount)), place_m)
    return np.stack([np.hypot(seen[:, 0], seen[:, 1]), np.arctan2(seen[:, 1], seen[:, 0])], axis=-1)
