"""Compiled planar pose estimation: the two poses that explain the four corners of a square, and rays through pixels.

The result is that of `groundsbot.calib.camera.planar_pose`, which uses OpenCV for any board; tests compare both. The
rotation follows, up to the sign of its tilt from the ray, from the first derivatives of the homography at the tag's
centre (Collins and Bartoli, "Infinitesimal plane-based pose estimation", 2014). The homography of a square is from
Heckbert, "Fundamentals of texture mapping and image warping" (1989).
"""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.corners.kernels.lens import CENTRE, distort
from groundsbot.offline.foundation import inner

_LEAST_COSINE: Final = 0.05  # of the angle between a corner's ray and the mean ray
_NEWTON_STEPS: Final = 20
_RESIDUAL: Final = 1e-12


@inner
def ray_through(lens: FloatArray, pixel: FloatArray, out: FloatArray) -> None:
    """Set the unit ray (3,) through a pixel (2,) by Newton's method, started without distortion; NaN if it fails."""
    target_x, target_y = (pixel[0] - lens[CENTRE]) / lens[0], (pixel[1] - lens[CENTRE + 1]) / lens[1]
    x, y, is_found = target_x, target_y, False
    for _ in range(_NEWTON_STEPS):
        image_x, image_y, d00, d01, d11, _, _ = distort(lens, x, y, 1.0)
        off_x, off_y = image_x - target_x, image_y - target_y
        if abs(off_x) + abs(off_y) < _RESIDUAL * (1.0 + abs(target_x) + abs(target_y)):
            is_found = True
            break
        inverse = 1.0 / (d00 * d11 - d01 * d01)
        x -= inverse * (d11 * off_x - d01 * off_y)
        y -= inverse * (d00 * off_y - d01 * off_x)
    share = 1.0 / np.sqrt(1.0 + x * x + y * y) if is_found else np.nan
    out[0], out[1], out[2] = share * x, share * y, share


@inner
def square_poses(rays: FloatArray, side_m: float, turns: FloatArray, places: FloatArray) -> bool:
    """Set R (2, 3, 3) and t (2, 3) of T_camera_tag from rays (4, 3) to the corners; return False without a solution."""
    ahead, turned, H, lean = np.empty((3, 3)), np.empty((4, 3)), np.empty((3, 3)), np.empty((3, 3))
    _least_turn(rays[0, 0] + rays[1, 0] + rays[2, 0] + rays[3, 0], rays[0, 1] + rays[1, 1] + rays[2, 1] + rays[3, 1],
                rays[0, 2] + rays[1, 2] + rays[2, 2] + rays[3, 2], ahead)  # fmt: skip
    for k in range(4):
        for i in range(3):  # rotate into a camera with its axis along the mean ray
            turned[k, i] = ahead[0, i] * rays[k, 0] + ahead[1, i] * rays[k, 1] + ahead[2, i] * rays[k, 2]
        if not turned[k, 2] >= _LEAST_COSINE:
            return False
    _homography(turned, 0.5 * side_m, H)
    p, q = H[0, 2], H[1, 2]
    _least_turn(p, q, 1.0, lean)
    b00, b01 = lean[0, 0] - p * lean[2, 0], lean[0, 1] - p * lean[2, 1]
    b10, b11 = lean[1, 0] - q * lean[2, 0], lean[1, 1] - q * lean[2, 1]
    j00, j01 = H[0, 0] - H[2, 0] * p, H[0, 1] - H[2, 1] * p
    j10, j11 = H[1, 0] - H[2, 0] * q, H[1, 1] - H[2, 1] * q
    inverse = 1.0 / (b00 * b11 - b01 * b10)
    a00, a01 = inverse * (b11 * j00 - b01 * j10), inverse * (b11 * j01 - b01 * j11)
    a10, a11 = inverse * (b00 * j10 - b10 * j00), inverse * (b00 * j11 - b10 * j01)
    above, across = a00 * a00 + a01 * a01, a00 * a10 + a01 * a11
    below = a10 * a10 + a11 * a11
    gain = np.sqrt(0.5 * (above + below + np.sqrt((above - below) ** 2 + 4.0 * across * across)))
    if not 0.0 < gain < np.inf:
        return False
    r00, r01, r10, r11 = a00 / gain, a01 / gain, a10 / gain, a11 / gain
    b0 = np.sqrt(max(0.0, 1.0 - r00 * r00 - r10 * r10))
    b1 = np.sqrt(max(0.0, 1.0 - r01 * r01 - r11 * r11))
    if r00 * r01 + r10 * r11 > 0.0:
        b1 = -b1
    for s in range(2):
        c0, c1 = (b0, b1) if s == 0 else (-b0, -b1)
        R = turns[s]
        for i in range(3):  # R = lean times a rotation whose third column is the cross product of the others
            u, v, w = lean[i, 0], lean[i, 1], lean[i, 2]
            R[i, 0], R[i, 1] = u * r00 + v * r10 + w * c0, u * r01 + v * r11 + w * c1
            R[i, 2] = u * (r10 * c1 - c0 * r11) + v * (c0 * r01 - r00 * c1) + w * (r00 * r11 - r10 * r01)
        _shift(turned, R, 0.5 * side_m, places[s])
        _rotate_back(ahead, R, places[s])
    return True


@inner
def _least_turn(x: float, y: float, z: float, out: FloatArray) -> None:
    """Set the smallest rotation that maps the z axis to a direction (x, y, z), with z > -length."""
    inverse = 1.0 / np.sqrt(x * x + y * y + z * z)
    x, y, z = x * inverse, y * inverse, z * inverse
    share = 1.0 / (1.0 + z)
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - x * x * share, -x * y * share, x
    out[1, 0], out[1, 1], out[1, 2] = -x * y * share, 1.0 - y * y * share, y
    out[2, 0], out[2, 1], out[2, 2] = -x, -y, z


@inner
def _homography(rays: FloatArray, half_m: float, H: FloatArray) -> None:
    """Set H from the tag's plane in metres to z = 1, with H[2, 2] = 1; corners as in `tag_pose.UNIT_CORNERS`."""
    x0, y0 = rays[3, 0] / rays[3, 2], rays[3, 1] / rays[3, 2]
    x1, y1 = rays[2, 0] / rays[2, 2], rays[2, 1] / rays[2, 2]
    x2, y2 = rays[1, 0] / rays[1, 2], rays[1, 1] / rays[1, 2]
    x3, y3 = rays[0, 0] / rays[0, 2], rays[0, 1] / rays[0, 2]
    sum_x, sum_y = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3
    dx1, dx2, dy1, dy2 = x1 - x2, x3 - x2, y1 - y2, y3 - y2
    inverse = 1.0 / (dx1 * dy2 - dx2 * dy1)
    g, h = inverse * (sum_x * dy2 - dx2 * sum_y), inverse * (dx1 * sum_y - sum_x * dy1)
    # Homography of the unit square, whose centre is the tag's centre.
    a, b, d, e = x1 - x0 + g * x1, x3 - x0 + h * x3, y1 - y0 + g * y1, y3 - y0 + h * y3
    middle = 1.0 / (1.0 + 0.5 * (g + h))
    across = middle * 0.5 / half_m
    H[0, 0], H[0, 1], H[0, 2] = a * across, b * across, (x0 + 0.5 * (a + b)) * middle
    H[1, 0], H[1, 1], H[1, 2] = d * across, e * across, (y0 + 0.5 * (d + e)) * middle
    H[2, 0], H[2, 1], H[2, 2] = g * across, h * across, 1.0


@inner
def _shift(rays: FloatArray, R: FloatArray, half_m: float, out: FloatArray) -> None:
    """Set the position given R by least squares at z = 1: t_x - x t_z = x (R c)_z - (R c)_x, and likewise for y."""
    sx, sy, square, gx, gy, gz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(4):
        u = -half_m if k == 0 or k == 3 else half_m
        v = half_m if k < 2 else -half_m
        x, y = rays[k, 0] / rays[k, 2], rays[k, 1] / rays[k, 2]
        depth = R[2, 0] * u + R[2, 1] * v
        ex, ey = x * depth - (R[0, 0] * u + R[0, 1] * v), y * depth - (R[1, 0] * u + R[1, 1] * v)
        sx, sy, square = sx + x, sy + y, square + x * x + y * y
        gx, gy, gz = gx + ex, gy + ey, gz - x * ex - y * ey
    out[2] = (gz + 0.25 * (sx * gx + sy * gy)) / (square - 0.25 * (sx * sx + sy * sy))
    out[0], out[1] = 0.25 * (gx + sx * out[2]), 0.25 * (gy + sy * out[2])


@inner
def _rotate_back(ahead: FloatArray, R: FloatArray, place: FloatArray) -> None:
    """Rotate R and t back from the camera along the mean ray."""
    for j in range(3):
        x, y, z = R[0, j], R[1, j], R[2, j]
        for i in range(3):
            R[i, j] = ahead[i, 0] * x + ahead[i, 1] * y + ahead[i, 2] * z
    x, y, z = place[0], place[1], place[2]
    for i in range(3):
        place[i] = ahead[i, 0] * x + ahead[i, 1] * y + ahead[i, 2] * z
