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
from groundsbot.offline.self_calibration.pass_kernels import set_derivatives, set_poses
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
    """Return base poses (S, 3) at the stations, in the frame of the first station of each pass.

    Returns:
        The poses (x_m, y_m, theta_rad), and their derivatives (S, 3, 3) with respect to time offset, wheel ratio and
        turn factor.
    """
    wheels, n = passes.wheels, len(passes.stations_s)
    pose, by_motion = np.empty((n, 3)), np.empty((n, 3, 3))
    set_poses(
        wheels.time_s,
        wheels.motion,
        wheels.track_m,
        parameters,
        passes.stations_s,
        passes.first_station,
        pose,
        by_motion,
    )
    return pose, by_motion


def tag_positions(passes: Passes, parameters: FloatArray) -> FloatArray:
    """Return (G, 2) tag positions, the mean over the observations of each pass, in the frame of its first station."""
    base, _ = poses(passes, parameters)
    range_m = (passes.value[:, 0] - parameters[6]) * (1.0 + parameters[7])
    mount = passes.sensor + parameters[3:6]
    in_sensor = range_m[:, None] * np.stack([np.cos(passes.value[:, 1]), np.sin(passes.value[:, 1])], axis=-1)
    places = se2.apply(base[passes.at], se2.apply(mount, in_sensor))
    return np.asarray(np.add.reduceat(places, passes.first) / np.bincount(passes.group)[:, None])


def linearise(passes: Passes, parameters: FloatArray, tags_m: FloatArray) -> LinearisedTracks:
    """Return residuals and derivatives.

    Args:
        passes: M observations in G passes.
        parameters: (8,) in order of PARAMETERS.
        tags_m: (G, 2) as from `tag_positions`.
    """
    pose, by_motion = poses(passes, parameters)
    n = len(passes.group)
    found = LinearisedTracks(np.empty((n, 2)), np.empty((n, 2, 2)), np.empty((n, 2, len(PARAMETERS))))
    set_derivatives(
        pose,
        by_motion,
        passes.at,
        passes.group,
        passes.value,
        passes.sensor,
        parameters,
        tags_m,
        _NEAREST_M,
        found.residual,
        found.by_tag,
        found.by_parameters,
    )
    return found
