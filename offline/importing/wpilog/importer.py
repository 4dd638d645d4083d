"""A WPILib log of an FRC robot -> a run log that `map` reads like a recorded one."""

from dataclasses import dataclass
from heapq import merge
from math import degrees
from pathlib import Path
from typing import Final

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation import StrPath, plural
from groundsbot.calib.robot import read_robot_yaml
from groundsbot.calib.tags import families
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.importing.bags.sightings import TagEntries, check_sizes, corner_entries
from groundsbot.offline.importing.csv.odometry import refuse_tick_options
from groundsbot.offline.importing.robot import (
    DETECTOR_SCALE_SIGMA,
    UNKNOWN_MOUNT_SIGMA_M,
    UNKNOWN_MOUNT_SIGMA_YAW_RAD,
    ImportOptions,
    RobotDefaults,
    describe_robot,
    safe_name,
)
from groundsbot.offline.importing.run_writer import Entry, ImportReport, check_output, write_run
from groundsbot.offline.importing.wpilog.camera import photon_camera
from groundsbot.offline.importing.wpilog.gyro import gyro_entries, is_gyro, likely_gyros
from groundsbot.offline.importing.wpilog.limelight import is_fiducials, limelight_mount
from groundsbot.offline.importing.wpilog.odometry import WpiOdometry, read_odometry
from groundsbot.offline.importing.wpilog.reader import WpiLog, WpiTopic
from groundsbot.offline.importing.wpilog.tags import WpiTags, count_tags, is_tags, positions_in, read_tags, seen_line
from groundsbot.offline.importing.wpilog.tilt import tilt_by_tags
from groundsbot.offline.importing.wpilog.topics import (
    WpilogOptions,
    check_odometry_name,
    choose_gyro,
    choose_odometry,
    choose_tags,
)
from groundsbot.onboard.log import log_head

FRC_TAG_SIZE_M: Final = 0.1651  # 6.5 inches, of fields since 2024


@dataclass(frozen=True)
class _WpiRecording:
    """What was read of a log.

    Attributes:
        camera: camera whose pixels the corners are in; None for positions.
        tag_size_m: tag size of tags with corners.
        remarks: lines for the user.
    """

    odometry: WpiOdometry
    gyro: list[Entry]
    tags: WpiTags
    tags_topic: WpiTopic
    camera: CameraModel | None
    tag_size_m: float
    remarks: list[str]


def import_wpilog(
    path: StrPath, output: StrPath, options: ImportOptions | None = None, wpilog_options: WpilogOptions | None = None
) -> ImportReport:
    """Write `output/<run_id>/0000.core.mcap` from a WPILib log; the same log gives the same bytes.

    The whole log is read before anything is written, and the run folder appears complete or not at all.

    Args:
        path: a `.wpilog` file.
        output: folder of runs.
        options: what is known of the run and its robot.
        wpilog_options: which topics, and where the swerve modules are.

    Raises:
        GroundsbotError: one line that names log, topic, value and what to do.
    """
    path, output = Path(path), Path(output)
    options, wpilog_options = options or ImportOptions(), wpilog_options or WpilogOptions()
    _check_options(path, options, wpilog_options)
    log = WpiLog(path)
    run_id = options.run_id or safe_name(path)
    check_output(output, output / run_id)
    read = _read(log, options, wpilog_options)
    known, mount_remarks = _defaults(log, read, options)
    robot, robot_yaml, robot_remarks = describe_robot(path, options, True, known)
    if read.camera is not None:
        entries = corner_entries(read.tags.pictures, read.camera, "PhotonVision")
    else:
        entries = positions_in(read.tags, robot.mount)
    tags = TagEntries(entries, read.camera, read.tags.lines())
    where = f"{path}: {read.tags_topic.name}"
    if not tags.tags:
        raise OfflineError(f"{where}: no tag is left: {'; '.join(tags.remarks)}; choose another with --tags-topic")
    check_sizes(where, robot, tags)
    readings = read.odometry.readings
    outside = _check_times(where, readings[0].stamp_ns, readings[-1].stamp_ns, tags.entries)
    head = log_head(robot, robot_yaml, read.camera, run_id, readings[0].stamp_ns, 0)
    odometry: list[Entry] = [(reading.stamp_ns, "/odometry", reading) for reading in readings]
    write_run(output / run_id, head, merge(odometry, read.gyro, tags.entries, key=lambda entry: entry[0]))
    return ImportReport(
        run_folder=output / run_id,
        run_id=run_id,
        robot_id=robot.robot_id,
        n_odometry=len(readings),
        duration_s=(readings[-1].stamp_ns - readings[0].stamp_ns) * 1e-9,
        distance_m=read.odometry.distance_m,
        n_observations=len(tags.tags),
        n_tags=len(set(tags.tags)),
        remarks=(*read.remarks, *tags.remarks, *outside, *robot_remarks, *mount_remarks),
    )


def _read(log: WpiLog, options: ImportOptions, wpilog_options: WpilogOptions) -> _WpiRecording:
    places = wpilog_options.module_places
    if not places and options.robot is not None:
        places = read_robot_yaml(Path(options.robot)).module_places
    topic = choose_odometry(log, wpilog_options, bool(places))
    remark = check_odometry_name(log, topic)
    odometry = read_odometry(log, topic, places)
    if wpilog_options.swerve_modules_m is not None and not odometry.uses_modules:
        raise OfflineError(
            f"{log.path}: odometry comes from {topic.name} ({topic.type}), so --swerve-modules-m would have no effect; "
            "leave it out, or choose modules with --odometry-topic"
        )
    gyro_topic = choose_gyro(log, wpilog_options, is_gyro)
    gyro, gyro_remark = ([], _unused_gyros(log)) if gyro_topic is None else gyro_entries(log, gyro_topic)
    tags_topic = choose_tags(log, wpilog_options, is_tags, lambda each: count_tags(log, each))
    tags = read_tags(log, tags_topic, options.tag_family, with_camera=True)
    camera, camera_remark = None, ""
    if tags.has_corners:
        found = photon_camera(log, tags_topic, tags.corners_px, options.robot_path)
        if found is None:
            tags = read_tags(log, tags_topic, options.tag_family, with_camera=False)
        else:
            camera, camera_remark = found
    size_m, size_remark = _tag_size(log.path, tags_topic, tags, options, wpilog_options)
    cut = f"the log ends within a record: its last {log.n_cut_bytes} bytes are left out" if log.n_cut_bytes else ""
    said = [odometry.remark, remark, gyro_remark, seen_line(tags_topic, tags), camera_remark, size_remark, cut]
    return _WpiRecording(odometry, gyro, tags, tags_topic, camera, size_m, [each for each in said if each])


def _unused_gyros(log: WpiLog) -> str:
    likely = likely_gyros(log)
    return f"{', '.join(likely)} not used; --imu-topic takes a yaw that the odometry does not contain" if likely else ""


def _tag_size(
    path: Path, topic: WpiTopic, tags: WpiTags, options: ImportOptions, wpilog_options: WpilogOptions
) -> tuple[float, str]:
    """Return the side of tags with corners, and a remark where it is that of FRC's fields."""
    given = wpilog_options.tag_size_m
    if not tags.has_corners and given is not None:
        raise OfflineError(f"{path}: {topic.name} gives places, so --tag-size-m would have no effect; leave it out")
    if not tags.has_corners or options.robot is not None or given is not None:
        return given or FRC_TAG_SIZE_M, ""
    return FRC_TAG_SIZE_M, f"tags of {FRC_TAG_SIZE_M} m, as on FRC's fields since 2024; --tag-size-m says otherwise"


def _defaults(log: WpiLog, read: _WpiRecording, options: ImportOptions) -> tuple[RobotDefaults, list[str]]:
    """Return what the log implies of its robot, and lines for the user."""
    mount, remarks = None, []
    fields: dict[str, float] = {"z_m_sigma": UNKNOWN_MOUNT_SIGMA_M}
    if options.robot is None:
        mount = limelight_mount(log, read.tags_topic) if is_fiducials(read.tags_topic) else None
        if mount is not None:
            angles = (
                f"roll {degrees(mount.roll_rad):.1f} deg, pitch {degrees(mount.pitch_rad):.1f} deg (positive: down)"
            )
            source = f"{read.tags_topic.parent}/camerapose_robotspace"
            remarks.append(f"mount: as typed into the Limelight ({source}): z {mount.z_m:.3g} m, {angles}")
        else:
            remarks += _tilt_remarks(read, options, fields)
    known = RobotDefaults(
        mount=mount,
        mount_fields=fields,
        family=options.tag_family,
        tag_size_m=read.tag_size_m if read.camera is not None else None,
        needs_track=False,
        wheel_scale_sigma=read.odometry.scale_sigma,
        range_scale_sigma=DETECTOR_SCALE_SIGMA,
    )
    return known, remarks


def _tilt_remarks(read: _WpiRecording, options: ImportOptions, fields: dict[str, float]) -> list[str]:
    """Add the camera's roll and pitch to the fields of its mount, from its tags where possible; return lines."""
    if options.camera_pitch_deg is not None:
        return []
    ways = "give --camera-roll-deg and --camera-pitch-deg, or --robot"
    if read.camera is None:
        return [f"the log has no mount, so the camera is assumed level; if it is tilted, {ways}"]
    tilt = tilt_by_tags(read.tags.tag_ids, read.tags.corners_px, read.tag_size_m, read.camera)
    if tilt is None:
        fields["roll_rad_sigma"] = fields["pitch_rad_sigma"] = UNKNOWN_MOUNT_SIGMA_YAW_RAD
        said = (
            "the log has no mount, and its views of tags do not determine the camera's tilt: assumed level, "
            f"with a sigma of {degrees(UNKNOWN_MOUNT_SIGMA_YAW_RAD):g} deg; if it is tilted, {ways}"
        )
        return [said]
    fields |= vars(tilt)
    roll, pitch = (
        f"{degrees(angle):.1f} +- {degrees(sigma):.1f} deg"
        for angle, sigma in ((tilt.roll_rad, tilt.roll_rad_sigma), (tilt.pitch_rad, tilt.pitch_rad_sigma))
    )
    said = f"camera rolled by {roll} and pitched by {pitch} (positive: down), as its tags fit best if they are upright"
    return [f"{said}; where they do not, {ways}"]


def _check_times(where: str, first_ns: int, last_ns: int, tags: list[Entry]) -> list[str]:
    """Return a remark if some tags were seen while there was no odometry.

    Raises:
        OfflineError: all were.
    """
    n_outside = sum(not first_ns <= stamp_ns <= last_ns for stamp_ns, _, _ in tags)
    if n_outside == len(tags):
        raise OfflineError(
            f"{where}: its tags were seen from {tags[0][0] * 1e-9:.3f} to {tags[-1][0] * 1e-9:.3f} s, odometry lasts "
            f"from {first_ns * 1e-9:.3f} to {last_ns * 1e-9:.3f} s; choose another with --odometry-topic"
        )
    return [f"{plural(n_outside, 'picture')} outside the odometry's time: a map cannot use them"] if n_outside else []


def _check_options(path: Path, options: ImportOptions, wpilog_options: WpilogOptions) -> None:
    """Check that no option was given that has no effect.

    Raises:
        OfflineError: the first such option.
    """
    if options.tag_family not in families():
        raise OfflineError(f"--tag-family is {options.tag_family!r}, must be one of {', '.join(families())}")
    for flag, value in (
        ("--state-rate-hz", options.state_rate_hz),
        ("--wheelbase-m", options.wheelbase_m),
        ("--track-width-m", options.track_width_m),
    ):
        if value is not None:
            raise OfflineError(f"{path}: {flag} would have no effect, for a WPILib log; leave it out")
    refuse_tick_options(path, options.tick_flags)
    if options.robot is not None and wpilog_options.tag_size_m is not None:
        raise OfflineError("--tag-size-m and --robot: the `tags` of robot.yaml have the sizes; leave one out")
