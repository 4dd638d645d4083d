"""How much work a log is worth: a small file that was made for it shall not take minutes or gigabytes.

Work is counted in multiplications, so that it is the same on any machine; some ten thousand million take a second. What
is allowed grows with the log. A drive needs a small part of it: its logs have at least some 50 bytes a look and 12 a
reading, since noise cannot be compressed, and recorded ones 200 and more.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from offline.errors import OfflineError
from offline.inputs import ALONE, Inputs
from offline.run import Run
from offline.solver import MAX_STEPS, Problem, Solution

# Linearising a factor takes as long as so many multiplications in a leaf; those above run in larger blocks.
_A_FACTOR: Final = 2000.0
_IN_BLOCKS: Final = 0.3
# A dense solve of all tags that the families have, 1304 columns, takes 0.7e9 a step.
_FREE_WORK: Final = 30e9
# By the square of a log's size, since building up takes the more steps the longer the way: an import of 2 km past 762
# tags with 98,000 readings in 3.2 MB, as dense as noise can be packed, takes 165e9 of 310e9.
_WORK_AT_A_MIB: Final = 30e9
# A map takes at least as many steps over the whole log, all its stages together.
_LEAST_STEPS: Final = 30
# No solve gets less than this: one from a good start needs no more.
_LEAST_OF_A_SOLVE: Final = 6
# What map takes of memory for each keyframe and reading, fronts aside, as measured.
_BYTES_A_KEYFRAME: Final = 3300.0
_BYTES_A_READING: Final = 2900.0
_FREE_BYTES: Final = 56 << 20
_BYTES_PER_BYTE: Final = 160.0
# Stretches are laid over each other by the joint covariances of their tags. One stretch may see all tags that there
# are; that others see them again takes a recorder some 26 readings of 200 bytes for each.
_FREE_PLACES: Final = 652
_BYTES_A_PLACE: Final = 5200


@dataclass
class Effort:
    """What may be spent on a log, and what is left of it.

    Attributes:
        allowed: work, by the log's size.
        left: what was not yet used.
        memory_bytes: that a map of it may take.
        promised: work of one step over all problems that were found to be affordable.
        places: how many tags all stretches may see, each counted anew in each.
    """

    allowed: float
    left: float
    memory_bytes: float
    promised: float = 0.0
    places: float = np.inf

    @staticmethod
    def of_log(log_bytes: int, inputs: Inputs = ALONE, times: int = 1) -> "Effort":
        """What a log of this size is worth beside the others that are mapped with it, each of so many times."""
        free = 1.0 / inputs.n_logs
        size_mib, all_mib = log_bytes / 2**20, max(log_bytes, inputs.n_bytes) / 2**20
        allowed = free * _FREE_WORK + _WORK_AT_A_MIB * size_mib * all_mib
        return Effort(
            allowed / times,
            allowed / times,
            free * _FREE_BYTES + _BYTES_PER_BYTE * log_bytes,
            places=_FREE_PLACES + log_bytes / _BYTES_A_PLACE,
        )

    def suffices(self, problem: Problem) -> bool:
        """Whether some solves of a problem can be paid for."""
        return step_work(problem) <= self.allowed / _LEAST_STEPS and memory_bytes_of(problem) <= self.memory_bytes

    def check(self, problem: Problem, log: Path, name: str) -> None:
        """Refuses a problem that it does not suffice for, beside those that were checked before.

        Raises:
            OfflineError: naming log and chain, what a step would take, the limit and the way out.
        """
        self.promised += step_work(problem)
        self.places -= len(problem.columns.tags)
        if self.places < 0.0:
            raise OfflineError(
                f"{log}: {name}: the run's stretches see more tags than a log of this size can tell of; "
                "are the tags' numbers right? leave out some of the looks"
            )
        if self.promised <= self.allowed / _LEAST_STEPS and memory_bytes_of(problem) <= self.memory_bytes:
            return
        work, mib = self.promised / 1e9, memory_bytes_of(problem) / 2**20
        readings = problem.readings
        raise OfflineError(
            f"{log}: {name}: {len(readings.tag)} readings of {len(problem.columns.tags)} tags from "
            f"{len(problem.columns.poses)} keyframes would take {work:.1f}e9 multiplications a step and {mib:.0f} MiB, "
            f"limit {self.allowed / _LEAST_STEPS / 1e9:.1f}e9 and {self.memory_bytes / 2**20:.0f} MiB for a log of "
            "this size; are the tags' numbers right? leave out some of the looks"
        )

    def steps(self, problem: Problem, share: float, most: int = MAX_STEPS) -> int:
        """How many steps a share of what is allowed is enough for, or what the solves before have left of it."""
        work = min(share * self.allowed, max(self.left, 0.0))
        return max(_LEAST_OF_A_SOLVE, min(most, int(work / step_work(problem))))

    def spend(self, solution: Solution) -> None:
        """Takes off what a solve used."""
        self.left -= solution.n_linearised * step_work(solution.problem)


def efforts_of(runs: Sequence[Run], times: int = 1) -> dict[str, Effort]:
    """What each of some runs is worth, by its name, each of the times that a command maps them."""
    return {run.name: Effort.of_log(run.log_bytes, run.inputs, times) for run in runs}


def step_work(problem: Problem) -> float:
    """Multiplications that linearising all factors and eliminating all variables takes."""
    tree = problem.arrowhead.tree
    square = np.square(np.diff(tree.front_start).astype(np.float64))
    leaf = tree.level == 0
    in_leaves = (3.0 * (tree.end - tree.first) * square)[leaf].sum()
    above = (tree.n_eliminated * square)[~leaf].sum()
    n_factors = len(problem.odometry.first) + len(problem.readings.tag)
    return float(_A_FACTOR * n_factors + in_leaves + _IN_BLOCKS * above)


def memory_bytes_of(problem: Problem) -> float:
    """What mapping takes of memory: keyframes, readings, and the fronts and rows of an elimination."""
    tree = problem.arrowhead.tree
    size = np.diff(tree.front_start).astype(np.float64)
    widest = sum(float(size[tree.level == level].max(initial=0.0)) ** 2 for level in np.unique(tree.level))
    fronts = 8.0 * (float((tree.n_eliminated * size).sum()) + widest)
    return fronts + _BYTES_A_KEYFRAME * tree.n_poses + _BYTES_A_READING * len(problem.readings.tag)
