"""ROS bags made from our own logs, message by message."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry.se2 import chain_motions
from groundsbot.calib.robot.camera_section import Mount
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.run import Run, load_run
from groundsbot.onboard.log.messages import TagDetections, TagObservations
from groundsbot.onboard.log.reading.reader import read_log
from tests.support.data.importing.ros_messages import BASE, CAMERA, ODOM, Sent, header, write_bag, xyz, xyzw


@dataclass(frozen=True)
class BagOfLog:
    """The messages that ROS's nodes would have sent on the drive that a log holds, received later than measured."""

    run: Run
    looks: list[TagDetections]
    observations: list[TagObservations]
    sent: list[Sent] = field(default_factory=list)

    @classmethod
    def of(cls, log: Path) -> "BagOfLog":
        messages = [each.message for each in read_log(log)]
        return cls(
            load_run(log),
            [each for each in messages if isinstance(each, TagDetections)],
            [each for each in messages if isinstance(each, TagObservations)],
        )

    @property
    def track(self) -> WheelSegment:
        (track,) = self.run.wheel_segments
        return track

    def add(self, topic: str, msgtype: str, stamp_ns: int, fields: dict[str, Any]) -> None:
        late_ns = 5_000_000 if msgtype in ("nav_msgs/msg/Odometry", "sensor_msgs/msg/JointState") else 90_000_000
        self.sent.append(Sent(topic, msgtype, stamp_ns + late_ns, fields))

    @property
    def poses(self) -> FloatArray:
        """(N, 3) by the wheels, starting somewhere in odom."""
        stamps_ns = self.track.stamps_ns
        motions = self.track.motions(stamps_ns[:-1], stamps_ns[1:], self.run.robot.wheels.track_m)
        return chain_motions(motions, np.array([3.0, -2.0, 2.5]))

    def odometry(self, topic: str = "/odom", covariances: FloatArray | None = None) -> "BagOfLog":
        """nav_msgs/Odometry from the wheels; covariances (N, 3, 3) of (x, y, yaw)."""
        for number, (stamp, (x, y, theta)) in enumerate(zip(self.track.stamps_ns.tolist(), self.poses, strict=True)):
            pose = {"position": xyz([x, y, 0.0]), "orientation": xyzw(Rotation.from_euler("z", theta))}
            covariance = np.diag([0.0, 0.0, 1e6, 1e6, 1e6, 0.0]) if covariances is not None else np.zeros((6, 6))
            if covariances is not None:
                covariance[np.ix_([0, 1, 5], [0, 1, 5])] = covariances[number]
            with_covariance = {"pose": pose, "covariance": covariance.ravel()}
            fields = {"header": header(stamp, ODOM), "child_frame_id": BASE, "pose": with_covariance}
            self.add(topic, "nav_msgs/msg/Odometry", stamp, fields)
        return self

    def imu(self, topic: str = "/imu", frame: str = "imu", upside_down: bool = False) -> "BagOfLog":
        """sensor_msgs/Imu at the wheels' times, with a bias of 0.01 rad/s; upside down its z axis points down."""
        track_m = self.run.robot.wheels.track_m
        rates = self.track.twist_at(self.track.stamps_ns, track_m)[:, 2] + 0.01
        for stamp, rate in zip(self.track.stamps_ns.tolist(), rates.tolist(), strict=True):
            measured = xyz([0.0, 0.0, -rate if upside_down else rate])
            self.add(
                topic, "sensor_msgs/msg/Imu", stamp, {"header": header(stamp, frame), "angular_velocity": measured}
            )
        turned = Rotation.from_euler("x", np.pi if upside_down else 0.0)
        link = {"header": header(0, BASE), "child_frame_id": frame, "transform": _transform(np.ones(3), turned)}
        self.add("/tf_static", "tf2_msgs/msg/TFMessage", int(self.track.stamps_ns[0]), {"transforms": [link]})
        return self

    def joints(
        self, topic: str = "/joint_states", names: Sequence[str] = ("wheel_left", "arm", "wheel_right")
    ) -> "BagOfLog":
        """sensor_msgs/JointState: the first name is the left wheel, the last the right one."""
        radii = self.run.robot.wheels
        track = self.track
        for stamp, left_m, right_m in zip(track.stamps_ns.tolist(), track.left_m, track.right_m, strict=True):
            angles = {names[0]: 5.0 + left_m / radii.radius_left_m, names[-1]: right_m / radii.radius_right_m - 3.0}
            position = [angles.get(name, 0.7) for name in names]
            fields = {"header": header(stamp, ""), "name": list(names), "position": position}
            self.add(topic, "sensor_msgs/msg/JointState", stamp, fields)
        return self

    def mount(self, mount: Mount | None = None) -> "BagOfLog":
        """/tf_static in two links and one that leads elsewhere."""
        T_base_camera = (mount or self.run.robot.mount).T_base_camera
        place, rotation = T_base_camera.as_components()
        half = Rotation.from_euler("xyz", [0.3, -0.2, 0.5])
        links = [
            (BASE, "camera_link", place, half),
            ("camera_link", CAMERA, np.zeros(3), half.inv() * rotation),
            (BASE, "laser", np.ones(3), half),
        ]
        transforms = [
            {"header": header(0, parent), "child_frame_id": child, "transform": _transform(t, r)}
            for parent, child, t, r in links
        ]
        self.add("/tf_static", "tf2_msgs/msg/TFMessage", int(self.track.stamps_ns[0]), {"transforms": transforms})
        return self

    def camera_info(self, topic: str = "/camera/camera_info", camera: CameraModel | None = None) -> "BagOfLog":
        camera = camera or self.run.camera
        assert camera is not None
        k = camera.matrix
        fields = {
            "header": header(int(self.track.stamps_ns[0]), CAMERA),
            "width": camera.width_px,
            "height": camera.height_px,
            "distortion_model": camera.distortion_model,
            "k": k.ravel(),
            "d": camera.distortion,
            "p": np.hstack([k, np.zeros((3, 1))]).ravel(),
        }
        self.add(topic, "sensor_msgs/msg/CameraInfo", int(self.track.stamps_ns[0]), fields)
        return self

    def apriltag_msgs(self, topic: str = "/detections", frame: str = CAMERA) -> "BagOfLog":
        """As the ROS 2 node: bottom left first, against the clock, the first pixel's corner at (0, 0)."""
        for look in self.looks:
            detections = [
                {
                    "family": each.family,
                    "id": each.tag_id,
                    "decision_margin": 50.0,
                    "corners": [
                        {"x": x + 0.5, "y": y + 0.5}
                        for x, y in np.reshape(list(each.corners_px), (4, 2))[::-1].tolist()
                    ],
                }
                for each in look.detections
            ]
            fields = {"header": header(look.stamp_ns, frame), "detections": detections}
            self.add(topic, "apriltag_msgs/msg/AprilTagDetectionArray", look.stamp_ns, fields)
        return self

    def isaac(self, topic: str = "/tag_detections") -> "BagOfLog":
        """As NVIDIA's node: top left first, with the clock; of a log with positions, zeros for corners."""
        for look in self.looks:
            detections = [
                {
                    "family": each.family,
                    "id": each.tag_id,
                    "corners": [
                        {"x": x + 0.5, "y": y + 0.5} for x, y in np.reshape(list(each.corners_px), (4, 2)).tolist()
                    ],
                    "pose": {"pose": {"pose": {"position": xyz([0.0, 0.0, 9.0])}}},
                }
                for each in look.detections
            ]
            fields = {"header": header(look.stamp_ns, CAMERA), "detections": detections}
            self.add(topic, "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray", look.stamp_ns, fields)
        return self

    def isaac_poses(self, topic: str = "/tag_detections") -> "BagOfLog":
        for observed in self.observations:
            detections = [
                {"family": each.family, "id": each.tag_id, "pose": self._pose(observed.stamp_ns, each)}
                for each in observed.observations
            ]
            fields = {"header": header(observed.stamp_ns, CAMERA), "detections": detections}
            self.add(topic, "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray", observed.stamp_ns, fields)
        return self

    def apriltag_ros(self, topic: str = "/tag_detections") -> "BagOfLog":
        """As the ROS 1 node: poses, families not named."""
        for observed in self.observations:
            detections = [
                {"id": [each.tag_id], "size": [0.15], "pose": self._pose(observed.stamp_ns, each)}
                for each in observed.observations
            ]
            fields = {"header": header(observed.stamp_ns, CAMERA), "detections": detections}
            self.add(topic, "apriltag_ros/msg/AprilTagDetectionArray", observed.stamp_ns, fields)
        return self

    def tag_transforms(self) -> "BagOfLog":
        """/tf of the tags as the ROS 2 node sends it, and bare detections with them."""
        for observed in self.observations:
            transforms, detections = [], []
            for each in observed.observations:
                place = self._optical(each)
                head = header(observed.stamp_ns, CAMERA)
                transform = _transform(place, Rotation.identity())
                transforms.append(
                    {"header": head, "child_frame_id": f"{each.family}:{each.tag_id}", "transform": transform}
                )
                detections.append({"family": each.family, "id": each.tag_id})
            self.add("/tf", "tf2_msgs/msg/TFMessage", observed.stamp_ns, {"transforms": transforms})
            fields = {"header": header(observed.stamp_ns, CAMERA), "detections": detections}
            self.add("/detections", "apriltag_msgs/msg/AprilTagDetectionArray", observed.stamp_ns, fields)
        return self

    def picture(
        self, form: str, grey: NDArray[np.uint8], stamp_ns: int, topic: str = "/camera/image_raw"
    ) -> "BagOfLog":
        """sensor_msgs/Image with padded rows, or a CompressedImage."""
        head = header(stamp_ns, CAMERA)
        if form == "png":
            data = np.frombuffer(cv2.imencode(".png", grey)[1].tobytes(), np.uint8)
            self.add(
                topic, "sensor_msgs/msg/CompressedImage", stamp_ns, {"header": head, "format": "png", "data": data}
            )
            return self
        rows = grey if form == "mono8" else np.repeat(grey, 3, axis=1)
        height, width = grey.shape
        rows = np.pad(rows, ((0, 0), (0, 5)))
        fields = {"height": height, "width": width, "encoding": form, "step": rows.shape[1], "data": rows.ravel()}
        self.add(topic, "sensor_msgs/msg/Image", stamp_ns, {"header": head, **fields})
        return self

    def without(self, topic: str) -> "BagOfLog":
        return replace(self, sent=[each for each in self.sent if each.topic != topic])

    def write(self, path: Path) -> Path:
        return write_bag(path, self.sent)

    def _planar_to_optical(self) -> Rotation:
        mount = self.run.robot.mount
        return mount.T_base_camera.rotation.inv() * Rotation.from_euler("z", mount.yaw_rad)

    def _optical(self, each: Any) -> Any:
        place, polar = each.cartesian, each.polar
        if each.HasField("polar"):
            planar = [polar.range_m * np.cos(polar.bearing_rad), polar.range_m * np.sin(polar.bearing_rad), 0.0]
        else:
            planar = [place.x_m, place.y_m, place.z_m]
        return self._planar_to_optical().apply(planar)

    def _pose(self, stamp_ns: int, each: Any) -> dict[str, Any]:
        turned = self._planar_to_optical().as_matrix()
        covariance = np.zeros((6, 6))
        if len(each.covariance):
            planar = np.diag([0.0, 0.0, 0.01])
            planar[:2, :2] = np.reshape(list(each.covariance), (2, 2))
            covariance[:3, :3] = turned @ planar @ turned.T
        pose = {"position": xyz(self._optical(each)), "orientation": {"w": 1.0}}
        return {"header": header(stamp_ns, CAMERA), "pose": {"pose": pose, "covariance": covariance.ravel()}}


def _transform(place: Any, rotation: Rotation) -> dict[str, Any]:
    return {"translation": xyz(place), "rotation": xyzw(rotation)}


def good(log: Path) -> BagOfLog:
    """The bag of a log, with nothing amiss."""
    return BagOfLog.of(log).mount().odometry().camera_info().apriltag_msgs()
