"""WPILib data logs, record by record, and a drive past upright tags in the forms in which FRC robots log one."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from groundsbot.calib.camera import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.calib.robot import Mount

PHOTON_2025 = "photonstruct:PhotonPipelineResult:4b2ff16a964b5e2bf01be0c1454d91c4"
CAMERA = CameraModel("test", 1280, 720, 900.0, 905.0, 640.0, 355.0, "plumb_bob", (0.02, -0.03, 0.001, 0.001, 0.0))
MOUNT = Mount(x_m=0.2, y_m=0.1, z_m=0.5, roll_rad=0.1, pitch_rad=-0.3, yaw_rad=0.2)
SIDE_M = 0.1651
# id: place, and heading of the face's outward normal
TAGS: dict[int, tuple[tuple[float, float, float], float]] = {
    7: ((4.0, 0.4, 1.4), 3.0),
    8: ((4.2, 1.3, 1.5), 3.4),
}
MODULES = ((0.28, 0.28), (0.28, -0.28), (-0.28, 0.28), (-0.28, -0.28))
LATENCY_US = 40_000
START_US, PERIOD_US, N_ROWS = 5_000_000, 20_000, 200
TWIST = np.array([0.4, 0.2, 0.3])  # m/s ahead, m/s to the left, rad/s; the robot stands for the first second
_N_STANDING = 50


@dataclass
class DataLog:
    """A log under way; the bytes of its records."""

    records: list[bytes] = field(default_factory=list)
    entries: dict[str, int] = field(default_factory=dict)

    def start(self, name: str, type_: str, metadata: str = "") -> int:
        entry = self.entries[name] = len(self.entries) + 1
        texts = b"".join(struct.pack("<I", len(each)) + each for each in (t.encode() for t in (name, type_, metadata)))
        self.records.append(as_record(0, 0, struct.pack("<BI", 0, entry) + texts))
        return entry

    def add(self, name: str, type_: str, stamp_us: int, payload: bytes) -> None:
        entry = self.entries.get(name) or self.start(name, type_)
        self.records.append(as_record(entry, stamp_us, payload))

    def doubles(self, name: str, type_: str, stamp_us: int, values: Sequence[float] | FloatArray) -> None:
        self.add(name, type_, stamp_us, np.asarray(values, dtype="<f8").tobytes())

    def content(self, version: int = 0x0100, extra: bytes = b"") -> bytes:
        return b"WPILOG" + struct.pack("<HI", version, len(extra)) + extra + b"".join(self.records)

    def write(self, path: Path) -> Path:
        path.write_bytes(self.content())
        return path


def as_record(entry: int, stamp_us: int, payload: bytes) -> bytes:
    """A record with the shortest lengths that hold its fields."""
    stamp = stamp_us & (1 << 64) - 1
    lengths = [max(1, (value.bit_length() + 7) // 8) for value in (entry, len(payload), stamp)]
    first = lengths[0] - 1 | lengths[1] - 1 << 2 | lengths[2] - 1 << 4
    fields = zip((entry, len(payload), stamp), lengths, strict=True)
    return bytes([first]) + b"".join(value.to_bytes(n, "little") for value, n in fields) + payload


def stamps_us() -> list[int]:
    return [START_US + PERIOD_US * k for k in range(N_ROWS)]


def speeds() -> FloatArray:
    """(N, 3) of the chassis: it stands, then drives, never quite as fast as a moment before."""
    row = np.arange(N_ROWS)[:, None]
    return np.where(row < _N_STANDING, 0.0, TWIST * (1.0 + 0.2 * np.sin(0.1 * row)))


@cache
def poses() -> FloatArray:
    """(N, 3) that trapezoids over the speeds lead to."""
    v = speeds()
    return chain_motions(se2.exp(0.5 * (v[:-1] + v[1:]) * PERIOD_US * 1e-6), np.zeros(3))


def add_speeds(log: DataLog, name: str = "/Drive/ActualSpeeds", only_changes: bool = True) -> None:
    last: list[float] = []
    for stamp, row in zip(stamps_us(), speeds().tolist(), strict=True):
        if row != last or not only_changes:
            log.doubles(name, "struct:ChassisSpeeds", stamp, row)
        last = row


def add_modules(log: DataLog, name: str, kind: str) -> None:
    """`SwerveModulePosition[]`, `SwerveModuleState[]` or `double[]` (angle and speed of each)."""
    v = speeds()
    way = np.zeros(len(MODULES))
    for k, (stamp, row) in enumerate(zip(stamps_us(), v, strict=True)):
        velocity = np.array([[row[0] - row[2] * y, row[1] + row[2] * x] for x, y in MODULES])
        length, angle = np.hypot(*velocity.T), np.arctan2(velocity[:, 1], velocity[:, 0])
        if k:
            way += 0.5 * (np.hypot(*_module_velocity(v[k - 1]).T) + length) * PERIOD_US * 1e-6
        first = way if "Position" in kind else length
        pairs = np.column_stack([angle, length] if kind == "double[]" else [first, angle])
        log.doubles(name, kind if kind == "double[]" else f"struct:{kind}", stamp, pairs.ravel())


def _module_velocity(row: FloatArray) -> FloatArray:
    return np.array([[row[0] - row[2] * y, row[1] + row[2] * x] for x, y in MODULES])


@cache
def pictures() -> list[tuple[int, dict[int, FloatArray], dict[int, FloatArray]]]:
    """Of each second row: its stamp in us, and by tag the corners in our order and the place ahead, left, up."""
    track = poses()
    return [(stamp, *_look(pose)) for stamp, pose in zip(stamps_us()[::2], track[::2], strict=True)]


def _look(pose: FloatArray) -> tuple[dict[int, FloatArray], dict[int, FloatArray]]:
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    R_base_map = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
    T = MOUNT.T_base_camera
    corners, places = {}, {}
    for tag_id, (place, heading) in TAGS.items():
        right, up = np.array([-np.sin(heading), np.cos(heading), 0.0]), np.array([0.0, 0.0, 1.0])
        unit = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]]) * SIDE_M
        points = np.array(place) + unit[:, :1] * right + unit[:, 1:] * up
        in_base = (np.vstack([points, place]) - [pose[0], pose[1], 0.0]) @ R_base_map.T
        in_camera = T.inv().apply(in_base)
        seen = CAMERA.project(in_camera[:4])
        if np.isfinite(seen).all() and (seen > 0).all() and (seen < [CAMERA.width_px, CAMERA.height_px]).all():
            corners[tag_id] = seen
            places[tag_id] = np.array([in_camera[4, 2], -in_camera[4, 0], -in_camera[4, 1]])
    return corners, places


def packet_2024(targets: Sequence[tuple[int, FloatArray, FloatArray]], latency_ms: float = 40.0) -> bytes:
    """Of (id, corners in our order, place ahead, left, up); a rest of zeros as PhotonVision leaves it."""
    body = struct.pack(">dB", latency_ms, len(targets))
    for tag_id, corners, place in targets:
        pose = struct.pack(">7d", *place, 1.0, 0.0, 0.0, 0.0)
        body += struct.pack(">4di", 0.0, 0.0, 0.0, 0.0, tag_id) + pose + pose + struct.pack(">d8d", 0.1, *[0.0] * 8)
        body += bytes([len(corners)]) + theirs(corners).astype(">f8").tobytes()
    return body + bytes(192)


def packet_2025(
    targets: Sequence[tuple[int, FloatArray, FloatArray]], multitag: bool = False, latency_us: int = LATENCY_US
) -> bytes:
    body = struct.pack("<4q", 5, 1_000_000, 1_000_000 + latency_us, 7) + bytes([len(targets)])
    for tag_id, corners, place in targets:
        pose = struct.pack("<7d", *place, 1.0, 0.0, 0.0, 0.0)
        body += struct.pack("<4diif", 0.0, 0.0, 0.0, 0.0, tag_id, -1, 0.0) + pose + pose + struct.pack("<d", 0.1)
        body += b"\x04" + bytes(64) + bytes([len(corners)]) + theirs(corners).astype("<f8").tobytes()
    return body + (b"\x01" + bytes(17 * 8) + b"\x02\x07\x00\x08\x00" if multitag else b"\x00")


def theirs(corners_px: FloatArray) -> FloatArray:
    """The AprilTag library's order, against the clock from the bottom left, and its pixels."""
    return corners_px[::-1] + 0.5


def add_photon(
    log: DataLog, folder: str = "/photonvision/front", *, new: bool = False, corners: bool = True, camera: bool = True
) -> None:
    """Several tags in a picture have places as a field layout would have them: a metre off."""
    for stamp, seen, places in pictures():
        wrong = 1.0 if len(seen) > 1 else 0.0
        none = np.zeros((0, 2))
        targets = [(i, c if corners else none, places[i] + [wrong, 0.0, 0.0]) for i, c in seen.items()]
        payload = packet_2025(targets, multitag=len(seen) > 1) if new else packet_2024(targets)
        log.add(f"{folder}/rawBytes", PHOTON_2025 if new else "rawBytes", stamp + LATENCY_US, payload)
    if camera:
        log.doubles(f"{folder}/cameraIntrinsics", "double[]", 1, CAMERA.matrix.ravel())
        log.doubles(f"{folder}/cameraDistortion", "double[]", 1, CAMERA.distortion)


def add_limelight(log: DataLog, folder: str = "NT:/limelight-a", mount: Mount | None = MOUNT) -> None:
    for stamp, _, places in pictures():
        rows = []
        for tag_id, (ahead, left, up) in ((i, each.tolist()) for i, each in places.items()):
            angles = np.degrees([np.arctan2(-left, ahead), np.arctan2(up, ahead)]).tolist()
            rows += [float(tag_id), *angles, 0.1, float(np.linalg.norm([ahead, left, up])), 9.0, 0.2]
        log.doubles(f"{folder}/tl", "double", stamp + LATENCY_US - 100, [30.0])
        log.doubles(f"{folder}/rawfiducials", "double[]", stamp + LATENCY_US, rows)
    log.doubles(f"{folder}/cl", "double", -50, [10.0])
    if mount is not None:
        angles = np.degrees([mount.roll_rad, -mount.pitch_rad, mount.yaw_rad]).tolist()
        pose = [mount.x_m, -mount.y_m, mount.z_m, *angles]
        log.doubles(f"{folder}/camerapose_robotspace", "double[]", -50, pose)


def good() -> DataLog:
    """A log with speeds and one camera of PhotonVision 2024."""
    log = DataLog()
    add_speeds(log)
    add_photon(log)
    return log
