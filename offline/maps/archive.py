"""Measurements and calibration archived in a map, to localise later runs in it or to solve them jointly with its own.

Plain arrays and texts, as in map.npz; `local_map.archive` restores local maps from them.
"""

from dataclasses import dataclass, fields
from typing import Any, Final

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.robot import CAMERA_PARAMETERS

# A calibration parameter corrects at most four numbers; the rest of a row is NaN.
_NOMINAL: Final = 4


@dataclass(frozen=True)
class ArchivedCalibration:
    """Estimate of the calibration in a component's solve, with its covariance with the tags.

    Attributes:
        owners: (C,) robot id or printed batch of each parameter.
        names: (C,) as in `CalibrationResult`.
        nominal: (C, 4) the numbers it corrects, padded with NaN.
        values: (C,) corrections.
        covariance: (C, C).
        with_tags: (C, 2 T) covariance with the component's tags, in order as (x, y), map frame.
    """

    owners: tuple[str, ...]
    names: tuple[str, ...]
    nominal: FloatArray
    values: FloatArray
    covariance: FloatArray
    with_tags: FloatArray


@dataclass(frozen=True)
class ArchivedSegment:
    """Measurements of one segment as they entered the joint solve, and the estimate of its own solve.

    Attributes:
        name, run, log, robot_id, run_id: as in `RunResult`.
        robot_json: the robot.yaml that was used; camera_json: the camera, empty without one.
        log_bytes: size of the log.
        lost: what of the log could not be read.
        warnings: warnings of the segment; run_warnings: those of its run.
        stamps_ns: (K,) of the keyframes.
        motion: (K-1, 3) by the wheels, motion_covariance: (K-1, 3, 3) of its right tangent, motion_by_wheels: (K-1, 3,
            3) its derivative with respect to wheel_scale, wheel_ratio, track_scale; distance_m: (K-1,).
        tag_families, tag_ids, tag_instances: (T,) observed tags; an instance if the run alone showed several places.
        reading_keyframe, reading_tag: (M,); reading: (M, 2) range and bearing, or x and y; reading_covariance: (M, 2,
            2); reading_by_camera: (M, 2, 5) derivative with respect to `CAMERA_PARAMETERS`; reading_turning_rad_s: (M,)
            turning rate of base.
        reading_polar, reading_in_camera: (M,) its form, and whether relative to the camera or to base.
        picture_stamps_ns: (F,) of all pictures.
        poses: (K, 3) in the frame of the segment's start; tags_m: (T, 2) there; calibration: of its graph.
        goodness: (5,) the fields of `GoodnessOfFit`.
        reading_camera: (M,) index of the camera in `Robot.camera_names`, and named_cameras_json: the cameras by name;
            None where robot.yaml has one.
        gyro_step, gyro_rows, gyro_values, gyro_walk_rows, gyro_owner: as `HeadingDifferences`; None without a gyro.
    """

    name: str
    run: str
    log: str
    robot_id: str
    run_id: str
    robot_json: str
    camera_json: str
    log_bytes: int
    lost: str
    warnings: tuple[str, ...]
    run_warnings: tuple[str, ...]
    stamps_ns: IntArray
    motion: FloatArray
    motion_covariance: FloatArray
    motion_by_wheels: FloatArray
    distance_m: FloatArray
    tag_families: tuple[str, ...]
    tag_ids: IntArray
    tag_instances: tuple[str, ...]
    reading_keyframe: IntArray
    reading_tag: IntArray
    reading: FloatArray
    reading_covariance: FloatArray
    reading_by_camera: FloatArray
    reading_turning_rad_s: FloatArray
    reading_polar: BoolArray
    reading_in_camera: BoolArray
    picture_stamps_ns: IntArray
    poses: FloatArray
    tags_m: FloatArray
    calibration: FloatArray
    goodness: FloatArray
    gyro_step: IntArray | None = None
    gyro_rows: FloatArray | None = None
    gyro_values: FloatArray | None = None
    gyro_walk_rows: FloatArray | None = None
    gyro_owner: str | None = None
    reading_camera: IntArray | None = None
    named_cameras_json: str | None = None


def arrays_of(kept: ArchivedCalibration | ArchivedSegment, key: str) -> dict[str, Any]:
    """Return arrays by name, each prefixed with the key; texts as unicode arrays."""
    arrays: dict[str, Any] = {}
    for each in fields(kept):
        value = getattr(kept, each.name)
        if value is None:
            continue
        is_text = isinstance(value, str | tuple)
        arrays[f"{key}{each.name}"] = np.array(value, dtype=np.str_) if is_text else np.asarray(value)
    return arrays


def calibration_from(arrays: Any, key: str) -> ArchivedCalibration | None:  # noqa: ANN401 - numpy's file of arrays
    """Return what `arrays_of` wrote; None if there is none."""
    return ArchivedCalibration(**_values(ArchivedCalibration, arrays, key)) if f"{key}owners" in arrays else None


def segment_from(arrays: Any, key: str) -> ArchivedSegment | None:  # noqa: ANN401 - numpy's file of arrays
    """Return what `arrays_of` wrote; None if there is none, or if written by a program that kept less."""
    if f"{key}reading_turning_rad_s" not in arrays:
        return None
    if arrays[f"{key}reading_by_camera"].shape[-1] != len(CAMERA_PARAMETERS):
        return None
    return ArchivedSegment(**_values(ArchivedSegment, arrays, key))


def _values(kind: type[ArchivedCalibration | ArchivedSegment], arrays: Any, key: str) -> dict[str, Any]:  # noqa: ANN401
    """Return a dataclass's values: texts and counts as Python's own types, all else as arrays."""
    values: dict[str, Any] = {}
    for each in fields(kind):
        if each.default is None and f"{key}{each.name}" not in arrays:
            continue
        array = arrays[f"{key}{each.name}"]
        if array.dtype.kind == "U":
            values[each.name] = str(array) if array.ndim == 0 else tuple(array.tolist())
        else:
            values[each.name] = int(array) if array.ndim == 0 else array
    return values


def nominal_row(nominal: tuple[float, ...]) -> FloatArray:
    """Return the numbers that a calibration parameter corrects as a row (4,), padded with NaN."""
    row = np.full(_NOMINAL, np.nan)
    row[: len(nominal)] = nominal
    return row
