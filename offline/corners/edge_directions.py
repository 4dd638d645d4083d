"""Which way tags' sides face in pictures, for cameras that see them too far in (`groundsbot.calib.tags.edges`).

Seen corners would tell it too, but with their noise in it: a side that is seen askew would face as its own error has
it, and the sum of that over all looks tells of a shift that is not there. A corner adds 2 sigma^2 over the side's
length to it, which is little, but all add it with one sign: it came to a sigma of the scale. Predicted corners have
one solution's noise.
"""

from dataclasses import replace

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.tags import outward
from groundsbot.offline.corners.factors import CornerFactors, SpatialState, spatial_values
from groundsbot.offline.corners.kernels.initial_tag_poses import eyes_of
from groundsbot.offline.corners.kernels.lens import CENTRE, distort
from groundsbot.offline.corners.kernels.view import CameraPose, CornerArrays, SpatialValues
from groundsbot.offline.foundation import borrow, njit


def with_predicted_facings(factors: CornerFactors, state: SpatialState) -> CornerFactors:
    """The factors with sides that face as the state has them; as they were where a lens has no image of a corner."""
    looks = factors.observations
    predicted_px = np.empty_like(looks.corners_px)
    project(factors.arrays, factors.lenses, spatial_values(state), predicted_px)
    found = outward(predicted_px)
    is_seen = np.isfinite(found).all((-1, -2), keepdims=True)
    return replace(factors, observations=replace(looks, outward=np.where(is_seen, found, looks.outward)))


@njit
def project(looks: CornerArrays, lenses: FloatArray, values: SpatialValues, out: FloatArray) -> None:
    """Sets the pixels (M, 4, 2) of all corners, before sides are seen too far out; NaN where a lens has no image."""
    looks, values = borrow(looks), borrow(values)
    axes, places = np.empty((4, 3, 3)), np.empty((4, 3))
    eye = CameraPose(np.full(6, np.nan), np.empty((3, 3)), np.empty((3, 3)))
    for m in range(len(looks.pose)):
        eyes_of(looks, values, m, eye, axes, places)
        tag, lens = looks.tag[m], lenses[looks.camera[m]]
        half = 0.5 * looks.side_m[m] * (1.0 + values.calibration[looks.scale_parameter[m]])
        focal, R = 1.0 + values.calibration[looks.focal_parameter[m]], values.turns[tag]
        for k in range(4):
            u = -half if k == 0 or k == 3 else half
            v = half if k < 2 else -half
            x = values.tags[tag, 0] + R[0, 0] * u + R[0, 1] * v - places[k, 0]
            y = values.tags[tag, 1] + R[1, 0] * u + R[1, 1] * v - places[k, 1]
            z = values.heights_m[tag] + R[2, 0] * u + R[2, 1] * v - places[k, 2]
            W = axes[k]
            px, py, _, _, _, _, _ = distort(
                lens,
                W[0, 0] * x + W[0, 1] * y + W[0, 2] * z,
                W[1, 0] * x + W[1, 1] * y + W[1, 2] * z,
                W[2, 0] * x + W[2, 1] * y + W[2, 2] * z,
            )
            out[m, k, 0] = lens[0] * focal * px + lens[CENTRE]
            out[m, k, 1] = lens[1] * focal * py + lens[CENTRE + 1]
