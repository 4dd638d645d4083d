"""Messages at the head of every file of a log, so that each file can be read alone."""

import importlib.metadata
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.message import Message

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.robot import Mount, Robot
from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log.messages import (
    CALIBRATION_TOPIC,
    CameraCalibration,
    FrameTransform,
    RunInfo,
    camera_topic,
    timestamp,
)

_BASE: Final = "base"
_CAMERA: Final = "camera"


# The cameras of a run: one without a name, or several by name; None for a run of wheels only.
Cameras = CameraModel | Mapping[str, CameraModel] | None


class RunFrames(NamedTuple):
    """Frames of one run; they contain its name, so that a viewer shows several logs in one map."""

    base: str
    camera: str

    @staticmethod
    def of(run: str, camera: str = "") -> "RunFrames":
        """Return the frames of the run with this name, robot id and run id joined by `_`, and of a camera by name."""
        return RunFrames(f"{run}/{_BASE}", f"{run}/{_CAMERA}_{camera}" if camera else f"{run}/{_CAMERA}")


def log_head(
    robot: Robot, robot_yaml: str, camera: Cameras, run_id: str, start_ns: int, run_epoch_ns: int
) -> dict[str, Message | Sequence[Message]]:
    """Return the messages at the head of a file, by topic.

    Args:
        robot: the robot.
        robot_yaml: the text of its robot.yaml, which the log contains.
        camera: its camera, or its cameras by name; None for a run of wheels only.
        run_id: name of the run, unique among the runs of this robot.
        start_ns: start of the run on its clock.
        run_epoch_ns: realtime minus monotonic time at the start.
    """
    run = RunInfo(
        run_id=run_id,
        robot_id=robot.robot_id,
        software_version=importlib.metadata.version("groundsbot"),
        robot_yaml=robot_yaml,
        run_epoch_ns=run_epoch_ns,
    )
    head: dict[str, Message | Sequence[Message]] = {"/run": run}
    mounts: list[Message] = []
    for name, model in cameras_by_name(camera).items():
        frames = RunFrames.of(f"{robot.robot_id}_{run_id}", name)
        head[camera_topic(CALIBRATION_TOPIC, name)] = calibration_message(model, start_ns, frames)
        mounts.append(mount_message((robot.with_camera(name) if name else robot).mount, start_ns, frames))
    if mounts:
        head["/tf"] = mounts[0] if len(mounts) == 1 else mounts
    return head


def cameras_by_name(camera: Cameras) -> Mapping[str, CameraModel]:
    """Return the cameras by name; a single one has an empty name."""
    if camera is None:
        return {}
    return {"": camera} if isinstance(camera, CameraModel) else camera


def calibration_message(camera: CameraModel, stamp_ns: int, frames: RunFrames) -> CameraCalibration:
    """Return a camera as a message of Foxglove's schema, with ROS's names of distortion models."""
    (fx, _, cx), (_, fy, cy), _ = camera.matrix.tolist()
    return CameraCalibration(
        timestamp=timestamp(stamp_ns),
        frame_id=frames.camera,
        width=camera.width_px,
        height=camera.height_px,
        distortion_model=camera.distortion_model,
        D=[float(value) for value in camera.distortion],
        K=[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        R=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        P=[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    )


def camera_from_message(message: CameraCalibration) -> CameraModel:
    """Return the camera with which a log was recorded.

    Raises:
        LogError: the calibration is incomplete.
        CalibError: its values are invalid.
    """
    if len(message.K) != 9:
        raise LogError(f"{CALIBRATION_TOPIC}: K has {len(message.K)} numbers, must have 9; give --robot robot.yaml")
    fx, _, cx, _, fy, cy, *_ = message.K
    return CameraModel(
        name=message.frame_id.rpartition("/")[2],  # without the run, of which a camera file is not
        width_px=message.width,
        height_px=message.height,
        fx_px=fx,
        fy_px=fy,
        cx_px=cx,
        cy_px=cy,
        distortion_model=message.distortion_model,
        distortion=tuple(message.D),
    )


def mount_message(mount: Mount, stamp_ns: int, frames: RunFrames) -> FrameTransform:
    """Return the pose of the camera, which transforms points from camera to base, as a message."""
    qx, qy, qz, qw = mount.quaternion_base_camera
    return FrameTransform(
        timestamp=timestamp(stamp_ns),
        parent_frame_id=frames.base,
        child_frame_id=frames.camera,
        translation=Vector3(x=mount.x_m, y=mount.y_m, z=mount.z_m),
        rotation=Quaternion(x=qx, y=qy, z=qz, w=qw),
    )
