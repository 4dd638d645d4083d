"""First-order bias of tags and calibration that are estimated jointly with poses.

A joint solve maximises the likelihood over poses instead of integrating them out. There are as many poses as
observations, which biases the parameters that all of them share (Neyman and Scott, "Consistent estimates based on
partially consistent observations", 1948). With poses x, tags and calibration y, and H_xx the information of the poses
alone, the integrated likelihood has the additional term -1/2 log det H_xx(x, y) (Laplace's approximation; Cox and Reid,
"Parameter orthogonality and approximate conditional inference", 1987). Its gradient q moves the optimum by -H^-1 q.

This assumes wheel slip without bias, and white noise with the assumed sigmas. Correlated errors have larger assumed
sigmas than their scatter, which reduces the bias. The share of the bias that is present is therefore modelled as
uniform between 0 and 1: the calibration of a finished map is corrected by half of the bias (`correct_bias`), and the
variance of the share is in its covariance.
"""

from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot import CAMERA_PARAMETERS, TIME_OFFSET
from groundsbot.offline.sam.arrowhead.build import build_arrowhead
from groundsbot.offline.sam.chain_covariances import chain_covariances
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    Columns,
    ObservationFactors,
    State,
)
from groundsbot.offline.sam.linearisation.robust_losses import losses_and_weights
from groundsbot.offline.sam.minimisation import factorise
from groundsbot.offline.sam.solver import PLAIN_SQUARES, Problem, Solution, solve

_TIME: Final = CAMERA_PARAMETERS.index(TIME_OFFSET)
# Mean and variance of a uniform distribution between 0 and 1.
MEAN_SHARE: Final = 0.5
SHARE_VARIANCE: Final = 1.0 / 12.0
# Largest change of the bias by its own correction, relative to its length in sigmas, at which first order still holds.
_MOST_CHANGE: Final = 0.25
# Largest predicted decrease of a converged solve for a corrected calibration, in squared sigmas: a thousandth of a
# sigma. Thousands of robust losses may keep it from less for hundreds of steps.
_COST_TOLERANCE: Final = 1e-6
_ROWS_AT_ONCE: Final = 256
_OBSERVATIONS_AT_ONCE: Final = 2**15


def bias_of(solution: Solution) -> FloatArray:
    """Return the change (n,) of the estimate, in the tangent space, from integrating out the poses."""
    return _bias(solution, solution.problem.columns.poses >= 0)


def _bias_of_calibration(solution: Solution) -> FloatArray:
    """Return the change (k,) of the free calibration from integrating out all poses.

    It depends on no frame, so that the pose that fixes the frame is integrated out as well.
    """
    columns = solution.problem.columns
    every = np.ones(columns.poses.shape, dtype=np.bool_)
    return _bias(solution, every)[columns.calibration[columns.calibration >= 0]]


def _bias(solution: Solution, is_free: BoolArray) -> FloatArray:
    """Return the change (n,) of the estimate from integrating out the free ones of the pose variables (P, 3)."""
    if not len(solution.problem.observations.tag):
        return np.zeros(solution.problem.columns.n)
    weights = _weights(solution)
    gradient = _gradient(
        solution.problem, solution.state, _conditional_covariances(solution, weights, is_free), weights
    )
    return -solution.factorisation.solve(gradient)


def correct_bias(solution: Solution, scatter: float) -> Solution:
    """Return the solution with the mean share of the bias of its calibration removed, where first order suffices.

    The bias of measurements that scatter less than assumed is smaller in proportion to their variance.

    Poses and tags are solved again for the corrected calibration: they follow it on arcs, along which a step in the
    tangent space would not keep them together. If the bias is another one there, as of a calibration that is hardly
    determined, its linearisation does not hold, and the solution is returned as it is; so it is where the second solve
    does not converge.

    Args:
        solution: solution at its optimum.
        scatter: variance of the measurements relative to the assumed one; at most 1 is used.
    """
    columns, share = solution.problem.columns, MEAN_SHARE * min(1.0, scatter)
    free = columns.calibration >= 0
    if not free.any() or share == 0.0:
        return solution
    before = replace(solution)  # its factorisation ends with it
    bias = _bias_of_calibration(before)
    information = np.linalg.inv(before.covariance(columns.calibration[free]))
    del before
    calibration = solution.state.calibration.copy()
    calibration[free] += share * bias
    again = solve(
        _with_fixed_calibration(solution.problem),
        State(solution.state.poses, solution.state.tags, calibration),
        _COST_TOLERANCE,
        losses=solution.losses,
    )
    state, converged = again.state, again.converged
    del again  # its work arrays end with it
    if not converged:
        return solution
    costs = (*solution.costs, solution.problem.cost(state, solution.losses))
    corrected = replace(solution, state=state, costs=costs, bias_share=share)
    change = _bias_of_calibration(corrected) - bias
    is_linear = change @ information @ change <= _MOST_CHANGE**2 * (bias @ information @ bias)
    return corrected if is_linear else solution


def _with_fixed_calibration(problem: Problem) -> Problem:
    """Return the problem with all calibration parameters fixed; their columns are the last."""
    columns, n = problem.columns, int((problem.columns.calibration >= 0).sum())
    fixed = replace(columns, calibration=np.full_like(columns.calibration, -1), n=columns.n - n)
    return replace(problem, columns=fixed, prior=CalibrationPrior(problem.prior.sigma))


def covariance_with_bias(
    solution: Solution, columns: IntArray, first: int = 0, change: FloatArray | None = None
) -> FloatArray:
    """Return the joint covariance (k, k) of k columns of the tangent vector, with the bias; 0 where fixed (-1).

    Columns of the covariance before `first` are left out; `change` is what `bias_of` returns, where it is known.

    The mean square of the share of the bias that remains is in it: of the whole share before `correct_bias`, and of its
    scatter about the mean after.
    """
    change = bias_of(solution) if change is None else change
    bias = np.where(columns >= 0, np.append(change, 0.0)[columns], 0.0)
    remaining = (MEAN_SHARE - solution.bias_share) ** 2 + SHARE_VARIANCE
    covariance = solution.covariance(columns, first)
    for begin in range(0, len(columns), _ROWS_AT_ONCE):  # of thousands of tags a copy takes hundreds of MiB
        rows = slice(begin, begin + _ROWS_AT_ONCE)
        covariance[rows] += remaining * np.outer(bias[rows], bias[first:])
    return covariance


def cost_of_bias(apart: Solution, together: Solution) -> float:
    """Return the cost, in squared sigmas, of a calibration difference that is explained by the biases.

    The difference between two estimates is weighted by the information of the first. Any share between 0 and 1 of the
    difference between their biases may be in it; the share that explains most is used.

    Args:
        apart: solution of windows that share the calibration only.
        together: solution of the same observations as one map.
    """
    columns = apart.problem.columns.calibration
    free = columns >= 0
    if not free.any():
        return 0.0
    information = np.linalg.inv(apart.covariance(columns[free]))
    difference = (apart.state.calibration - together.state.calibration)[free]
    bias = bias_of(apart)[columns[free]] - bias_of(together)[together.problem.columns.calibration[free]]
    weighted = information @ bias
    share = np.clip(-(difference @ weighted) / max(float(bias @ weighted), np.finfo(np.float64).tiny), 0.0, 1.0)
    remaining = difference + share * bias
    return max(0.0, float(difference @ information @ difference - remaining @ information @ remaining))


def _weights(solution: Solution) -> FloatArray:
    """Return the robust weights (M,) of the observations."""
    _, weights = losses_and_weights(
        solution.losses.observations, solution.problem.observations.residual(solution.state)
    )
    return weights


def _conditional_covariances(solution: Solution, weights: FloatArray, is_free: BoolArray) -> FloatArray:
    """Return the covariances (P, 3, 3) of the poses given tags and calibration; 0 where they are not free.

    Segments are then independent chains but for measured distances and starts.
    """
    problem, state = solution.problem, solution.state
    if not len(problem.measured):
        loss = solution.losses.observations._replace(least_curvature=1.0)
        return chain_covariances(problem.arrowhead, state, loss, is_free)
    observations = replace(
        problem.observations, whitening=problem.observations.whitening * np.sqrt(weights)[:, None, None]
    )
    poses = np.where(is_free, np.cumsum(is_free).reshape(is_free.shape) - 1, -1)
    alone = Columns(poses, np.full(state.tags.shape, -1), np.full(len(state.calibration), -1), int(is_free.sum()))
    arrowhead = build_arrowhead(problem.odometry, observations, problem.prior, alone, problem.measured)
    system, _ = arrowhead.linearise(state, *PLAIN_SQUARES)
    factorisation, _ = factorise(arrowhead, system, 0.0)
    return factorisation.pose_covariances(np.arange(len(poses)))


class _ObservationGradients(NamedTuple):
    """The contribution of each of M observations to the gradient of 1/2 log det H_xx.

    Attributes:
        by_place: (M, 2) derivative with respect to the tag's position in base, for a fixed mount.
        by_sensor: (M, 2) part of `by_place` through the position relative to the sensor.
        by_yaw: (M,) derivative with respect to the sensor's yaw.
        by_scale: (M,) derivative with respect to the tag scale.
        by_time: (M,) derivative with respect to the time offset.
        place_by_pose: (M, 2, 3) derivative A of the tag's position in base by the pose.
        place_m: (M, 2) position of the tag in base.
        mount_m: (M, 2) position of the sensor in base.
    """

    by_place: FloatArray
    by_sensor: FloatArray
    by_yaw: FloatArray
    by_scale: FloatArray
    by_time: FloatArray
    place_by_pose: FloatArray
    place_m: FloatArray
    mount_m: FloatArray


def _gradient(problem: Problem, state: State, covariances: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the gradient (n,) of 1/2 log det H_xx in the tangent space.

    Odometry contributes only through the wheel scale, which makes the result invariant to a common scale of poses,
    tags, mount and wheels.
    """
    columns, wheel_scale = problem.columns, np.zeros(len(state.poses), dtype=np.int64)
    for end in (0, 1):
        wheel_scale[problem.odometry.first + end] = problem.odometry.parameters[:, 0]
    gradient = np.zeros(columns.n + 1)  # the last entry collects fixed columns
    for begin in range(0, len(weights), _OBSERVATIONS_AT_ONCE):  # those of a fleet take a gigabyte together
        some = slice(begin, begin + _OBSERVATIONS_AT_ONCE)
        observations = problem.observations.part(some)
        each = _observation_gradients(observations, state, covariances, weights[some])
        theta = state.poses[observations.pose, 2]
        in_map = se2.apply(np.stack([np.zeros_like(theta), np.zeros_like(theta), theta], axis=-1), each.by_place)
        by_tag_scale = each.by_scale * (1.0 + state.calibration[observations.scale_parameter])
        by_lengths = (each.by_place * each.place_m).sum(axis=1) - (each.by_sensor * each.mount_m).sum(axis=1)
        for at, values in (
            (columns.poses[observations.pose], np.einsum("mi,mij->mj", each.by_place, each.place_by_pose)),
            (columns.tags[observations.tag], in_map),
            (columns.calibration[observations.mount_parameters[:, :2]], -each.by_sensor),
            (columns.calibration[observations.mount_parameters[:, 2]], each.by_yaw),
            (columns.calibration[observations.scale_parameter], each.by_scale),
            (columns.calibration[observations.camera_parameters[:, _TIME]], each.by_time),
            (columns.calibration[wheel_scale[observations.pose]], -by_lengths - by_tag_scale),
        ):
            np.add.at(gradient, at, values)
    return gradient[:-1]


def _observation_gradients(
    observations: ObservationFactors, state: State, covariances: FloatArray, weights: FloatArray
) -> _ObservationGradients:
    """Return the gradients of w/2 tr(P K), the contribution of each observation.

    P is the information about the tag's position u in base, at distance r and direction psi from the sensor, and K the
    covariance of that position due to the pose:

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
    K = by_pose @ covariance @ by_pose.swapaxes(-1, -2)
    K_turned = turned.swapaxes(-1, -2) @ K @ turned
    (k11, k12), (_, k22) = np.moveaxis(K_turned, 0, -1)
    (i11, i12), (_, i22) = np.moveaxis(own_information, 0, -1)
    half = 0.5 * weights / scale**2
    by_psi = half * 2.0 * (i11 * k12 + i12 * (k22 - k11) - i22 * k12)
    by_distance = np.where(polar, -half * 2.0 * (i12 * k12 + i22 * k22) / distance, 0.0)
    # P depends on direction and distance from the sensor, K on the position in base.
    across = turned[..., 1] / distance[:, None]
    by_sensor = np.where(polar[:, None], by_psi[:, None] * across + by_distance[:, None] * along, 0.0)
    by_angle = np.einsum("mij,mjk,mk->mi", information, by_pose, covariance[..., 2])
    by_place = by_sensor + weights[:, None] * np.stack([-by_angle[:, 1], by_angle[:, 0]], axis=-1)
    # A larger scale shortens the range in nominal tag sizes, and the terms with 1 / r, at a given position.
    by_scale = np.where(
        polar,
        -2.0 * (half / scale) * (i11 * k11 + i12 * k12),
        -2.0 * (half / scale) * (i11 * k11 + 2.0 * i12 * k12 + i22 * k22),
    )
    by_time = -2.0 * half * np.einsum("mij,mj,mjk,mki->m", K_turned, own, omega, _rates_by_place(observations, range_))
    return _ObservationGradients(
        by_place, by_sensor, np.where(polar, 0.0, by_psi), by_scale, by_time, by_pose, place, mount[:, :2]
    )


def _rates_by_place(observations: ObservationFactors, range_m: FloatArray) -> FloatArray:
    """Return (M, 2, 2) the derivative of observations' rates with respect to the tag's position relative to the sensor.

    A camera that turns with the base at w changes range and bearing by

        dr/dt = -v_along,  dpsi/dt = -v_across / r - w

    with its velocity v along and across the line of sight; x and y by -v + (w y, -w x).

    Args:
        observations: M, with the rates in `by_camera`.
        range_m: (M,) where polar.

    Returns:
        By the position along and across the line of sight, or along x and y.
    """
    rates, turning = observations.by_camera[..., _TIME], observations.turning_rad_s
    found = np.zeros((len(range_m), 2, 2))
    minus_v_across = range_m * (rates[:, 1] + turning)
    found[:, 0, 1] = np.where(observations.polar, minus_v_across / range_m, turning)
    found[:, 1, 0] = np.where(observations.polar, -minus_v_across / range_m**2, -turning)
    found[:, 1, 1] = np.where(observations.polar, -rates[:, 0] / range_m**2, 0.0)
    return found
