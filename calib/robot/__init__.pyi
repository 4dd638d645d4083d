from .camera_section import CameraFields, CameraSection, Mount
from .mount_transform import R_LEVEL_OPTICAL
from .noise import NoiseParameters, read_noise_yaml
from .parameters import (
    CAMERA_PARAMETERS,
    EDGE_SHIFT,
    FOCAL_SCALE,
    IMPORTED_BATCH,
    MOUNT_PARAMETERS,
    RANGE_OFFSET,
    TAG_SCALE,
    TIME_OFFSET,
    WHEEL_PARAMETERS,
    camera_parameter,
    split_camera_parameter,
    without_camera,
)
from .robot_yaml import (
    Gyro,
    Robot,
    TagBatch,
    Wheels,
    parse_robot_yaml,
    read_robot_yaml,
    write_robot_yaml,
)
from .wiring import WIRINGS, Wiring

__all__ = [
    "CAMERA_PARAMETERS",
    "EDGE_SHIFT",
    "FOCAL_SCALE",
    "IMPORTED_BATCH",
    "MOUNT_PARAMETERS",
    "RANGE_OFFSET",
    "R_LEVEL_OPTICAL",
    "TAG_SCALE",
    "TIME_OFFSET",
    "WHEEL_PARAMETERS",
    "WIRINGS",
    "CameraFields",
    "CameraSection",
    "Gyro",
    "Mount",
    "NoiseParameters",
    "Robot",
    "TagBatch",
    "Wheels",
    "Wiring",
    "camera_parameter",
    "parse_robot_yaml",
    "read_noise_yaml",
    "read_robot_yaml",
    "split_camera_parameter",
    "without_camera",
    "write_robot_yaml",
]
