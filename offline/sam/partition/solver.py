"""The solve of a problem in parts, with the steps of a single process, and the covariances of its solution."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import Handle, Stages, TaskWorkers, Workers
from groundsbot.offline.sam.arrowhead.build import segment_starts
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.minimisation import COST_TOLERANCE, MAX_STEPS, Stopping, factorise, minimise
from groundsbot.offline.sam.partition.division import ProblemPart, Whole, divide
from groundsbot.offline.sam.partition.elimination import build
from groundsbot.offline.sam.partition.system import (
    PartitionedFactorisation,
    PartitionedSystem,
)
from groundsbot.offline.sam.solver import DEFAULT_LOSSES, Losses, Problem, Solution, solve

# Here fewer poses are linearised and eliminated in the time in which messages go to and fro.
LEAST_POSES: Final = 150_000


@dataclass(frozen=True)
class PartitionedSolution:
    """The result of a solve in parts; attributes as in `Solution`."""

    state: State
    costs: tuple[float, ...]
    reason: str
    converged: bool
    n_linearised: int
    linear: PartitionedSystem = field(repr=False)
    losses: Losses = DEFAULT_LOSSES

    @property
    def cost(self) -> float:
        """Final cost."""
        return self.costs[-1]

    @cached_property
    def factorisation(self) -> PartitionedFactorisation:
        """Factorisation of H at the solution, damped where that of a `Solution` is.

        Raises:
            UnderDeterminedError: a variable is in no factor, or measurements are not finite.
        """
        system, _ = self.linear.linearise(self.state, *self.losses)
        return factorise(self.linear, system, 0.0)[0]

    @cached_property
    def covariance_of_top(self) -> FloatArray:
        """Joint covariance (t, t) of starts, and of tags and free calibration in the top, in its order."""
        factorisation = self.factorisation
        with self.linear.stages.stage("covariance of the top"):
            return factorisation.covariance_of_top()

    def covariance(self, columns: IntArray) -> FloatArray:
        """Return the joint covariance (k, k) of k columns of the tangent vector, to first order; 0 where fixed (-1).

        Raises:
            ValueError: a column is that of a variable that is not in the top.
        """
        free = np.flatnonzero(columns >= 0)
        in_top = self.linear.whole.top_in_tangent[columns[free]]
        if (in_top < 0).any():
            raise ValueError("covariances are those of starts of segments, and of tags and calibration in the top")
        covariance = np.zeros((len(columns), len(columns)))
        covariance[np.ix_(free, free)] = self.covariance_of_top[np.ix_(in_top, in_top)]
        return covariance

    def pose_covariances(self, poses: IntArray) -> FloatArray:
        """Return the covariance (k, 3, 3) of each of k poses, in its own axes; computed by the workers."""
        return self.factorisation.pose_covariances(self.covariance_of_top)[poses]


def hold_parts(
    whole: Whole, parts: Sequence[ProblemPart], workers: TaskWorkers, stages: Stages | None = None
) -> PartitionedSystem:
    """Return the system of parts that are sent to workers."""
    handles: list[Handle] = [workers.call("part", build, part) for part in parts]
    return PartitionedSystem(whole, [part.numbers for part in parts], handles, workers, stages or Stages())


def solve_parts(
    linear: PartitionedSystem, start: State, losses: Losses = DEFAULT_LOSSES, stopping: Stopping | None = None
) -> PartitionedSolution:
    """Minimise the cost as `solver.solve` does, by the same steps but for rounding.

    Args:
        linear: parts with workers.
        start: initial state of all variables.
        losses: losses of odometry and observations.
        stopping: when to end, as for `solver.solve`.

    Raises:
        ValueError: the state has other sizes than the whole.
        OfflineError: workers are lost.
    """
    linear.whole.columns.check(start)
    found = minimise(linear, linear.whole.anchor, start, losses, stopping or Stopping())
    linear.without_scratch()
    solution = PartitionedSolution(
        found.state, found.costs, found.reason, found.converged, found.n_linearised, linear, losses
    )
    if found.factorisation is not None:
        vars(solution)["factorisation"] = found.factorisation  # cached property
    return solution


def solve_with_workers(
    problem: Problem,
    start: State,
    cost_tolerance: float = COST_TOLERANCE,
    most_steps: int = MAX_STEPS,
    *,
    workers: Workers | None = None,
) -> Solution:
    """Return the solution by `solver.solve`; that of a fleet in parts, each a segment, on a cluster.

    In parts it differs by rounding.

    Raises:
        OfflineError: workers are lost.
    """
    tasks = None if workers is None else workers.tasks
    if tasks is None or len(start.poses) < LEAST_POSES:
        return solve(problem, start, cost_tolerance, most_steps=most_steps)
    problem.check(start)
    first_poses = segment_starts(problem.odometry, len(start.poses))[:-1]
    linear = hold_parts(*divide(problem, first_poses.tolist(), np.zeros(0, dtype=np.int64)), tasks)
    found = solve_parts(linear, start, stopping=Stopping(cost_tolerance, most_steps=most_steps))
    return Solution(
        found.state, found.costs, found.reason, found.converged, problem, found.losses, n_linearised=found.n_linearised
    )
