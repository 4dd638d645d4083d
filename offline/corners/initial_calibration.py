"""Initial calibration and tag poses, fitted jointly with fixed robot poses, before the full solve.

Corners determine the camera mount, in particular its pitch, far better than planar observations. An error of the mount
is common to all images and may be tens of sigmas, and the first step of a full solve would mainly correct it. A few
detections of each tag suffice for that, in a tenth of the time.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.corners.factors import CornerFactors, SpatialColumns, SpatialState, columns_of, spatial_values
from groundsbot.offline.corners.kernels.linearisation import add_corners
from groundsbot.offline.corners.kernels.view_selection import detections_by_tag, select_evenly
from groundsbot.offline.corners.problem import CORNER_LOSS, CornerProblem, normal_equations
from groundsbot.offline.sam import EliminationFronts, FrontalSystem, NotPositiveError, build_fronts

_DETECTIONS: Final = 0  # index of their kind


def initial_calibration(problem: CornerProblem, state: SpatialState) -> SpatialState:
    """Apply one Gauss-Newton step of tags and calibration to a few detections of each tag, if it lowers the cost.

    Args:
        problem: problem of its factors, only detections and the prior of the calibration are used.
        state: initial state with tag poses.
    """
    detections = problem.corners.observations
    few = select_evenly(detections_by_tag(detections.tag, len(state.tags))).order
    own = replace(
        problem,
        corners=CornerFactors(detections.where(few), problem.corners.cameras),
        columns=_with_held_poses(problem),
    )
    order = _order(own)
    system, cost = _system(own, order, state)
    unseen = (order.diagonal_of(system) == 0.0).astype(np.float64)
    try:
        step = -order.factorise(system, unseen).solve(system.gradient)
    except NotPositiveError:
        return state
    moved = own.retract(state, step)
    return moved if _system(own, order, moved, is_whole=False)[1] < cost else state


def _with_held_poses(problem: CornerProblem) -> SpatialColumns:
    """Return columns of tags and calibration, with fixed poses."""
    columns = problem.columns
    free = columns_of(1, columns.heights >= 0, problem.prior.sigma)
    return replace(free, poses=np.full_like(columns.poses, -1))


def _order(problem: CornerProblem) -> EliminationFronts:
    """Return an order of elimination with one node for each tag, and the calibration in the root."""
    columns = problem.columns
    n_tags = len(columns.heights)
    node_of = np.full(columns.n, n_tags, dtype=np.int64)
    for variable in (columns.tags, columns.heights[:, None], columns.turns):
        of_tag: IntArray = np.broadcast_to(np.arange(n_tags)[:, None], variable.shape)
        node_of[variable[variable >= 0]] = of_tag[variable >= 0]
    parent = np.append(np.full(n_tags, n_tags), -1)
    return build_fronts(columns.n, node_of, parent, [problem.corners.columns(columns), columns.calibration[:, None]])


def _system(
    problem: CornerProblem, order: EliminationFronts, state: SpatialState, *, is_whole: bool = True
) -> tuple[FrontalSystem, float]:
    """Return the normal equations of detections, grouped by tag, and prior, and twice their cost."""
    system, corners, kind = order.empty(is_whole=is_whole), problem.corners, order.kinds[_DETECTIONS]
    values, by_tag = spatial_values(state), np.arange(corners.observations.n)
    cost = add_corners(corners.observations, corners.lenses, CORNER_LOSS, values, kind, by_tag, system)
    normal, cost_of_prior = normal_equations(problem.prior.linearise(state, problem.columns))
    order.add(system, _DETECTIONS + 1, [normal])
    return system, cost + cost_of_prior
