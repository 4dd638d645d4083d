"""Compiled residual and Jacobian of one detection; see `corners.factors` for the model.

The Jacobian has the columns of `CornerFactors.columns`. Tests compare it with finite differences.
"""

from typing import NamedTuple

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.offline.corners.kernels.lens import CENTRE, distort
from groundsbot.offline.foundation import inline, inner
from groundsbot.offline.sam import series


class CornerObservations(NamedTuple):
    """M tags detected in images, in contiguous arrays for compiled functions.

    Attributes:
        pose, tag: (M,) indices of keyframe and tag.
        corners_px: (M, 4, 2) raw pixels.
        sigma_px: (M,) sigma of each coordinate.
        side_m: (M,) nominal side of the tag.
        camera: (M,) index of the camera.
        moved: (M, 4, 3) T_keyframe_base by odometry, at the readout of each corner's row.
        twist: (M, 3) velocity of base (x, y, theta per second) at the keyframe.
        mount: (M, 6) nominal CORNER_MOUNT.
        mount_parameters: (M, 6) indices into the calibration.
        time_parameter, scale_parameter, focal_parameter, edge_parameter: (M,) indices into the calibration.
        outward: (M, 4, 2) derivative of the corners with respect to an outward shift of the tag's edges
            (`edge_directions`).
        jitter: (M, 8) w of the matrix I - w w^T that whitens the residuals by the heading's jitter
            (`heading_jitter`); zero without a gyro.
    """

    pose: IntArray
    tag: IntArray
    corners_px: FloatArray
    sigma_px: FloatArray
    side_m: FloatArray
    camera: IntArray
    moved: FloatArray
    twist: FloatArray
    mount: FloatArray
    mount_parameters: IntArray
    time_parameter: IntArray
    scale_parameter: IntArray
    focal_parameter: IntArray
    edge_parameter: IntArray
    outward: FloatArray
    jitter: FloatArray

    @property
    def n(self) -> int:
        """Number of detections."""
        return len(self.pose)

    def where(self, which: BoolArray | IntArray) -> "CornerObservations":
        """Return the detections of a mask or of indices."""
        return CornerObservations._make(each[which] for each in self)


class SpatialValues(NamedTuple):
    """`SpatialState` for compiled functions."""

    poses: FloatArray
    tags: FloatArray
    calibration: FloatArray
    heights_m: FloatArray
    turns: FloatArray


class CameraPose(NamedTuple):
    """The mount of a camera on its base, its rotation, and the rotation axes of its roll, pitch and yaw."""

    mount: FloatArray  # (6,)
    rotation: FloatArray  # (3, 3) R_base_camera
    axes: FloatArray  # (3, 3) axes of roll, pitch and yaw in base, in rows


@inner
def set_mount(detections: CornerObservations, m: int, calibration: FloatArray, eye: CameraPose) -> None:
    """Set the corrected mount of a detection's camera, unless it is set already, as for most detections."""
    is_same = True
    for k in range(6):
        value = detections.mount[m, k] + calibration[detections.mount_parameters[m, k]]
        is_same &= value == eye.mount[k]
        eye.mount[k] = value
    if is_same:
        return
    sin_r, cos_r = np.sin(eye.mount[3]), np.cos(eye.mount[3])
    sin_p, cos_p = np.sin(eye.mount[4]), np.cos(eye.mount[4])
    sin_y, cos_y = np.sin(eye.mount[5]), np.cos(eye.mount[5])
    R, axes = eye.rotation, eye.axes
    # z, -x and -y of a level camera are x, y and z of base.
    R[0, 2], R[1, 2], R[2, 2] = cos_y * cos_p, sin_y * cos_p, -sin_p
    R[0, 0] = -(cos_y * sin_p * sin_r - sin_y * cos_r)
    R[1, 0] = -(sin_y * sin_p * sin_r + cos_y * cos_r)
    R[2, 0] = -cos_p * sin_r
    R[0, 1] = -(cos_y * sin_p * cos_r + sin_y * sin_r)
    R[1, 1] = -(sin_y * sin_p * cos_r - cos_y * sin_r)
    R[2, 1] = -cos_p * cos_r
    axes[0, 0], axes[0, 1], axes[0, 2] = cos_y * cos_p, sin_y * cos_p, -sin_p
    axes[1, 0], axes[1, 1], axes[1, 2] = -sin_y, cos_y, 0.0
    axes[2, 0], axes[2, 1], axes[2, 2] = 0.0, 0.0, 1.0


@inner
def corner_factor(
    detections: CornerObservations,
    lenses: FloatArray,
    m: int,
    values: SpatialValues,
    eye: CameraPose,
    r: FloatArray,
    J: FloatArray,
    B: FloatArray,
) -> None:
    """Set the whitened residual r (8,), its Jacobian J (8, 19), and its derivatives B (8, 3) with respect to ATTITUDE.

    They are NaN where the lens has no image of a corner.
    """
    pose, tag, lens = detections.pose[m], detections.tag[m], lenses[detections.camera[m]]
    late = values.calibration[detections.time_parameter[m]]
    scale = 1.0 + values.calibration[detections.scale_parameter[m]]
    focal = 1.0 + values.calibration[detections.focal_parameter[m]]
    shift = values.calibration[detections.edge_parameter[m]]
    half = 0.5 * detections.side_m[m] * scale
    place_x, place_y, heading = values.poses[pose, 0], values.poses[pose, 1], values.poses[pose, 2]
    cos_h, sin_h = np.cos(heading), np.sin(heading)
    T, R, mount = values.turns[tag], eye.rotation, eye.mount
    v0, v1, omega = detections.twist[m, 0], detections.twist[m, 1], detections.twist[m, 2]
    back_x, back_y, cos_l, sin_l = base_before(v0, v1, omega, late)
    cos_m, sin_m, cos_t, sin_t, last = 1.0, 0.0, cos_l, sin_l, 0.0
    by_pixel, by_scale = 1.0 / detections.sigma_px[m], 1.0 / scale
    for k in range(4):
        u = -half if k == 0 or k == 3 else half
        v = half if k < 2 else -half
        dx = values.tags[tag, 0] + T[0, 0] * u + T[0, 1] * v - place_x
        dy = values.tags[tag, 1] + T[1, 0] * u + T[1, 1] * v - place_y
        up = values.heights_m[tag] + T[2, 0] * u + T[2, 1] * v
        key_x, key_y = cos_h * dx + sin_h * dy, cos_h * dy - sin_h * dx
        moved = detections.moved[m, k]
        if moved[2] != last:  # differs between corners with a rolling shutter only
            last = moved[2]
            cos_m, sin_m = np.cos(last), np.sin(last)
            cos_t, sin_t = cos_m * cos_l - sin_m * sin_l, sin_m * cos_l + cos_m * sin_l
        rest_x = key_x - (moved[0] + cos_m * back_x - sin_m * back_y)
        rest_y = key_y - (moved[1] + sin_m * back_x + cos_m * back_y)
        base_x, base_y = cos_t * rest_x + sin_t * rest_y, cos_t * rest_y - sin_t * rest_x
        x, y, z = base_x - mount[0], base_y - mount[1], up - mount[2]
        depth = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
        px, py, d00, d01, d11, nx, ny = distort(
            lens,
            R[0, 0] * x + R[1, 0] * y + R[2, 0] * z,
            R[0, 1] * x + R[1, 1] * y + R[2, 1] * z,
            depth,
        )
        for axis in range(2):
            i = 2 * k + axis
            off = lens[axis] * (px if axis == 0 else py)
            outward = detections.outward[m, k, axis]
            r[i] = by_pixel * (focal * off + lens[CENTRE + axis] + shift * outward - detections.corners_px[m, k, axis])
            gain = by_pixel * lens[axis] * focal / depth
            b0, b1, b2 = _by_place(R, nx, ny, gain * (d00 if axis == 0 else d01), gain * (d01 if axis == 0 else d11))
            k0, k1 = b0 * cos_t - b1 * sin_t, b0 * sin_t + b1 * cos_t
            row = J[i]
            row[0], row[1], row[2] = -k0, -k1, k0 * key_y - k1 * key_x
            _by_tag(row, k0 * cos_h - k1 * sin_h, k0 * sin_h + k1 * cos_h, b2, T, u, v, by_scale)
            _by_mount(row, b0, b1, b2, x, y, z, eye.axes)
            row[15] = b0 * v0 + b1 * v1 - (b0 * base_y - b1 * base_x) * omega
            row[17], row[18] = by_pixel * off, by_pixel * outward
            B[i, 0], B[i, 1], B[i, 2] = b1 * up - b2 * base_y, b2 * base_x - b0 * up, -b2
    whiten_jitter(detections.jitter[m], r, J, B)


@inner
def whiten_jitter(w: FloatArray, r: FloatArray, J: FloatArray, B: FloatArray) -> None:
    """Multiply r (8,), J (8, 19) and B (8, 3) by I - w w^T (`CornerObservations.jitter`)."""
    square, total = 0.0, 0.0
    for i in range(8):
        square += w[i] * w[i]
        total += w[i] * r[i]
    if square == 0.0:  # without a gyro
        return
    for i in range(8):
        r[i] -= w[i] * total
    for X in (J, B):
        for k in range(X.shape[1]):
            total = 0.0
            for i in range(8):
                total += w[i] * X[i, k]
            for i in range(8):
                X[i, k] -= w[i] * total


@inline
def base_before(v0: float, v1: float, omega: float, late: float) -> tuple[float, float, float, float]:
    """Return exp(-late (v0, v1, omega)), the motion back by `late` seconds, as x, y, cosine and sine of its heading."""
    along, even, _ = series(-late * omega)
    across = -late * omega * even
    return (
        -late * (along * v0 - across * v1),
        -late * (across * v0 + along * v1),
        1.0 + late * omega * across,
        -late * omega * along,
    )


@inline
def _by_place(R: FloatArray, nx: float, ny: float, j0: float, j1: float) -> tuple[float, float, float]:
    """Return the Jacobian of a corner in base, from that (j0, j1) of its position across the camera axis."""
    j2 = -(j0 * nx + j1 * ny)
    return (
        j0 * R[0, 0] + j1 * R[0, 1] + j2 * R[0, 2],
        j0 * R[1, 0] + j1 * R[1, 1] + j2 * R[1, 2],
        j0 * R[2, 0] + j1 * R[2, 1] + j2 * R[2, 2],
    )


@inline
def _by_tag(
    row: FloatArray, m0: float, m1: float, m2: float, T: FloatArray, u: float, v: float, by_scale: float
) -> None:
    """Set the Jacobian of the tag's position, rotation and scale, from that (m0, m1, m2) of a corner (u, v) in map."""
    t0 = m0 * T[0, 0] + m1 * T[1, 0] + m2 * T[2, 0]
    t1 = m0 * T[0, 1] + m1 * T[1, 1] + m2 * T[2, 1]
    t2 = m0 * T[0, 2] + m1 * T[1, 2] + m2 * T[2, 2]
    row[3], row[4], row[5] = m0, m1, m2
    row[6], row[7], row[8] = t2 * v, -t2 * u, t1 * u - t0 * v
    row[16] = (t0 * u + t1 * v) * by_scale


@inline
def _by_mount(row: FloatArray, b0: float, b1: float, b2: float, x: float, y: float, z: float, axes: FloatArray) -> None:
    """Set the Jacobian of the mount, from that (b0, b1, b2) of a corner in base, at (x, y, z) from the mount."""
    row[9], row[10], row[11] = -b0, -b1, -b2
    w0, w1, w2 = b1 * z - b2 * y, b2 * x - b0 * z, b0 * y - b1 * x
    row[12] = w0 * axes[0, 0] + w1 * axes[0, 1] + w2 * axes[0, 2]
    row[13] = w0 * axes[1, 0] + w1 * axes[1, 1]
    row[14] = w2
