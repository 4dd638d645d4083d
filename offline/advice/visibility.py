"""How likely a tag that hangs beside one pose is in view of others, when it is not known how they lie to each other.

Somebody who hangs up a tag goes by what is around. Where the map itself knows only to metres how a later drive passed
there, that drive may have passed too far away: such readings must not be counted on.
"""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.advice.information_gain import JointCovariance
from groundsbot.offline.advice.new_tags import DrivePaths, TagSite, TagViews, gain_of_place, is_in_view

# Points of equal weight on circles that hold 1/6, 1/2 and 5/6 of a normal distribution in the plane.
_RADII: Final = np.sqrt(-2.0 * np.log1p(-np.array([1.0, 3.0, 5.0]) / 6.0))
_ANGLES: Final = np.arange(8) * np.pi / 4.0


def visibility_probabilities(drives: DrivePaths, view: TagViews, place: TagSite, known: JointCovariance) -> FloatArray:
    """(k,) with which probability each viewer of a place has a tag in view that hangs by the pose beside it.

    Args:
        drives: all of a component.
        view: what is in view.
        place: and its viewers, the pose beside it among them.
        known: the joint covariance of these poses, and others.
    """
    columns = drives.graph.problem.columns.poses
    beside = int(drives.graph.first_pose[place.segment]) + place.keyframe
    face = drives.sensors[beside, :2] - place.position_m
    shares = []
    for viewer in place.viewers.tolist():
        joint = known.of(np.concatenate([columns[beside], columns[viewer]]))
        by = np.hstack([_place_jacobian(drives, beside, place), -_place_jacobian(drives, viewer, place)])
        values, vectors = np.linalg.eigh(by @ joint @ by.T)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        circle = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=-1)
        off_m = (_RADII[:, None, None] * circle).reshape(-1, 2) @ root.T
        sensors = np.column_stack([drives.sensors[viewer, :2] - off_m, np.full(len(off_m), drives.sensors[viewer, 2])])
        shares.append(is_in_view(sensors, place.position_m, face, view).mean())
    return np.array(shares)


def expected_sigmas_m(drives: DrivePaths, view: TagViews, place: TagSite, known: JointCovariance) -> FloatArray:
    """(T,) the tags' largest sigmas with a tag at the place, the mean over which of its viewers have it in view.

    A single reading from a drive that nothing held is worth the most, so what counts is whether there is one: readings
    that count by their probability would promise as good as all of it. What puts one viewer too far off mostly puts
    those near it too far off as well, so they are taken to miss it in the order of their probabilities.
    """
    shares = visibility_probabilities(drives, view, place, known)
    levels = np.unique(shares)[::-1]
    chances = -np.diff(np.append(levels, 0.0))
    expected: FloatArray = (1.0 - levels[0]) * known.sigmas_m()
    for level, chance in zip(levels, chances, strict=True):
        expected = expected + chance * known.sigmas_with_m(gain_of_place(drives, view, place, shares >= level))
    return expected


def _place_jacobian(drives: DrivePaths, pose: int, place: TagSite) -> FloatArray:
    """(2, 3) how the place moves in map with a pose that it hangs by, perturbed on the right."""
    theta = drives.state.poses[pose, 2]
    cos, sin = np.cos(theta), np.sin(theta)
    away = se2.apply(se2.inverse(drives.state.poses[pose]), place.position_m)
    turn = np.array([[cos, -sin], [sin, cos]])
    return np.column_stack([turn, turn @ np.array([-away[1], away[0]])])
