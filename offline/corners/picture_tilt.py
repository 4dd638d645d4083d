"""What looks say of how their pictures stand, all but that at the solution."""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.factors import SpatialState, spatial_values
from groundsbot.offline.corners.kernels.linearisation import N_LOOK, add_attitude_noise
from groundsbot.offline.corners.problem import CORNER_LOSS, CornerProblem

_BY_THE_LOSS: Final = np.zeros(0)


class Pictures(NamedTuple):
    """The looks of P pictures by how these stand, in WOBBLE.

    Attributes:
        picture: (M,) of each look; weight: (M,) by which it counts.
        own: (P, 3, 3) B^T W B, B being derivatives by how a picture stands; force: (P, 3) B^T W r of level pictures.
        coupled: (M, 3, 19) B^T W J with each look's columns.
    """

    picture: IntArray
    weight: FloatArray
    own: FloatArray
    force: FloatArray
    coupled: FloatArray

    @property
    def outliers(self) -> float:
        """Share of looks beyond where their loss leaves the square."""
        return float((self.weight < 1.0).mean())


def pictures_at(problem: CornerProblem, state: SpatialState) -> Pictures:
    """Of all pictures at a state; how they stand by the problem's sigmas decides what a look counts."""
    picture, n = problem.pictures
    corners, n_looks = problem.corners, len(problem.corners.observations)
    weight = _BY_THE_LOSS
    if problem.attitude_sigmas.any():
        linearised, wobble = corners.linearise(state, problem.columns)
        weight = problem.weigh(linearised.residual, wobble).weight
    found = Pictures(picture, np.empty(n_looks), np.zeros((n, 3, 3)), np.zeros((n, 3)), np.empty((n_looks, 3, N_LOOK)))
    add_attitude_noise(corners.arrays, corners.lenses, CORNER_LOSS, spatial_values(state), weight, *found)
    return found
