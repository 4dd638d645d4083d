"""The calibration parameters of a graph: which there are, whose they are, and their priors."""

from typing import Final, NamedTuple

from groundsbot.calib.robot import (
    CAMERA_PARAMETERS,
    IMPORTED_BATCH,
    MOUNT_PARAMETERS,
    TAG_SCALE,
    WHEEL_PARAMETERS,
    Gyro,
    Robot,
)
from groundsbot.offline.measurements import Segment, TagKey


class Parameter(NamedTuple):
    """One calibration number: a correction to what a robot.yaml says."""

    owner: str  # robot id or printed batch
    name: str
    nominal: tuple[float, ...]  # logs of one robot share a correction as long as they share what it corrects
    sigma: float


# Takes the place of a calibration number where an observation depends on none; held at zero.
NO_PARAMETER: Final = Parameter("", "", (), 0.0)


def parameters_of_wheels(robot: Robot) -> list[Parameter]:
    """In the order of WHEEL_PARAMETERS."""
    wheels = robot.wheels
    nominal = (wheels.radius_left_m, wheels.radius_right_m, wheels.track_m, wheels.ticks_per_turn)
    return [
        Parameter(robot.robot_id, name, nominal, sigma)
        for name, sigma in zip(WHEEL_PARAMETERS, wheels.relative_sigmas, strict=True)
    ]


def odometry_parameters_of(segment: Segment) -> list[Parameter]:
    """In the order of the columns of `SegmentOdometry.jacobian`: of the wheels, then of the gyro where there is one.

    The bias at each node of one segment has a wide prior of its own here; how far it walks from node to node is among
    the rows of `HeadingDifferences`.
    """
    robot, differences = segment.run.robot, segment.odometry.differences
    found = parameters_of_wheels(robot)
    if differences is None:
        return found
    gyro = robot.gyro or Gyro()
    scale, time_offset, *nodes = differences.parameter_names
    return [
        *found,
        Parameter(robot.robot_id, scale, (gyro.scale,), gyro.scale_sigma),
        Parameter(robot.robot_id, time_offset, (gyro.time_offset_s,), gyro.time_offset_s_sigma),
        *(Parameter(differences.owner, name, (), gyro.bias_rad_s_sigma) for name in nodes),
    ]


def mount_parameters_of(robot: Robot) -> list[Parameter]:
    """In the order of MOUNT_PARAMETERS."""
    mount = robot.mount
    nominal = (mount.x_m, mount.y_m, mount.yaw_rad)
    sigmas = (mount.x_m_sigma, mount.y_m_sigma, mount.yaw_rad_sigma)
    return [
        Parameter(robot.robot_id, name, nominal, sigma) for name, sigma in zip(MOUNT_PARAMETERS, sigmas, strict=True)
    ]


def camera_parameters_of(segment: Segment) -> list[Parameter]:
    """In the order of CAMERA_PARAMETERS; none where no observation of the segment depends on it."""
    by_camera = segment.observations.by_camera
    parameters = parameters_of_camera(segment.run.robot)
    return [each if by_camera[..., i].any() else NO_PARAMETER for i, each in enumerate(parameters)]


def parameters_of_camera(robot: Robot) -> list[Parameter]:
    """In the order of CAMERA_PARAMETERS."""
    mount = robot.mount
    nominal = (mount.roll_rad, mount.pitch_rad, robot.time_offset_s)
    sigmas = (mount.roll_rad_sigma, mount.pitch_rad_sigma, robot.time_offset_s_sigma)
    *of_mount_and_time, of_edges, of_range = CAMERA_PARAMETERS
    return [
        *(Parameter(robot.robot_id, *each) for each in zip(of_mount_and_time, [nominal] * 3, sigmas, strict=True)),
        Parameter(robot.robot_id, of_edges, (robot.edge_shift_px,), robot.edge_shift_px_sigma),
        Parameter(robot.robot_id, of_range, (robot.range_offset_m,), robot.range_offset_m_sigma),
    ]


def scale_parameter_of(segment: Segment, tag: TagKey) -> Parameter:
    """Of the batch of a tag that a segment read."""
    return parameter_of_scale(segment.run.robot, tag)


def parameter_of_scale(robot: Robot, tag: TagKey) -> Parameter:
    """Of the batch that a tag was printed in; for imported positions the size that somebody else told a detector."""
    if not any(batch.family == tag.family for batch in robot.tags):
        return Parameter(f"{IMPORTED_BATCH}{tag.family}", TAG_SCALE, (), robot.imported_tag_scale_sigma)
    size_m, sigma_m, batch = robot.tag_size_m(tag.family, tag.tag_id)
    return Parameter(f"{batch} {tag.family}", TAG_SCALE, (), sigma_m / size_m)
