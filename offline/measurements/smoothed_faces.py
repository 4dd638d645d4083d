"""Derivatives with respect to the camera's roll and pitch at smoothed poses of the tags' faces.

The heading of a tag's face is known to several degrees from one picture. The derivatives depend on it: evaluated there
they are correlated with the errors of range and bearing, and vary from picture to picture, while the rest of them is
mostly absorbed by tags, poses and scale. Least squares then find a roll or pitch that is not there, and are too certain
of it (errors in variables: Fuller, "Measurement Error Models", 1987). Heading, roll and height of a face are the same
in all pictures of a pass, so their means over the pass have little of the error left.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.measurements.passes import passes_of
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.segment import Segment
from groundsbot.offline.measurements.sensor_model.sensor_model import mount_axes
from groundsbot.offline.measurements.sensor_model.tag_pose import range_bearing_by_turn

# Those derivatives are the first in `by_camera`, as in CAMERA_PARAMETERS.
_ROLL_AND_PITCH: Final = slice(2)


def with_smoothed_faces(segment: Segment, T_start_base: FloatArray, range_m: FloatArray) -> Segment:
    """Return the segment with the derivatives of its observations with respect to the mount's roll and pitch replaced.

    Args:
        segment: segment with M observations; those without a face are unchanged.
        T_start_base: (K, 3) poses of the keyframes.
        range_m: (M,) ranges from the camera in the solved map.
    """
    track, by_camera = passes_of(segment), segment.observations.by_camera.copy()
    for number in range(len(segment.run.robot.camera_names)):
        run, own = segment.run.with_camera(number), segment.observations.camera == number
        _smooth_faces(run, segment, own, track, T_start_base, range_m, by_camera)
    return replace(segment, observations=replace(segment.observations, by_camera=by_camera))


def _smooth_faces(
    run: Run,
    segment: Segment,
    of_camera: BoolArray,
    track_of: IntArray,
    T_start_base: FloatArray,
    range_m: FloatArray,
    by_camera: FloatArray,
) -> None:
    """Replace the derivatives `by_camera` of the observations (M,) of one camera, to which the run is reduced."""
    observations = segment.observations
    which = np.flatnonzero(of_camera & np.isfinite(observations.face).all(axis=-1))
    if run.camera is None or not len(which):
        return
    of_base = T_start_base[observations.keyframe[which], 2]
    heading, sigma, roll, height_m = observations.face[which].T
    (_, track), weight = np.unique(track_of[which], return_inverse=True), sigma**-2.0
    heading = _mean_angle(heading + of_base, weight, track) - of_base
    mean_m = np.bincount(track, weight * height_m) / np.bincount(track, weight)
    bearing = observations.value[which, 1] + run.robot.mount.yaw_rad
    along_m = range_m[which] + run.robot.range_offset_m
    centre_m = np.column_stack([along_m * np.cos(bearing), along_m * np.sin(bearing), mean_m[track]])
    face_rad = np.column_stack([heading, _mean_angle(roll, weight, track)])
    sides_m = np.array([run.robot.tag_size_m(tag.family, tag.tag_id)[0] for tag in segment.tags])
    rotation = run.robot.mount.T_base_camera.rotation.as_matrix()
    by_turn = range_bearing_by_turn(centre_m, face_rad, sides_m[observations.tag[which]], run.camera, rotation)
    by_turn = by_turn @ mount_axes(run.robot).T
    good = np.isfinite(by_turn).all(axis=(-1, -2))
    by_camera[which[good], :, _ROLL_AND_PITCH] = by_turn[good]


def _mean_angle(angle: FloatArray, weight: FloatArray, group: IntArray) -> FloatArray:
    """Return (M,) the weighted mean of angles (M,) over the group of each."""
    sums = (np.bincount(group, weight * each)[group] for each in (np.sin(angle), np.cos(angle)))
    return np.asarray(np.arctan2(*sums))
