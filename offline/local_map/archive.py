"""Archive local maps in a finished map, and restore them to extend it.

A map is extended by the steps by which all its runs would be mapped at once: merge, solve, search for outlier tags. So
it archives all measurements of each run (motions and observations, some 1 MB for 100 m) and the solution of the run
alone, from which its solve converges at once. Nothing is marginalised, so nothing stays at the linearisation point of
the smaller map; and no log is needed.
"""

import json
from dataclasses import asdict, astuple, replace
from pathlib import Path
from typing import Any

import numpy as np

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.robot import Robot
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import log_path
from groundsbot.offline.local_map.goodness_of_fit import GoodnessOfFit
from groundsbot.offline.local_map.local_map import LocalMap
from groundsbot.offline.maps import ArchivedSegment, MapResult
from groundsbot.offline.measurements import (
    SAME_SIZE_M,
    CovarianceParts,
    Detections,
    HeadingDifferences,
    Observations,
    Positions,
    Run,
    Segment,
    SegmentOdometry,
    TagKey,
    TapeOptions,
)
from groundsbot.offline.sam import State, build_graph, solve


def archive_map(local_map: LocalMap) -> ArchivedSegment:
    """Return what is archived of a local map."""
    segment, state = local_map.segment, local_map.solution.state
    run, odometry, observations = segment.run, segment.odometry, segment.observations
    return ArchivedSegment(
        name=segment.name,
        run=run.name,
        log=str(run.log),
        robot_id=run.robot_id,
        run_id=run.run_id,
        robot_json=run.robot.model_dump_json(),
        camera_json="" if run.camera is None else json.dumps(asdict(run.camera)),
        log_bytes=run.log_bytes,
        lost=run.lost,
        warnings=segment.warnings,
        run_warnings=run.warnings,
        stamps_ns=segment.stamps_ns,
        motion=odometry.motion,
        motion_covariance=odometry.covariance,
        motion_by_wheels=odometry.jacobian,
        distance_m=odometry.distance_m,
        tag_families=tuple(tag.family for tag in segment.tags),
        tag_ids=np.array([tag.tag_id for tag in segment.tags], dtype=np.int64),
        tag_instances=tuple(tag.instance for tag in segment.tags),
        reading_keyframe=observations.keyframe,
        reading_tag=observations.tag,
        reading=observations.value,
        reading_covariance=observations.covariance,
        reading_by_camera=observations.by_camera,
        reading_turning_rad_s=observations.turning_rad_s,
        reading_polar=observations.polar,
        reading_in_camera=observations.in_camera,
        picture_stamps_ns=run.picture_stamps_ns,
        poses=state.poses,
        tags_m=state.tags,
        calibration=state.calibration,
        goodness=np.array(astuple(local_map.goodness), dtype=np.float64),
        **(_archived_cameras(segment) if run.robot.cameras else {}),
        **({} if odometry.differences is None else _archived_differences(odometry.differences)),
    )


def _archived_cameras(segment: Segment) -> dict[str, Any]:
    cameras = {name: asdict(camera) for name, camera in segment.run.named_cameras.items()}
    return {"reading_camera": segment.observations.camera, "named_cameras_json": json.dumps(cameras)}


def _archived_differences(differences: HeadingDifferences) -> dict[str, Any]:
    return {
        "gyro_step": differences.step,
        "gyro_rows": differences.rows,
        "gyro_values": differences.values,
        "gyro_walk_rows": differences.walk_rows,
        "gyro_owner": differences.owner,
    }


def _differences(kept: ArchivedSegment) -> HeadingDifferences | None:
    if (
        kept.gyro_step is None
        or kept.gyro_rows is None
        or kept.gyro_values is None
        or kept.gyro_walk_rows is None
        or kept.gyro_owner is None
    ):
        return None
    return HeadingDifferences(kept.gyro_step, kept.gyro_rows, kept.gyro_values, kept.gyro_walk_rows, kept.gyro_owner)


def restore_local_map(kept: ArchivedSegment) -> LocalMap:
    """Return the archived local map, under the noise it was archived with."""
    segment = _segment(kept)
    graph = build_graph([segment])
    solution = solve(graph.problem, State(kept.poses, kept.tags_m, kept.calibration))
    chi_square, expected, bound, odometry_factor, observation_factor = kept.goodness.tolist()
    return LocalMap(
        segment, graph, solution, GoodnessOfFit(chi_square, round(expected), bound, odometry_factor, observation_factor)
    )


def segment_from_arrays(
    run: Run,
    stamps_ns: IntArray,
    motions: tuple[FloatArray, FloatArray, FloatArray],
    tags: tuple[TagKey, ...],
    keyframe: IntArray,
    tag: IntArray,
    value: FloatArray,
    covariance: FloatArray,
    by_camera: FloatArray,
    polar: BoolArray,
    in_camera: BoolArray,
    *,
    distance_m: FloatArray | None = None,
    turning_rad_s: FloatArray | None = None,
    camera: IntArray | None = None,
) -> Segment:
    """Return a segment of motions and observations with fixed noise, named as its run.

    Args:
        run: run to which they belong.
        stamps_ns: (K,) of the keyframes.
        motions: (K-1, 3), (K-1, 3, 3) and (K-1, 3, 3): motion, covariance and jacobian of `SegmentOdometry`.
        tags: tags, as in `Segment`.
        keyframe: keyframe, as in `Observations`, and likewise the others.
        tag: index into the tags.
        value: value of each observation.
        covariance: covariance of the value.
        by_camera: its derivative with respect to the camera's parameters.
        polar: whether it is (range, bearing).
        in_camera: whether it is relative to the camera.
        distance_m: (K-1,) driven; None: the forward component of each motion.
        turning_rad_s: as of `Observations`; None: taken as zero. Only the bias of the time offset depends on it.
        camera: camera, as in `Observations`; None: the first of the robot.
    """
    motion, spread, jacobian = motions
    driven_m = np.abs(motion[:, 0]) if distance_m is None else distance_m
    odometry = SegmentOdometry(motion, spread, CovarianceParts.constant(spread), jacobian, driven_m)
    n = len(value)
    observations = Observations(
        keyframe,
        tag,
        value,
        covariance,
        CovarianceParts.constant(covariance),
        by_camera,
        polar,
        in_camera,
        corners_px=np.full((n, 4, 2), np.nan),
        corner_bias_px=np.zeros((n, 2)),
        face=np.full((n, 4), np.nan),
        corner_sigmas=np.ones(n),
        turning_rad_s=np.zeros(n) if turning_rad_s is None else turning_rad_s,
        heading_jitter_rad=np.zeros(n),  # the covariance contains it; only a fit of the noise would need it
        camera=np.zeros(n, dtype=np.int64) if camera is None else camera,
    )
    return Segment(run.name, run, stamps_ns, odometry, tags, observations)


def run_without_log(name: str, robot: Robot, tags: tuple[TagKey, ...]) -> Run:
    """Return a run without the wheel readings, pictures and events that only a log has."""
    none: IntArray = np.zeros(0, dtype=np.int64)
    return Run(
        name=name,
        robot_id=robot.robot_id,
        run_id="",
        log=Path(),
        robot=robot,
        camera=None,
        wheel_segments=(),
        picture_stamps_ns=none,
        picture_camera=none,
        tags=tuple(sorted({tag.whole for tag in tags})),
        detections=Detections(none, none, np.zeros((0, 4, 2)), none),
        positions=Positions(
            none, none, np.zeros((0, 2)), none.astype(np.bool_), np.zeros((0, 2, 2)), none.astype(np.bool_)
        ),
        warnings=(),
    )


def _segment(kept: ArchivedSegment) -> Segment:
    names = zip(kept.tag_families, kept.tag_ids.tolist(), kept.tag_instances, strict=True)
    tags = tuple(TagKey(*name) for name in names)
    camera = json.loads(kept.camera_json) if kept.camera_json else None
    named = json.loads(kept.named_cameras_json) if kept.named_cameras_json else {}
    run = replace(
        run_without_log(kept.run, Robot.model_validate_json(kept.robot_json), tags),
        run_id=kept.run_id,
        log=log_path(kept.log),
        camera=None if camera is None else _camera_from(camera),
        named_cameras={name: _camera_from(each) for name, each in named.items()},
        picture_stamps_ns=kept.picture_stamps_ns,
        picture_camera=np.zeros(len(kept.picture_stamps_ns), dtype=np.int64),
        warnings=kept.run_warnings,
        log_bytes=kept.log_bytes,
        lost=kept.lost,
    )
    segment = segment_from_arrays(
        run,
        kept.stamps_ns,
        (kept.motion, kept.motion_covariance, kept.motion_by_wheels),
        tags,
        kept.reading_keyframe,
        kept.reading_tag,
        kept.reading,
        kept.reading_covariance,
        kept.reading_by_camera,
        kept.reading_polar,
        kept.reading_in_camera,
        distance_m=kept.distance_m,
        turning_rad_s=kept.reading_turning_rad_s,
        camera=kept.reading_camera,
    )
    odometry = replace(segment.odometry, differences=_differences(kept))
    return replace(segment, name=kept.name, warnings=kept.warnings, odometry=odometry)


def _camera_from(entry: dict[str, Any]) -> CameraModel:
    return CameraModel(**entry | {"distortion": tuple(entry["distortion"])})


def check_extendable(known: MapResult) -> None:
    """Refuse a map without archived measurements of its runs.

    Raises:
        OfflineError: it was made by an older program.
    """
    if not known.archived_segments:
        raise OfflineError(
            "--extend: the map's map.npz does not contain its runs' measurements (an older program made it); map their "
            "logs together with the new ones"
        )


def archived_tag_ids(kept: ArchivedSegment) -> list[TagKey]:
    """Return the ids of the tags that a segment observed, without instances."""
    return [TagKey(family, tag_id) for family, tag_id in zip(kept.tag_families, kept.tag_ids.tolist(), strict=True)]


def check_sizes_in_map(run: Run, known: MapResult) -> None:
    """Refuse a run whose robot.yaml gives a tag another size than the map has.

    Raises:
        OfflineError: naming run, tag and both sizes.
    """
    sizes_m = {(tag.family, tag.tag_id): tag.size_m for component in known.components for tag in component.tags}
    for index in np.unique(run.detections.tag):
        family, tag_id, _ = run.tags[index]
        in_map_m = sizes_m.get((family, tag_id))
        size_m = run.robot.tag_size_m(family, tag_id)[0]
        if in_map_m is not None and abs(in_map_m - size_m) > SAME_SIZE_M:
            raise OfflineError(
                f"{run.log}: tags: tag {tag_id} of {family} has size {size_m} m in the robot.yaml of {run.name} but "
                f"{in_map_m} m in the map; give the right robot.yaml with --robot"
            )


def tape_options_of(known: MapResult, tape: TapeOptions) -> TapeOptions:
    """Return the tape measurements of an archived map together with those for its extension."""
    starts, distances = [], []
    for each in known.measurements:
        numbers = ",".join(f"{value!r}" for value in [*each.measured.tolist(), *each.sigma.tolist()])
        if each.kind == "start":
            starts.append(f"{each.b}={numbers}")
        else:
            distances.append(f"{each.a},{each.b}={numbers}")
    return TapeOptions((*starts, *tape.starts), (*distances, *tape.distances))
