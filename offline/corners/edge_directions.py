"""Edge normals of tags in images, for the shift of edges (`groundsbot.calib.tags.edges`), from predicted corners.

Normals from detected corners are correlated with the noise of these corners, which biases the estimated shift. Each
corner contributes 2 sigma^2 divided by the length of the side, always with the same sign, and their sum reached one
sigma of the tag scale. Predicted corners have the noise of one solution only.
"""

from dataclasses import replace

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.tags import outward
from groundsbot.offline.corners.factors import CornerFactors, SpatialState, spatial_values
from groundsbot.offline.corners.kernels.initial_tag_poses import camera_poses_of
from groundsbot.offline.corners.kernels.lens import CENTRE, distort
from groundsbot.offline.corners.kernels.view import CameraPose, CornerObservations, SpatialValues
from groundsbot.offline.foundation import borrow, njit


def with_predicted_facings(factors: CornerFactors, state: SpatialState) -> CornerFactors:
    """Return factors whose sides have the outward normals of the predicted corners.

    Those of a tag stay unchanged where its lens has no image of a corner.
    """
    detections = factors.observations
    predicted_px = np.empty_like(detections.corners_px)
    project(factors.observations, factors.lenses, spatial_values(state), predicted_px)
    found = outward(predicted_px)
    is_seen = np.isfinite(found).all((-1, -2), keepdims=True)
    return replace(factors, observations=detections._replace(outward=np.where(is_seen, found, detections.outward)))


@njit
def project(detections: CornerObservations, lenses: FloatArray, values: SpatialValues, out: FloatArray) -> None:
    """Set the predicted pixels (M, 4, 2) of all corners without the shift of edges; NaN where a lens has no image."""
    detections, values = borrow(detections), borrow(values)
    axes, places = np.empty((4, 3, 3)), np.empty((4, 3))
    eye = CameraPose(np.full(6, np.nan), np.empty((3, 3)), np.empty((3, 3)))
    for m in range(len(detections.pose)):
        camera_poses_of(detections, values, m, eye, axes, places)
        tag, lens = detections.tag[m], lenses[detections.camera[m]]
        half = 0.5 * detections.side_m[m] * (1.0 + values.calibration[detections.scale_parameter[m]])
        focal, R = 1.0 + values.calibration[detections.focal_parameter[m]], values.turns[tag]
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
