"""Selection of detections for initial tag poses: two that provide candidates, and a few that evaluate these."""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import inner, njit

POSED_DETECTIONS: Final = 2  # detections of each tag that provide candidates
_EVALUATING: Final = 8  # detections of each tag that evaluate candidates


class ByTag(NamedTuple):
    """Detections grouped by tag: order (M,), and the start (T + 1,) of each tag's detections in it."""

    order: IntArray
    begin: IntArray


def detections_by_tag(tag: IntArray, n_tags: int) -> ByTag:
    """Group detections by their tags (M,), in their order."""
    n_detections = np.bincount(tag, minlength=n_tags)
    return ByTag(np.argsort(tag, kind="stable"), np.concatenate([[0], np.cumsum(n_detections)]))


def select_evenly(by_tag: ByTag) -> ByTag:
    """Select a few evenly spaced detections of each tag, or all if there are no more."""
    n_detections = np.diff(by_tag.begin)
    share = np.linspace(0.0, 1.0, _EVALUATING)
    at = by_tag.begin[:-1, None] + np.rint(share * (n_detections - 1)[:, None]).astype(np.int64)
    kept = np.zeros(len(by_tag.order), dtype=np.bool_)
    kept[at[n_detections > 0]] = True
    return ByTag(by_tag.order[kept], np.concatenate([[0], np.cumsum(kept)])[by_tag.begin])


@njit
def select_views(corners_px: FloatArray, by_tag: ByTag, out: IntArray) -> None:
    """Set out (T, 2) to the largest detection of each tag, and to the most different shape of at least half its area.

    Missing detections are -1.
    """
    for t in range(len(out)):
        own = by_tag.order[by_tag.begin[t] : by_tag.begin[t + 1]]
        out[t, :] = -1
        if not len(own):
            continue
        largest, most = own[0], -1.0
        for m in own:
            size = _size(corners_px[m])
            if size > most:
                largest, most = m, size
        out[t, 0] = largest
        if len(own) < POSED_DETECTIONS:
            continue
        out[t, 1], farthest = own[0], 0.0
        for m in own:
            apart = _shape_distance(corners_px[m], corners_px[largest]) if _size(corners_px[m]) > 0.5 * most else 0.0
            if apart > farthest:
                out[t, 1], farthest = m, apart


@inner
def _size(corners: FloatArray) -> float:
    """Return twice the area of a quadrangle (4, 2)."""
    across_x, across_y = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1]
    up_x, up_y = corners[3, 0] - corners[1, 0], corners[3, 1] - corners[1, 1]
    return abs(float(across_x * up_y - across_y * up_x))


@inner
def _shape_distance(a: FloatArray, b: FloatArray) -> float:
    """Return the distance between two quadrangles, each centred and divided by the root of its area."""
    by_a, by_b, total = 1.0 / np.sqrt(max(_size(a), 1.0)), 1.0 / np.sqrt(max(_size(b), 1.0)), 0.0
    for i in range(2):
        middle_a = 0.25 * (a[0, i] + a[1, i] + a[2, i] + a[3, i])
        middle_b = 0.25 * (b[0, i] + b[1, i] + b[2, i] + b[3, i])
        for k in range(4):
            total += abs((a[k, i] - middle_a) * by_a - (b[k, i] - middle_b) * by_b)
    return total
