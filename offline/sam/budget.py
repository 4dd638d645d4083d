"""Limits on work and memory, so that a small hostile file cannot take minutes or gigabytes.

Work is counted in multiplications, which makes the limit independent of the machine; 1e10 take about a second. The
limit grows with the size of the logs. A real drive needs a small part of it: since noise cannot be compressed, its log
has at least about 50 bytes for a detection and 12 for an imported observation, and recorded logs have 200 and more.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.measurements import ALONE, Inputs, Segment
from groundsbot.offline.sam.graph import build_graph
from groundsbot.offline.sam.minimisation import MAX_TRIES
from groundsbot.offline.sam.solver import Problem, Solution

# Time to linearise a factor, in multiplications of a leaf; multiplications above the leaves run in larger blocks. Time
# to build a graph and its order of elimination, in linearisations of all factors.
_A_FACTOR: Final = 2000.0
_IN_BLOCKS: Final = 0.3
_A_BUILDING: Final = 3.5
# A dense solve of all tags of the families, 1304 columns, takes 0.7e9 a step.
_FREE_WORK: Final = 30e9
# Times the square of the log's size, since longer drives need more steps: an import of 2 km past 762 tags with 98,000
# observations in 3.2 MB, the densest that noise allows, takes 165e9 of 310e9.
_WORK_AT_A_MIB: Final = 30e9
# Least number of steps of a map over the whole log, in all stages together; and of linearisations of a solve.
_LEAST_STEPS: Final = 30
_LEAST_OF_A_SOLVE: Final = 6
# Memory of `map` for each keyframe and observation, without fronts, as measured.
_BYTES_A_KEYFRAME: Final = 3300.0
_BYTES_A_OBSERVATION: Final = 2900.0
_FREE_BYTES: Final = 56 << 20
_BYTES_PER_BYTE: Final = 160.0
# Segments are aligned by the joint covariances of their tags. One segment may observe all tags of the families; each
# further segment that observes a tag has about 26 observations of 200 bytes of it.
_FREE_PLACES: Final = 652
_BYTES_A_PLACE: Final = 5200


class BudgetSpentError(Exception):
    """No work is left; not a user's mistake."""


@dataclass
class Budget:
    """The work, in multiplications, and the memory that logs or a part of one may take; unlimited by default."""

    allowed: float = np.inf
    memory_bytes: float = np.inf
    left: float = field(init=False)

    def __post_init__(self) -> None:
        """Begin with all work left."""
        self.left = self.allowed

    @staticmethod
    def of_log(log_bytes: int, inputs: Inputs = ALONE, times: int = 1) -> "Budget":
        """Return the budget of one of `times` uses of a log of this size that is mapped with other inputs."""
        size_mib, all_mib = log_bytes / 2**20, max(log_bytes, inputs.n_bytes) / 2**20
        allowed = _FREE_WORK / inputs.n_logs + _WORK_AT_A_MIB * size_mib * all_mib
        return Budget(allowed / times, _FREE_BYTES / inputs.n_logs + _BYTES_PER_BYTE * log_bytes)

    def take(self, share: float) -> "Budget":
        """Take a share of the remaining work, for a part of a segment."""
        taken = Budget(share * max(self.left, 0.0), self.memory_bytes)
        self.left -= taken.allowed
        return taken

    def give_back(self, taken: "Budget") -> None:
        """Return the remaining work of a budget from `take`, which is negative if it was exceeded."""
        self.left += taken.left

    def is_spent(self) -> bool:
        """Return whether no work remains."""
        return self.left <= 0.0

    def suffices(self, problem: Problem) -> bool:
        """Return whether the budget suffices for the solves of a problem."""
        return step_work(problem) <= self.allowed / _LEAST_STEPS and memory_bytes_of(problem) <= self.memory_bytes

    def max_linearisations(self, problem: Problem, share: float, most: int = MAX_TRIES) -> int:
        """Return the number of linearisations that a share of the allowed work, or the remaining work, suffices for."""
        work = min(share * self.allowed, max(self.left, 0.0))
        return max(_LEAST_OF_A_SOLVE, int(min(most, work / step_work(problem))))

    def spend(self, solution: Solution, *, is_built: bool = False) -> None:
        """Subtract the work of a solve, and with `is_built` also that of building its problem."""
        self.left -= solution.n_linearised * step_work(solution.problem)
        if is_built:
            self.left -= _A_BUILDING * _A_FACTOR * solution.problem.n_factors

    def charge(self, work: float) -> None:
        """Subtract some work; raise BudgetSpentError if less was left."""
        self.left -= work
        if self.left < 0.0:
            raise BudgetSpentError


def budgets_of(segments: Sequence[Segment], times: int = 1) -> list[Budget]:
    """Return the budget of each segment, in proportion to its size, for one of `times` solves of each log.

    Raises:
        OfflineError: the budget of a log does not suffice; the message names log, segment, need, limit and remedy.
    """
    sizes = [len(each.stamps_ns) + len(each.observations) for each in segments]
    wholes = {each.run.name: Budget.of_log(each.run.log_bytes, each.run.inputs, times) for each in segments}
    n_places, in_all, work = (defaultdict[str, float](float) for _ in range(3))
    for segment, size in zip(segments, sizes, strict=True):
        run, whole, problem = segment.run, wholes[segment.run.name], build_graph([segment]).problem
        n_places[run.name] += len(segment.tags)
        in_all[run.name] += size
        work[run.name] += step_work(problem)
        n_bytes, most_work = memory_bytes_of(problem), whole.allowed / _LEAST_STEPS
        refusal = "the run's segments observe more tags than a log of this size can record"
        if n_places[run.name] <= _FREE_PLACES + run.log_bytes / _BYTES_A_PLACE:
            if work[run.name] <= most_work and n_bytes <= whole.memory_bytes:
                continue
            refusal = (
                f"{len(segment.observations)} observations of {len(segment.tags)} tags from {len(segment.stamps_ns)} "
                f"keyframes would take {work[run.name] / 1e9:.1f}e9 multiplications a step and {n_bytes / 2**20:.0f} "
                f"MiB, limit {most_work / 1e9:.1f}e9 and {whole.memory_bytes / 2**20:.0f} MiB for a log of this size"
            )
        raise OfflineError(
            f"{run.log}: {segment.name}: {refusal}; check the tags' ids, or leave out some of the observations"
        )
    shares = [(wholes[each.run.name], size / in_all[each.run.name]) for each, size in zip(segments, sizes, strict=True)]
    return [Budget(share * whole.allowed, whole.memory_bytes) for whole, share in shares]


def step_work(problem: Problem) -> float:
    """Return the multiplications of one step: linearisation of all factors and elimination of all variables."""
    tree = problem.arrowhead.tree
    square = np.square(np.diff(tree.front_start).astype(np.float64))
    leaf = tree.level == 0
    in_leaves = (3.0 * (tree.end - tree.first) * square)[leaf].sum()
    above = (tree.n_eliminated * square)[~leaf].sum()
    return float(_A_FACTOR * problem.n_factors + in_leaves + _IN_BLOCKS * above)


def memory_bytes_of(problem: Problem) -> float:
    """Return the memory of mapping a problem: keyframes, observations, and fronts and rows of an elimination."""
    tree = problem.arrowhead.tree
    size = np.diff(tree.front_start).astype(np.float64)
    widest = sum(size[tree.level == level].max() ** 2 for level in np.unique(tree.level))
    fronts = 8.0 * float((tree.n_eliminated * size).sum() + widest)
    return fronts + _BYTES_A_KEYFRAME * tree.n_poses + _BYTES_A_OBSERVATION * len(problem.observations.tag)
