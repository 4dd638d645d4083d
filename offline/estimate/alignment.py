"""Places drives in one frame by the tags that they share: RANSAC, as in the paper, onto the growing map."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.estimate.start import rigid
from groundsbot.offline.measurements import TagKey

_SIGMA_M: Final = 0.3  # of a shared tag, by drives that were solved alone
_LEAST_SCORE: Final = 2.0
_ALL_PAIRS: Final = 40
_N_SAMPLES: Final = 800
_LEAST_APART_M: Final = 0.5


def place(places: Sequence[Mapping[TagKey, FloatArray]], weight: Sequence[int]) -> list[dict[int, FloatArray]]:
    """Return groups of drives that can be placed in one frame, each with T_map_start (3,) of its drives.

    Args:
        places: places of the tags in the frame of each drive's start.
        weight: by which the first drive of a group is chosen.
    """
    todo = sorted(range(len(places)), key=lambda k: -weight[k])
    groups = []
    while todo:
        group = {todo[0]: np.zeros(3)}
        todo = todo[1:]
        while todo:
            known = _median_places(places, group)
            found = [(k, *_best(places[k], known)) for k in todo]
            k, score, T = max(found, key=lambda each: each[1])
            if T is None or score < _LEAST_SCORE:
                break
            group[k] = T
            todo.remove(k)
        groups.append(_in_frame_of_first(group))
    return sorted(groups, key=lambda each: -len(each))


def _in_frame_of_first(group: Mapping[int, FloatArray]) -> dict[int, FloatArray]:
    first = se2.inverse(group[min(group)])
    return {k: se2.compose(first, T) for k, T in group.items()}


def _median_places(
    places: Sequence[Mapping[TagKey, FloatArray]], group: Mapping[int, FloatArray]
) -> dict[TagKey, FloatArray]:
    """Return the median of the places of each tag by the drives of a group."""
    seen: dict[TagKey, list[FloatArray]] = {}
    for k, T in group.items():
        for tag, at in places[k].items():
            seen.setdefault(tag, []).append(se2.apply(T, at))
    return {tag: np.median(each, axis=0) for tag, each in seen.items()}


def _best(own: Mapping[TagKey, FloatArray], known: Mapping[TagKey, FloatArray]) -> tuple[float, FloatArray | None]:
    """Return the best score and T_map_start of a drive; a score is about the number of tags that agree."""
    shared = sorted(set(own) & set(known))
    if len(shared) < 2:
        return 0.0, None
    a, b = np.array([own[tag] for tag in shared]), np.array([known[tag] for tag in shared])
    pairs = list(combinations(range(len(shared)), 2))
    if len(shared) > _ALL_PAIRS:
        rng = np.random.default_rng(len(shared))
        pairs = [tuple(rng.choice(len(shared), 2, replace=False)) for _ in range(_N_SAMPLES)]
    best = 0.0
    found: FloatArray | None = None
    for i, j in pairs:
        if np.hypot(*(a[i] - a[j])) < _LEAST_APART_M:
            continue
        T = rigid(a[[i, j]], b[[i, j]])
        off = np.hypot(*(se2.apply(T, a) - b).T)
        score = float(np.exp(-(off**2) / (2.0 * _SIGMA_M**2)).sum()) + 0.01 * len(shared)
        if score > best:
            keep = off < 2.0 * _SIGMA_M
            best, found = score, rigid(a[keep], b[keep]) if keep.sum() >= 2 else T
    return best, found
