"""Whether a map's covariances are honest: the normalised estimation error squared of places in it.

NEES is e' C^-1 e per dimension: 1 on average where the covariances are right (Bar-Shalom, Li, Kirubarajan, "Estimation
with Applications to Tracking and Navigation", 2001, section 5.4).

A covariance C is about errors to first order, and a long map errs in its turn: some degrees at the far end of a drive,
growing along it. What is turned by phi moves on an arc, so that two tags a metre apart come out phi^2 / 2 of a metre
nearer in map axes, where C knows their distance to a fraction of a millimetre. NEES does not depend on the coordinates
to first order, and what is not first order depends on little else. So it is taken in lengths and directions: of links
from place to place, along the tree of those whose lengths are known best. In these a map bends without stretching. C is
carried over to them at the places found, which is the same as carrying their errors back to map axes. Nothing of the
truth but the places is asked, and no error is made smaller or left out.
"""

import numpy as np
from scipy import linalg
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2


def nees_per_dim(error: FloatArray, covariance: FloatArray) -> float | None:
    """E' C^-1 e / dim of an error (n,); None without dimensions or where C is not positive definite."""
    if not len(error):
        return None
    try:
        factor = linalg.cho_factor(covariance, lower=True)
    except linalg.LinAlgError:
        return None
    return float(error @ linalg.cho_solve(factor, error)) / len(error)


def tangent_errors(found_m: FloatArray, true_m: FloatArray, covariance: FloatArray) -> FloatArray:
    """Errors (N, 2) of places as the covariance counts them; to first order they are found - true.

    Args:
        found_m: (N, 2) in the map frame, whose origin and direction are exact.
        true_m: (N, 2) likewise.
        covariance: (2N, 2N) of the places found.
    """
    found, true = (np.concatenate([places, np.zeros((1, 2))]) for places in (found_m, true_m))
    along, across = _variances(found, covariance)
    length = np.linalg.norm(found[:, None] - found[None], axis=-1)
    # Of places that may well be one the difference counts as it is. Lengths and directions are for those whose distance
    # is known to a quarter and whose direction to a radian: what is swung far round still has a length.
    has_direction = (length**2 > 16.0 * along) & (length**2 > across)
    errors = np.zeros_like(found)
    for child, parent in _tree(np.where(has_direction, along, along + across)):
        difference = found[child] - found[parent], true[child] - true[parent]
        of_link = _polar_error(*difference) if has_direction[child, parent] else difference[0] - difference[1]
        errors[child] = errors[parent] + of_link
    return errors[:-1]


def _polar_error(found: FloatArray, true: FloatArray) -> FloatArray:
    """(2,) what is wrong in the length and in the direction of a difference (2,), along and across the one found."""
    length, true_length = float(np.linalg.norm(found)), float(np.linalg.norm(true))
    if not true_length:
        return found  # no direction at all
    along = found / length
    across = np.array([-along[1], along[0]])
    turn = se2.wrap_angle(np.arctan2(found[1], found[0]) - np.arctan2(true[1], true[0]))
    error: FloatArray = (length - true_length) * along + length * turn * across
    return error


def _variances(places_m: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N + 1, N + 1) of differences between places, along and across each; the last place is the origin, and exact."""
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


def _tree(variance: FloatArray) -> list[tuple[int, int]]:
    """(child, parent) for each place but the last one, parents first: the tree from there with the least variances."""
    # Two places that are one, as far as the map can tell, would be no link at all, and no more so what is below 1e-8.
    sigma = np.sqrt(np.maximum(variance / max(float(variance.max()), 1e-300), 1e-12))
    np.fill_diagonal(sigma, 0.0)
    order, parents = breadth_first_order(minimum_spanning_tree(sigma), len(sigma) - 1, directed=False)
    return [(int(child), int(parents[child])) for child in order[1:]]
