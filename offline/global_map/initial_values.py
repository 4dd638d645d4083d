"""Initial values of a joint solve: local maps placed by their alignments, warped onto each other and solved in groups.

Each local map is bent by the errors of its own odometry, so that between several placed maps the same tag lies metres
apart, and from there the joint solve may end in another minimum than the least. So maps are joined one by one, those
that share most tags first, each warped onto the tags of those before it, and solved together loosely. In a wrong
minimum the cost is far higher than that of both parts; then the other part is warped instead, or the join is put off
until others were made. Of many maps all are solved together only when their number has grown by half, so that the time
of all these solves grows with the number of maps as that of the joint solve does.
"""

from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment import Group
from groundsbot.offline.foundation import Workers
from groundsbot.offline.global_map.warp import Warp, find_warp
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import Graph, Parameter, State, build_graph, solve_with_workers

# With so many members more are only warped onto a part, until their number has grown by this factor.
_MANY: Final = 8
_GROWTH: Final = 1.5
# In squared sigmas, and relative to the cost: a start need not be better, since the next maps bend it anyway.
_COST_TOLERANCE: Final = 1.0
_RELATIVE_TOLERANCE: Final = 1e-3
_MOST_STEPS: Final = 30
# Of a higher cost of a right join, under noise that has up to this many times the assumed variance.
_FALSE_ALARM: Final = 1e-3
_VARIANCE_FACTOR: Final = 2.0

_Members = tuple[int, ...]
_Pair = tuple[_Members, _Members]


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


def initial_map(maps: Sequence[LocalMap], group: Group, workers: Workers | None = None) -> InitialMap:
    """Return initial values of a group's members, in their order; the frame is the first one's start.

    Args:
        maps: all local maps; the group names its members among them.
        group: the members and their placement by alignments.
        workers: a cluster that may solve a fleet in parts; None: this process.
    """
    # By name, so that the result does not depend on the order of the logs.
    order = sorted(range(len(group.members)), key=lambda i: maps[group.members[i]].segment.name)
    whole = _Joining([maps[group.members[i]] for i in order], group.T_frame_start[order], workers).join_all()
    poses = tuple(whole.poses[order.index(i)] for i in range(len(order)))
    return whole._replace(poses=poses).transform(se2.inverse(poses[0][0]))


class _JoinedMaps(NamedTuple):
    """Some members of a group.

    Attributes:
        map: initial values.
        cost: sum of the costs of those that were last solved together, before they were joined.
        freedom: degrees of freedom of the joins since then; 0 where all are solved together.
        n_solved: number of members when they were last solved together.
    """

    map: InitialMap
    cost: float
    freedom: int = 0
    n_solved: int = 1


class _Joining:
    """Joins the members of a group until they are one part."""

    def __init__(self, members: Sequence[LocalMap], T_frame_start: FloatArray, workers: Workers | None) -> None:
        """Begin with a part for each member, placed in a common frame."""
        self._members, self._workers = members, workers
        self._parts: dict[_Members, _JoinedMaps] = {}
        self._n_shared: dict[_Pair, int] = {}
        self._put_off: dict[_Pair, float] = {}  # by how much the cost was too high
        for i, (T, each) in enumerate(zip(T_frame_start, members, strict=True)):
            placed = InitialMap((i,), (each.T_start_base,), each.tags_m, each.calibration).transform(T)
            self._add(_JoinedMaps(placed, each.solution.cost))

    def join_all(self) -> InitialMap:
        """Return all members in one part."""
        while len(self._parts) > 1:
            pair = self._next_pair()
            small, large = sorted((self._parts[each] for each in pair), key=_size)
            joined, excess = self._join(small, large, self._n_shared[pair])
            if excess > 0.0 and pair not in self._put_off and len(self._parts) > 2:
                self._put_off[pair] = excess
                continue
            for each in pair:
                del self._parts[each]
            for known in (self._n_shared, self._put_off):
                for other in [other for other in known if set(other) & set(pair)]:
                    known.pop(other)
            self._add(joined)
        (whole,) = self._parts.values()
        return whole.map

    def _add(self, part: _JoinedMaps) -> None:
        members, tags = part.map.members, part.map.tags_m.keys()
        for other, each in self._parts.items():
            self._n_shared[min(other, members), max(other, members)] = len(tags & each.map.tags_m.keys())
        self._parts[members] = part

    def _next_pair(self) -> _Pair:
        """Return the pair of which one is smallest, and of these the one that shares most tags.

        Where all were put off, the one of least excess; where no tags are shared, the first.
        """
        untried = [pair for pair, n in self._n_shared.items() if n and pair not in self._put_off]
        if untried:
            return min(untried, key=lambda pair: (min(map(len, pair)), -self._n_shared[pair], pair))
        return min(self._put_off or self._n_shared, key=lambda pair: (self._put_off.get(pair, 0.0), pair))

    def _join(self, small: _JoinedMaps, large: _JoinedMaps, n_shared: int) -> tuple[_JoinedMaps, float]:
        """Return two parts in one, and by how much its cost exceeds what is likely if they are joined rightly."""
        cost, freedom = small.cost + large.cost, small.freedom + large.freedom + max(2 * n_shared - 3, 0)
        both = _unite(large.map, self._warp(small.map, large.map))
        n = len(both.members)
        is_due = len(large.map.members) < _MANY or len(small.map.members) > 1 or n >= _GROWTH * large.n_solved
        if not n_shared or not (is_due or len(self._parts) == 2):
            return _JoinedMaps(both, cost, freedom, large.n_solved), 0.0
        likely = cost + 0.5 * _VARIANCE_FACTOR * float(chdtri(max(freedom, 1), _FALSE_ALARM))
        joined = self._solve(both, cost)
        if joined.cost > likely:
            other = self._solve(_unite(small.map, self._warp(large.map, small.map)), cost)
            joined = min(joined, other, key=lambda part: part.cost)
        return joined, joined.cost - likely

    def _warp(self, part: InitialMap, onto: InitialMap) -> InitialMap:
        """Return a part warped onto another, drive by drive; shared tags are where they are there."""
        warps = [find_warp(self._members[m].segment, part.tags_m, onto.tags_m) for m in part.members]
        places: dict[TagKey, list[FloatArray]] = {}
        for warp, m in zip(warps, part.members, strict=True):
            for tag, place in _warp_tags(warp, self._members[m], part).items():
                places.setdefault(tag, []).append(place)
        return part._replace(
            poses=tuple(warp.apply_to_poses(poses) for warp, poses in zip(warps, part.poses, strict=True)),
            tags_m={tag: onto.tags_m[tag] if tag in onto.tags_m else np.mean(at, axis=0) for tag, at in places.items()},
        )

    def _solve(self, part: InitialMap, cost: float) -> _JoinedMaps:
        """Return a part whose members are solved together loosely.

        Args:
            part: initial values.
            cost: of its members apart.
        """
        graph = build_graph([self._members[m].segment for m in part.members])
        # Not relative to the cost on the way: such a solve may end far from a minimum.
        tolerance = _COST_TOLERANCE + _RELATIVE_TOLERANCE * cost
        solution = solve_with_workers(graph.problem, part.state(graph), tolerance, _MOST_STEPS, workers=self._workers)
        state, n = solution.state, len(part.members)
        poses = tuple(graph.poses_of(state, i) for i in range(n))
        solved = InitialMap(part.members, poses, graph.tags_of(state), graph.calibration_of(state))
        return _JoinedMaps(solved, solution.cost, n_solved=n)


def _size(part: _JoinedMaps) -> tuple[int, _Members]:
    return len(part.map.members), part.map.members


def _warp_tags(warp: Warp, member: LocalMap, part: InitialMap) -> dict[TagKey, FloatArray]:
    """Return the places of the tags of a drive after a warp at the keyframes that observe them."""
    segment = member.segment
    observations = segment.observations
    places_m = np.array([part.tags_m[tag] for tag in segment.tags]).reshape(-1, 2)
    found = warp.apply_to_points(places_m[observations.tag], observations.keyframe)
    n = np.bincount(observations.tag, minlength=len(segment.tags))
    sums = [np.bincount(observations.tag, weights=axis, minlength=len(segment.tags)) for axis in found.T]
    means = np.stack(sums, axis=-1) / np.maximum(n, 1)[:, None]
    return dict(zip(segment.tags, np.where(n[:, None] > 0, means, places_m), strict=True))


def _unite(large: InitialMap, small: InitialMap) -> InitialMap:
    """Return two parts in one, members in order, with the tags of the larger one."""
    poses = dict(pair for part in (large, small) for pair in zip(part.members, part.poses, strict=True))
    members = tuple(sorted(poses))
    calibration = large.calibration | small.calibration
    for parameter in large.calibration.keys() & small.calibration.keys():
        weights = [len(large.members), len(small.members)]
        values = [large.calibration[parameter], small.calibration[parameter]]
        calibration[parameter] = float(np.average(values, weights=weights))
    return large._replace(
        members=members,
        poses=tuple(poses[member] for member in members),
        tags_m=small.tags_m | large.tags_m,
        calibration=calibration,
    )
