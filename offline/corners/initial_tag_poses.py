"""Initial tag poses: candidates from single detections, selected by detections along the drive.

Two poses explain a single detection of a tag nearly equally well (planar pose ambiguity). Detections from other
directions resolve it: each candidate is fitted to detections along the drive with fixed robot poses, and the best one
is used.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.factors import CornerFactors, SpatialState, spatial_values
from groundsbot.offline.corners.kernels.initial_tag_poses import POSES, SAME_RAD, candidate_poses, fit, rays_of
from groundsbot.offline.corners.kernels.view_selection import (
    POSED_DETECTIONS,
    detections_by_tag,
    select_evenly,
    select_views,
)
from groundsbot.offline.corners.problem import CORNER_LOSS, CornerProblem


def with_initial_tag_poses(problem: CornerProblem, state: SpatialState) -> SpatialState:
    """Return the state with a pose of each detected tag, fitted to its detections with fixed robot poses.

    Args:
        problem: problem with the detections.
        state: initial state; rotations and heights of tags that have none yet are NaN.
    """
    tags, places, turns, losses = _fit_poses(problem.corners, state)
    order = np.lexsort((losses, tags))
    first = order[np.unique(tags[order], return_index=True)[1]]
    first = first[np.isfinite(losses[first])]
    return _with_tag_poses(state, tags[first], places[first], turns[first])


def alternative_states(problem: CornerProblem, state: SpatialState, tag: int) -> list[SpatialState]:
    """Return states with alternative poses of one tag, fitted to its detections with fixed robot poses.

    The alternatives are local minima of the tag's own cost, in ascending order. A full solve from each is needed to
    compare them.
    """
    own = CornerFactors(
        problem.corners.observations.where(problem.corners.observations.tag == tag), problem.corners.cameras
    )
    _, places, turns, losses = _fit_poses(own, replace(state, turns=np.full_like(state.turns, np.nan)))
    found: list[SpatialState] = []
    known = [state.turns[tag]]
    for i in np.argsort(losses, kind="stable")[: int(np.isfinite(losses).sum())].tolist():
        if all(Rotation.from_matrix(turn.T @ turns[i]).magnitude() > SAME_RAD for turn in known):
            known.append(turns[i])
            found.append(_with_tag_poses(state, np.array([tag]), places[i : i + 1], turns[i : i + 1]))
    return found


def with_alternative_tag_poses(problem: CornerProblem, state: SpatialState) -> SpatialState:
    """Replace each tag's pose by an alternative of lower cost, if there is one; robot poses stay fixed.

    A planar tag has two poses that project to nearly the same corners (planar pose ambiguity). Initial tag poses are
    chosen under the assumption of a level floor. A tilt of the robot by 0.3 degrees moves the corners of a distant tag
    by more than the two poses differ, so the choice is repeated after the robot's roll and pitch were estimated.

    Args:
        problem: problem in which roll, pitch and height of the robot are estimated: sigmas of ATTITUDE above zero.
        state: solution of the problem.

    Returns:
        The state with the chosen tag poses; the input where no alternative costs less.
    """
    picture, n = problem.pictures
    detections = problem.corners.observations
    for tag in np.unique(detections.tag).tolist():
        shown = np.zeros(n, dtype=np.bool_)
        shown[picture[detections.tag == tag]] = True
        own = replace(problem, corners=replace(problem.corners, observations=detections.where(shown[picture])))
        state = min([state, *alternative_states(own, state, tag)], key=own.corners_cost)
    return state


def _with_tag_poses(state: SpatialState, tags: IntArray, places: FloatArray, turns: FloatArray) -> SpatialState:
    places_m, heights_m, all_turns = state.tags.copy(), state.heights_m.copy(), state.turns.copy()
    places_m[tags], heights_m[tags], all_turns[tags] = places[:, :2], places[:, 2], turns
    return replace(state, tags=places_m, heights_m=heights_m, turns=all_turns)


def _fit_poses(factors: CornerFactors, state: SpatialState) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Return tags (C,), positions (C, 3) and rotations (C, 3, 3) of fitted candidates, and their losses (C,).

    Candidates start at the poses from single detections, and at those of the state where it has any.
    """
    tag, values = factors.observations.tag, spatial_values(state)
    by_tag = detections_by_tag(tag, len(state.tags))
    chosen = np.empty((len(state.tags), POSED_DETECTIONS), dtype=np.int64)
    select_views(factors.observations.corners_px, by_tag, chosen)
    chosen = chosen[chosen >= 0]
    places, turns = np.empty((len(chosen), POSES, 3)), np.empty((len(chosen), POSES, 3, 3))
    candidate_poses(factors.observations, values, chosen, _rays(factors, chosen), places, turns)
    own = np.flatnonzero(
        (np.diff(by_tag.begin) > 0) & np.isfinite(state.turns).all((-1, -2)) & np.isfinite(state.heights_m)
    )
    given = np.column_stack([state.tags, state.heights_m])[own]
    tags = np.concatenate([np.repeat(tag[chosen], POSES), own])
    places, turns = (
        np.concatenate([places.reshape(-1, 3), given]),
        np.concatenate([turns.reshape(-1, 3, 3), state.turns[own]]),
    )
    losses = fit(factors.observations, factors.lenses, CORNER_LOSS, values, select_evenly(by_tag), tags, places, turns)
    return tags, places, turns, losses


def _rays(factors: CornerFactors, which: IntArray) -> FloatArray:
    """Return unit rays (C, 4, 3) to the corners of some detections; NaN where a lens has none."""
    rays = np.empty((len(which), 4, 3))
    rays_of(factors.observations, factors.lenses, which, rays)
    for i in np.flatnonzero(~np.isfinite(rays).all((-1, -2))).tolist():  # where Newton's method failed
        camera = factors.cameras[factors.observations.camera[which[i]]]
        rays[i] = camera.unproject(factors.observations.corners_px[which[i]])
    return rays
