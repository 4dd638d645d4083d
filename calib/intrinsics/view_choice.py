"""Selection of the most informative views of a camera calibration."""

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray, IntArray


def most_telling(by_view: FloatArray, most: int) -> BoolArray:
    """Return (V,) the `most` views selected greedily for a D-optimal design.

    Each step adds the view that increases the determinant of the information most. Blurred views and repetitions
    contribute little and are chosen last.

    Args:
        by_view: (V, n, n) marginal information of each view about the intrinsics.
        most: number of views to choose.
    """
    count, n = len(by_view), by_view.shape[-1]
    chosen = np.zeros(count, dtype=np.bool_)
    if count <= most:
        return ~chosen
    total = by_view.sum(axis=0)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(total), 1e-300))
    scaled = by_view * scale[:, None] * scale
    # Regularisation, small against the information of two good views.
    gathered = 1e-6 * np.eye(n)
    for _ in range(most):
        gain = np.linalg.slogdet(gathered + scaled[~chosen])[1]
        best = np.nonzero(~chosen)[0][int(np.argmax(gain))]
        chosen[best] = True
        gathered = gathered + scaled[best]
    return chosen


def distinct(corners: list[tuple[IntArray, FloatArray]], least_px: float) -> int:
    """Return how many views differ.

    A view is counted if the mean shift of its corners against each view counted before is at least `least_px`.

    Args:
        corners: ids (N,) and pixels (N, 2) of each view.
        least_px: smallest mean shift of a different view.
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
