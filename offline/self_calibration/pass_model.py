"""Predicted tag observations in passes of tags, and their derivatives with respect to the calibration.

Wheels are taken as exact within a pass, and so are the arcs between its stations (calib.geometry.wheels). With the base
pose p in the frame of the pass's first station, tag t, mount m and rotations R:

    q = R(m)' (R(p)' (t - p) - m),  range = |q| / (1 + tag scale) + range offset,  bearing = atan2(q_y, q_x)
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.self_calibration.passes import Passes

# Corrections to robot.yaml, in this order. All but the first are nuisance parameters here; their priors bound them
# where passes do not observe them.
PARAMETERS: Final = (
    "time_offset_s",
    "wheel_ratio",
    "turn_factor",
    "mount_x_m",
    "mount_y_m",
    "mount_yaw_rad",
    "range_offset_m",
    "tag_scale",
)
PRIOR_SIGMA: Final = np.array([0.5, 0.05, 0.3, 0.5, 0.5, 0.15, 0.15, 0.2])

_NEAREST_M: Final = 1e-3


@dataclass(frozen=True)
class LinearisedTracks:
    """Residuals of M observations, predicted less observed, and their derivatives.

    Attributes:
        residual: (M, 2) m and rad.
        by_tag: (M, 2, 2) with respect to the position of the pass's tag in the frame of its first station.
        by_parameters: (M, 2, 8) with respect to PARAMETERS.
    """

    residual: FloatArray
    by_tag: FloatArray
    by_parameters: FloatArray


def poses(passes: Passes, parameters: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return base poses (3, M) at the observations, in the frame of the first station of each pass.

    Returns:
        The poses (x_m, y_m, theta_rad), and their derivatives (3, 3, M) with respect to time offset, wheel ratio and
        turn factor.
    """
    offset_s, ratio, turn = parameters[:3]
    left_m, right_m, lateral_m, left_m_s, right_m_s, lateral_m_s = passes.wheels.at(passes.stations_s - offset_s).T
    turns = (1.0 + turn) / passes.wheels.track_m
    left, right = 1.0 - 0.5 * ratio, 1.0 + 0.5 * ratio
    none = np.zeros_like(left_m)
    forward_m_s, turning = 0.5 * (left * left_m_s + right * right_m_s), turns * (right * right_m_s - left * left_m_s)
    sums = np.stack([0.5 * (left * left_m + right * right_m), turns * (right * right_m - left * left_m), lateral_m])
    by_time = -np.stack([forward_m_s, turning, lateral_m_s])
    by_ratio = np.stack([0.25 * (right_m - left_m), 0.5 * turns * (right_m + left_m), none])
    by_turn = np.stack([none, sums[1] / (1.0 + turn), none])
    # Of (way, heading, way to the left): the step from the previous station, and the heading since the pass began.
    all_sums = np.stack([sums, by_time, by_ratio, by_turn])
    steps = np.diff(all_sums, axis=-1, prepend=0.0)
    steps[..., passes.first_station] = 0.0
    since = all_sums[:, 1] - all_sums[:, 1][:, passes.first_station][:, passes.station_group]
    middle = since - 0.5 * steps[:, 1]
    turned = steps[0, 1]
    chords_m = steps[:, [0, 2]] * np.sinc(0.5 * turned / np.pi)
    chords_m[1:] -= steps[0, [0, 2]] * turned / 12.0 * steps[1:, 1:2]  # sinc(turned / 2) to its first order
    cos, sin = np.cos(middle[0]), np.sin(middle[0])
    x, y = chords_m[:, 0] * cos - chords_m[:, 1] * sin, chords_m[:, 0] * sin + chords_m[:, 1] * cos
    x[1:], y[1:] = x[1:] - y[0] * middle[1:], y[1:] + x[0] * middle[1:]
    places = np.cumsum(np.stack([x, y]), axis=-1)
    places = places[..., passes.at] - places[..., passes.first_station][..., passes.group]
    together = np.concatenate([places, since[None][..., passes.at]])
    return together[:, 0], together[:, 1:]


def tag_positions(passes: Passes, parameters: FloatArray) -> FloatArray:
    """Return (G, 2) tag positions, the mean over the observations of each pass, in the frame of its first station."""
    base, _ = poses(passes, parameters)
    range_m = (passes.value[:, 0] - parameters[6]) * (1.0 + parameters[7])
    mount = passes.sensor + parameters[3:6]
    in_sensor = range_m[:, None] * np.stack([np.cos(passes.value[:, 1]), np.sin(passes.value[:, 1])], axis=-1)
    places = se2.apply(base.T, se2.apply(mount, in_sensor))
    return np.asarray(np.add.reduceat(places, passes.first) / np.bincount(passes.group)[:, None])


def linearise(passes: Passes, parameters: FloatArray, tags_m: FloatArray) -> LinearisedTracks:
    """Return residuals and derivatives.

    Args:
        passes: M observations in G passes.
        parameters: (8,) in order of PARAMETERS.
        tags_m: (G, 2) as from `tag_positions`.
    """
    (x, y, theta), by_motion = poses(passes, parameters)
    mount = passes.sensor + parameters[3:6]
    scale = 1.0 + parameters[7]
    cos, sin = np.cos(theta), np.sin(theta)
    away = tags_m[passes.group] - np.stack([x, y], axis=-1)
    in_base = np.stack([cos * away[:, 0] + sin * away[:, 1], cos * away[:, 1] - sin * away[:, 0]], axis=-1)
    from_mount = in_base - mount[:, :2]
    range_m = np.maximum(np.hypot(*from_mount.T), _NEAREST_M)
    bearing_rad = np.arctan2(from_mount[:, 1], from_mount[:, 0]) - mount[:, 2]
    residual = np.stack(
        [
            range_m / scale + parameters[6] - passes.value[:, 0],
            se2.wrap_angle(bearing_rad - passes.value[:, 1]),
        ],
        axis=-1,
    )
    along = from_mount / (scale * range_m[:, None])
    across = np.stack([-from_mount[:, 1], from_mount[:, 0]], axis=-1) / (range_m**2)[:, None]
    by_base = np.stack([along, across], axis=1)  # by the place in base
    first, second = by_base[..., 0], by_base[..., 1]
    by_tag = np.stack([cos[:, None] * first - sin[:, None] * second, sin[:, None] * first + cos[:, None] * second], -1)
    by_theta = first * in_base[:, 1:] - second * in_base[:, :1]
    by_parameters = np.zeros((len(residual), 2, len(PARAMETERS)))
    by_parameters[..., :3] = np.concatenate([-by_tag, by_theta[..., None]], axis=-1) @ by_motion.transpose(2, 0, 1)
    by_parameters[..., 3:5] = -by_base
    by_parameters[:, 1, 5] = -1.0
    by_parameters[:, 0, 6] = 1.0
    by_parameters[:, 0, 7] = -range_m / scale**2
    return LinearisedTracks(residual, by_tag, by_parameters)
