"""The calibration parameters of a graph: owners, nominal values and priors."""

from typing import Final, NamedTuple

from groundsbot.calib.robot import (
    CAMERA_PARAMETERS,
    IMPORTED_BATCH,
    MOUNT_PARAMETERS,
    TAG_SCALE,
    WHEEL_PARAMETERS,
    Gyro,
    Robot,
    camera_parameter,
)
from groundsbot.offline.measurements import GYRO_BIAS, GYRO_PARAMETERS, Segment, TagKey


class Parameter(NamedTuple):
    """A calibration parameter: an additive correction to a value of robot.yaml, with a Gaussian prior of mean zero."""

    owner: str  # robot id or printed batch
    name: str
    nominal: tuple[float, ...]  # logs of one robot share a correction if their nominal values are equal
    sigma: float


# Placeholder of a parameter that an observation does not depend on; fixed at zero.
NO_PARAMETER: Final = Parameter("", "", (), 0.0)


def parameters_of_wheels(robot: Robot) -> list[Parameter]:
    """Return the wheel parameters in the order of WHEEL_PARAMETERS."""
    wheels = robot.wheels
    nominal = (wheels.radius_left_m, wheels.radius_right_m, wheels.track_m, wheels.ticks_per_turn)
    return [
        Parameter(robot.robot_id, name, nominal, sigma)
        for name, sigma in zip(WHEEL_PARAMETERS, wheels.relative_sigmas, strict=True)
    ]


def odometry_parameters_of(segment: Segment) -> list[Parameter]:
    """Return the parameters in the order of the columns of `SegmentOdometry.jacobian`: wheels, then the gyro, if any.

    The gyro bias at each node of a segment has a wide prior here. The rows of `HeadingDifferences` contain its random
    walk from node to node.
    """
    robot, differences = segment.run.robot, segment.odometry.differences
    found = parameters_of_wheels(robot)
    return (
        found if differences is None else [*found, *parameters_of_gyro(robot, differences.owner, differences.n_nodes)]
    )


def parameters_of_gyro(robot: Robot, owner: str, n_nodes: int) -> list[Parameter]:
    """Return the parameters in the order of GYRO_PARAMETERS, then the bias of a segment at each of its nodes."""
    gyro = robot.gyro or Gyro()
    scale, time_offset = GYRO_PARAMETERS
    return [
        Parameter(robot.robot_id, scale, (gyro.scale,), gyro.scale_sigma),
        Parameter(robot.robot_id, time_offset, (gyro.time_offset_s,), gyro.time_offset_s_sigma),
        *(Parameter(owner, f"{GYRO_BIAS}_{i}", (), gyro.bias_rad_s_sigma) for i in range(n_nodes)),
    ]


def mount_parameters_of(robot: Robot, camera: str = "") -> list[Parameter]:
    """Return the mount parameters of a camera, of `Robot.camera_names`, in the order of MOUNT_PARAMETERS."""
    mount = robot.with_camera(camera).mount
    nominal = (mount.x_m, mount.y_m, mount.yaw_rad)
    sigmas = (mount.x_m_sigma, mount.y_m_sigma, mount.yaw_rad_sigma)
    return [
        Parameter(robot.robot_id, camera_parameter(name, camera), nominal, sigma)
        for name, sigma in zip(MOUNT_PARAMETERS, sigmas, strict=True)
    ]


def camera_parameters_of(segment: Segment) -> list[list[Parameter]]:
    """Return the parameters of each camera of a segment; NO_PARAMETER where no observation of a camera depends on one.

    Each list is in the order of CAMERA_PARAMETERS; the lists are in that of `Robot.camera_names`.
    """
    observations, found = segment.observations, []
    for number, camera in enumerate(segment.run.robot.camera_names):
        by_camera = observations.by_camera[observations.camera == number]
        parameters = parameters_of_camera(segment.run.robot, camera)
        found.append([each if by_camera[..., i].any() else NO_PARAMETER for i, each in enumerate(parameters)])
    return found


def parameters_of_camera(robot: Robot, camera: str = "") -> list[Parameter]:
    """Return the camera parameters of a camera, of `Robot.camera_names`, in the order of CAMERA_PARAMETERS.

    The excess of ranges is common to all cameras.
    """
    owner, robot = robot.robot_id, robot.with_camera(camera)
    mount = robot.mount
    nominal = (mount.roll_rad, mount.pitch_rad, robot.time_offset_s)
    sigmas = (mount.roll_rad_sigma, mount.pitch_rad_sigma, robot.time_offset_s_sigma)
    *of_mount_and_time, of_edges, of_range = CAMERA_PARAMETERS
    return [
        *(
            Parameter(owner, camera_parameter(name, camera), nominal, sigma)
            for name, sigma in zip(of_mount_and_time, sigmas, strict=True)
        ),
        Parameter(owner, camera_parameter(of_edges, camera), (robot.edge_shift_px,), robot.edge_shift_px_sigma),
        Parameter(owner, of_range, (robot.range_offset_m,), robot.range_offset_m_sigma),
    ]


def is_of_segment(parameter: Parameter) -> bool:
    """Return whether a parameter is of one segment alone, as the bias of its gyro is."""
    return parameter.name.startswith(GYRO_BIAS)


def scale_parameter_of(segment: Segment, tag: TagKey) -> Parameter:
    """Return the scale parameter of the batch of a tag that a segment observed."""
    return parameter_of_scale(segment.run.robot, tag)


def parameter_of_scale(robot: Robot, tag: TagKey) -> Parameter:
    """Return the scale parameter of a tag's printed batch, or of the tag size assumed by an imported recording."""
    if not any(batch.family == tag.family for batch in robot.tags):
        return Parameter(f"{IMPORTED_BATCH}{tag.family}", TAG_SCALE, (), robot.imported_tag_scale_sigma)
    size_m, sigma_m, batch = robot.tag_size_m(tag.family, tag.tag_id)
    return Parameter(f"{batch} {tag.family}", TAG_SCALE, (), sigma_m / size_m)
