"""Calibration and how tags hang fitted to each other, the robots' poses held, before a solve moves all at once.

How a camera sits on its robot, and above all how it looks up or down, corners tell far better than the floor did. What
is off there is off in all pictures at once, by tens of sigmas, and the first step of a solve of everything would go to
putting it right. A few looks of each tag settle that as well, for a tenth of the work.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.corners.factors import CornerFactors, SpatialColumns, SpatialState, spatial_values
from groundsbot.offline.corners.kernels.linearisation import add_corners
from groundsbot.offline.corners.kernels.view_selection import judges, observations_by_tag
from groundsbot.offline.corners.multifrontal.fronts import EliminationFronts, NotPositiveError, build_fronts
from groundsbot.offline.corners.multifrontal.kernels import FrontalSystem
from groundsbot.offline.corners.problem import CORNER_LOSS, CornerProblem, columns_of, prior_normal

_LOOKS: Final = 0  # among the kinds of factors


def initial_calibration(problem: CornerProblem, state: SpatialState) -> SpatialState:
    """The state after one step of tags and calibration on a few looks of each tag; as it was where that helps none.

    Args:
        problem: of which only looks and the prior of the calibration count.
        state: its tags hang.
    """
    looks = problem.corners.observations
    few = judges(observations_by_tag(looks.tag, len(state.tags))).order
    own = replace(
        problem, corners=CornerFactors(looks.where(few), problem.corners.cameras), columns=_with_held_poses(problem)
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
    """Columns of tags and calibration alone."""
    columns = problem.columns
    free = columns_of(1, columns.heights >= 0, problem.prior.sigma)
    return replace(free, poses=np.full_like(columns.poses, -1))


def _order(problem: CornerProblem) -> EliminationFronts:
    """Each tag for itself, then the calibration."""
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
    """Of looks, which come tag by tag, and of the prior; with twice their cost."""
    system, corners, kind = order.empty(is_whole=is_whole), problem.corners, order.kinds[_LOOKS]
    values, by_tag = spatial_values(state), np.arange(len(corners.observations))
    cost = add_corners(corners.arrays, corners.lenses, CORNER_LOSS, values, kind, by_tag, system)
    normal, cost_of_prior = prior_normal(problem.prior, state)
    order.add(system, _LOOKS + 1, [normal])
    return system, cost + cost_of_prior
