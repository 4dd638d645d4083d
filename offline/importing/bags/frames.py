"""Pose of a camera on its robot, from the fixed transforms in a bag."""

from typing import Any, Final

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from groundsbot.calib.robot import R_LEVEL_OPTICAL, Mount
from groundsbot.offline.errors import OfflineError

_Values = tuple[float, float, float, float, float, float, float]  # x, y, z, then quaternion x, y, z, w
# Rounding of a transform that is sent repeatedly; a moving joint changes by more.
_TRANSFORM_TOLERANCE: Final = 1e-6
_LENGTH_TOLERANCE: Final = 1e-3  # tolerance of a quaternion's length: far beyond rounding, even to float32
_MAX_DEPTH: Final = 100  # links from a frame to its root; more mean a cycle
MAX_MOUNT_M: Final = 10.0  # robot.yaml's limit too


class FixedFrames:
    """Transforms between frames that do not move relative to each other."""

    def __init__(self, where: str) -> None:
        """Start without frames; `where` names the bag in errors."""
        self._where = where
        self._links: dict[str, tuple[str, _Values]] = {}  # child -> parent and T_parent_child
        self._moving: set[str] = set()  # children whose pose in the parent changes

    def add(self, message: Any) -> None:  # noqa: ANN401 - made by rosbags from the bag's definition
        """Add a message of `/tf` or `/tf_static`."""
        for each in message.transforms:
            parent, child = frame_name(each.header.frame_id), frame_name(each.child_frame_id)
            t, q = each.transform.translation, each.transform.rotation
            values = (t.x, t.y, t.z, q.x, q.y, q.z, q.w)
            old_parent, old = self._links.setdefault(child, (parent, values))
            if old_parent != parent or not np.allclose(values, old, rtol=0.0, atol=_TRANSFORM_TOLERANCE):
                self._moving.add(child)

    def has(self, frame: str) -> bool:
        """Whether any transform names the frame."""
        return frame in self._links or any(parent == frame for parent, _ in self._links.values())

    def are_connected(self, a: str, b: str) -> bool:
        """Whether fixed transforms connect two frames."""
        return self._path(a)[-1][0] == self._path(b)[-1][0]

    def moving_root(self, frame: str) -> str | None:
        """Return the root that fixed transforms lead to from a frame, if it moves relative to its parent; else None."""
        root = self._path(frame)[-1][0]
        return root if root in self._moving else None

    def transform(self, to: str, frame: str) -> RigidTransform:
        """Return T_to_frame, which maps the coordinates of a point in `frame` (m) to those in `to`.

        Args:
            to: name of the target frame.
            frame: name of the source frame. `are_connected(to, frame)` must hold.

        Raises:
            OfflineError: a transform in the chain between the frames is invalid, as a quaternion whose norm is not 1.
        """
        return self._to_root(to).inv() * self._to_root(frame)

    def _path(self, frame: str) -> list[tuple[str, _Values | None]]:
        """Return the frames from one up to its root, each with its transform to the next."""
        path: list[tuple[str, _Values | None]] = []
        while frame in self._links and frame not in self._moving and len(path) < _MAX_DEPTH:
            parent, values = self._links[frame]
            path.append((frame, values))
            frame = parent
        return [*path, (frame, None)]

    def _to_root(self, frame: str) -> RigidTransform:
        found = RigidTransform.identity()
        for child, values in self._path(frame):
            if values is not None:
                found = rigid_transform(values, f"{self._where}: tf to {child}") * found
        return found


def rigid_transform(values: _Values, where: str) -> RigidTransform:
    """Return a transform of ROS as a RigidTransform.

    Args:
        values: translation x, y, z, then quaternion x, y, z, w.
        where: names it in errors.

    Raises:
        OfflineError: a number is not finite, or the quaternion is not of length 1.
    """
    length = float(np.linalg.norm(values[3:]))
    if not np.isfinite(values).all() or abs(length - 1.0) > _LENGTH_TOLERANCE:
        raise OfflineError(
            f"{where}: {values} is not a transform: its quaternion has norm {length:.4g}, must be 1; correct its sender"
        )
    return RigidTransform.from_components(np.array(values[:3]), Rotation.from_quat(np.array(values[3:])))


def frame_name(name: str) -> str:
    """Return a frame name as tf2 has it: without the leading slash of ROS 1's first tf."""
    return name.lstrip("/")


def mount_of(T_base_camera: RigidTransform) -> Mount:
    """Return the mount of robot.yaml for this pose of a camera's optical frame.

    Raises:
        OfflineError: the camera is implausibly far from the base.
    """
    place, rotation = T_base_camera.as_components()
    if float(np.abs(place).max()) > MAX_MOUNT_M:
        raise OfflineError(
            f"tf: the camera is {np.linalg.norm(place):.4g} m from its base, limit {MAX_MOUNT_M:g} m; "
            "check the base frame, or name it with --base-frame"
        )
    yaw, pitch, roll = (rotation * R_LEVEL_OPTICAL.inv()).as_euler("ZYX").tolist()
    x, y, z = place.tolist()
    return Mount(x_m=x, y_m=y, z_m=z, yaw_rad=yaw, pitch_rad=pitch, roll_rad=roll)
