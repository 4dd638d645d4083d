"""What wheels, gyro and corners measure on a drive at its true state, and how that depends on all that is unknown.

For `tests.benchmarks.accuracy.cramer_rao`: nothing of `offline`, every derivative a difference quotient. Places on the
floor are complex numbers, so that a turn is a product.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundsbot.calib.camera.model import CameraModel
from groundsbot.calib.foundation.arrays import FloatArray, IntArray
from tests.benchmarks.accuracy.cramer_rao_gyro import TrueGyro

ComplexArray = NDArray[np.complex128]

# Of each run; radii, track and focal length as shares of themselves.
CALIBRATION: Final = (
    "radius_left", "radius_right", "track", "mount_x_m", "mount_y_m", "mount_z_m", "mount_roll_rad", "mount_pitch_rad",
    "mount_yaw_rad", "time_offset_s", "focal_length", "edge_shift_px",
)  # fmt: skip
N_WHEELS: Final = 3
_STEP: Final = 1e-5  # of the difference quotients: m, rad, s or share
_N_POINT: Final = 20  # of what a corner's place in the camera depends on
# Keeps a step without motion invertible: no wheel resolves 10 micrometres.
_LEAST_VARIANCE: Final = 1e-10
_CORNERS: Final = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
_OPTICAL: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # x right, y down, z ahead


@dataclass(frozen=True)
class Noise:
    """Sigmas, as `groundsbot.calib.robot.noise` and docs/worlds.md have them."""

    distance_m_per_sqrt_m: float
    lateral_m_per_sqrt_m: float
    heading_rad_per_sqrt_m: float
    heading_rad_per_sqrt_rad: float
    corner_px: float
    tilt_rad: float = 0.0
    height_m: float = 0.0


@dataclass(frozen=True)
class TrueTags:
    """T tags at their true poses.

    `place_m` [T, 3], `rotation` [T, 3, 3] to the world, `side_m` [T]; `batch` [T] numbers those printed together, and
    `batch_sigma` [B] says how far each batch's scale is open (0: known).
    """

    place_m: FloatArray
    rotation: FloatArray
    side_m: FloatArray
    batch: IntArray
    batch_sigma: FloatArray


@dataclass(frozen=True)
class TrueRun:
    """One drive at its true state.

    Attributes:
        place: [N] x + iy of the base at N moments; heading_rad: [N]; rolled_m: [N - 1, 2] what the left and the right
            wheel turned from each moment to the next.
        pose: [P] the moments whose poses are unknowns, the start first.
        picture_pose: [F] the pose that each picture was taken from; twist: [F, 2] m/s and rad/s meanwhile.
        picture, tag: [M] which tag was seen in which picture, in order of pictures.
        row_s: [M, 4] how long after the picture's stamp each corner's row was read.
        track_m, mount: true ones; x, y, z, roll, pitch, yaw as robot.yaml has them.
        sigma: [12] priors by CALIBRATION; 0: known.
        gyro: None without one.
    """

    place: ComplexArray
    heading_rad: FloatArray
    rolled_m: FloatArray
    pose: IntArray
    picture_pose: IntArray
    twist: FloatArray
    picture: IntArray
    tag: IntArray
    row_s: FloatArray
    camera: CameraModel
    track_m: float
    mount: FloatArray
    sigma: FloatArray
    gyro: TrueGyro | None = None


def motion_jacobian(run: TrueRun, noise: Noise) -> FloatArray:
    """[P - 1, 3, 9 + G] of what motions between poses are off: by the first pose, the second, the wheels' shares and
    the G parameters of the gyro."""
    place, heading = run.place[run.pose], run.heading_rad[run.pose]
    measured = _between(place[:-1], heading[:-1], place[1:], heading[1:])
    weight, n = _gyro_weight(run, noise), N_WHEELS + _n_gyro(run)
    rolled = _roll(run, np.zeros(n), weight)

    def off(by: FloatArray) -> FloatArray:
        first = place[:-1] + complex(by[0], by[1]), heading[:-1] + by[2]
        second = place[1:] + complex(by[3], by[4]), heading[1:] + by[5]
        moved = _between(*measured, *_between(*first, *second))
        more_rolled = _between(*rolled, *_roll(run, by[6:], weight))
        place_off, turned_off = _between(*more_rolled, *moved)
        return np.stack([place_off.real, place_off.imag, turned_off], axis=-1)

    return _quotients(off, 6 + n)


def _roll(run: TrueRun, by: FloatArray, weight: FloatArray) -> tuple[ComplexArray, FloatArray]:
    """Motions from pose to pose as wheels and gyro measure them, whose calibration is off by these numbers."""
    left_m, right_m = (run.rolled_m * (1.0 + by[:2])).T
    turn_rad = _wheel_turns(run, by) + weight * _turn_differences(run, by)
    heading = np.concatenate([[0.0], np.cumsum(turn_rad)])
    chords = _arc(0.5 * (left_m + right_m), turn_rad) * np.exp(1j * heading[:-1])
    place = np.concatenate([[0.0], np.cumsum(chords)])
    return _between(place[run.pose[:-1]], heading[run.pose[:-1]], place[run.pose[1:]], heading[run.pose[1:]])


def _wheel_turns(run: TrueRun, by: FloatArray) -> FloatArray:
    """[N - 1] turns from moment to moment by the wheels, whose radii and track are off by these shares."""
    left_m, right_m = (run.rolled_m * (1.0 + by[:2])).T
    return np.asarray((right_m - left_m) / (run.track_m * (1.0 + by[2])))


def _turn_differences(run: TrueRun, by: FloatArray) -> FloatArray:
    """[N - 1] turns by the gyro less those by the wheels, whose calibration is off by these numbers.

    The wheels' turn is given and the robot's strays from it by the noise, so that the scale goes with the wheels' turn.
    """
    if run.gyro is None:
        return np.zeros(len(run.rolled_m))
    turn_rad = _wheel_turns(run, np.zeros(N_WHEELS))
    return np.asarray(turn_rad + run.gyro.turn_jacobian(turn_rad) @ by[N_WHEELS:] - _wheel_turns(run, by))


def _n_gyro(run: TrueRun) -> int:
    return 0 if run.gyro is None else len(run.gyro.sigma)


def _variances(run: TrueRun, noise: Noise) -> FloatArray:
    """[N - 1, 3] of the wheels' motion from each moment to the next."""
    left_m, right_m = run.rolled_m.T
    distance_m, turn_rad = 0.5 * np.abs(left_m + right_m), np.abs(right_m - left_m) / run.track_m
    return np.stack(
        [
            noise.distance_m_per_sqrt_m**2 * distance_m,
            noise.lateral_m_per_sqrt_m**2 * distance_m,
            noise.heading_rad_per_sqrt_m**2 * distance_m + noise.heading_rad_per_sqrt_rad**2 * turn_rad,
        ],
        axis=-1,
    )


def _gyro_weight(run: TrueRun, noise: Noise) -> FloatArray:
    """[N - 1] of the gyro in the best mean of its turn and the wheels', which their difference is independent of."""
    if run.gyro is None:
        return np.zeros(len(run.rolled_m))
    by_wheels = _variances(run, noise)[:, 2]
    return np.where(run.gyro.is_known, by_wheels / (by_wheels + run.gyro.turn_variance), 0.0)


def calibration_information(run: TrueRun, noise: Noise) -> FloatArray:
    """[3 + G, 3 + G] of the wheels' shares and the gyro's parameters, by the differences of their turns and by the walk
    of the bias."""
    n = N_WHEELS + _n_gyro(run)
    if run.gyro is None:
        return np.zeros((n, n))
    variance = _variances(run, noise)[:, 2] + run.gyro.turn_variance
    J = _quotients(lambda by: _turn_differences(run, by), n)
    information: FloatArray = J.T @ (J * (run.gyro.is_known / variance)[:, None])
    information[N_WHEELS:, N_WHEELS:] += run.gyro.walk_information()
    return information


def motion_covariance(run: TrueRun, noise: Noise) -> FloatArray:
    """[P - 1, 3, 3] of the motions in the frame of their ends: each moment's noise, carried to the next pose."""
    variance = _variances(run, noise)
    variance[:, 2] *= 1.0 - _gyro_weight(run, noise)
    step = np.searchsorted(run.pose, np.arange(len(run.place) - 1), side="right") - 1
    inside = step < len(run.pose) - 1
    step, variance = step[inside], variance[inside]
    at, end = np.arange(1, len(run.place))[inside], run.pose[1:][step]

    def end_moved(by: FloatArray) -> FloatArray:
        place = run.place[at] + complex(by[0], by[1]) * np.exp(1j * run.heading_rad[at])
        rest = _between(run.place[at], run.heading_rad[at], run.place[end], run.heading_rad[end])
        moved, heading = place + rest[0] * np.exp(1j * (run.heading_rad[at] + by[2])), run.heading_rad[end] + by[2]
        off, turned = _between(run.place[end], run.heading_rad[end], moved, heading)
        return np.stack([off.real, off.imag, turned], axis=-1)

    J = _quotients(end_moved, 3)
    C = np.tile(_LEAST_VARIANCE * np.eye(3), (len(run.pose) - 1, 1, 1))
    np.add.at(C, step, np.einsum("nij,nj,nkj->nik", J, variance, J))
    return C


class CornerJacobians:
    """Derivatives [M, 8, .] of each track's pixels: by its pose, its tag (6) and the batch's scale, the run's camera
    (mount, time offset, focal length, edge shift) and the sway of the base (roll, pitch, height)."""

    def __init__(self, run: TrueRun, tags: TrueTags) -> None:
        self._run, self._tags = run, tags
        pose = run.pose[run.picture_pose[run.picture]]
        self._place, self._heading, self._twist = run.place[pose], run.heading_rad[pose], run.twist[run.picture]
        by_point = _quotients(lambda by: run.camera.project(self._points(np.zeros(_N_POINT)) + by), 3)
        by_all = np.einsum("mkpi,mkij->mkpj", by_point, _quotients(self._points, _N_POINT))
        by_all = by_all.reshape(len(pose), 8, _N_POINT)
        self.by_pose, self.by_tag, self.by_sway = by_all[..., :3], by_all[..., 3:10], by_all[..., 17:20]
        pixels = run.camera.project(self._points(np.zeros(_N_POINT)))
        by_focal = (pixels - [run.camera.cx_px, run.camera.cy_px]).reshape(len(pose), 8, 1)
        by_edge = _quotients(lambda by: _with_sides_moved(pixels, by[0]), 1).reshape(len(pose), 8, 1)
        self.by_camera = np.concatenate([by_all[..., 10:17], by_focal, by_edge], axis=-1)

    def _points(self, by: FloatArray) -> FloatArray:
        """[M, 4, 3] corners in the camera, where all is off by: pose 3, tag 6, scale, mount 6, time, sway 3."""
        run, tags = self._run, self._tags
        turned = tags.rotation[run.tag] @ Rotation.from_rotvec(by[6:9]).as_matrix()
        on_face = _CORNERS * (tags.side_m[run.tag] * (1.0 + by[9]))[:, None, None]
        corners = tags.place_m[run.tag][:, None] + by[3:6] + on_face @ turned.swapaxes(-1, -2)
        seconds = run.row_s + by[16]
        speed, turning = (each[:, None] for each in self._twist.T)
        heading = self._heading[:, None] + by[2]
        place = (
            self._place[:, None]
            + complex(by[0], by[1])
            + np.exp(1j * heading) * _arc(speed * seconds, turning * seconds)
        )
        level = (corners[..., 0] + 1j * corners[..., 1] - place) * np.exp(-1j * (heading + turning * seconds))
        in_base = np.stack([level.real, level.imag, corners[..., 2] - by[19]], axis=-1)
        in_base = in_base @ Rotation.from_rotvec([by[17], by[18], 0.0]).as_matrix()
        mount = run.mount + by[10:16]
        R = Rotation.from_euler("ZYX", mount[[5, 4, 3]]).as_matrix() @ _OPTICAL
        return np.asarray((in_base - mount[:3]) @ R)


def _with_sides_moved(pixels: FloatArray, by_px: float) -> FloatArray:
    """[M, 4, 2] where the sides of quadrilaterals meet that are moved away from the middle."""
    ends = np.roll(pixels, -1, axis=1)
    normal = np.stack([ends[..., 1] - pixels[..., 1], pixels[..., 0] - ends[..., 0]], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    middle = pixels.mean(axis=1, keepdims=True)
    normal *= np.sign(np.einsum("mki,mki->mk", normal, pixels - middle))[..., None]
    along = np.einsum("mki,mki->mk", normal, pixels) + by_px
    sides = np.stack([np.roll(normal, 1, axis=1), normal], axis=-2)
    return np.linalg.solve(sides, np.stack([np.roll(along, 1, axis=1), along], axis=-1)[..., None])[..., 0]


def _quotients(function: Callable[[FloatArray], FloatArray], n: int) -> FloatArray:
    """[..., n] derivatives of a function [...] of n numbers at zero, by central differences."""
    steps = _STEP * np.eye(n)
    return np.stack([(function(step) - function(-step)) / (2.0 * _STEP) for step in steps], axis=-1)


def _arc(distance_m: FloatArray, turn_rad: FloatArray) -> ComplexArray:
    """Where an arc ends that begins along x."""
    return np.asarray(distance_m * np.sinc(turn_rad / (2.0 * np.pi)) * np.exp(0.5j * turn_rad))


def _between(
    place_a: ComplexArray, heading_a: FloatArray, place_b: ComplexArray, heading_b: FloatArray
) -> tuple[ComplexArray, FloatArray]:
    """Pose b as seen from pose a."""
    turned = heading_b - heading_a
    return (place_b - place_a) * np.exp(-1j * heading_a), np.asarray((turned + np.pi) % (2.0 * np.pi) - np.pi)
