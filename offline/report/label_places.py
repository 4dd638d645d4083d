"""Placement of labels beside points so that they stay legible."""

from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray

_MARKER_PX: Final = 5.0  # half a marker, and a gap
_DIRECTIONS: Final = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1], [0, 1], [0, -1], [1, 0], [-1, 0]], dtype=np.float64)
_RINGS: Final = (1.0, 1.8, 2.8)  # the nearest ring of places first
_EVERYWHERE: Final = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
# Costs of covering another label, another marker and a trajectory's point, of each further ring, and of leaving the
# panel.
_COST_LABEL: Final = 20.0
_COST_MARKER: Final = 10.0
_COST_TRAIL: Final = 0.5
_COST_RING: Final = 1.0
_COST_OUTSIDE: Final = 20.0


def place_labels(
    points_px: FloatArray, sizes_px: FloatArray, trails_px: FloatArray, panel_px: FloatArray = _EVERYWHERE
) -> FloatArray:
    """Return centres (N, 2) of labels of given sizes (N, 2) beside points (N, 2), greedily at the least cost.

    Args:
        points_px: positions to label; none should be covered.
        sizes_px: width and height of each label.
        trails_px: (M, 2) positions that are better not covered.
        panel_px: (2, 2) lowest and highest corner of the area for labels.
    """
    centres = np.empty_like(points_px)
    for index, (point, size) in enumerate(zip(points_px, sizes_px, strict=True)):
        reach = size / 2 + _MARKER_PX
        candidates = np.concatenate([point + ring * _DIRECTIONS * reach for ring in _RINGS])
        cost = np.repeat(np.arange(len(_RINGS)) * _COST_RING, len(_DIRECTIONS))
        others = np.delete(points_px, index, axis=0)
        cost = cost + _COST_MARKER * _n_points_inside(candidates, size / 2 + _MARKER_PX / 2, others)
        cost = cost + _COST_TRAIL * np.minimum(_n_points_inside(candidates, size / 2, trails_px), 4)
        cost = cost + _COST_LABEL * _n_points_inside(candidates, (size + sizes_px[:index]) / 2, centres[:index])
        leaves = (candidates - size / 2 < panel_px[0]) | (candidates + size / 2 > panel_px[1])
        cost = cost + _COST_OUTSIDE * leaves.any(axis=1)
        centres[index] = candidates[int(np.argmin(cost))]
    return centres


def _n_points_inside(candidates: FloatArray, half: FloatArray, points: FloatArray) -> FloatArray:
    """Return how many points (M, 2) lie within the half widths (2,) or (M, 2) of each candidate (C, 2)."""
    half = np.broadcast_to(half, points.shape)
    lowest, highest = candidates.min(axis=0), candidates.max(axis=0)
    # Most points are far from all candidates.
    near = np.flatnonzero(((points > lowest - half) & (points < highest + half)).all(axis=-1))
    apart = np.abs(candidates[:, np.newaxis] - points[near])
    return np.asarray((apart < half[near]).all(axis=-1).sum(axis=1), dtype=np.float64)
