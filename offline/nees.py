"""Whether a map's covariances are honest: the normalised estimation error squared of places in it.

NEES is e' C^-1 e per dimension: 1 on average where the covariances are right (Bar-Shalom, Li, Kirubarajan, "Estimation
with Applications to Tracking and Navigation", 2001, section 5.4).

A covariance C is about errors to first order, and a long map errs in its turn: some degrees at the far end of a drive,
growing along it. What is turned by phi moves on an arc, so that two tags a metre apart come out phi^2 / 2 of a metre
nearer in map axes, where C knows their distance to a fraction of a millimetre. So errors are taken in the coordinates
in which the estimate moves (T o exp(delta)): between two places, the true difference is turned by what the map is
turned there, what is left over counts as it stands, and the turn as the tangent that C knows. To first order in the
turn nothing changes; an error is neither made smaller nor left out.
"""

import numpy as np
from scipy import linalg

from calib import se2
from calib.arrays import FloatArray
from offline.result import Component
from offline.truth import Truth


def nees_per_dim(error: FloatArray, covariance: FloatArray) -> float | None:
    """E' C^-1 e / dim of an error (n,); None without dimensions or where C is not positive definite."""
    if not len(error):
        return None
    try:
        factor = linalg.cho_factor(covariance, lower=True)
    except linalg.LinAlgError:
        return None
    return float(error @ linalg.cho_solve(factor, error)) / len(error)


def errors_along_arcs(
    found_m: FloatArray, true_m: FloatArray, turn_rad: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Errors (N, 2) of places as the covariance counts them.

    They are the least squares over all pairs of places, and of each place and the frame's origin, of what each pair
    says of its difference, stiff pairs first.

    Args:
        found_m: (N, 2) in the map frame, whose origin and direction are exact.
        true_m: (N, 2) likewise.
        turn_rad: (N,) how far the map is turned at each place.
        covariance: (2N, 2N) of the places found.
    """
    n = len(found_m)
    difference, true = _differences(found_m), _differences(true_m)
    turned = np.append(turn_rad, 0.0)
    turn = 0.5 * (turned[:, None] + turned)
    cos, sin = np.cos(turn), np.sin(turn)
    left_over = difference - np.stack(
        [cos * true[..., 0] - sin * true[..., 1], sin * true[..., 0] + cos * true[..., 1]], axis=-1
    )
    said = left_over + turn[..., None] * np.stack([-difference[..., 1], difference[..., 0]], axis=-1)
    weight = _weights(covariance)
    laplacian = np.diag(weight.sum(axis=1)) - weight
    errors: FloatArray = linalg.solve(laplacian[:n, :n], (weight[..., None] * said).sum(axis=1)[:n], assume_a="pos")
    return errors


def turns_rad(component: Component, truth: Truth, T_world_map: FloatArray, places_m: FloatArray) -> FloatArray:
    """(N,) how far the map is turned at places (N, 2): the heading error of the nearest keyframe; 0 without truth."""
    positions, errors = [np.zeros((1, 2))], [np.zeros(1)]
    for run in component.runs:
        true_run = truth.runs.get(run.run)
        if true_run is not None:
            T_world_base, covered = true_run.at(run.stamps_ns)
            T_map_base = se2.between(T_world_map, T_world_base)
            positions.append(run.T_map_base[covered, :2])
            errors.append(se2.wrap_angle(run.T_map_base[:, 2] - T_map_base[:, 2])[covered])
    keyframes_m, errors_rad = np.concatenate(positions), np.concatenate(errors)
    nearest = [int(np.argmin(((keyframes_m - place) ** 2).sum(axis=1))) for place in places_m]
    turns: FloatArray = np.array([errors_rad[i] for i in nearest], dtype=np.float64)
    return turns


def _differences(places_m: FloatArray) -> FloatArray:
    """(N + 1, N + 1, 2) from place to place, the origin being the last."""
    places = np.concatenate([places_m, np.zeros((1, 2))])
    differences: FloatArray = places[:, None] - places[None]
    return differences


def _weights(covariance: FloatArray) -> FloatArray:
    """(N + 1, N + 1) inverse variances of the differences between places, the origin being the last; 0 of itself."""
    n = len(covariance) // 2
    joint = np.zeros((n + 1, n + 1))
    joint[:n, :n] = np.einsum("iaja->ij", covariance.reshape(n, 2, n, 2))
    own = np.diag(joint)
    variance: FloatArray = own[:, None] + own - 2.0 * joint
    # Two places that are one, as far as the map can tell, would weigh infinitely much.
    weight: FloatArray = 1.0 / np.maximum(variance, max(1e-12 * float(variance.max()), 1e-300))
    np.fill_diagonal(weight, 0.0)
    return weight
