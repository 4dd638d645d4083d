"""Join components over single shared tags, once each is solved on corners and its tags have poses in space.

About a shared point two maps may still rotate; about a tag's pose they may not. A single tag cannot show whether it was
moved in between: a join over one is weak, and reported as such. Two that agree confirm each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment import Group, Merge, size_rank
from groundsbot.offline.corners import refine
from groundsbot.offline.foundation import Stages
from groundsbot.offline.global_map.solve_component import SolvedComponent
from groundsbot.offline.global_map.tag_joins.verdict import Verdict, verdict
from groundsbot.offline.global_map.tape import with_measurements
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import Measurements, TagKey
from groundsbot.offline.sam import Graph, Parameter, StartFactors, State, build_graph, solve

# Negligible against the heading information of tags and wheels; it acts only where they have none.
_HEADING_PRIOR_RAD: Final = 1.0


@dataclass(frozen=True)
class TagJoin:
    """A join of two components over tags that they share.

    Attributes:
        a: a run that observed the first of the tags; b: one of the other component, by name.
        tags: that both have.
        T_a_b: (3,) pose of b's start in a's.
        alternatives: likewise, of others that explain the corners as well.
        verdict: verdict of the components' own maps.
        reason: why they are not joined; empty where they are.
    """

    a: str
    b: str
    tags: tuple[TagKey, ...]
    T_a_b: FloatArray
    alternatives: tuple[FloatArray, ...]
    verdict: Verdict
    reason: str

    @property
    def is_weak(self) -> bool:
        """Whether it would go unnoticed that the tag was moved in between."""
        return len(self.tags) == 1

    def refuse(self, why: str) -> "TagJoin":
        """Return the join as not made, with the reason."""
        ids = ", ".join(str(tag.tag_id) for tag in self.tags)
        return replace(self, reason=f"{self.b} shares only tag{'s' * (not self.is_weak)} {ids} with {self.a}: {why}")


def join_over_tags(
    maps: Sequence[LocalMap],
    merged: Merge,
    solved: Sequence[SolvedComponent],
    measurements: Measurements,
    stages: Stages,
    upright_sigma_rad: float | None = None,
) -> tuple[list[SolvedComponent], list[TagJoin]]:
    """Join components of which no two runs share more than a tag, where the tags determine their transform.

    Args:
        maps: local maps.
        merged: the merge that gave their components.
        solved: these, refined on corners.
        measurements: measurements made by a person.
        stages: notified of progress.
        upright_sigma_rad: sigma of the tags' tilt where they are known to be upright; None: any tilt.

    Returns:
        The components, largest first, and all joins tried: those made, then those not made with their reasons.
    """
    joiner = _Joiner(maps, merged, measurements, upright_sigma_rad)
    with stages.stage("joining over single tags"):
        components = joiner.join(list(solved))
    components.sort(key=lambda each: size_rank(maps, each.members))
    return components, [*joiner.made.values(), *joiner.refused.values()]


_Key = tuple[tuple[int, ...], tuple[int, ...]]  # the members of two components


class _Candidate(NamedTuple):
    """Two components that share tags."""

    a: SolvedComponent
    b: SolvedComponent
    join: TagJoin


class _Joiner:
    def __init__(
        self, maps: Sequence[LocalMap], merged: Merge, measurements: Measurements, upright_sigma_rad: float | None
    ) -> None:
        self._maps, self._measurements, self._upright_sigma_rad = maps, measurements, upright_sigma_rad
        # Runs that share more than a tag were decided by the alignment.
        self._decided = {frozenset((pair.a, pair.b)) for pair in merged.pairs if len(pair.shared) > 1}
        self._judged: dict[_Key, TagJoin | None] = {}
        self.made: dict[_Key, TagJoin] = {}
        self.refused: dict[_Key, TagJoin] = {}

    def join(self, solved: list[SolvedComponent]) -> list[SolvedComponent]:
        """Join components, most certain first, until no join is left; of contradicting joins none is made."""
        components, self.made = solved, {}
        while True:
            tries = [each for a, b in combinations(components, 2) if (each := self._candidate(a, b)) is not None]
            if self._undo_weak_joins(tries):
                return self.join(solved)
            good = [each for each in tries if not each.join.reason]
            if not good:
                self.refused |= {_key(a, b): join for a, b, join in tries}
                return components
            a, b, join = min(good, key=lambda each: each.join.verdict.best.heading_sigma_rad)
            whole = self._solve_together(a, b, join.verdict.best.T_a_b)
            if whole.refined is None:
                self.refused[_key(a, b)] = join.refuse("; ".join(whole.messages) or "both together have no solution")
            else:
                self.made[_key(a, b)] = join
                components = [whole, *(each for each in components if each is not a and each is not b)]

    def _undo_weak_joins(self, tries: Sequence[_Candidate]) -> bool:
        """Withdraw weak joins whose components share tags that contradict each other; return whether there were any."""
        wrong = {
            m for a, b, join in tries if join.reason and not join.is_weak for m in (*_key(a, b)[0], *_key(a, b)[1])
        }
        back = {key: join for key, join in self.made.items() if join.is_weak and wrong.issuperset((*key[0], *key[1]))}
        for key, join in back.items():
            self.refused[key] = join.refuse("other tags that their runs share contradict that it stayed in place")
        return bool(back)

    def _candidate(self, a: SolvedComponent, b: SolvedComponent) -> _Candidate | None:
        a, b = sorted((a, b), key=lambda each: min(segment.name for segment in each.graph.segments))
        key = _key(a, b)
        if key in self.refused or any(frozenset((m, n)) in self._decided for m in key[0] for n in key[1]):
            return None
        if key not in self._judged:
            self._judged[key] = self._join_of(a, b)
        join = self._judged[key]
        return None if join is None else _Candidate(a, b, join)

    def _join_of(self, a: SolvedComponent, b: SolvedComponent) -> TagJoin | None:
        """Return the join; None where no shared tag has a pose in space in both, or one is in several places."""
        tags = tuple(sorted({tag.whole for tag in a.graph.tags} & {tag.whole for tag in b.graph.tags}))
        if not tags or not all(tag in each.graph.tags for tag in tags for each in (a, b)):
            return None
        found = verdict(self._maps, a, b, tags)
        if found is None:
            return None
        seen = [next(i for i, segment in enumerate(each.graph.segments) if tags[0] in segment.tags) for each in (a, b)]
        names = [each.graph.segments[i].name for each, i in zip((a, b), seen, strict=True)]
        starts = [_poses(each)[each.graph.first_pose[i]] for each, i in zip((a, b), seen, strict=True)]
        T_a_b, *rivals = (
            se2.compose(se2.between(starts[0], fit.T_a_b), starts[1]) for fit in (found.best, *found.alternatives)
        )
        return TagJoin(names[0], names[1], tags, T_a_b, tuple(rivals), found, found.reason(names[0], names[1], tags))

    def _solve_together(self, a: SolvedComponent, b: SolvedComponent, T_a_b: FloatArray) -> SolvedComponent:
        """Solve both in one. On the floor they may rotate about a single tag, so headings get weak priors."""
        if b.members.members[0] < a.members.members[0]:
            return self._solve_together(b, a, se2.inverse(T_a_b))
        placed = [(a, np.zeros(3)), (b, T_a_b)]
        poses = {}
        for each, T in placed:
            own = se2.compose(T, _poses(each))
            for i, m in enumerate(each.members.members):
                poses[m] = (
                    each.graph.segments[i],
                    own[each.graph.first_pose[i] :][: len(each.graph.segments[i].stamps_ns)],
                )
        members = tuple(sorted(poses))
        graph = with_measurements(build_graph([poses[m][0] for m in members]), self._measurements)
        tags, calibration = dict[TagKey, FloatArray](), dict[Parameter, float]()
        for each, T in placed[::-1]:
            tags |= {tag: se2.apply(T, place) for tag, place in each.graph.tags_of(_state(each)).items()}
            calibration |= each.graph.calibration_of(each.solution.state)
        start = graph.start(np.concatenate([poses[m][1] for m in members]), tags, calibration)
        solution = solve(_with_heading_priors(graph, start).problem, start)
        T_frame_start = solution.state.poses[graph.first_pose]
        refined, messages = refine(graph, solution, self._upright_sigma_rad)
        return SolvedComponent(
            Group(members, T_frame_start), graph, solution, a.outliers + b.outliers, refined, tuple(messages)
        )


def _with_heading_priors(graph: Graph, start: State) -> Graph:
    """Return the graph with weak heading priors at the starts of all segments."""
    poses = graph.first_pose[1:]
    measured = graph.problem.measured
    softly = np.tile(np.diag([0.0, 0.0, 1.0 / _HEADING_PRIOR_RAD]), (len(poses), 1, 1))
    starts = StartFactors(
        pose=np.concatenate([measured.starts.pose, poses]),
        T_map_start=np.concatenate([measured.starts.T_map_start, start.poses[poses]]),
        whitening=np.concatenate([measured.starts.whitening, softly]),
    )
    return replace(graph, problem=replace(graph.problem, measured=replace(measured, starts=starts)))


def _key(a: SolvedComponent, b: SolvedComponent) -> _Key:
    return a.members.members, b.members.members


def _state(component: SolvedComponent) -> State:
    """Return the state of the map."""
    return component.solution.state if component.refined is None else component.refined.solution.state


def _poses(component: SolvedComponent) -> FloatArray:
    """Return (P, 3) poses of the map."""
    return _state(component).poses
