"""Choice of a log's topics to import: by type, or as named on the command line."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Final

from groundsbot.calib.foundation import plural
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.wpilog.reader import WpiLog, WpiTopic
from groundsbot.offline.importing.wpilog.structs import is_array, struct_name

CHASSIS: Final = "ChassisSpeeds"
POSITIONS: Final = "SwerveModulePosition"
STATES: Final = "SwerveModuleState"
MODULES: Final = (POSITIONS, STATES)
POSE: Final = "Pose2d"
NUMBERS: Final = "double[]"
# What a program wants is no measurement, and speeds along the field's axes are not those of the base.
_WANTED: Final = re.compile(r"target|setpoint|desired|goal|command|request|reference|optimi[sz]ed", re.IGNORECASE)
_OF_FIELD: Final = re.compile(r"field.?(relative|oriented|centric|speed)", re.IGNORECASE)
_MOST_LISTED: Final = 8
_MOST_MODULES: Final = 16
_PLACE: Final = re.compile(r"[\s;]+")


@dataclass(frozen=True)
class WpilogOptions:
    """Options of the command line for logs of WPILib; None if not given.

    Attributes:
        swerve_modules_m: places of the wheels in base, as `x,y x,y ...`, in the order of the log's arrays.
    """

    odometry_topic: str | None = None
    tags_topic: str | None = None
    imu_topic: str | None = None
    tag_size_m: float | None = None
    swerve_modules_m: str | None = None

    def __post_init__(self) -> None:
        if self.tag_size_m is not None and not (isfinite(self.tag_size_m) and 0.0 < self.tag_size_m <= 10.0):
            raise OfflineError(f"--tag-size-m is {self.tag_size_m}, must be above 0 and at most 10; correct it")
        _ = self.module_places

    @property
    def module_places(self) -> tuple[tuple[float, float], ...]:
        """Places of the wheels in base, m; empty if not given.

        Raises:
            OfflineError: the option is not of the form `x,y x,y ...`.
        """
        if self.swerve_modules_m is None:
            return ()
        try:
            pairs = [tuple(map(float, each.split(","))) for each in _PLACE.split(self.swerve_modules_m.strip())]
        except ValueError:
            pairs = []
        places = tuple((each[0], each[1]) for each in pairs if len(each) == 2)
        if len(places) != len(pairs) or not 2 <= len(places) <= _MOST_MODULES:
            raise OfflineError(
                f"--swerve-modules-m is {self.swerve_modules_m!r}, must be the places of 2 to {_MOST_MODULES} wheels "
                "as 'x,y x,y ...', metres ahead of the base and to its left"
            )
        if not all(abs(value) <= 10.0 for place in places for value in place):
            raise OfflineError(f"--swerve-modules-m is {self.swerve_modules_m!r}, no place is beyond 10 m; give metres")
        return places


def choose_odometry(log: WpiLog, options: WpilogOptions, has_modules: bool) -> WpiTopic:
    """Choose the topic of odometry: swerve modules where their places are known, else speeds of the chassis.

    Raises:
        OfflineError: nothing fits, several do, or what was named does not.
    """
    flag = "--odometry-topic"
    if options.odometry_topic is not None:
        return _topic_by_name(
            log, flag, options.odometry_topic, _is_odometry, "ChassisSpeeds, swerve modules or Pose2d"
        )
    measured = [each for each in log.topics if not _WANTED.search(each.name) and not _OF_FIELD.search(each.name)]
    modules = [[each for each in measured if is_array(each) and struct_name(each) == name] for name in MODULES]
    chassis = [each for each in measured if struct_name(each) == CHASSIS and not is_array(each)]
    for found in (*modules, chassis) if has_modules else (chassis,):
        if found:
            return _only(log.path, found, flag)
    if any(modules):
        raise OfflineError(
            f"{log.path}: its odometry is that of swerve modules, {list_topics([*modules[0], *modules[1]])}; give "
            "--swerve-modules-m, the places of the wheels in the order of the log, or --robot with swerve_modules_m"
        )
    others = [each for each in log.topics if _is_odometry(each) and each.type != NUMBERS]
    beside = (
        f"; setpoints and field-relative values, by their names, are not used: {list_topics(others)}" if others else ""
    )
    raise OfflineError(
        f"{log.path}: no odometry: no ChassisSpeeds, SwerveModulePosition[] or SwerveModuleState[]{beside}; name a "
        f"topic with {flag}, or log one of these"
    )


def check_odometry_name(log: WpiLog, topic: WpiTopic) -> str:
    """Return a remark about a topic that only its name identifies as odometry; empty if there is nothing to say.

    Raises:
        OfflineError: the speeds are along the field's axes.
    """
    if struct_name(topic) == CHASSIS and _OF_FIELD.search(topic.name):
        raise OfflineError(
            f"{log.path}: {topic.name}: by its name these speeds are along the field's axes, not those of the base; "
            "choose another with --odometry-topic"
        )
    return f"{topic.name}: by its name it is a setpoint, not a measurement" if _WANTED.search(topic.name) else ""


def choose_tags(
    log: WpiLog,
    options: WpilogOptions,
    is_tags: Callable[[WpiTopic], bool],
    n_tags: Callable[[WpiTopic], int],
) -> WpiTopic:
    """Choose the topic of tags, which is that of one camera.

    Args:
        log: the log.
        options: options of the command line.
        is_tags: function that returns whether a topic's type is one of those that hold tag detections.
        n_tags: number of tags that a topic saw.

    Raises:
        OfflineError: no tag was seen, several cameras saw some, or what was named does not fit.
    """
    known = "PhotonVision results, Limelight rawfiducials or Transform3d[] beside tag ids"
    if options.tags_topic is not None:
        return _topic_by_name(log, "--tags-topic", options.tags_topic, is_tags, known)
    fitting = [each for each in log.topics if is_tags(each)]
    seeing = [each for each in fitting if n_tags(each)]
    if not seeing:
        found = f"no tag was seen in {list_topics(fitting)}" if fitting else f"none of its topics holds {known}"
        raise OfflineError(
            f"{log.path}: no tags: {found}; poses of the robot that were computed from a field layout are not "
            "measurements; log the camera's results"
        )
    return _only(log.path, seeing, "--tags-topic", "; a run has one camera")


def choose_gyro(log: WpiLog, options: WpilogOptions, is_gyro: Callable[[WpiTopic], bool]) -> WpiTopic | None:
    """Return the topic of the yaw that the options name; None where they name none.

    Raises:
        OfflineError: it is not in the log, or of another type.
    """
    if options.imu_topic is None:
        return None
    known = "Rotation2d, Rotation3d, double or robot_orientation_set"
    return _topic_by_name(log, "--imu-topic", options.imu_topic, is_gyro, known)


def list_topics(topics: Sequence[WpiTopic]) -> str:
    """Return names with types and numbers of records, in one line."""
    listed = [f"{each.name} ({each.type}, {plural(each.n_records, 'record')})" for each in topics[:_MOST_LISTED]]
    more = [f"and {len(topics) - _MOST_LISTED} more"] if len(topics) > _MOST_LISTED else []
    return ", ".join([*listed, *more])


def _is_odometry(topic: WpiTopic) -> bool:
    name = struct_name(topic)
    if topic.type == NUMBERS:
        return True
    return is_array(topic) if name in MODULES else name in (CHASSIS, POSE) and not is_array(topic)


def _topic_by_name(log: WpiLog, flag: str, name: str, fits: Callable[[WpiTopic], bool], known: str) -> WpiTopic:
    same = [each for each in log.topics if _bare(each.name) == _bare(name)]
    found = [each for each in same if each.name == name] or same
    fitting = [each for each in found if fits(each)]
    if fitting:
        return max(fitting, key=lambda each: each.n_records)
    if found:
        raise OfflineError(f"{log.path}: {flag} {name} is of type {found[0].type}, must be {known}; name another")
    likely = [each for each in log.topics if fits(each) and each.type != NUMBERS]
    holds = f"; it holds {list_topics(likely)}" if likely else ""
    raise OfflineError(f"{log.path}: {flag} {name} has no records in this log{holds}; name another")


def _bare(name: str) -> str:
    """Return a name without the prefix of NetworkTables."""
    return name.removeprefix("NT:").lstrip("/")


def _only(path: Path, found: Sequence[WpiTopic], flag: str, why: str = "") -> WpiTopic:
    if len(found) > 1:
        raise OfflineError(f"{path}: {len(found)} topics fit: {list_topics(found)}{why}; choose one with {flag}")
    return found[0]
