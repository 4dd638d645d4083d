"""Drives that go through the online estimate one by one, and its roots about the points where they ended."""

from collections.abc import Sequence

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.localization.online.information_root import OnlineRoot
from groundsbot.offline.localization.online.localizer import OnlineLocalizer
from groundsbot.offline.localization.online.prior import OnlinePrior
from tests.benchmarks.accuracy.localize_study import Taken


def whole_root(online: OnlineLocalizer, calibration: FloatArray) -> OnlineRoot:
    """Through the whole drive, about where the estimate ended."""
    return root_about(online, calibration, online._smoother.places_m)


def root_about(online: OnlineLocalizer, calibration: FloatArray, places_m: FloatArray) -> OnlineRoot:
    smoother = online._smoother
    root = OnlineRoot(OnlinePrior(online._known, smoother._numbers, calibration), smoother.drive.poses[0], held=False)
    for tag, place_m in enumerate(places_m):
        root.add_tag(place_m, smoother.map_tags.get(tag))
    while not root.is_at_end_of(smoother.drive):
        root.advance(smoother.drive)
    return root


def straight_step(root: OnlineRoot) -> FloatArray:
    """Of Gauss-Newton: all in straight lines."""
    return root.solve_root(np.concatenate([root._pose[:, 3], root._right[: root.prior.n]]))


def feed(online: OnlineLocalizer, taken: Sequence[Taken]) -> None:
    for motion, observations in taken:
        if motion is not None:
            online.add_motion(*motion)
        for observation in observations:
            online.add_observation(observation)
