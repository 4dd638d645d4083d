"""How much work a log is worth: a small file that was made for it shall not take minutes or gigabytes.

Work is counted in multiplications, so that it is the same on any machine; some ten thousand million take a second. What
is allowed grows with the log. A drive needs a small part of it: its logs have at least some 50 bytes a look and 12 a
observation, since noise cannot be compressed, and recorded ones 200 and more.
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

# Linearising a factor takes as long as so many multiplications in a leaf; those above run in larger blocks.
_A_FACTOR: Final = 2000.0
_IN_BLOCKS: Final = 0.3
# A dense solve of all tags that the families have, 1304 columns, takes 0.7e9 a step.
_FREE_WORK: Final = 30e9
# By the square of a log's size, since building up takes the more steps the longer the way: an import of 2 km past 762
# tags with 98,000 observations in 3.2 MB, as dense as noise can be packed, takes 165e9 of 310e9.
_WORK_AT_A_MIB: Final = 30e9
# A map takes at least as many steps over the whole log, all its stages together.
_LEAST_STEPS: Final = 30
# No solve gets fewer tries than this: one from a good start needs no more.
_LEAST_OF_A_SOLVE: Final = 6
# Building a problem's graph and the order of its elimination takes as long as linearising its factors so many times.
_A_BUILDING: Final = 3.5
# What map takes of memory for each keyframe and observation, fronts aside, as measured.
_BYTES_A_KEYFRAME: Final = 3300.0
_BYTES_A_OBSERVATION: Final = 2900.0
_FREE_BYTES: Final = 56 << 20
_BYTES_PER_BYTE: Final = 160.0
# Segments are laid over each other by the joint covariances of their tags. One segment may see all tags that there
# are; that others see them again takes a recorder some 26 observations of 200 bytes for each.
_FREE_PLACES: Final = 652
_BYTES_A_PLACE: Final = 5200


@dataclass
class SolveBudget:
    """What may be spent on a log or on one of its segments, and what is left of it.

    Attributes:
        allowed: work, by the log's size.
        left: what was not yet used.
        memory_bytes: that a map of it may take.
        promised: work of one step over all problems that were found to be affordable.
        places: how many tags all segments may see, each counted anew in each.
        whole: the log's, where this is a segment's.
    """

    allowed: float
    left: float
    memory_bytes: float
    promised: float = 0.0
    places: float = np.inf
    whole: "SolveBudget | None" = None

    @staticmethod
    def of_log(log_bytes: int, inputs: Inputs = ALONE, times: int = 1) -> "SolveBudget":
        """What a log of this size is worth beside the others that are mapped with it, each of so many times."""
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
        """Of segments, each as much as its share of all their sizes."""
        allowed = [self.allowed * size / max(1, sum(sizes)) for size in sizes]
        return [replace(self, allowed=each, left=each, whole=self) for each in allowed]

    def take(self, share: float) -> "SolveBudget":
        """A share of what is left, for a part of a segment that was itself found to be affordable."""
        work = share * max(self.left, 0.0)
        self.left -= work
        return SolveBudget(work, work, self.memory_bytes, promised=-np.inf)

    def give_back(self, taken: "SolveBudget") -> None:
        """What is left of it, or what it used beyond it."""
        self.left += taken.left

    def is_spent(self) -> bool:
        """Whether nothing is left."""
        return self.left <= 0.0

    def suffices(self, problem: Problem) -> bool:
        """Whether some solves of a problem can be paid for."""
        return step_work(problem) <= self.allowed / _LEAST_STEPS and memory_bytes_of(problem) <= self.memory_bytes

    def check(self, problem: Problem, log: Path, name: str) -> None:
        """Refuses a problem that it does not suffice for, beside those that were checked before.

        Raises:
            OfflineError: naming log and segment, what a step would take, the limit and the way out.
        """
        whole = self.whole or self
        whole.promised += step_work(problem)
        whole.places -= len(problem.columns.tags)
        if whole.places < 0.0:
            raise OfflineError(
                f"{log}: {name}: the run's segments see more tags than a log of this size can tell of; "
                "are the tags' numbers right? leave out some of the looks"
            )
        if whole.promised <= whole.allowed / _LEAST_STEPS and memory_bytes_of(problem) <= self.memory_bytes:
            return
        work, mib = whole.promised / 1e9, memory_bytes_of(problem) / 2**20
        observations = problem.observations
        raise OfflineError(
            f"{log}: {name}: {len(observations.tag)} observations of {len(problem.columns.tags)} tags from "
            f"{len(problem.columns.poses)} keyframes would take {work:.1f}e9 multiplications a step and {mib:.0f} MiB, "
            f"limit {whole.allowed / _LEAST_STEPS / 1e9:.1f}e9 and {self.memory_bytes / 2**20:.0f} MiB for a log of "
            "this size; are the tags' numbers right? leave out some of the looks"
        )

    def max_linearisations(self, problem: Problem, share: float, most: int = MAX_TRIES) -> int:
        """How many tries a share of what is allowed is enough for, or what the solves before have left of it."""
        work = min(share * self.allowed, max(self.left, 0.0))
        return max(_LEAST_OF_A_SOLVE, min(most, int(work / step_work(problem))))

    def spend(self, solution: Solution, *, is_built: bool = False) -> None:
        """Takes off what a solve used, and what building its problem did where that counts."""
        self.left -= solution.n_linearised * step_work(solution.problem)
        if is_built:
            self.left -= _A_BUILDING * _A_FACTOR * _n_factors(solution.problem)


def budgets_of(segments: Sequence[Segment], times: int = 1) -> list[SolveBudget]:
    """What each segment of some runs is worth of its log, each of the times that a command maps them."""
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
    """Its keyframes and observations: work grows with them."""
    return len(segment.stamps_ns) + len(segment.observations)


def step_work(problem: Problem) -> float:
    """Multiplications that linearising all factors and eliminating all variables takes."""
    tree = problem.arrowhead.tree
    square = np.square(np.diff(tree.front_start).astype(np.float64))
    leaf = tree.level == 0
    in_leaves = (3.0 * (tree.end - tree.first) * square)[leaf].sum()
    above = (tree.n_eliminated * square)[~leaf].sum()
    return float(_A_FACTOR * _n_factors(problem) + in_leaves + _IN_BLOCKS * above)


def _n_factors(problem: Problem) -> int:
    return len(problem.odometry.first) + len(problem.observations.tag)


def memory_bytes_of(problem: Problem) -> float:
    """What mapping takes of memory: keyframes, observations, and the fronts and rows of an elimination."""
    tree = problem.arrowhead.tree
    size = np.diff(tree.front_start).astype(np.float64)
    widest = sum(float(size[tree.level == level].max(initial=0.0)) ** 2 for level in np.unique(tree.level))
    fronts = 8.0 * (float((tree.n_eliminated * size).sum()) + widest)
    return fronts + _BYTES_A_KEYFRAME * tree.n_poses + _BYTES_A_OBSERVATION * len(problem.observations.tag)
