"""Initial values of a joint solve: local maps placed by their alignments and solved in growing groups.

Each local map is bent by the errors of its own odometry, so that between several placed maps the same tag lies metres
apart. From there the joint solve may end in another minimum, or not at all: of eight drives of 1 km in 1 of 4 simulated
towns. So the map that is joined with fewest others is joined with the one that it shares most tags with, and both are
solved together loosely, until one is left. Each solve bends two maps onto each other that fit in themselves, and a map
is in about log2(n) of n.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import fit_transform, se2
from groundsbot.offline.alignment import Group
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import Graph, Parameter, State, build_graph, solve

_LEAST_SHARED_TAGS: Final = 3
# In squared sigmas, and relative to the cost: a start need not be better, since the next maps bend it anyway.
_COST_TOLERANCE: Final = 1.0
_RELATIVE_TOLERANCE: Final = 1e-3
_MOST_STEPS: Final = 30


class InitialMap(NamedTuple):
    """Initial values of some of the maps of a group, in a common frame.

    Attributes:
        members: positions in the group, in order of names.
        poses: (K, 3) of each member.
        tags_m: (2,) of each tag.
        calibration: corrections of calibration parameters.
    """

    members: tuple[int, ...]
    poses: tuple[FloatArray, ...]
    tags_m: dict[TagKey, FloatArray]
    calibration: dict[Parameter, float]

    def state(self, graph: Graph) -> State:
        """Return the state of a graph of the same members."""
        return graph.start(np.concatenate(self.poses), self.tags_m, self.calibration)

    def transform(self, T: FloatArray) -> "InitialMap":
        """Return the map transformed by T (3,)."""
        return self._replace(
            poses=tuple(se2.compose(T, each) for each in self.poses),
            tags_m={tag: se2.apply(T, place) for tag, place in self.tags_m.items()},
        )


def initial_map(maps: Sequence[LocalMap], group: Group) -> InitialMap:
    """Return initial values of a group's members, in their order; the frame is the first one's start.

    Args:
        maps: all local maps; the group names its members among them.
        group: the members and their placement by alignments.
    """
    # By name, so that the result does not depend on the order of the logs.
    order = sorted(range(len(group.members)), key=lambda i: maps[group.members[i]].segment.name)
    members = [maps[group.members[i]] for i in order]
    parts = [
        InitialMap((i,), (each.T_start_base,), each.tags_m, each.calibration).transform(T)
        for i, (T, each) in enumerate(zip(group.T_frame_start[order], members, strict=True))
    ]
    while len(parts) > 1:
        parts.sort(key=lambda part: (-len(part.members), part.members))
        least = parts.pop()
        nearest = max(parts, key=lambda part: len(part.tags_m.keys() & least.tags_m.keys()))
        parts.remove(nearest)
        parts.append(_join(nearest, least, members, is_last=not parts))
    (whole,) = parts
    poses = tuple(whole.poses[order.index(i)] for i in range(len(order)))
    return whole._replace(poses=poses).transform(se2.inverse(poses[0][0]))


def _join(a: InitialMap, b: InitialMap, members: Sequence[LocalMap], *, is_last: bool) -> InitialMap:
    """Return two parts of a group in one, solved unless it is the whole group, which is solved next."""
    shared = sorted(a.tags_m.keys() & b.tags_m.keys())
    if len(shared) >= _LEAST_SHARED_TAGS:
        of_a, of_b = (np.array([part.tags_m[tag] for tag in shared]) for part in (a, b))
        b = b.transform(fit_transform(of_a, of_b))
    both = _unite([a, b])
    if is_last or not shared:
        return both
    graph = build_graph([members[m].segment for m in both.members])
    state = solve(
        graph.problem,
        both.state(graph),
        _COST_TOLERANCE,
        relative_tolerance=_RELATIVE_TOLERANCE,
        most_steps=_MOST_STEPS,
    ).state
    poses = tuple(graph.poses_of(state, i) for i in range(len(both.members)))
    return InitialMap(both.members, poses, graph.tags_of(state), graph.calibration_of(state))


def _unite(parts: Sequence[InitialMap]) -> InitialMap:
    """Return parts in one, members in order; tags and calibration are means over the members that have them."""
    poses = dict(pair for part in parts for pair in zip(part.members, part.poses, strict=True))
    tags: dict[TagKey, list[tuple[FloatArray, int]]] = {}
    calibration: dict[Parameter, list[tuple[float, int]]] = {}
    for part in parts:
        for tag, place in part.tags_m.items():
            tags.setdefault(tag, []).append((place, len(part.members)))
        for parameter, value in part.calibration.items():
            calibration.setdefault(parameter, []).append((value, len(part.members)))
    order = tuple(sorted(poses))
    return InitialMap(
        order,
        tuple(poses[member] for member in order),
        {tag: _mean(found) for tag, found in tags.items()},
        {parameter: float(_mean(found)) for parameter, found in calibration.items()},
    )


def _mean(found: Sequence[tuple[FloatArray | float, int]]) -> FloatArray:
    """Return the mean of values, each with its weight."""
    values, weights = zip(*found, strict=True)
    mean: FloatArray = np.average(np.array(values), axis=0, weights=weights)
    return mean
