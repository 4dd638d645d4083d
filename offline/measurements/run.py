"""Reads a run log into a `Run` of measurements, or refuses it with the reason."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.camera import CameraModel, read_camera_yaml
from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.foundation import IntArray, StrPath, plural
from groundsbot.calib.robot import Robot, parse_robot_yaml, read_robot_yaml
from groundsbot.calib.tags import shift_edges
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import log_size
from groundsbot.offline.measurements.motion_model.gyro import GyroSamples, gyro_samples
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.motion_model.wheel_segments import wheel_segments_of
from groundsbot.offline.measurements.plausibility import check_file_name
from groundsbot.offline.measurements.run_messages import MEASURED_TOPICS, RunEvent, RunMessages
from groundsbot.offline.measurements.tags import Detections, Positions, TagKey
from groundsbot.onboard.log import (
    CALIBRATION_TOPIC,
    DETECTIONS_TOPIC,
    Allowance,
    LogLosses,
    RunInfo,
    TagDetections,
    TagObservations,
    camera_from_message,
    camera_topic,
    read_log,
)


class Inputs(NamedTuple):
    """The number of logs that are read together, and their total size in bytes."""

    n_logs: int = 1
    n_bytes: int = 0

    @staticmethod
    def of(logs: Sequence[Path]) -> "Inputs":
        """Return the number and total size of files and run folders; missing ones, refused later, have size zero."""
        return Inputs(max(1, len(logs)), sum(map(log_size, logs)))


ALONE: Final = Inputs()


@dataclass(frozen=True)
class Run:
    """The measurements of one log.

    Attributes:
        name: robot id and run id, unique among the runs of a map.
        wheel_segments: wheel readings with unbroken odometry, in order.
        picture_stamps_ns: (F,) of all pictures, including those without tags.
        picture_camera: (F,) index of their camera in `Robot.camera_names`.
        tags: all observed tags, sorted.
        camera: the first camera; None in an imported log.
        named_cameras: all cameras by name; empty for a robot with one camera. One that saw no tag may be missing.
        warnings: messages for the user.
        log_bytes: size of the log, which limits the work done for it.
        inputs: the logs that are read together, including this one.
        lost: description of what cannot be read of the log; empty where all can.
        corners_refined: whether all corners were refined on the picture.
        events: events of the recorder, in order of their stamps.
        gyro: yaw rates; None where the log has none.
    """

    name: str
    robot_id: str
    run_id: str
    log: Path
    robot: Robot
    camera: CameraModel | None
    wheel_segments: tuple[WheelSegment, ...]
    picture_stamps_ns: IntArray
    picture_camera: IntArray
    tags: tuple[TagKey, ...]
    detections: Detections
    positions: Positions
    warnings: tuple[str, ...]
    log_bytes: int = 0
    inputs: Inputs = ALONE
    lost: str = ""
    corners_refined: bool = False
    events: tuple[RunEvent, ...] = ()
    gyro: GyroSamples | None = None
    named_cameras: Mapping[str, CameraModel] = field(default_factory=dict)

    def __repr__(self) -> str:
        pictures, tags = plural(len(self.picture_stamps_ns), "picture"), plural(len(self.tags), "tag")
        return f"<Run {self.name} of {self.log}: {pictures}, {tags}>"

    def shift_stamps(self, *late_s: float) -> "Run":
        """Return the run with the stamps of each camera's pictures reduced, and imported ones as the first camera's."""
        late_ns = np.array([round(each * 1e9) for each in late_s], dtype=np.int64)
        detections = self.detections
        return replace(
            self,
            picture_stamps_ns=self.picture_stamps_ns - late_ns[self.picture_camera],
            detections=replace(detections, stamps_ns=detections.stamps_ns - late_ns[detections.camera]),
            positions=replace(self.positions, stamps_ns=self.positions.stamps_ns - late_ns[0]),
        )

    def without_detections(self) -> "Run":
        """Return the run without detections, which its segments have as observations."""
        none = np.zeros(len(self.detections.tag), dtype=np.bool_)
        return replace(
            self,
            detections=self.detections.where(none),
            wheel_segments=tuple(replace(each) for each in self.wheel_segments),  # without what they cached
        )

    def without_measurements(self) -> "Run":
        """Return a copy of the run without its measurements: names, robots and calibration."""
        return replace(
            self.without_detections(),
            wheel_segments=(),
            picture_stamps_ns=self.picture_stamps_ns[:0].copy(),
            picture_camera=self.picture_camera[:0].copy(),
            positions=self.positions.where(np.zeros(len(self.positions.tag), dtype=np.bool_)),
            gyro=None,
        )

    def with_camera(self, number: int) -> "Run":
        """Return the run of one of its cameras alone, in the form of a robot with one camera.

        Args:
            number: index in `Robot.camera_names`. Only the first has the imported positions.
        """
        if not self.robot.cameras:
            return self
        name = self.robot.camera_names[number]
        own = self.detections.camera == number
        is_own = self.picture_camera == number
        return replace(
            self,
            robot=self.robot.with_camera(name),
            camera=self.named_cameras.get(name),
            named_cameras={},
            picture_stamps_ns=self.picture_stamps_ns[is_own],
            picture_camera=np.zeros(int(is_own.sum()), dtype=np.int64),
            detections=replace(self.detections.where(own), camera=np.zeros(int(own.sum()), dtype=np.int64)),
            positions=self.positions.where(np.full(len(self.positions.tag), number == 0)),
        )


@dataclass(frozen=True)
class RobotFile:
    """A robot.yaml given by the user, with its cameras by name, which replace the ones in a log.

    The name of a single camera is empty; without a camera file there is none.
    """

    robot: Robot
    cameras: Mapping[str, CameraModel]

    @property
    def camera(self) -> CameraModel | None:
        """The camera of a robot that has a single one; None without its file."""
        return self.cameras.get("")


def read_robot_file(path: StrPath) -> RobotFile:
    """Read robot.yaml and the camera files that it names.

    Raises:
        GroundsbotError: a file cannot be read, or a field is invalid.
    """
    path = Path(path)
    robot = read_robot_yaml(path)
    files = {name: robot.with_camera(name).camera for name in robot.camera_names}
    return RobotFile(robot, {name: read_camera_yaml(path.parent / file) for name, file in files.items() if file})


def load_run(
    log: StrPath,
    robot_files: Mapping[str, RobotFile] | None = None,
    inputs: Inputs = ALONE,
    allowance: Allowance | None = None,
) -> Run:
    """Read one log.

    Args:
        log: a file or a run folder.
        robot_files: calibrations by robot id that replace those in the log.
        inputs: the logs that are read together, including this one.
        allowance: shared by these logs while reading; a new one where None.

    Raises:
        GroundsbotError: the log cannot be mapped; the message is one line.
    """
    log = Path(log)
    collected, losses = RunMessages(), LogLosses()
    log_bytes = log_size(log)
    for entry in read_log(log, topics=MEASURED_TOPICS, losses=losses, allowance=allowance):
        collected.add(entry)
        if type(entry.message) in (TagDetections, TagObservations):
            collected.observations.check(log, log_bytes, inputs.n_logs)
    return run_of(collected, losses, log, log_bytes, robot_files, inputs, allowance)


def run_of(
    collected: RunMessages,
    losses: LogLosses,
    log: Path,
    log_bytes: int,
    robot_files: Mapping[str, RobotFile] | None = None,
    inputs: Inputs = ALONE,
    allowance: Allowance | None = None,
) -> Run:
    """Return the measurements of a log from its messages.

    Args:
        collected: the messages.
        losses: what could not be read of the log.
        log: named in errors.
        log_bytes: its size.
        robot_files: calibrations by robot id that replace those in the log.
        inputs: the logs that are read together, including this one.
        allowance: shared by these logs; a new one where None.

    Raises:
        GroundsbotError: the log cannot be mapped; the message is one line.
    """
    info = _run_info(collected, log, losses)
    (allowance or Allowance()).check_text(info.robot_yaml, log, log_bytes)
    given = (robot_files or {}).get(info.robot_id)
    robot = given.robot if given else _parse_robot(info.robot_yaml, f"{log}: robot.yaml in /run")
    names = robot.camera_names
    _check_cameras(collected, names, log)
    wheel_segments, warnings = wheel_segments_of(collected.wheels, collected.odometry, robot, log, log_bytes)
    warnings += losses.lines()
    gyro, gyro_warnings = gyro_samples(collected.gyro, robot, f"{log}: /gyro")
    warnings += gyro_warnings
    collected.observations.check_tags(log)
    tags = collected.observations.collect(log_bytes, inputs.n_logs, names)
    warnings += _thinning_warnings(collected, tags.every, log_bytes)
    cameras = {each: _camera(collected, given.cameras.get(each) if given else None, each, log) for each in names}
    views = [robot.with_camera(each) for each in names]
    name = f"{info.robot_id}_{info.run_id}"
    return Run(
        name=name,
        robot_id=info.robot_id,
        run_id=info.run_id,
        log=log,
        robot=robot,
        camera=cameras[names[0]],
        named_cameras={name: each for name, each in cameras.items() if name and each is not None},
        wheel_segments=tuple(wheel_segments),
        picture_stamps_ns=tags.pictures_ns,
        picture_camera=tags.picture_camera,
        tags=tags.tags,
        detections=_without_edge_shift(tags.detections, [each.edge_shift_px for each in views]),
        positions=tags.positions,
        warnings=tuple(f"{name}: {warning}" for warning in warnings),
        log_bytes=log_bytes,
        inputs=inputs,
        lost=losses.in_words,
        corners_refined=tags.corners_refined,
        events=tuple(sorted(collected.events)),
        gyro=gyro,
    ).shift_stamps(*(each.time_offset_s for each in views))  # pictures' stamps are this much later than the wheels'


def _without_edge_shift(detections: Detections, by_camera_px: Sequence[float]) -> Detections:
    """Return the detections with the sides of tags where they would be without the shift by each camera."""
    corners_px = detections.corners_px.copy()
    for number, shift_px in enumerate(by_camera_px):
        own = detections.camera == number
        corners_px[own] = shift_edges(corners_px[own], -shift_px)
    return replace(detections, corners_px=corners_px)


# A run that grows is read again for each pose, and parsing took two thirds of that time.
_parse_robot = lru_cache(maxsize=16)(parse_robot_yaml)


def _run_info(collected: RunMessages, log: Path, losses: LogLosses) -> RunInfo:
    """Return the identity of the run, after checking that its names can be used in file names."""
    info = collected.info
    if info is None:
        found = "; ".join([f"{log}: no /run message, so its robot and run are unknown", *losses.lines()])
        raise OfflineError(f"{found}; check that it is a groundsbot log")
    check_file_name(info.robot_id, f"{log}: /run: robot_id")
    check_file_name(info.run_id, f"{log}: /run: run_id")
    return info


def _thinning_warnings(collected: RunMessages, every: int, log_bytes: int) -> list[str]:
    warnings = []
    if every > 1:
        warnings.append(
            f"{collected.observations.count} tag observations exceed what is used of a log of {log_bytes} bytes; "
            f"one picture in {every} is used"
        )
    if collected.n_other_size:
        pictures = plural(collected.n_other_size, "picture")
        first = " or ".join(str(size) for size in dict.fromkeys(collected.picture_sizes.values()))
        warnings.append(f"{pictures} of another size than the first {first}; left out")
    return warnings


def _check_cameras(collected: RunMessages, names: Sequence[str], log: Path) -> None:
    """Refuse pictures of a camera that robot.yaml does not have.

    Raises:
        OfflineError: naming the camera.
    """
    for name in collected.observations.cameras:
        if name not in names:
            seen, topic = f"camera {name!r}" if name else "a single camera", camera_topic(DETECTIONS_TOPIC, name)
            known = ", ".join(filter(None, names)) or "a single camera"
            raise OfflineError(
                f"{log}: {topic} is of {seen}, but robot.yaml describes {known}; give the robot.yaml of this recording "
                "with --robot"
            )


def _camera(collected: RunMessages, given: CameraModel | None, name: str, log: Path) -> CameraModel | None:
    """Return the given calibration, or else the log's; None where neither exists and there are no detections.

    Raises:
        OfflineError: there is no calibration for the detections, or it is for another picture size.
    """
    calibration, size = collected.calibrations.get(name), collected.picture_sizes.get(name)
    topic, of_detections = (camera_topic(kind, name) for kind in (CALIBRATION_TOPIC, DETECTIONS_TOPIC))
    camera, source = given, "the camera file given with --robot"
    if camera is None and calibration is not None:
        try:
            camera, source = camera_from_message(calibration), topic
        except GroundsbotError as error:
            raise OfflineError(f"{log}: {error}") from error
    if camera is None and name in collected.observations.in_pixels:
        raise OfflineError(
            f"{log}: tags were detected but {topic} has 0 messages; "
            "give the robot's file with --robot, with its `camera` set"
        )
    if camera is not None and size is not None and size != (camera.width_px, camera.height_px):
        raise OfflineError(
            f"{log}: {of_detections}: pictures are {size[0]}x{size[1]} px but {source} is for "
            f"{camera.width_px}x{camera.height_px} px; calibrate at the size that is recorded, "
            "or give the right file with --robot"
        )
    return camera
