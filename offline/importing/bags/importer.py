"""A ROS bag -> a run log that `map` reads like a recorded one."""

from dataclasses import replace
from heapq import merge
from math import pi
from pathlib import Path

import numpy as np

from groundsbot.calib.foundation import StrPath, plural
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import Progress
from groundsbot.offline.importing.bags.content import BagContent, read_content
from groundsbot.offline.importing.bags.gyro import gyro_entries
from groundsbot.offline.importing.bags.mount import find_mount
from groundsbot.offline.importing.bags.odometry import joint_readings, odometry_readings, wheel_joints
from groundsbot.offline.importing.bags.reader import open_bag
from groundsbot.offline.importing.bags.sightings import find_camera, tag_entries
from groundsbot.offline.importing.bags.topics import APRILTAG_ROS, JOINTS, BagOptions, ChosenTopics, choose_topics
from groundsbot.offline.importing.csv.odometry import refuse_tick_options
from groundsbot.offline.importing.robot import ImportOptions, RobotDefaults, describe_robot, safe_name, wheel_scale
from groundsbot.offline.importing.run_writer import Entry, ImportReport, check_output, write_run
from groundsbot.onboard.log import PlanarOdometry, log_head


def import_bag(
    path: StrPath,
    output: StrPath,
    options: ImportOptions | None = None,
    bag_options: BagOptions | None = None,
    progress: Progress = lambda *_: None,
) -> ImportReport:
    """Write `output/<run_id>/0000.core.mcap` from a bag of ROS 1 or ROS 2; the same bag gives the same bytes.

    The whole bag is read before anything is written, and the run folder appears complete or not at all.

    Args:
        path: a `.bag` file; a folder, an `.mcap` or a `.db3` file of ROS 2.
        output: folder of runs.
        options: what is known of the run and its robot.
        bag_options: which topics and frames.
        progress: called with the number of pictures that are done.

    Raises:
        GroundsbotError: one line that names bag, topic, value and what to do.
    """
    path, output = Path(path), Path(output)
    options, bag_options = options or ImportOptions(), bag_options or BagOptions()
    run_id = options.run_id or safe_name(path)
    check_output(output, output / run_id)
    with open_bag(path) as bag:
        chosen = choose_topics(path, bag.topics, bag_options)
        _check_options_used(path, chosen, options, bag_options)
        content = read_content(bag, chosen, bag_options, options.tag_family)
        camera = find_camera(path, chosen, content, options.robot_path)
        frames = {camera.frame} if camera is not None and chosen.has_pictures else content.camera_frames
        mount = find_mount(path, content.frames, content.base_frame, frames, options, bag_options)
        known = RobotDefaults(
            mount.mount, options.tag_family, bag_options.tag_size_m, chosen.odometry.msgtype == JOINTS
        )
        robot, robot_yaml, robot_remarks = describe_robot(path, options, mount.in_camera, known)
        readings, distance_m = _odometry(path, chosen, content, robot.wheels.track_m, options, bag_options)
        tags = tag_entries(bag, chosen, content, robot, mount.in_camera, camera, bag_options, progress)
    base_frame = bag_options.base_frame or content.base_frame
    gyro = [] if chosen.imu is None else gyro_entries(path, chosen.imu, content, base_frame)
    outside = _check_times(path, readings, tags.entries)
    head = log_head(robot, robot_yaml, tags.camera, run_id, readings[0].stamp_ns, 0)
    odometry: list[Entry] = [(reading.stamp_ns, "/odometry", reading) for reading in readings]
    write_run(output / run_id, head, merge(odometry, gyro, tags.entries, key=lambda entry: entry[0]))
    if chosen.unused_imus:
        content.remarks.append(
            f"{', '.join(chosen.unused_imus)} not used; --imu-topic takes its yaw rate, unless the odometry contains it"
        )
    used = f"odometry: {chosen.odometry.name} ({chosen.odometry.short_type})"
    return ImportReport(
        run_folder=output / run_id,
        run_id=run_id,
        robot_id=robot.robot_id,
        n_odometry=len(readings),
        duration_s=(readings[-1].stamp_ns - readings[0].stamp_ns) * 1e-9,
        distance_m=distance_m,
        n_observations=len(tags.tags),
        n_tags=len(set(tags.tags)),
        remarks=(used, *tags.remarks, *content.remarks, *outside, *mount.remarks, *robot_remarks),
    )


def _odometry(
    path: Path,
    chosen: ChosenTopics,
    content: BagContent,
    track_m: float,
    options: ImportOptions,
    bag_options: BagOptions,
) -> tuple[list[PlanarOdometry], float]:
    """Return odometry readings, and the driven distance in metres."""
    where = f"{path}: {chosen.odometry.name}"
    stamps_ns = np.array([stamp for stamp, _ in content.odometry], dtype=np.int64)
    messages = [message for _, message in content.odometry]
    if chosen.odometry.msgtype != JOINTS:
        readings, distance_m, said = odometry_readings(where, stamps_ns, messages, track_m)
        content.remarks.append(said)
        return readings, distance_m
    joints = wheel_joints(path, chosen.odometry.name, messages, bag_options)
    content.remarks.append(f"wheels: joints {joints[0]} and {joints[1]}")
    # Joints measure angles, so a tick is a radian.
    scale = wheel_scale(replace(options, ticks_per_turn=2.0 * pi))
    return joint_readings(where, stamps_ns, messages, joints, scale)


def _check_times(path: Path, readings: list[PlanarOdometry], tags: list[Entry]) -> list[str]:
    """Check that tags were observed while odometry was recorded; return a remark if some were not.

    Raises:
        OfflineError: no tag was observed in that time.
    """
    first, last = readings[0].stamp_ns, readings[-1].stamp_ns
    n_outside = sum(not first <= stamp_ns <= last for stamp_ns, _, _ in tags)
    if n_outside == len(tags):
        raise OfflineError(
            f"{path}: the odometry lasts from {first * 1e-9:.3f} to {last * 1e-9:.3f} s, the tags from "
            f"{tags[0][0] * 1e-9:.3f} to {tags[-1][0] * 1e-9:.3f} s; were they stamped by different clocks? "
            "--receive-times takes the bag's own"
        )
    return [f"{plural(n_outside, 'picture')} outside the odometry's time: a map cannot use them"] if n_outside else []


def _check_options_used(path: Path, chosen: ChosenTopics, options: ImportOptions, bag_options: BagOptions) -> None:
    """Check that every option given has an effect.

    Raises:
        OfflineError: naming one that has none.
    """
    if options.state_rate_hz is not None:
        raise OfflineError(f"{path}: --state-rate-hz is for odom.csv; a bag holds its own times, leave it out")
    if options.wheelbase_m is not None:
        raise OfflineError(f"{path}: --wheelbase-m is for steering_rad in odometry.csv; leave it out")
    if chosen.odometry.msgtype != JOINTS:
        refuse_tick_options(path, options.tick_flags)
        if bag_options.left_joint is not None:
            raise OfflineError(
                f"{path}: --left-joint and --right-joint would have no effect, for odometry comes from "
                f"{chosen.odometry.name} ({chosen.odometry.short_type}); leave them out, or give --odometry-topic"
            )
    elif options.ticks_per_turn is not None:
        raise OfflineError(f"{path}: --ticks-per-turn would have no effect, for joints hold angles; leave it out")
    if chosen.tags.msgtype == APRILTAG_ROS and bag_options.tag_size_m is not None:
        raise OfflineError(
            f"{path}: {chosen.tags.name} holds poses, so --tag-size-m would have no effect; leave it out"
        )
    if options.robot is not None and bag_options.tag_size_m is not None:
        raise OfflineError("--tag-size-m and --robot: the `tags` of robot.yaml have the sizes; leave one out")
