"""Transform between two local maps from the tags they share.

Two tags give a hypothesis, RANSAC picks the one that most agree on, least squares over those refines it.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from calib import se2
from calib.arrays import BoolArray, FloatArray
from offline.run import TagKey

# A shared tag this close after the transform counts as the same tag. It is fixed: wide enough for the drift of a local
# map over some hundred metres, narrow enough to notice a tag that was carried to the next door.
INLIER_GATE_M: Final = 0.5

# Two tags nearer to each other than this give a heading worth nothing.
_MIN_BASE_M: Final = 0.5
_MAX_HYPOTHESES: Final = 5000
_MAX_REFINEMENTS: Final = 10
_SEED: Final = 20170501


@dataclass(frozen=True)
class Alignment:
    """Pose of frame b in frame a.

    Attributes:
        T_a_b: (3,)
        shared: the tags in both, sorted.
        inlier: (n_shared,) which of them fit.
        rmse_m: of the inliers.
    """

    T_a_b: FloatArray
    shared: tuple[TagKey, ...]
    inlier: BoolArray
    rmse_m: float

    @property
    def n_inliers(self) -> int:
        """How many shared tags fit."""
        return int(self.inlier.sum())


def align(tags_a: Mapping[TagKey, FloatArray], tags_b: Mapping[TagKey, FloatArray]) -> Alignment | None:
    """The transform that most shared tags agree on, or None where no two of them fit together.

    Args:
        tags_a: places (2,) of tags in frame a.
        tags_b: places (2,) of tags in frame b.
    """
    shared = tuple(sorted(tags_a.keys() & tags_b.keys()))
    if len(shared) < 2:
        return None
    a = np.array([tags_a[tag] for tag in shared])
    b = np.array([tags_b[tag] for tag in shared])
    hypotheses = _hypotheses(a, b)
    if not len(hypotheses):
        return None
    distance_m = np.linalg.norm(se2.apply(hypotheses[:, None, :], b) - a, axis=-1)
    inlier = distance_m < INLIER_GATE_M
    # Most tags first, then the smallest spread among them.
    spread = np.where(inlier, distance_m**2, 0.0).sum(axis=1)
    best = np.lexsort((spread, -inlier.sum(axis=1)))[0]
    return _refined(a, b, shared, inlier[best])


def fit_transform(a: FloatArray, b: FloatArray) -> FloatArray:
    """T_a_b (3,) that brings points b (n, 2) onto a (n, 2) in least squares, without scale.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns" (1991), in the plane.
    """
    centre_a, centre_b = a.mean(axis=0), b.mean(axis=0)
    from_a, from_b = a - centre_a, b - centre_b
    dot = (from_a * from_b).sum()
    cross = (from_b[:, 0] * from_a[:, 1] - from_b[:, 1] * from_a[:, 0]).sum()
    turn = np.array([0.0, 0.0, np.arctan2(cross, dot)])
    translation = centre_a - se2.apply(turn, centre_b)
    return np.array([translation[0], translation[1], turn[2]])


def _hypotheses(a: FloatArray, b: FloatArray) -> FloatArray:
    """(H, 3) transforms from pairs of tags whose distance is the same in both maps, within the gate on either end."""
    pairs = np.array(list(combinations(range(len(a)), 2)))
    if len(pairs) > _MAX_HYPOTHESES:
        pairs = pairs[np.random.default_rng(_SEED).choice(len(pairs), _MAX_HYPOTHESES, replace=False)]
    base_a, base_b = a[pairs[:, 1]] - a[pairs[:, 0]], b[pairs[:, 1]] - b[pairs[:, 0]]
    length_a, length_b = np.linalg.norm(base_a, axis=1), np.linalg.norm(base_b, axis=1)
    fits = (np.abs(length_a - length_b) < 2.0 * INLIER_GATE_M) & (np.minimum(length_a, length_b) > _MIN_BASE_M)
    pairs, base_a, base_b = pairs[fits], base_a[fits], base_b[fits]
    theta = np.arctan2(base_a[:, 1], base_a[:, 0]) - np.arctan2(base_b[:, 1], base_b[:, 0])
    turn = np.stack([np.zeros_like(theta), np.zeros_like(theta), se2.wrap_angle(theta)], axis=-1)
    middle_a, middle_b = a[pairs].mean(axis=1), b[pairs].mean(axis=1)
    translation = middle_a - se2.apply(turn, middle_b)
    return np.concatenate([translation, turn[:, 2:]], axis=-1)


def _refined(a: FloatArray, b: FloatArray, shared: tuple[TagKey, ...], inlier: BoolArray) -> Alignment | None:
    """Least squares over the inliers until they stay the same."""
    refined: Alignment | None = None
    for _ in range(_MAX_REFINEMENTS):
        if inlier.sum() < 2:
            return None
        T_a_b = fit_transform(a[inlier], b[inlier])
        distance_m = np.linalg.norm(se2.apply(T_a_b, b) - a, axis=-1)
        now = distance_m < INLIER_GATE_M
        refined = Alignment(T_a_b, shared, now, float(np.sqrt((distance_m[now] ** 2).mean()))) if now.any() else None
        if (now == inlier).all():
            break
        inlier = now
    return refined if refined is not None and refined.n_inliers >= 2 else None
