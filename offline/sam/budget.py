"""Limits on the work and the memory of a solve, so that a small hostile file cannot take minutes or gigabytes.

Work is counted in multiplications, which makes the limit independent of the machine; 1e10 take about a second. The
limit grows with the size of the log. A real drive needs a small part of it: since noise cannot be compressed, its log
has at least about 50 bytes for a detection and 12 for an imported observation, and recorded logs have 200 and more.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import ALONE, Inputs
from groundsbot.offline.measurements import Segment
from groundsbot.offline.sam.solver import MAX_TRIES, Problem, Solution

# Time to linearise a factor, in multiplications of a leaf; multiplications above the leaves run in larger blocks.
_A_FACTOR: Final = 2000.0
_IN_BLOCKS: Final = 0.3
# A dense solve of all tags of the families, 1304 columns, takes 0.7e9 a step.
_FREE_WORK: Final = 30e9
# Times the square of the log's size, since longer drives need more steps: an import of 2 km past 762 tags with 98,000
# observations in 3.2 MB, the densest that noise allows, takes 165e9 of 310e9.
_WORK_AT_A_MIB: Final = 30e9
# Least number of steps of a map over the whole log, in all stages together.
_LEAST_STEPS: Final = 30
# Least number of linearisations of a solve: enough from a good start.
_LEAST_OF_A_SOLVE: Final = 6
# Time to build a graph and its order of elimination, in linearisations of all factors.
_A_BUILDING: Final = 3.5
# Memory of `map` for each keyframe and observation, without fronts, as measured.
_BYTES_A_KEYFRAME: Final = 3300.0
_BYTES_A_OBSERVATION: Final = 2900.0
_FREE_BYTES: Final = 56 << 20
_BYTES_PER_BYTE: Final = 160.0
# Segments are aligned by the joint covariances of their tags. One segment may observe all tags of the families; each
# further segment that observes a tag has about 26 observations of 200 bytes of it.
_FREE_PLACES: Final = 652
_BYTES_A_PLACE: Final = 5200


@dataclass
class SolveBudget:
    """The work and memory that a log, or one of its segments, may take.

    Attributes:
        allowed: total work, in multiplications.
        left: remaining work.
        memory_bytes: memory that a map of it may take.
        committed: work of one step over all problems that passed `check`.
        places: remaining number of tags that segments may observe, counted in each segment.
        whole: budget of the log, if this is the budget of a segment.
    """

    allowed: float
    left: float
    memory_bytes: float
    committed: float = 0.0
    places: float = np.inf
    whole: "SolveBudget | None" = None

    @staticmethod
    def of_log(log_bytes: int, inputs: Inputs = ALONE, times: int = 1) -> "SolveBudget":
        """Return the budget of one of `times` solves of a log of this size that is mapped with other inputs."""
        free = 1.0 / inputs.n_logs
        size_mib, all_mib = log_bytes / 2**20, max(log_bytes, inputs.n_bytes) / 2**20
        allowed = free * _FREE_WORK + _WORK_AT_A_MIB * size_mib * all_mib
        return SolveBudget(
            allowed / times,
            allowed / times,
            free * _FREE_BYTES + _BYTES_PER_BYTE * log_bytes,
            places=_FREE_PLACES + log_bytes / _BYTES_A_PLACE,
        )

    def split(self, sizes: Sequence[int]) -> list["SolveBudget"]:
        """Return the budgets of segments, in proportion to their sizes."""
        allowed = [self.allowed * size / max(1, sum(sizes)) for size in sizes]
        return [replace(self, allowed=each, left=each, whole=self) for each in allowed]

    def take(self, share: float) -> "SolveBudget":
        """Take a share of the remaining work, for a part of a segment that passed `check`."""
        work = share * max(self.left, 0.0)
        self.left -= work
        return SolveBudget(work, work, self.memory_bytes, committed=-np.inf)

    def give_back(self, taken: "SolveBudget") -> None:
        """Return the remaining work of a budget from `take`, which is negative if it was exceeded."""
        self.left += taken.left

    def is_spent(self) -> bool:
        """Return whether no work remains."""
        return self.left <= 0.0

    def suffices(self, problem: Problem) -> bool:
        """Return whether the budget suffices for the solves of a problem."""
        return step_work(problem) <= self.allowed / _LEAST_STEPS and memory_bytes_of(problem) <= self.memory_bytes

    def check(self, problem: Problem, log: Path, name: str) -> None:
        """Check that the budget suffices for a problem in addition to those that were checked before.

        Raises:
            OfflineError: it does not; the message names log, segment, need, limit and remedy.
        """
        whole = self.whole or self
        whole.committed += step_work(problem)
        whole.places -= len(problem.columns.tags)
        if whole.places < 0.0:
            raise OfflineError(
                f"{log}: {name}: the run's segments observe more tags than a log of this size can record; "
                "check the tags' ids, or leave out some of the observations"
            )
        if whole.committed <= whole.allowed / _LEAST_STEPS and memory_bytes_of(problem) <= self.memory_bytes:
            return
        work, mib = whole.committed / 1e9, memory_bytes_of(problem) / 2**20
        observations = problem.observations
        raise OfflineError(
            f"{log}: {name}: {len(observations.tag)} observations of {len(problem.columns.tags)} tags from "
            f"{len(problem.columns.poses)} keyframes would take {work:.1f}e9 multiplications a step and {mib:.0f} MiB, "
            f"limit {whole.allowed / _LEAST_STEPS / 1e9:.1f}e9 and {self.memory_bytes / 2**20:.0f} MiB for a log of "
            "this size; check the tags' ids, or leave out some of the observations"
        )

    def max_linearisations(self, problem: Problem, share: float, most: int = MAX_TRIES) -> int:
        """Return the number of linearisations that a share of the allowed work, or the remaining work, suffices for."""
        work = min(share * self.allowed, max(self.left, 0.0))
        return max(_LEAST_OF_A_SOLVE, min(most, int(work / step_work(problem))))

    def spend(self, solution: Solution, *, is_built: bool = False) -> None:
        """Subtract the work of a solve, and with `is_built` also that of building its problem."""
        self.left -= solution.n_linearised * step_work(solution.problem)
        if is_built:
            self.left -= _A_BUILDING * _A_FACTOR * _n_factors(solution.problem)


def budgets_of(segments: Sequence[Segment], times: int = 1) -> list[SolveBudget]:
    """Return the budget of each segment, for one of `times` solves of each log by a command."""
    of_run: dict[str, list[Segment]] = {}
    for segment in segments:
        of_run.setdefault(segment.run.name, []).append(segment)
    parts = {
        name: iter(
            SolveBudget.of_log(some[0].run.log_bytes, some[0].run.inputs, times).split([size_of(c) for c in some])
        )
        for name, some in of_run.items()
    }
    return [next(parts[segment.run.name]) for segment in segments]


def size_of(segment: Segment) -> int:
    """Return the number of keyframes and observations of a segment, with which work grows."""
    return len(segment.stamps_ns) + len(segment.observations)


def step_work(problem: Problem) -> float:
    """Return the multiplications of one step: linearisation of all factors and elimination of all variables."""
    tree = problem.arrowhead.tree
    square = np.square(np.diff(tree.front_start).astype(np.float64))
    leaf = tree.level == 0
    in_leaves = (3.0 * (tree.end - tree.first) * square)[leaf].sum()
    above = (tree.n_eliminated * square)[~leaf].sum()
    return float(_A_FACTOR * _n_factors(problem) + in_leaves + _IN_BLOCKS * above)


def _n_factors(problem: Problem) -> int:
    return len(problem.odometry.first) + len(problem.observations.tag)


def memory_bytes_of(problem: Problem) -> float:
    """Return the memory of mapping a problem: keyframes, observations, and fronts and rows of an elimination."""
    tree = problem.arrowhead.tree
    size = np.diff(tree.front_start).astype(np.float64)
    widest = sum(float(size[tree.level == level].max(initial=0.0)) ** 2 for level in np.unique(tree.level))
    fronts = 8.0 * (float((tree.n_eliminated * size).sum()) + widest)
    return fronts + _BYTES_A_KEYFRAME * tree.n_poses + _BYTES_A_OBSERVATION * len(problem.observations.tag)
