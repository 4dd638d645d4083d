"""Where tags hang to begin with: the poses that a few looks allow, of which the looks from all around choose.

A tag seen in one picture has two poses that explain it nearly as well. From the side the wrong one gives itself away,
so each is taken for true in turn, fitted to looks from along the drive with the robot's poses held, and the best kept.
"""

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from calib.arrays import BoolArray, FloatArray, IntArray
from calib.bundle import planar_poses
from offline.corner_factors import CornerFactors, Looks, SpatialState, spatial_values
from offline.corner_kernels import add_to_tags
from offline.corner_problem import CORNER_LOSS, CornerProblem
from offline.tag_pose import UNIT_CORNERS

_POSED_LOOKS: Final = 2  # of each tag, whose poses are tried
_JUDGING_LOOKS: Final = 8
# Upright faces are tried too, turned so far to either side: most tags hang so, and a picture without perspective may
# have no planar pose at all.
_ASIDE_RAD: Final = (-0.6, 0.6)
_STEPS: Final = 5
_SAME_RAD: Final = 0.01  # fits that end nearer than this are one
_DAMPING: Final = 1e-6
_PLACE_AND_TURN: Final = slice(3, 9)  # of a look's columns


def tags_hung(problem: CornerProblem, state: SpatialState) -> SpatialState:
    """The state with every tag that was seen where its looks put it, the robots' poses held.

    Args:
        problem: which tags were seen from where.
        state: its turns and heights do not count where no tag has them yet (NaN).
    """
    factors = problem.corners
    tags, candidates = _candidates(factors, state)
    known = np.isfinite(state.turns).all((-1, -2)) & np.isfinite(state.heights_m)
    seen = np.unique(factors.looks.tag)
    own = seen[known[seen]]
    tags = np.concatenate([tags, own])
    place = np.column_stack([state.tags, state.heights_m])
    places = np.concatenate([candidates[0], place[own]])
    turns = np.concatenate([candidates[1], state.turns[own]])
    tried = SpatialState(state.poses, places[:, :2], state.calibration, places[:, 2], turns)
    tried, losses = _fitted(_judges(factors, tags), tried)
    order = np.lexsort((losses, tags))
    first = order[np.unique(tags[order], return_index=True)[1]]
    first = first[np.isfinite(losses[first])]
    hung = tags[first]
    places_m, heights_m, all_turns = state.tags.copy(), state.heights_m.copy(), state.turns.copy()
    places_m[hung], heights_m[hung], all_turns[hung] = tried.tags[first], tried.heights_m[first], tried.turns[first]
    return replace(state, tags=places_m, heights_m=heights_m, turns=all_turns)


def hung_otherwise(problem: CornerProblem, state: SpatialState, tag: int) -> list[SpatialState]:
    """The state with one tag in each other way that single looks and its looks from all around allow.

    The robots' poses are held: a solve from there tells what each is worth.
    """
    own = CornerFactors(problem.corners.looks.where(problem.corners.looks.tag == tag), problem.corners.cameras)
    tags, (places, turns) = _candidates(own, state)
    tried, losses = _fitted(
        _judges(own, tags), SpatialState(state.poses, places[:, :2], state.calibration, places[:, 2], turns)
    )
    found: list[SpatialState] = []
    known = [state.turns[tag]]
    for i in np.argsort(losses, kind="stable")[: int(np.isfinite(losses).sum())].tolist():
        if all(Rotation.from_matrix(turn.T @ tried.turns[i]).magnitude() > _SAME_RAD for turn in known):
            known.append(tried.turns[i])
            places_m, heights_m, all_turns = state.tags.copy(), state.heights_m.copy(), state.turns.copy()
            places_m[tag], heights_m[tag], all_turns[tag] = tried.tags[i], tried.heights_m[i], tried.turns[i]
            found.append(replace(state, tags=places_m, heights_m=heights_m, turns=all_turns))
    return found


def _candidates(factors: CornerFactors, state: SpatialState) -> tuple[IntArray, tuple[FloatArray, FloatArray]]:
    """(C,) tags, with places (C, 3) and turns (C, 3, 3) in map that single looks give them."""
    looks = factors.looks
    turn, place = factors.T_map_camera(state)
    chosen = np.array([index for own in _by_tag(looks.tag) for index in _posed(own, looks.corners_px[own])], dtype=int)
    tags, places, turns = [], [], []
    for i, camera in enumerate(factors.cameras):
        own_looks = chosen[looks.camera[chosen] == i]
        for index, rays in zip(own_looks.tolist(), camera.unproject(looks.corners_px[own_looks]), strict=True):
            corners_m = np.column_stack([UNIT_CORNERS * looks.side_m[index], np.zeros(4)])
            for R_camera_tag, centre_m in planar_poses(corners_m, rays):
                tags.append(int(looks.tag[index]))
                turns.append(turn[index] @ R_camera_tag)
                places.append(turn[index] @ centre_m + place[index])
            in_map = turn[index] @ rays.mean(axis=0)
            range_m = np.linalg.norm(state.tags[looks.tag[index]] - place[index, :2])
            tags += [int(looks.tag[index])] * len(_ASIDE_RAD)
            turns += list(_upright(-in_map))
            places += [place[index] + in_map * range_m / np.hypot(in_map[0], in_map[1])] * len(_ASIDE_RAD)
    return np.array(tags, dtype=np.int64), (np.array(places).reshape(-1, 3), np.array(turns).reshape(-1, 3, 3))


def _upright(towards: FloatArray) -> FloatArray:
    """R_map_tag `[2, 3, 3]` of upright faces that look so far aside of a direction to either side."""
    yaw = np.arctan2(towards[1], towards[0]) + np.array(_ASIDE_RAD)
    cos, sin, zero, one = np.cos(yaw), np.sin(yaw), np.zeros(len(yaw)), np.ones(len(yaw))
    return np.stack([-sin, zero, cos, cos, zero, sin, zero, one, zero], axis=-1).reshape(-1, 3, 3)


def _posed(own: IntArray, corners_px: FloatArray) -> list[int]:
    """The largest look, and of those half as large the one whose picture's shape differs most from it."""
    across, up = corners_px[:, 2] - corners_px[:, 0], corners_px[:, 3] - corners_px[:, 1]
    size = np.abs(across[:, 0] * up[:, 1] - across[:, 1] * up[:, 0])
    largest = int(np.argmax(size))
    shape = (corners_px - corners_px.mean(axis=1, keepdims=True)) / np.sqrt(np.maximum(size, 1.0))[:, None, None]
    apart = np.abs(shape - shape[largest]).sum((-1, -2)) * (size > 0.5 * size[largest])
    return [int(own[largest]), int(own[np.argmax(apart)])][: max(1, min(_POSED_LOOKS, len(own)))]


def _judges(factors: CornerFactors, tags: IntArray) -> CornerFactors:
    """Looks spread over all of a tag's, once for each of the candidates (C,), whose numbers stand for tags here."""
    own_of = dict(zip(np.unique(factors.looks.tag).tolist(), _by_tag(factors.looks.tag), strict=True))
    index, candidate = [], []
    for i, tag in enumerate(tags.tolist()):
        own = own_of[tag]
        spread = own[np.unique(np.linspace(0, len(own) - 1, _JUDGING_LOOKS).round().astype(np.int64))]
        index.append(spread)
        candidate.append(np.full(len(spread), i))
    looks: Looks = factors.looks.where(np.concatenate(index))
    return CornerFactors(replace(looks, tag=np.concatenate(candidate)), factors.cameras)


def _fitted(judges: CornerFactors, state: SpatialState) -> tuple[SpatialState, FloatArray]:
    """Each tag of the state fitted to its looks alone, and what they lose (T,); infinite where one is not seen."""
    n = len(state.tags)
    is_seen = np.bincount(judges.looks.tag, minlength=n) > 0
    losses = np.full(n, np.inf)
    best = tried = state
    with np.errstate(invalid="ignore"):
        for _ in range(_STEPS):
            total, normal, gradient = np.zeros(n), np.zeros((n, 6, 6)), np.zeros((n, 6))
            values = spatial_values(tried)
            add_to_tags(judges.arrays, judges.lenses, CORNER_LOSS, values, total, normal, gradient)
            better = (total < losses) & is_seen
            best, losses = _mixed(better, tried, best), np.where(better, total, losses)
            good = better & np.isfinite(normal).all((-1, -2))
            diagonal = np.einsum("tii->ti", normal)
            normal = np.where(good[:, None, None], normal + _DAMPING * diagonal[:, :, None] * np.eye(6), np.eye(6))
            step = -np.linalg.solve(normal, np.where(good[:, None], gradient, 0.0)[..., None])[..., 0]
            tried = replace(
                best,
                tags=best.tags + step[:, :2],
                heights_m=best.heights_m + step[:, 2],
                turns=best.turns @ Rotation.from_rotvec(step[:, 3:]).as_matrix(),
            )
    return best, losses


def _mixed(which: BoolArray, a: SpatialState, b: SpatialState) -> SpatialState:
    """Tags of `a` where (T,) says so, else of `b`."""
    return replace(
        b,
        tags=np.where(which[:, None], a.tags, b.tags),
        heights_m=np.where(which, a.heights_m, b.heights_m),
        turns=np.where(which[:, None, None], a.turns, b.turns),
    )


def _by_tag(tag: IntArray) -> list[IntArray]:
    """Indices of each tag's looks, in order of the tags seen."""
    order = np.argsort(tag, kind="stable")
    return list(np.split(order, np.flatnonzero(np.diff(tag[order])) + 1)) if len(tag) else []
