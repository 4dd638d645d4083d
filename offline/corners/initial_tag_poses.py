"""Where tags hang to begin with: the poses that a few looks allow, of which the looks from all around choose.

A tag seen in one picture has two poses that explain it nearly as well. From the side the wrong one gives itself away,
so each is taken for true in turn, fitted to looks from along the drive with the robot's poses held, and the best kept.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.corners.factors import CornerFactors, SpatialState, spatial_values
from groundsbot.offline.corners.kernels.initial_tag_poses import POSES, SAME_RAD, candidate_poses, fit, rays_of
from groundsbot.offline.corners.kernels.view_selection import POSED_LOOKS, judges, observations_by_tag, select_views
from groundsbot.offline.corners.problem import CORNER_LOSS, CornerProblem


def with_initial_tag_poses(problem: CornerProblem, state: SpatialState) -> SpatialState:
    """The state with every tag that was seen where its looks put it, the robots' poses held.

    Args:
        problem: which tags were seen from where.
        state: its turns and heights do not count where no tag has them yet (NaN).
    """
    tags, places, turns, losses = _fit_poses(problem.corners, state)
    order = np.lexsort((losses, tags))
    first = order[np.unique(tags[order], return_index=True)[1]]
    first = first[np.isfinite(losses[first])]
    return _with_tag_poses(state, tags[first], places[first], turns[first])


def alternative_states(problem: CornerProblem, state: SpatialState, tag: int) -> list[SpatialState]:
    """The state with one tag in each other way that single looks and its looks from all around allow.

    The robots' poses are held: a solve from there tells what each is worth.
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
    """The state with each tag in the way that costs its pictures least, as they stand on a floor that is not level.

    Where tags are hung first, pictures are taken for level: tilts of 0.3 degrees move corners by more than the two
    planar poses of a far tag differ. The robots' poses are held.

    Args:
        problem: of some uneven floor.
        state: its solution.
    """
    picture, n = problem.pictures
    looks = problem.corners.observations
    for tag in np.unique(looks.tag).tolist():
        shown = np.zeros(n, dtype=np.bool_)
        shown[picture[looks.tag == tag]] = True
        own = replace(problem, corners=replace(problem.corners, observations=looks.where(shown[picture])))
        state = min([state, *alternative_states(own, state, tag)], key=own.corners_cost)
    return state


def _with_tag_poses(state: SpatialState, tags: IntArray, places: FloatArray, turns: FloatArray) -> SpatialState:
    places_m, heights_m, all_turns = state.tags.copy(), state.heights_m.copy(), state.turns.copy()
    places_m[tags], heights_m[tags], all_turns[tags] = places[:, :2], places[:, 2], turns
    return replace(state, tags=places_m, heights_m=heights_m, turns=all_turns)


def _fit_poses(factors: CornerFactors, state: SpatialState) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """(C,) tags, with places (C, 3) and turns (C, 3, 3) fitted to looks from along the drive, and their losses (C,).

    They begin where single looks put them, and where they hang in the state if they do.
    """
    tag, values = factors.observations.tag, spatial_values(state)
    by_tag = observations_by_tag(tag, len(state.tags))
    chosen = np.empty((len(state.tags), POSED_LOOKS), dtype=np.int64)
    select_views(factors.observations.corners_px, by_tag, chosen)
    chosen = chosen[chosen >= 0]
    places, turns = np.empty((len(chosen), POSES, 3)), np.empty((len(chosen), POSES, 3, 3))
    candidate_poses(factors.arrays, values, chosen, _rays(factors, chosen), places, turns)
    own = np.flatnonzero(
        (np.diff(by_tag.begin) > 0) & np.isfinite(state.turns).all((-1, -2)) & np.isfinite(state.heights_m)
    )
    hung = np.column_stack([state.tags, state.heights_m])[own]
    tags = np.concatenate([np.repeat(tag[chosen], POSES), own])
    places, turns = (
        np.concatenate([places.reshape(-1, 3), hung]),
        np.concatenate([turns.reshape(-1, 3, 3), state.turns[own]]),
    )
    losses = fit(factors.arrays, factors.lenses, CORNER_LOSS, values, judges(by_tag), tags, places, turns)
    return tags, places, turns, losses


def _rays(factors: CornerFactors, which: IntArray) -> FloatArray:
    """Unit rays (C, 4, 3) to the corners of some looks; NaN where a lens has none."""
    rays = np.empty((len(which), 4, 3))
    rays_of(factors.arrays, factors.lenses, which, rays)
    for i in np.flatnonzero(~np.isfinite(rays).all((-1, -2))).tolist():  # where the quick way failed
        camera = factors.cameras[factors.observations.camera[which[i]]]
        rays[i] = camera.unproject(factors.observations.corners_px[which[i]])
    return rays
