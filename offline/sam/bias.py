"""Bias of what is estimated together with poses, to first order.

A joint solve maximises the likelihood over poses instead of integrating them out. There are as many poses as
observations, so this biases what all of them share (Neyman and Scott, "Consistent estimates based on partially
consistent observations", 1948). With poses x, tags and calibration y, and H_xx the information of the poses alone, the
integrated likelihood has another term, -1/2 log det H_xx(x, y) (Laplace's approximation; Cox and Reid, "Parameter
orthogonality and approximate conditional inference", 1987). Its gradient q moves the optimum by -H^-1 q.

This holds where wheels slip at random about what they count, and noise is white and as large as assumed. Errors that
last are counted with larger sigmas than they scatter by, and then the bias is less. The estimate is therefore not
corrected: of three recordings with known landmarks (MRCLAM sets 2, 4 and 9) it would be worse by 15 % in shape. Any
share of the bias between none and all is taken as equally likely.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.sam.factors.odometry_and_observations import Columns, ObservationFactors, State
from groundsbot.offline.sam.linearisation.robust_losses import losses_and_weights
from groundsbot.offline.sam.solver import PLAIN_SQUARES, Problem, Solution, factorise

# Of a share that is uniform between 0 and 1.
MEAN_SHARE: Final = 0.5
SHARE_VARIANCE: Final = 1.0 / 12.0
_SHARE_SQUARED: Final = MEAN_SHARE**2 + SHARE_VARIANCE


def bias_of(solution: Solution) -> FloatArray:
    """Return (n,) by how much the estimate changes in the tangent space when poses are integrated out."""
    weights = _weights(solution)
    gradient = _gradient(solution.problem, solution.state, _conditional_covariances(solution, weights), weights)
    return -solution.factorisation.solve(gradient)


def covariance_with_bias(solution: Solution, columns: IntArray) -> FloatArray:
    """Return the joint covariance (k, k) of k columns of the tangent vector, bias included; 0 where held (-1)."""
    bias = np.where(columns >= 0, np.append(bias_of(solution), 0.0)[columns], 0.0)
    return solution.covariance(columns) + _SHARE_SQUARED * np.outer(bias, bias)


def cost_of_bias(apart: Solution, together: Solution) -> float:
    """Return the cost, in squared sigmas, of the difference in calibration that biases explain.

    The difference between the two estimates, weighed by the information of the first, may contain any share of the
    difference between their biases. The share that explains most of it is taken.

    Args:
        apart: windows, which share the calibration only.
        together: the same observations as one map.
    """
    columns = apart.problem.columns.calibration
    free = columns >= 0
    if not free.any():
        return 0.0
    information = np.linalg.inv(apart.covariance(columns[free]))
    difference = (apart.state.calibration - together.state.calibration)[free]
    bias = bias_of(apart)[columns[free]] - bias_of(together)[together.problem.columns.calibration[free]]
    weighed = information @ bias
    share = np.clip(-(difference @ weighed) / max(float(bias @ weighed), np.finfo(np.float64).tiny), 0.0, 1.0)
    left = difference + share * bias
    return max(0.0, float(difference @ information @ difference - left @ information @ left))


def _weights(solution: Solution) -> FloatArray:
    """Return (M,) robust weights of the observations."""
    _, weights = losses_and_weights(
        solution.losses.observations, solution.problem.observations.residual(solution.state)
    )
    return weights


def _conditional_covariances(solution: Solution, weights: FloatArray) -> FloatArray:
    """Return (P, 3, 3) of the poses where tags and calibration are known."""
    problem = solution.problem
    columns = problem.columns
    free = columns.poses >= 0
    poses = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1)
    alone = Columns(poses, np.full_like(columns.tags, -1), np.full_like(columns.calibration, -1), int(free.sum()))
    observations = problem.observations.whitening * np.sqrt(weights)[:, None, None]
    held = replace(problem, columns=alone, observations=replace(problem.observations, whitening=observations))
    system, _ = held.arrowhead.linearise(solution.state, *PLAIN_SQUARES)
    factorisation, _ = factorise(held.arrowhead, system, 0.0)  # a drive without tags is not determined
    return factorisation.pose_covariances(np.arange(len(poses)))


class _ObservationGradients(NamedTuple):
    """What each of M observations adds to the gradient of 1/2 log det H_xx.

    Attributes:
        by_place: (M, 2) by the tag's place in base, with the mount held.
        by_sensor: (M, 2) the part of it that comes from the place relative to the sensor.
        by_yaw: (M,) by the sensor's yaw.
        by_scale: (M,) by the tag scale.
        place_by_pose: (M, 2, 3) derivative of the tag's place in base by the pose: A.
        place_m: (M, 2) in base.
        mount_m: (M, 2) of the sensor in base.
    """

    by_place: FloatArray
    by_sensor: FloatArray
    by_yaw: FloatArray
    by_scale: FloatArray
    place_by_pose: FloatArray
    place_m: FloatArray
    mount_m: FloatArray


def _gradient(problem: Problem, state: State, covariances: FloatArray, weights: FloatArray) -> FloatArray:
    """Return (n,) gradient of 1/2 log det H_xx in the tangent space.

    Odometry adds nothing but by the wheels' scale: scaling poses, tags, mount and wheels alike must not count.
    """
    observations, columns = problem.observations, problem.columns
    each = _observation_gradients(problem.observations, state, covariances, weights)
    theta = state.poses[observations.pose, 2]
    in_map = se2.apply(np.stack([np.zeros_like(theta), np.zeros_like(theta), theta], axis=-1), each.by_place)
    by_tag_scale = each.by_scale * (1.0 + state.calibration[observations.scale_parameter])
    by_lengths = (each.by_place * each.place_m).sum(axis=1) - (each.by_sensor * each.mount_m).sum(axis=1)
    wheel_scale = np.zeros(len(state.poses), dtype=np.int64)
    for end in (0, 1):
        wheel_scale[problem.odometry.first + end] = problem.odometry.parameters[:, 0]
    gradient = np.zeros(columns.n + 1)  # the last one takes what is held
    for at, values in (
        (columns.poses[observations.pose], np.einsum("mi,mij->mj", each.by_place, each.place_by_pose)),
        (columns.tags[observations.tag], in_map),
        (columns.calibration[observations.mount_parameters[:, :2]], -each.by_sensor),
        (columns.calibration[observations.mount_parameters[:, 2]], each.by_yaw),
        (columns.calibration[observations.scale_parameter], each.by_scale),
        (columns.calibration[wheel_scale[observations.pose]], -by_lengths - by_tag_scale),
    ):
        np.add.at(gradient, at, values)
    return gradient[:-1]


def _observation_gradients(
    observations: ObservationFactors, state: State, covariances: FloatArray, weights: FloatArray
) -> _ObservationGradients:
    """Return the gradients of w/2 tr(P K), which each observation adds.

    P is the information on the tag's place in base (u, at distance r and direction psi from the sensor), and K the
    covariance of that place by the pose:

        K = A C A^T,  A = [-I, (u_y, -u_x)^T],   P = R(psi) diag(1, 1/r) Omega diag(1, 1/r) R(psi)^T / (1 + tag scale)^2
    """
    mount = observations.mount + state.calibration[observations.mount_parameters]
    scale = 1.0 + state.calibration[observations.scale_parameter]
    place = se2.apply(se2.inverse(state.poses[observations.pose]), state.tags[observations.tag])
    from_mount = place - mount[:, :2]
    distance = np.maximum(np.hypot(from_mount[:, 0], from_mount[:, 1]), 1e-6)
    polar = observations.polar
    psi = np.where(polar, np.arctan2(from_mount[:, 1], from_mount[:, 0]), mount[:, 2])
    range_ = np.where(polar, distance / scale, 1.0)
    along = np.stack([np.cos(psi), np.sin(psi)], axis=-1)
    turned = np.stack([along, np.stack([-along[:, 1], along[:, 0]], axis=-1)], axis=-1)  # R(psi)
    omega = observations.whitening.swapaxes(-1, -2) @ observations.whitening
    own = np.stack([np.ones_like(range_), 1.0 / range_], axis=-1)
    own_information = omega * own[:, :, None] * own[:, None, :]
    information = turned @ own_information @ turned.swapaxes(-1, -2) / (scale**2)[:, None, None]
    covariance = covariances[observations.pose]
    by_pose = np.zeros((len(place), 2, 3))  # A
    by_pose[:, 0, 0] = by_pose[:, 1, 1] = -1.0
    by_pose[:, 0, 2], by_pose[:, 1, 2] = place[:, 1], -place[:, 0]
    of_place = by_pose @ covariance @ by_pose.swapaxes(-1, -2)  # K
    (k11, k12), (_, k22) = np.moveaxis(turned.swapaxes(-1, -2) @ of_place @ turned, 0, -1)
    (i11, i12), (_, i22) = np.moveaxis(own_information, 0, -1)
    half = 0.5 * weights / scale**2
    by_psi = half * 2.0 * (i11 * k12 + i12 * (k22 - k11) - i22 * k12)
    by_distance = np.where(polar, -half * 2.0 * (i12 * k12 + i22 * k22) / distance, 0.0)
    # The information changes with the direction and distance from the sensor, the covariance with the place in base.
    across = turned[..., 1] / distance[:, None]
    by_sensor = np.where(polar[:, None], by_psi[:, None] * across + by_distance[:, None] * along, 0.0)
    pulled = np.einsum("mij,mjk,mk->mi", information, by_pose, covariance[..., 2])
    by_place = by_sensor + weights[:, None] * np.stack([-pulled[:, 1], pulled[:, 0]], axis=-1)
    # At a given place the range by the tags' stated size is less by the scale, and so are the terms with 1 / r.
    by_scale = np.where(
        polar,
        -2.0 * (half / scale) * (i11 * k11 + i12 * k12),
        -2.0 * (half / scale) * (i11 * k11 + 2.0 * i12 * k12 + i22 * k22),
    )
    return _ObservationGradients(
        by_place, by_sensor, np.where(polar, 0.0, by_psi), by_scale, by_pose, place, mount[:, :2]
    )
