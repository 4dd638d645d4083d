"""Initial values of a joint solve: local maps placed by their alignments, and solved in growing groups.

Each local map is bent by the errors of its own odometry, so that between several placed maps the same tag lies metres
apart, and from there the joint solve may end in another minimum than the least. So maps are joined one by one, those
that share most tags first, and solved together loosely. In a wrong minimum the cost is far higher than that of both
parts; such a join is put off until other maps were joined.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtri

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
_MOST_STEPS: Final = 15
# That the cost of a right join increases by more, if the noise has up to this many times the assumed variance.
_FALSE_ALARM: Final = 1e-3
_VARIANCE_FACTOR: Final = 2.0

_Members = tuple[int, ...]


class InitialMap(NamedTuple):
    """Initial values of some of the maps of a group, in a common frame.

    Attributes:
        members: positions in the group, in order of names.
        poses: (K, 3) of each member.
        tags_m: (2,) of each tag.
        calibration: corrections of calibration parameters.
    """

    members: _Members
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

    def move_onto(self, other: "InitialMap") -> "InitialMap":
        """Return the map transformed so that tags are nearest to those of another; as it is if they share too few."""
        shared = sorted(other.tags_m.keys() & self.tags_m.keys())
        if len(shared) < _LEAST_SHARED_TAGS:
            return self
        there, here = (np.array([part.tags_m[tag] for tag in shared]) for part in (other, self))
        return self.transform(fit_transform(there, here))


def initial_map(maps: Sequence[LocalMap], group: Group) -> InitialMap:
    """Return initial values of a group's members, in their order; the frame is the first one's start.

    Args:
        maps: all local maps; the group names its members among them.
        group: the members and their placement by alignments.
    """
    # By name, so that the result does not depend on the order of the logs.
    order = sorted(range(len(group.members)), key=lambda i: maps[group.members[i]].segment.name)
    whole = _Joining([maps[group.members[i]] for i in order], group.T_frame_start[order]).join_all()
    poses = tuple(whole.poses[order.index(i)] for i in range(len(order)))
    return whole._replace(poses=poses).transform(se2.inverse(poses[0][0]))


class _Part(NamedTuple):
    """Some members of a group.

    Attributes:
        map: initial values.
        cost: of their joint solve.
    """

    map: InitialMap
    cost: float


class _Joining:
    """Joins the members of a group until they are one part."""

    def __init__(self, members: Sequence[LocalMap], T_frame_start: FloatArray) -> None:
        """Begin with a part for each member, placed in a common frame."""
        self._members = members
        self._parts: dict[_Members, _Part] = {}
        self._n_shared: dict[tuple[_Members, _Members], int] = {}
        self._excess: dict[tuple[_Members, _Members], float] = {}  # of the cost, where a join was put off
        for i, (T, each) in enumerate(zip(T_frame_start, members, strict=True)):
            placed = InitialMap((i,), (each.T_start_base,), each.tags_m, each.calibration).transform(T)
            self._add(_Part(placed, each.solution.cost))

    def join_all(self) -> InitialMap:
        """Return all members in one part, whose last join is not solved, since the whole is solved next."""
        while len(self._parts) > 1:
            pair = self._next_pair()
            joined, excess = self._join(*sorted(pair, key=len, reverse=True))
            if excess > 0.0 and pair not in self._excess and len(self._parts) > 2:
                self._excess[pair] = excess
                continue
            for known in (self._n_shared, self._excess):
                for other in [other for other in known if set(other) & set(pair)]:
                    known.pop(other)
            for each in pair:
                del self._parts[each]
            self._add(joined)
        (whole,) = self._parts.values()
        return whole.map

    def _add(self, part: _Part) -> None:
        tags, members = part.map.tags_m.keys(), part.map.members
        for other, each in self._parts.items():
            self._n_shared[min(other, members), max(other, members)] = len(tags & each.map.tags_m.keys())
        self._parts[members] = part

    def _next_pair(self) -> tuple[_Members, _Members]:
        """Return the pair of which one is smallest, and of these the one that shares most tags.

        Where all joins were put off, the one of least excess; where no tags are shared, the first.
        """
        untried = [pair for pair, n in self._n_shared.items() if n and pair not in self._excess]
        if untried:
            return min(untried, key=lambda pair: (min(map(len, pair)), -self._n_shared[pair], pair))
        return min(self._excess or self._n_shared, key=lambda pair: (self._excess.get(pair, 0.0), pair))

    def _join(self, large: _Members, small: _Members) -> tuple[_Part, float]:
        """Return two parts in one, and by how much its cost exceeds what is likely for a right join."""
        one, other = self._parts[large], self._parts[small]
        n_shared = self._n_shared[min(large, small), max(large, small)]
        both = _unite([one.map, other.map.move_onto(one.map)])
        if not n_shared or len(self._parts) == 2:
            return _Part(both, one.cost + other.cost), 0.0
        solved = self._solve(both)
        return solved, _excess(solved.cost - one.cost - other.cost, n_shared)

    def _solve(self, part: InitialMap) -> _Part:
        """Return a part whose members are solved together loosely, with their tags alone."""
        graph = build_graph([self._members[m].segment for m in part.members])
        solution = solve(
            graph.problem,
            part.state(graph),
            _COST_TOLERANCE,
            relative_tolerance=_RELATIVE_TOLERANCE,
            most_steps=_MOST_STEPS,
        )
        state = solution.state
        poses = tuple(graph.poses_of(state, i) for i in range(len(part.members)))
        solved = InitialMap(part.members, poses, graph.tags_of(state), graph.calibration_of(state))
        return _Part(solved, solution.cost)


def _excess(increase: float, n_shared: int) -> float:
    """Return by how much an increase of the cost exceeds what is likely where shared tags join two parts.

    Twice the increase is a chi-square with 2 n - 3 degrees of freedom under the model.
    """
    freedom = max(2 * n_shared - 3, 1)
    return increase - 0.5 * _VARIANCE_FACTOR * float(chdtri(freedom, _FALSE_ALARM))


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
