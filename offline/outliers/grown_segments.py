"""Incremental solves of a drive from one of its ends, and the longest part whose observations fit together."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy.special import chdtri

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.measurements import Segment, TagKey
from groundsbot.offline.sam import Budget, Parameter, build_graph, solve

# Share of drives with correct odometry that are split.
FALSE_ALARM: Final = 1e-3
COST_TOLERANCE: Final = 1e-2  # loose, since the solution of a part is only the start of the next one
_PIECE_M: Final = 2.0
_MOST_PIECES: Final = 60


class SolvedPart(NamedTuple):
    """Solution of a part of a segment.

    Attributes:
        first, end: its first keyframe, and one beyond its last.
        poses: (end - first, 3)
        wheels: calibration of the odometry.
        tags: position (2,) of each tag.
        calibration: calibration, as in the graph.
        cost: half of chi-square.
        freedom: degrees of freedom of chi-square.
    """

    first: int
    end: int
    poses: FloatArray
    wheels: FloatArray
    tags: dict[TagKey, FloatArray]
    calibration: dict[Parameter, float]
    cost: float
    freedom: int


def grow_parts(segment: Segment, budget: Budget, *, backwards: bool) -> list[SolvedPart]:
    """Solve longer and longer parts of a segment from one end until the budget is spent."""
    n = len(segment.stamps_ns)
    parts: list[SolvedPart] = []
    for end in _coarse_ends(segment):
        if budget.is_spent():
            break
        piece = (n - end, n) if backwards else (0, end)
        parts.append(_solve_part(segment, *piece, parts[-1] if parts else None, budget))
    return parts


def noise_factor(grown: Sequence[Sequence[SolvedPart]]) -> float:
    """Return the ratio of the variances to the given ones.

    It is the median over the pieces of the added cost per degree of freedom, as a break affects few of them.
    """
    added = [
        2.0 * (after.cost - before.cost) / (after.freedom - before.freedom)
        for parts in grown
        for before, after in pairwise(parts)
        if after.freedom > before.freedom
    ]
    return float(np.median(added)) if added else 1.0


def limit_of(segment: Segment, parts: Sequence[SolvedPart], factor: float, budget: Budget) -> SolvedPart | None:
    """Return the longest part whose observations fit together, within the budget; None if the whole segment fits."""
    for before, after in pairwise(parts):
        if _is_contradicted(before, after, factor, len(parts)):
            return _refine_end(segment, before, after, factor, budget)
    return None


def _refine_end(segment: Segment, known: SolvedPart, beyond: SolvedPart, factor: float, budget: Budget) -> SolvedPart:
    """Return the longest fitting part, to the keyframe, between a fitting one and a longer one, by bisection."""
    longest = known
    observation = np.unique(segment.observations.keyframe)
    ahead = observation[(observation >= known.end) & (observation < beyond.end)] + 1
    back = observation[(observation < known.first) & (observation >= beyond.first)][::-1]
    parts = [(known.first, int(end)) for end in ahead] + [(int(first), known.end) for first in back]
    fitting, contradicted = -1, len(parts)
    while contradicted - fitting > 1 and not budget.is_spent():
        middle = (fitting + contradicted) // 2
        grown = _solve_part(segment, *parts[middle], longest, budget)
        if _is_contradicted(known, grown, factor, len(parts)):
            contradicted = middle
        else:
            fitting, longest = middle, grown
    return longest


def _is_contradicted(before: SolvedPart, after: SolvedPart, factor: float, n_tests: int) -> bool:
    """Return whether a longer part costs significantly more than a shorter one."""
    freedom = max(1, after.freedom - before.freedom)
    return bool(2.0 * (after.cost - before.cost) > factor * chdtri(freedom, FALSE_ALARM / n_tests))


def _solve_part(segment: Segment, first: int, end: int, known: SolvedPart | None, budget: Budget) -> SolvedPart:
    """Solve a part of a segment, starting at the solution of a part that has an end in common with it."""
    part = segment.part(first, end)
    graph = build_graph([part])
    wheels = np.zeros(segment.odometry.jacobian.shape[2]) if known is None else known.wheels
    poses = _poses(segment, first, end, known, wheels)
    start = graph.start(poses, {}, {}) if known is None else graph.start(poses, known.tags, known.calibration)
    solution = solve(graph.problem, start, COST_TOLERANCE, most_tries=budget.max_linearisations(graph.problem, 1.0))
    budget.spend(solution, is_built=True)
    state, problem = solution.state, graph.problem
    freedom = problem.n_residuals + int((problem.columns.calibration >= 0).sum()) - problem.columns.n
    wheels, tags = graph.odometry_calibration(state, 0), graph.tags_of(state)
    return SolvedPart(first, end, state.poses, wheels, tags, graph.calibration_of(state), solution.cost, freedom)


def _poses(segment: Segment, first: int, end: int, known: SolvedPart | None, wheels: FloatArray) -> FloatArray:
    """Return initial poses (end - first, 3) of a part: the known ones, extended at both ends by dead reckoning."""
    odometry = segment.odometry.part(first, end - 1)
    motion = se2.compose(odometry.motion, se2.exp(odometry.jacobian @ wheels))
    if known is None:
        return chain_motions(motion, np.zeros(3))
    shared = known.poses[max(0, first - known.first) : end - known.first]
    at = max(0, known.first - first)
    after = chain_motions(motion[at + len(shared) - 1 :], shared[-1])[1:]
    before = chain_motions(se2.inverse(motion[:at][::-1]), shared[0])[1:][::-1]
    return np.concatenate([before, shared, after])


def _coarse_ends(segment: Segment) -> list[int]:
    """Return the ends of growing parts as numbers of keyframes, some metres apart; the last is the whole segment."""
    along_m = segment.along_m
    step_m = max(_PIECE_M, along_m[-1] / _MOST_PIECES)
    marks = np.searchsorted(along_m, np.arange(step_m, along_m[-1], step_m)) + 1
    ends: list[int] = np.unique([*marks[(marks > 1) & (marks < len(along_m))], len(along_m)]).tolist()
    return ends
