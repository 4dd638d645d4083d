"""Drives and logs made by hand, whose truth is known to the last digit."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2, wheels
from groundsbot.calib.geometry.se2 import chain_motions
from groundsbot.calib.robot.robot_yaml import Robot
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.tags import Detections, Positions, TagKey
from groundsbot.onboard.log.head import log_head
from groundsbot.onboard.log.messages import TagDetection, TagDetections, WheelEncoders
from groundsbot.onboard.log.writing.writer import LogWriter

S = 1_000_000_000
START_NS = 1_800_000_000_000_000_003  # loses its last digits in a float
FAMILY = "tag36h11"
CAMERA = CameraModel("c", 1280, 720, 902.4, 901.1, 643.2, 356.7, "plumb_bob", (-0.182, 0.071, 0.0006, -0.0004, 0.0))
PINHOLE = replace(CAMERA, distortion=(0.0,) * 5)
_HALF_SIDE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
_FACE_TOWARDS_X = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def make_robot(robot_id: str = "carl", **sections: object) -> Robot:
    """A robot whose ticks are as fine as a nanometre; whole sections can be replaced."""
    content: dict[str, object] = {
        "robot_id": robot_id,
        "wheels": {"radius_left_m": 0.1, "radius_right_m": 0.1, "track_m": 0.5, "ticks_per_turn": 1e9},
        "mount": {"x_m": 0.2, "y_m": 0.05, "z_m": 0.4, "yaw_rad": 0.1, "pitch_rad": 0.05, "roll_rad": -0.03},
        "camera": "camera.yaml",
        "tags": [{"family": FAMILY, "default_size_m": 0.15}],
    }
    return Robot.model_validate(content | sections)


@dataclass(frozen=True)
class MadeTag:
    """A tag in the world; yaw is where its face looks, pitch up, roll counter-clockwise as one sees it."""

    tag_id: int
    position_m: tuple[float, float, float]
    yaw_rad: float
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    size_m: float = 0.15
    family: str = FAMILY

    def corners_m(self) -> FloatArray:
        """(4, 3) in the world."""
        turned = Rotation.from_euler("ZY", [self.yaw_rad, -self.pitch_rad]).as_matrix()
        face = turned @ _FACE_TOWARDS_X @ Rotation.from_euler("z", self.roll_rad).as_matrix()
        corners: FloatArray = np.array(self.position_m) + self.size_m * _HALF_SIDE @ face.T
        return corners

    def towards(self) -> FloatArray:
        """(3,) the way its face looks."""
        face: FloatArray = Rotation.from_euler("ZY", [self.yaw_rad, -self.pitch_rad]).as_matrix()[:, 0]
        return face


# A hall of six by four metres, the tags on its walls and one in the middle, facing two ways at once.
HALL = [
    MadeTag(0, (6.0, 1.0, 0.5), np.pi),
    MadeTag(1, (6.0, 3.0, 0.4), np.pi + 0.2),
    MadeTag(2, (0.0, 1.2, 0.45), 0.1),
    MadeTag(3, (0.0, 2.9, 0.6), -0.1, roll_rad=0.4),
    MadeTag(4, (2.0, 0.0, 0.4), np.pi / 2),
    MadeTag(5, (4.5, 0.0, 0.5), np.pi / 2, roll_rad=np.pi),
    MadeTag(6, (1.8, 4.0, 0.45), -np.pi / 2),
    MadeTag(7, (4.3, 4.0, 0.35), -np.pi / 2),
]


@dataclass(frozen=True)
class MadeDrive:
    """Wheel readings of a drive, and the robot's true poses at them."""

    stamps_ns: IntArray  # (N,)
    left_m: FloatArray  # (N,) cumulative
    right_m: FloatArray
    T_world_base: FloatArray  # (N, 3)

    def at(self, stamps_ns: IntArray) -> FloatArray:
        """(K, 3) T_world_base; speeds are constant between observations."""
        after = np.clip(np.searchsorted(self.stamps_ns, stamps_ns), 1, len(self.stamps_ns) - 1)
        begin, end = self.stamps_ns[after - 1], self.stamps_ns[after]
        fraction = (stamps_ns - begin) / (end - begin)
        return se2.interpolate(self.T_world_base[after - 1], self.T_world_base[after], fraction)

    @property
    def track(self) -> WheelSegment:
        """As the estimate has it."""
        return WheelSegment(self.stamps_ns, self.left_m, self.right_m)


def make_drive(
    start: Sequence[float], legs: Sequence[tuple[float, float, float]], track_m: float = 0.5, step_ns: int = S // 100
) -> MadeDrive:
    """Legs of (left speed, right speed, seconds), a wheel reading each step."""
    speeds = np.concatenate([np.tile([left, right], (round(s * S / step_ns), 1)) for left, right, s in legs])
    advances = speeds * step_ns * 1e-9
    stamps_ns = START_NS + step_ns * np.arange(len(speeds) + 1, dtype=np.int64)
    poses = chain_motions(wheels.advance(advances[:, 0], advances[:, 1], track_m), np.array(start, dtype=np.float64))
    left_m, right_m = (np.concatenate([[0.0], np.cumsum(advance)]) for advance in advances.T)
    return MadeDrive(stamps_ns, left_m, right_m, poses)


def seen_corners_px(tag: MadeTag, T_world_base: FloatArray, robot: Robot, camera: CameraModel) -> FloatArray | None:
    """(4, 2) exact corners, or None where the camera does not see the tag's face, or not nearer than 9 m."""
    pixels, seen = all_corners_px(tag, T_world_base[np.newaxis], robot, camera)
    return pixels[0] if seen[0] else None


def all_corners_px(
    tag: MadeTag, T_world_base: FloatArray, robot: Robot, camera: CameraModel
) -> tuple[FloatArray, BoolArray]:
    """(N, 4, 2) exact corners from each of (N, 3) poses, and (N,) whether the camera sees the tag's face within 9 m."""
    turns = Rotation.from_euler("z", T_world_base[:, 2:])
    places = np.column_stack([T_world_base[:, :2], np.zeros(len(T_world_base))])
    eye = robot.mount.T_base_camera
    in_base = (tag.corners_m() - places[:, np.newaxis]) @ turns.as_matrix()
    pixels = camera.project(eye.inv().apply(in_base.reshape(-1, 3))).reshape(-1, 4, 2)
    to_eye = places + turns.apply(eye.as_components()[0]) - np.array(tag.position_m)
    distance_m = np.linalg.norm(to_eye, axis=1)
    inside = ((pixels >= 0) & (pixels < [camera.width_px, camera.height_px])).all(axis=(1, 2))
    return pixels, inside & (to_eye @ tag.towards() > 0.2 * distance_m) & (distance_m < 9.0)


def picture_stamps(drive: MadeDrive, rate_hz: float = 7.3) -> IntArray:
    """Times of pictures, out of step with the wheels."""
    first_ns, last_ns = int(drive.stamps_ns[0]) + 3_333_333, int(drive.stamps_ns[-1])
    return np.arange(first_ns, last_ns, round(S / rate_hz), dtype=np.int64)


def write_drive(
    folder: Path,
    drive: MadeDrive,
    tags: Sequence[MadeTag] = (),
    robot: Robot | None = None,
    *,
    run_id: str = "one",
    camera: CameraModel | None = CAMERA,
    pictures_ns: IntArray | None = None,
    corner_sigma_px: float = 0.0,
    boot_of: Sequence[int] | None = None,
    seed: int = 0,
) -> Path:
    """Writes a run log of a drive past tags into `folder/<robot>/<run>`, and returns that.

    Args:
        folder: made if need be.
        drive: what the wheels count and where the robot is.
        tags: those in the world.
        robot: its robot.yaml goes into the log.
        run_id: of the run.
        camera: None for a log without calibration.
        pictures_ns: when a picture is taken; by default at 7.3 Hz.
        corner_sigma_px: noise of each corner coordinate.
        boot_of: (N,) the controller's boot id at each wheel reading; one for all by default.
        seed: of the noise.
    """
    robot = robot or make_robot()
    rng = np.random.default_rng(seed)
    entries: list[tuple[int, str, WheelEncoders | TagDetections]] = []
    left_m_per_tick, right_m_per_tick = robot.wheels.metres_per_tick
    ticks = np.rint(np.stack([drive.left_m / left_m_per_tick, drive.right_m / right_m_per_tick], axis=-1))
    boots = boot_of if boot_of is not None else [1] * len(ticks)
    for stamp, (left, right), boot in zip(drive.stamps_ns.tolist(), ticks.astype(int).tolist(), boots, strict=True):
        observation = WheelEncoders(stamp_ns=stamp, boot_id=boot, ticks_left=1000 + left, ticks_right=-77 + right)
        entries.append((stamp, "/wheels", observation))
    eye = camera or CAMERA
    stamps_ns = picture_stamps(drive) if pictures_ns is None else pictures_ns
    poses = drive.at(stamps_ns)
    exact = [all_corners_px(tag, poses, robot, eye) for tag in tags]
    for index, stamp in enumerate(stamps_ns.tolist()):
        found = []
        for tag, (pixels, seen) in zip(tags, exact, strict=True):
            if seen[index]:
                noisy = pixels[index] + corner_sigma_px * rng.standard_normal((4, 2))
                corners = noisy.reshape(-1).tolist()
                found.append(TagDetection(family=tag.family, tag_id=tag.tag_id, corners_px=corners))
        picture = TagDetections(stamp_ns=stamp, width_px=eye.width_px, height_px=eye.height_px, detections=found)
        entries.append((stamp, "/tags/detections", picture))
    log = folder / robot.robot_id / run_id
    text = yaml.safe_dump(robot.model_dump())
    head = log_head(robot, text, camera, run_id, START_NS, 0)
    with LogWriter(log, head, START_NS, durable=False) as writer:
        for stamp, topic, message in sorted(entries, key=lambda entry: entry[0]):
            writer.write(topic, message, stamp, stamp)
    return log


def make_run(
    tracks: Sequence[WheelSegment],
    *,
    robot: Robot | None = None,
    camera: CameraModel | None = CAMERA,
    tags: Sequence[TagKey] = (),
    pictures_ns: IntArray | None = None,
    detections: Detections | None = None,
    positions: Positions | None = None,
) -> Run:
    """A run as if it had been read from a log."""
    robot = robot or make_robot()
    none = np.zeros(0, dtype=np.int64)
    return Run(
        name=f"{robot.robot_id}_one",
        robot_id=robot.robot_id,
        run_id="one",
        log=Path("logs/one"),
        robot=robot,
        camera=camera,
        wheel_segments=tuple(tracks),
        picture_stamps_ns=none if pictures_ns is None else pictures_ns,
        picture_camera=np.zeros(0 if pictures_ns is None else len(pictures_ns), dtype=np.int64),
        tags=tuple(tags),
        detections=detections or Detections(none, none, np.zeros((0, 4, 2)), none),
        positions=positions or make_positions(none, none, np.zeros((0, 2))),
        warnings=(),
        log_bytes=1 << 24,
    )


def make_positions(stamps_ns: IntArray, tag: IntArray, xy_m: FloatArray, sigma_m: float = 0.05) -> Positions:
    """Tag places (M, 2) in base, with a covariance."""
    n = len(stamps_ns)
    return Positions(
        stamps_ns=stamps_ns,
        tag=tag,
        value=xy_m,
        polar=np.zeros(n, dtype=np.bool_),
        covariance=np.broadcast_to(sigma_m**2 * np.eye(2), (n, 2, 2)).copy(),
        in_camera=np.zeros(n, dtype=np.bool_),
    )
