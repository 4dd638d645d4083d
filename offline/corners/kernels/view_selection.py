"""Which looks at each tag tell how it hangs: two whose poses are tried, and a few that judge these."""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import inner, njit

POSED_LOOKS: Final = 2  # of each tag, whose poses are tried
_JUDGING_LOOKS: Final = 8  # of each tag


class ByTag(NamedTuple):
    """Looks (M,) by their tags: those of one begin at begin (T + 1,)."""

    order: IntArray
    begin: IntArray


def observations_by_tag(tag: IntArray, n_tags: int) -> ByTag:
    """Looks at tags (M,), those of each in their order."""
    n_looks = np.bincount(tag, minlength=n_tags)
    return ByTag(np.argsort(tag, kind="stable"), np.concatenate([[0], np.cumsum(n_looks)]))


def judges(by_tag: ByTag) -> ByTag:
    """A few looks spread over all of each tag's, or all where there are no more."""
    n_looks = np.diff(by_tag.begin)
    share = np.linspace(0.0, 1.0, _JUDGING_LOOKS)
    at = by_tag.begin[:-1, None] + np.rint(share * (n_looks - 1)[:, None]).astype(np.int64)
    kept = np.zeros(len(by_tag.order), dtype=np.bool_)
    kept[at[n_looks > 0]] = True
    return ByTag(by_tag.order[kept], np.concatenate([[0], np.cumsum(kept)])[by_tag.begin])


@njit
def select_views(corners_px: FloatArray, by_tag: ByTag, out: IntArray) -> None:
    """Sets (T, 2) of each tag the largest look, and of those half as large the one whose shape differs most.

    -1 where a tag has no look, or no second one.
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
        if len(own) < POSED_LOOKS:
            continue
        out[t, 1], farthest = own[0], 0.0
        for m in own:
            apart = _apart(corners_px[m], corners_px[largest]) if _size(corners_px[m]) > 0.5 * most else 0.0
            if apart > farthest:
                out[t, 1], farthest = m, apart


@inner
def _size(corners: FloatArray) -> float:
    """Twice the area of a quadrangle (4, 2)."""
    across_x, across_y = corners[2, 0] - corners[0, 0], corners[2, 1] - corners[0, 1]
    up_x, up_y = corners[3, 0] - corners[1, 0], corners[3, 1] - corners[1, 1]
    return abs(float(across_x * up_y - across_y * up_x))


@inner
def _apart(a: FloatArray, b: FloatArray) -> float:
    """How much two quadrangles differ in shape, each about its middle and by its size."""
    by_a, by_b, total = 1.0 / np.sqrt(max(_size(a), 1.0)), 1.0 / np.sqrt(max(_size(b), 1.0)), 0.0
    for i in range(2):
        middle_a = 0.25 * (a[0, i] + a[1, i] + a[2, i] + a[3, i])
        middle_b = 0.25 * (b[0, i] + b[1, i] + b[2, i] + b[3, i])
        for k in range(4):
            total += abs((a[k, i] - middle_a) * by_a - (b[k, i] - middle_b) * by_b)
    return total
