"""Compiled linearisation of `corner_factors`: residuals and Jacobians of looks, straight into the fronts.

What `CornerFactors` writes as arrays over all looks is here a loop with the same names; the tests hold both to each
other. Derivatives stand in the order of `CornerFactors.columns`.
"""

from typing import Final, NamedTuple

import numpy as np

from calib.arrays import FloatArray, IntArray
from offline.front_kernels import Kind, System, add_matrix, add_vector
from offline.jit import borrowed, inner, jitted
from offline.lens_kernels import CENTRE, distorted_at
from offline.linearise_kernels import Odometry, Values, series
from offline.linearise_odometry import error_by_wheels, error_of, motion_at, scaled_information, wheel_correction
from offline.robust import Loss, loss_and_weight

N_LOOK: Final = 19
N_MOTION: Final = 9


class LookArrays(NamedTuple):
    """`corner_factors.Looks`, for compiled functions."""

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


class SpatialValues(NamedTuple):
    """`corner_factors.SpatialState`, for compiled functions."""

    poses: FloatArray
    tags: FloatArray
    calibration: FloatArray
    heights_m: FloatArray
    turns: FloatArray


class Eye(NamedTuple):
    """A camera on its base: its place, the rotation from its axes, and the axes about which its mount turns."""

    mount: FloatArray  # (6,)
    rotation: FloatArray  # (3, 3) R_base_camera
    axes: FloatArray  # (3, 3) of roll, pitch and yaw, row by row


@jitted
def add_looks(
    looks: LookArrays,
    lenses: FloatArray,
    loss: Loss,
    values: SpatialValues,
    kind: Kind,
    system: System,
) -> float:
    """Adds J^T W J and J^T W r of all looks; returns the sum of their losses.

    Where the system has no room for matrices only gradients are added.
    """
    looks, values, kind, system = borrowed(looks), borrowed(values), borrowed(kind), borrowed(system)
    r, J, B, normal = np.empty(8), np.empty((8, N_LOOK)), np.empty((8, 3)), np.empty((N_LOOK, N_LOOK))
    eye = Eye(np.full(6, np.nan), np.empty((3, 3)), np.empty((3, 3)))
    total, is_whole = 0.0, len(system.entries) > 0
    free, place = np.empty(N_LOOK, dtype=np.uint64), np.empty(N_LOOK, dtype=np.uint64)
    for m in range(len(looks.pose)):
        face(looks, m, values.calibration, eye)
        look_factor(looks, lenses, m, values, eye, r, J, B)
        square = 0.0
        for i in range(8):
            square += r[i] * r[i]
        rho, w = loss_and_weight(loss, square)
        total += rho
        f0, f1, f2, f3 = w * r[0], w * r[1], w * r[2], w * r[3]
        f4, f5, f6, f7 = w * r[4], w * r[5], w * r[6], w * r[7]
        _combine(J, f0, f1, f2, f3, f4, f5, f6, f7, 0, normal[0])
        add_vector(kind, m, normal[0], system.gradient)
        if is_whole:
            for a in range(N_LOOK):  # above the diagonal, and in what blocks of six and seven have below
                f0, f1, f2, f3 = w * J[0, a], w * J[1, a], w * J[2, a], w * J[3, a]
                f4, f5, f6, f7 = w * J[4, a], w * J[5, a], w * J[6, a], w * J[7, a]
                if a < 6:
                    _combine(J, f0, f1, f2, f3, f4, f5, f6, f7, 0, normal[a])
                elif a < 12:
                    _combine(J, f0, f1, f2, f3, f4, f5, f6, f7, 6, normal[a])
                else:
                    _combine(J, f0, f1, f2, f3, f4, f5, f6, f7, 12, normal[a])
            add_matrix(kind, m, normal, system, free, place)
    return total


@jitted
def add_wobble(
    looks: LookArrays,
    lenses: FloatArray,
    loss: Loss,
    values: SpatialValues,
    given: FloatArray,
    picture: IntArray,
    weight: FloatArray,
    own: FloatArray,
    force: FloatArray,
    coupled: FloatArray,
) -> None:
    """Adds B^T W B (P, 3, 3) and B^T W r (P, 3) to pictures, and sets B^T W J (M, 3, 19); B as in `look_factor`.

    Sets the weights (M,) too: as given, or where none are by the loss of level pictures.
    """
    looks, values = borrowed(looks), borrowed(values)
    r, J, B = np.empty(8), np.empty((8, N_LOOK)), np.empty((8, 3))
    eye = Eye(np.full(6, np.nan), np.empty((3, 3)), np.empty((3, 3)))
    for m in range(len(looks.pose)):
        face(looks, m, values.calibration, eye)
        look_factor(looks, lenses, m, values, eye, r, J, B)
        square = 0.0
        for i in range(8):
            square += r[i] * r[i]
        w = given[m] if len(given) else loss_and_weight(loss, square)[1]
        weight[m] = w
        for k in range(3):
            f0, f1, f2, f3 = w * B[0, k], w * B[1, k], w * B[2, k], w * B[3, k]
            f4, f5, f6, f7 = w * B[4, k], w * B[5, k], w * B[6, k], w * B[7, k]
            _combine(J, f0, f1, f2, f3, f4, f5, f6, f7, 0, coupled[m, k])
            for i in range(8):
                force[picture[m], k] += w * B[i, k] * r[i]
                for j in range(3):
                    own[picture[m], k, j] += w * B[i, k] * B[i, j]


@jitted
def add_motions(odometry: Odometry, loss: Loss, values: Values, kind: Kind, system: System) -> float:
    """Adds J^T W J and J^T W r of all motions, by both poses and the wheels; returns the sum of their losses.

    Where the system has no room for matrices only gradients are added.
    """
    odometry, values, kind, system = borrowed(odometry), borrowed(values), borrowed(kind), borrowed(system)
    C, product, J, heavy = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, N_MOTION)), np.empty((3, N_MOTION))
    normal, vector = np.empty((N_MOTION, N_MOTION)), np.empty(N_MOTION)
    free, place = np.empty(N_MOTION, dtype=np.uint64), np.empty(N_MOTION, dtype=np.uint64)
    total, is_whole = 0.0, len(system.entries) > 0
    for m in range(len(odometry.first)):
        i = odometry.first[m]
        before, after = values.poses[i], values.poses[i + 1]
        cos_i, sin_i, turn = np.cos(before[2]), np.sin(before[2]), after[2] - before[2]
        apart_x, apart_y = after[0] - before[0], after[1] - before[1]
        x, y = cos_i * apart_x + sin_i * apart_y, cos_i * apart_y - sin_i * apart_x
        t = wheel_correction(odometry, m, values.calibration)
        e, (a, b, p, q) = error_of(motion_at(odometry, m, t), x, y, turn)
        s = 1.0 / (1.0 + values.calibration[odometry.parameters[m, 0]])
        error_by_wheels(odometry.jacobian[m], t, e, s, C, product)
        # By the second pose Jr^-1(e), by the first one that times minus the adjoint of the motion back.
        J[0, 3], J[0, 4], J[0, 5], J[1, 3], J[1, 4], J[1, 5] = a, -b, p, b, a, q
        J[2, 3], J[2, 4], J[2, 5] = 0.0, 0.0, 1.0
        cos, sin = np.cos(turn), np.sin(turn)
        u, v = sin * x - cos * y, cos * x + sin * y
        for k in range(3):
            J[k, 0] = -(J[k, 3] * cos - J[k, 4] * sin)
            J[k, 1] = -(J[k, 3] * sin + J[k, 4] * cos)
            J[k, 2] = -(J[k, 3] * u + J[k, 4] * v + J[k, 5])
            J[k, 6], J[k, 7], J[k, 8] = C[k, 0], C[k, 1], C[k, 2]
        l0, l1, l2, l3, l4, l5 = scaled_information(odometry.information[m], s)
        f0 = l0 * e[0] + l1 * e[1] + l2 * e[2]
        f1 = l1 * e[0] + l3 * e[1] + l4 * e[2]
        f2 = l2 * e[0] + l4 * e[1] + l5 * e[2]
        rho, w = loss_and_weight(loss, e[0] * f0 + e[1] * f1 + e[2] * f2)
        total += rho
        for k in range(N_MOTION):
            vector[k] = w * (f0 * J[0, k] + f1 * J[1, k] + f2 * J[2, k])
        add_vector(kind, m, vector, system.gradient)
        if is_whole:
            for k in range(N_MOTION):
                heavy[0, k] = w * (l0 * J[0, k] + l1 * J[1, k] + l2 * J[2, k])
                heavy[1, k] = w * (l1 * J[0, k] + l3 * J[1, k] + l4 * J[2, k])
                heavy[2, k] = w * (l2 * J[0, k] + l4 * J[1, k] + l5 * J[2, k])
            for k in range(N_MOTION):
                c0, c1, c2 = J[0, k], J[1, k], J[2, k]
                for j in range(k, N_MOTION):
                    normal[k, j] = c0 * heavy[0, j] + c1 * heavy[1, j] + c2 * heavy[2, j]
            add_matrix(kind, m, normal, system, free, place)
    return total


@inner
def _combine(
    J: FloatArray,
    f0: float,
    f1: float,
    f2: float,
    f3: float,
    f4: float,
    f5: float,
    f6: float,
    f7: float,
    first: int,
    out: FloatArray,
) -> None:
    """The rows of J (8, 19), so many times each, from some column on."""
    for b in range(first, N_LOOK):
        out[b] = (f0 * J[0, b] + f1 * J[1, b] + f2 * J[2, b] + f3 * J[3, b]) + (
            f4 * J[4, b] + f5 * J[5, b] + f6 * J[6, b] + f7 * J[7, b]
        )


@inner
def face(looks: LookArrays, m: int, calibration: FloatArray, eye: Eye) -> None:
    """Sets the eye as the calibration has it, unless it is so already: most looks are by the same one."""
    is_same = True
    for k in range(6):
        value = looks.mount[m, k] + calibration[looks.mount_parameters[m, k]]
        is_same &= value == eye.mount[k]
        eye.mount[k] = value
    if is_same:
        return
    sin_r, cos_r = np.sin(eye.mount[3]), np.cos(eye.mount[3])
    sin_p, cos_p = np.sin(eye.mount[4]), np.cos(eye.mount[4])
    sin_y, cos_y = np.sin(eye.mount[5]), np.cos(eye.mount[5])
    R, axes = eye.rotation, eye.axes
    # Columns: a level eye's z, -x and -y look along base's x, y and z.
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
def look_factor(
    looks: LookArrays,
    lenses: FloatArray,
    m: int,
    values: SpatialValues,
    eye: Eye,
    r: FloatArray,
    J: FloatArray,
    B: FloatArray,
) -> None:
    """Sets the whitened residual (8,), its derivatives (8, 19), and those by how the picture stands (8, 3).

    NaN where the lens has no image of a corner.
    """
    pose, tag, lens = looks.pose[m], looks.tag[m], lenses[looks.camera[m]]
    late = values.calibration[looks.time_parameter[m]]
    scale = 1.0 + values.calibration[looks.scale_parameter[m]]
    focal = 1.0 + values.calibration[looks.focal_parameter[m]]
    shift = values.calibration[looks.edge_parameter[m]]
    half = 0.5 * looks.side_m[m] * scale
    place_x, place_y, heading = values.poses[pose, 0], values.poses[pose, 1], values.poses[pose, 2]
    cos_h, sin_h = np.cos(heading), np.sin(heading)
    T, R, mount = values.turns[tag], eye.rotation, eye.mount
    v0, v1, omega = looks.twist[m, 0], looks.twist[m, 1], looks.twist[m, 2]
    along, even, _ = series(-late * omega)
    across = -late * omega * even
    back_x, back_y = -late * (along * v0 - across * v1), -late * (across * v0 + along * v1)
    cos_l, sin_l = 1.0 + late * omega * across, -late * omega * along
    cos_m, sin_m, cos_t, sin_t, last = 1.0, 0.0, cos_l, sin_l, 0.0
    by_pixel, by_scale = 1.0 / looks.sigma_px[m], 1.0 / scale
    for k in range(4):
        u = -half if k == 0 or k == 3 else half
        v = half if k < 2 else -half
        dx = values.tags[tag, 0] + T[0, 0] * u + T[0, 1] * v - place_x
        dy = values.tags[tag, 1] + T[1, 0] * u + T[1, 1] * v - place_y
        up = values.heights_m[tag] + T[2, 0] * u + T[2, 1] * v
        key_x, key_y = cos_h * dx + sin_h * dy, cos_h * dy - sin_h * dx
        moved = looks.moved[m, k]
        if moved[2] != last:  # all corners were seen at once, but by a rolling shutter
            last = moved[2]
            cos_m, sin_m = np.cos(last), np.sin(last)
            cos_t, sin_t = cos_m * cos_l - sin_m * sin_l, sin_m * cos_l + cos_m * sin_l
        rest_x = key_x - (moved[0] + cos_m * back_x - sin_m * back_y)
        rest_y = key_y - (moved[1] + sin_m * back_x + cos_m * back_y)
        base_x, base_y = cos_t * rest_x + sin_t * rest_y, cos_t * rest_y - sin_t * rest_x
        x, y, z = base_x - mount[0], base_y - mount[1], up - mount[2]
        c0 = R[0, 0] * x + R[1, 0] * y + R[2, 0] * z
        c1 = R[0, 1] * x + R[1, 1] * y + R[2, 1] * z
        c2 = R[0, 2] * x + R[1, 2] * y + R[2, 2] * z
        px, py, d00, d01, d11, nx, ny = distorted_at(lens, c0, c1, c2)
        inverse = 1.0 / c2
        for axis in range(2):
            i = 2 * k + axis
            distorted = px if axis == 0 else py
            scaled = lens[axis] * focal
            off = lens[axis] * distorted
            outward = looks.outward[m, k, axis]
            r[i] = by_pixel * (focal * off + lens[CENTRE + axis] + shift * outward - looks.corners_px[m, k, axis])
            gain = by_pixel * scaled * inverse
            j0, j1 = gain * (d00 if axis == 0 else d01), gain * (d01 if axis == 0 else d11)
            j2 = -(j0 * nx + j1 * ny)
            b0 = j0 * R[0, 0] + j1 * R[0, 1] + j2 * R[0, 2]
            b1 = j0 * R[1, 0] + j1 * R[1, 1] + j2 * R[1, 2]
            b2 = j0 * R[2, 0] + j1 * R[2, 1] + j2 * R[2, 2]
            k0, k1 = b0 * cos_t - b1 * sin_t, b0 * sin_t + b1 * cos_t
            m0, m1 = k0 * cos_h - k1 * sin_h, k0 * sin_h + k1 * cos_h
            t0 = m0 * T[0, 0] + m1 * T[1, 0] + b2 * T[2, 0]
            t1 = m0 * T[0, 1] + m1 * T[1, 1] + b2 * T[2, 1]
            t2 = m0 * T[0, 2] + m1 * T[1, 2] + b2 * T[2, 2]
            row = J[i]
            row[0], row[1], row[2] = -k0, -k1, k0 * key_y - k1 * key_x
            row[3], row[4], row[5] = m0, m1, b2
            row[6], row[7], row[8] = t2 * v, -t2 * u, t1 * u - t0 * v
            row[9], row[10], row[11] = -b0, -b1, -b2
            w0, w1, w2 = b1 * z - b2 * y, b2 * x - b0 * z, b0 * y - b1 * x
            row[12] = w0 * eye.axes[0, 0] + w1 * eye.axes[0, 1] + w2 * eye.axes[0, 2]
            row[13] = w0 * eye.axes[1, 0] + w1 * eye.axes[1, 1]
            row[14] = w2
            row[15] = b0 * v0 + b1 * v1 - (b0 * base_y - b1 * base_x) * omega
            row[16] = (t0 * u + t1 * v) * by_scale
            row[17], row[18] = by_pixel * off, by_pixel * outward
            B[i, 0], B[i, 1], B[i, 2] = b1 * up - b2 * base_y, b2 * base_x - b0 * up, -b2
