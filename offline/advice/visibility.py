"""Probability that a tag mounted beside one pose is in view of other poses, given their relative uncertainty.

A person mounts the tag relative to the surroundings of that pose. A later drive whose relative pose the map knows only
to metres may have passed too far away, so its observations are not certain.
"""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.advice.information_gain import JointCovariance
from groundsbot.offline.advice.new_tags import DrivePaths, TagSite, ViewStatistics, is_in_view, new_tag_gain

# Points of equal weight on circles that hold 1/6, 1/2 and 5/6 of a normal distribution in the plane.
_RADII: Final = np.sqrt(-2.0 * np.log1p(-np.array([1.0, 3.0, 5.0]) / 6.0))
_ANGLES: Final = np.arange(8) * np.pi / 4.0


def visibility_probabilities(
    drives: DrivePaths, view: ViewStatistics, place: TagSite, known: JointCovariance
) -> FloatArray:
    """Return the probability (k,) that each viewer of a site has in view a tag mounted relative to the pose beside it.

    Args:
        drives: all of a component.
        view: limits of the field of view.
        place: the site; its viewers include the pose beside it.
        known: a joint covariance that includes these poses.
    """
    columns = drives.graph.problem.columns.poses
    beside = int(drives.graph.first_pose[place.segment]) + place.keyframe
    face = drives.sensors[beside, :2] - place.position_m
    shares = []
    for viewer in place.viewers.tolist():
        joint = known.marginal(np.concatenate([columns[beside], columns[viewer]]))
        by = np.hstack([_place_jacobian(drives, beside, place), -_place_jacobian(drives, viewer, place)])
        values, vectors = np.linalg.eigh(by @ joint @ by.T)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        circle = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
        off_m = (_RADII[:, None, None] * circle).reshape(-1, 2) @ root.T
        sensors = np.column_stack([drives.sensors[viewer, :2] - off_m, np.full(len(off_m), drives.sensors[viewer, 2])])
        shares.append(is_in_view(sensors, place.position_m, face, view).mean())
    return np.array(shares)


def expected_sigmas_m(drives: DrivePaths, view: ViewStatistics, place: TagSite, known: JointCovariance) -> FloatArray:
    """Return the tags' sigmas (T,) with a tag at the site: their mean over which viewers have it in view.

    A single observation from an otherwise unconstrained drive carries the most information, so it matters whether there
    is one at all. Weighting observations by their probability would predict nearly the full gain. If one viewer is too
    far off, those near it mostly are as well; so viewers are assumed to lose the tag in the order of their
    probabilities.
    """
    shares = visibility_probabilities(drives, view, place, known)
    levels = np.unique(shares)[::-1]
    chances = -np.diff(np.append(levels, 0.0))
    expected: FloatArray = (1.0 - levels[0]) * known.sigmas_m()
    for level, chance in zip(levels, chances, strict=True):
        expected = expected + chance * known.predicted_sigmas_m(new_tag_gain(drives, view, place, shares >= level))
    return expected


def _place_jacobian(drives: DrivePaths, pose: int, place: TagSite) -> FloatArray:
    """Return the derivative (2, 3) of a site fixed to a pose, in map, by a right perturbation of that pose."""
    theta = drives.state.poses[pose, 2]
    cos, sin = np.cos(theta), np.sin(theta)
    away = se2.apply(se2.inverse(drives.state.poses[pose]), place.position_m)
    turn = np.array([[cos, -sin], [sin, cos]])
    return np.column_stack([turn, turn @ np.array([-away[1], away[0]])])
