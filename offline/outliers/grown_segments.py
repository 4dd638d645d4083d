"""Parts of a drive that grow from one of its ends on, and how far their observations fit together."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import chi2

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import chain_motions, se2
from groundsbot.offline.measurements import Segment, TagKey
from groundsbot.offline.sam import Parameter, SolveBudget, build_graph, solve

# Of all drives whose wheels are right, so many are taken for broken.
FALSE_ALARM: Final = 1e-3
COST_TOLERANCE: Final = 1e-2  # a part is only the next one's start
_PIECE_M: Final = 2.0
_MOST_PIECES: Final = 60


class SolvedPart(NamedTuple):
    """A part of a segment, solved."""

    first: int
    end: int
    poses: FloatArray
    wheels: FloatArray
    tags: dict[TagKey, FloatArray]
    calibration: dict[Parameter, float]
    cost: float
    freedom: int


def grow_parts(segment: Segment, effort: SolveBudget, *, backwards: bool) -> list[SolvedPart]:
    """Longer and longer parts of the segment, from one end on, as long as there is effort for them."""
    n = len(segment.stamps_ns)
    parts: list[SolvedPart] = []
    for end in _coarse_ends(segment):
        if effort.is_spent():
            break
        piece = (n - end, n) if backwards else (0, end)
        parts.append(_solve_part(segment, *piece, parts[-1] if parts else None, effort))
    return parts


def noise_factor(grown: Sequence[Sequence[SolvedPart]]) -> float:
    """How much larger than told the variances are, 1 at least: by what most pieces add, of which a break spoils few."""
    added = [
        2.0 * (after.cost - before.cost) / (after.freedom - before.freedom)
        for parts in grown
        for before, after in pairwise(parts)
        if after.freedom > before.freedom
    ]
    return max(1.0, float(np.median(added))) if added else 1.0


def limit_of(segment: Segment, parts: Sequence[SolvedPart], factor: float, effort: SolveBudget) -> SolvedPart | None:
    """Return the longest part whose observations fit together within the budget; None where all of the segment does."""
    for before, after in pairwise(parts):
        if _strains(before, after, factor, len(parts)):
            return _refine_end(segment, before, after, factor, effort)
    return None


def _refine_end(
    segment: Segment, known: SolvedPart, beyond: SolvedPart, factor: float, effort: SolveBudget
) -> SolvedPart:
    """Return the longest part between one that fits and a longer one that does not, to the keyframe, by bisection."""
    longest = known
    observation = np.unique(segment.observations.keyframe)
    ahead = observation[(observation >= known.end) & (observation < beyond.end)] + 1
    back = observation[(observation < known.first) & (observation >= beyond.first)][::-1]
    parts = [(known.first, int(end)) for end in ahead] + [(int(first), known.end) for first in back]
    fitting, strained = -1, len(parts)
    while strained - fitting > 1 and not effort.is_spent():
        middle = (fitting + strained) // 2
        grown = _solve_part(segment, *parts[middle], longest, effort)
        if _strains(known, grown, factor, len(parts)):
            strained = middle
        else:
            fitting, longest = middle, grown
    return longest


def _strains(before: SolvedPart, after: SolvedPart, factor: float, n_tests: int) -> bool:
    """Whether a longer part costs more than chance adds."""
    freedom = max(1, after.freedom - before.freedom)
    return 2.0 * (after.cost - before.cost) > factor * chi2.isf(FALSE_ALARM / n_tests, freedom)


def _solve_part(segment: Segment, first: int, end: int, known: SolvedPart | None, effort: SolveBudget) -> SolvedPart:
    """A part of a segment, from what is known of another that has an end in common with it."""
    part = segment.part(first, end)
    graph = build_graph([part])
    wheels = np.zeros(segment.odometry.jacobian.shape[2]) if known is None else known.wheels
    poses = _poses(segment, first, end, known, wheels)
    start = graph.start(poses, {}, {}) if known is None else graph.start(poses, known.tags, known.calibration)
    solution = solve(graph.problem, start, COST_TOLERANCE, most_tries=effort.max_linearisations(graph.problem, 1.0))
    effort.spend(solution, is_built=True)
    state, problem = solution.state, graph.problem
    freedom = problem.n_residuals + int((problem.columns.calibration >= 0).sum()) - problem.columns.n
    wheels, tags = graph.odometry_calibration(state, 0), graph.tags_of(state)
    return SolvedPart(first, end, state.poses, wheels, tags, graph.calibration_of(state), solution.cost, freedom)


def _poses(segment: Segment, first: int, end: int, known: SolvedPart | None, wheels: FloatArray) -> FloatArray:
    """Of a part: those known, and dead reckoning on from them either way."""
    odometry = segment.odometry.part(first, end - 1)
    motion = se2.compose(odometry.motion, se2.exp(odometry.jacobian @ wheels))
    if known is None:
        return chain_motions(motion, np.zeros(3))
    kept = known.poses[max(0, first - known.first) : end - known.first]
    at = max(0, known.first - first)
    after = chain_motions(motion[at + len(kept) - 1 :], kept[-1])[1:]
    before = chain_motions(se2.inverse(motion[:at][::-1]), kept[0])[1:][::-1]
    return np.concatenate([before, kept, after])


def _coarse_ends(segment: Segment) -> list[int]:
    """Numbers of keyframes, some metres apart; the last is all of them."""
    along_m = segment.along_m
    step_m = max(_PIECE_M, along_m[-1] / _MOST_PIECES)
    marks = np.searchsorted(along_m, np.arange(step_m, along_m[-1], step_m)) + 1
    ends: list[int] = np.unique([*marks[(marks > 1) & (marks < len(along_m))], len(along_m)]).tolist()
    return ends
