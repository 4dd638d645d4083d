"""Information of detections about the attitude and height of their images, at a state."""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.factors import SpatialState, spatial_values
from groundsbot.offline.corners.kernels.linearisation import N_DETECTION, add_attitude_noise
from groundsbot.offline.corners.problem import CORNER_LOSS, CornerProblem

_BY_THE_LOSS: Final = np.zeros(0)  # weights of the loss


class Pictures(NamedTuple):
    """The normal equations of P images for roll, pitch (rad) and height (m) of the base, with derivatives B.

    Attributes:
        picture: (M,) image of each detection.
        weight: (M,) robust weight of each detection.
        own: (P, 3, 3) B^T W B of each image.
        force: (P, 3) B^T W r of each image if level.
        coupled: (M, 3, 19) B^T W J with the columns of each detection.
    """

    picture: IntArray
    weight: FloatArray
    own: FloatArray
    force: FloatArray
    coupled: FloatArray

    @property
    def outliers(self) -> float:
        """Share of detections beyond the threshold of their loss."""
        return float((self.weight < 1.0).mean())


def pictures_at(problem: CornerProblem, state: SpatialState) -> Pictures:
    """Return the normal equations of all images at a state, with robust weights at their estimated roll and pitch."""
    picture, n = problem.pictures
    corners, n_detections = problem.corners, problem.corners.observations.n
    weight = _BY_THE_LOSS
    if problem.attitude_sigmas.any():
        linearised, by_attitude = corners.linearise(state, problem.columns)
        weight = problem.weigh(linearised.residual, by_attitude).weight
    found = Pictures(
        picture, np.empty(n_detections), np.zeros((n, 3, 3)), np.zeros((n, 3)), np.empty((n_detections, 3, N_DETECTION))
    )
    add_attitude_noise(corners.observations, corners.lenses, CORNER_LOSS, spatial_values(state), weight, *found)
    return found
