"""Chooses, of many views, those that tell most about the camera."""

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray


def most_telling(by_view: FloatArray, most: int) -> BoolArray:
    """(V,) the `most` views that one by one raise the information's determinant most (D-optimal, greedily).

    A blurred view tells little, and one that repeats another adds little, so neither is taken while better ones are.

    Args:
        by_view: (V, n, n) information of each view about the intrinsics, its pose unknown.
        most: how many to choose.
    """
    count, n = len(by_view), by_view.shape[-1]
    chosen = np.zeros(count, dtype=np.bool_)
    if count <= most:
        return ~chosen
    total = by_view.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-300))
    scaled = by_view * scale[:, None] * scale
    # So little to begin with that two good views outweigh it.
    gathered = 1e-6 * np.eye(n)
    for _ in range(most):
        gain = np.linalg.slogdet(gathered + scaled[~chosen])[1]
        best = np.nonzero(~chosen)[0][int(np.argmax(gain))]
        chosen[best] = True
        gathered = gathered + scaled[best]
    return chosen


def distinct(corners: list[tuple[IntArray, FloatArray]], least_px: float) -> int:
    """How many views differ: the mean of a corner's shift against each other one is at least `least_px`.

    Args:
        corners: of each view, ids (N,) and pixels (N, 2).
        least_px: that counts as another view.
    """
    different: list[tuple[IntArray, FloatArray]] = []
    for ids, pixels in corners:
        for other_ids, other_pixels in different:
            _, mine, theirs = np.intersect1d(ids, other_ids, return_indices=True)
            if len(mine) and np.linalg.norm(pixels[mine] - other_pixels[theirs], axis=1).mean() < least_px:
                break
        else:
            different.append((ids, pixels))
    return len(different)
