"""Arrays of many drives one after another in memory.

The joint graph takes the measurements of all drives, which took their memory twice: once for each drive, once for the
graph. Arrays that follow each other are one array for it (`sam.build_graph`).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from groundsbot.offline.local_map.local_map import LocalMap

# Attributes of `Segment` and `Problem`, and those of theirs that both have as they are.
_SHARED: Final = {"odometry": ("motion", "jacobian"), "observations": ("value", "polar", "by_camera", "turning_rad_s")}


def with_adjacent_arrays(maps: Sequence[LocalMap]) -> list[LocalMap]:
    """Return the same maps with their measurements one after another in memory, in their order."""
    found = list(maps)
    for kind, names in _SHARED.items():
        for name in names:
            arrays = [getattr(getattr(each.segment, kind), name) for each in found]
            if len({array.shape[1:] for array in arrays}) != 1:  # robots with and without a gyro
                continue
            parts = np.split(np.concatenate(arrays), np.cumsum([len(array) for array in arrays])[:-1])
            for i, part in enumerate(parts):
                found[i] = _with_array(found[i], kind, name, part)
    return found


def _with_array(local_map: LocalMap, kind: str, name: str, array: Any) -> LocalMap:  # noqa: ANN401 (of any type)
    """Return the map with an array of its segment replaced by an equal one, in its graph too."""
    measurements, problem = getattr(local_map.segment, kind), local_map.graph.problem
    factors = getattr(problem, kind)
    segment = replace(local_map.segment, **{kind: replace(measurements, **{name: array})})
    if getattr(factors, name) is getattr(measurements, name):
        problem = replace(problem, **{kind: replace(factors, **{name: array})})
    return replace(
        local_map,
        segment=segment,
        graph=replace(local_map.graph, problem=problem, segments=(segment,)),
        solution=replace(local_map.solution, problem=problem),
    )
