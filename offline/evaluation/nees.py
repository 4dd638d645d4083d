"""Consistency of a map's covariances: the normalised estimation error squared (NEES) of its positions.

NEES is e' C^-1 e per dimension: 1 on average if the covariances are right (Bar-Shalom, Li, Kirubarajan, "Estimation
with Applications to Tracking and Navigation", 2001, section 5.4).

C describes errors to first order, but heading errors of a long map are large: some degrees at the far end of a drive. A
rotation by phi moves a point on an arc, so two tags a metre apart come phi^2 / 2 m nearer to each other in map axes,
while C has their distance to a fraction of a millimetre. To first order NEES does not depend on the coordinates, and
the higher orders matter little in suitable ones. So it is computed in lengths and directions of links between
positions, along the spanning tree of the links whose lengths are most certain; a rotated part of the map changes no
length. C is propagated to these coordinates at the estimate, which equals propagating their errors back to map axes. Of
the truth only positions are used, and no error is reduced or left out.
"""

import numpy as np
from scipy import linalg
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2


def nees_per_dim(error: FloatArray, covariance: FloatArray) -> float | None:
    """E' C^-1 e / dim of an error (n,); None without dimensions or if C is not positive definite."""
    if not len(error):
        return None
    try:
        factor = linalg.cho_factor(covariance, lower=True)
    except linalg.LinAlgError:
        return None
    return float(error @ linalg.cho_solve(factor, error)) / len(error)


def link_errors(found_m: FloatArray, true_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return errors (N, 2) of positions to which the covariance applies; to first order they are found - true.

    Args:
        found_m: (N, 2) in the map frame, whose origin and direction are exact.
        true_m: (N, 2) likewise.
        covariance: (2N, 2N) of the estimated positions.
    """
    found, true = (np.concatenate([places, np.zeros((1, 2))]) for places in (found_m, true_m))
    along, across = _difference_variances(found, covariance)
    length = np.linalg.norm(found[:, None] - found[None], axis=-1)
    # Lengths and directions for links whose length has a sigma below a quarter and whose direction below a radian, so
    # that strongly rotated links keep their length; plain differences for positions that may coincide.
    has_direction = (length**2 > 16.0 * along) & (length**2 > across)
    errors = np.zeros_like(found)
    for child, parent in _minimum_variance_tree(np.where(has_direction, along, along + across)):
        difference = found[child] - found[parent], true[child] - true[parent]
        of_link = _polar_error(*difference) if has_direction[child, parent] else difference[0] - difference[1]
        errors[child] = errors[parent] + of_link
    return errors[:-1]


def _polar_error(found: FloatArray, true: FloatArray) -> FloatArray:
    """Return the error (2,) of a difference (2,) in length and direction, along and across the estimated one."""
    length, true_length = float(np.linalg.norm(found)), float(np.linalg.norm(true))
    if not true_length:
        return found  # no direction
    along = found / length
    across = np.array([-along[1], along[0]])
    turn = se2.wrap_angle(np.arctan2(found[1], found[0]) - np.arctan2(true[1], true[0]))
    error: FloatArray = (length - true_length) * along + length * turn * across
    return error


def _difference_variances(places_m: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return variances (N + 1, N + 1) of differences along and across each; the last position is the origin, exact."""
    n = len(places_m) - 1
    joint = np.zeros((n + 1, n + 1, 2, 2))
    joint[:n, :n] = covariance.reshape(n, 2, n, 2).swapaxes(1, 2)
    own = np.einsum("iiab->iab", joint)
    of_difference = own[:, None] + own[None] - joint - joint.swapaxes(0, 1)
    difference = places_m[:, None] - places_m[None]
    length = np.linalg.norm(difference, axis=-1, keepdims=True)
    unit = np.divide(difference, length, out=np.zeros_like(difference), where=length > 0.0)
    along: FloatArray = np.einsum("ija,ijab,ijb->ij", unit, of_difference, unit)
    across: FloatArray = np.einsum("ijaa->ij", of_difference) - along
    return along, across


def _minimum_variance_tree(variance: FloatArray) -> list[tuple[int, int]]:
    """Return (child, parent) of all places but the last one, parents first: the minimum spanning tree from there."""
    # scipy ignores links of zero weight and those below 1e-8.
    sigma = np.sqrt(np.maximum(variance / max(float(variance.max()), 1e-300), 1e-12))
    np.fill_diagonal(sigma, 0.0)
    order, parents = breadth_first_order(minimum_spanning_tree(sigma), len(sigma) - 1, directed=False)
    return [(int(child), int(parents[child])) for child in order[1:]]
