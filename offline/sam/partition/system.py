"""The normal equations of a problem whose parts are with workers, for the loop of `minimisation`.

States and steps of all variables are here, 24 bytes for a pose each. A worker gets the values of its part's variables,
and returns their step.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.foundation import Handle, Stages, TaskWorkers
from groundsbot.offline.sam.arrowhead.marginals import covariance_of_top
from groundsbot.offline.sam.arrowhead.retraction import retract, retract_relative
from groundsbot.offline.sam.arrowhead.system import Factorisation
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor
from groundsbot.offline.sam.linearisation.kernels import diagonal_square
from groundsbot.offline.sam.linearisation.robust_losses import Loss
from groundsbot.offline.sam.partition.division import PartNumbers, Whole
from groundsbot.offline.sam.partition.elimination import (
    PartStep,
    cost_of,
    eliminate,
    linearise,
    pose_covariances,
    reduce,
    substitute,
)
from groundsbot.offline.sam.partition.reduced import Reduced, add, add_to_front, sum_in_tree


class ThisProcess:
    """Workers that are this process: handles are results."""

    def call(self, _name: str, function: Callable[..., object], *arguments: object) -> Handle:
        """Return the function's result."""
        return function(*arguments)

    def results(
        self, submit: Callable[[int], Handle], names: Sequence[str], tick: Callable[[], None]
    ) -> tuple[list[Handle], list[Any]]:
        """Return the results, twice."""
        found = []
        for i in range(len(names)):
            found.append(submit(i))
            tick()
        return found, found


@dataclass
class PartitionBlocks:
    """Normal equations: those of the top's own factors, and handles of those of the parts."""

    top: NormalEquations
    parts: list[Handle] = field(default_factory=list)


@dataclass(frozen=True)
class PartitionedSystem:
    """The normal equations of parts that are with workers.

    Attributes:
        whole: what this process knows of all parts.
        numbers: of each part.
        parts: handle of each `PartSystem`.
        workers: that have them.
        stages: records the time of each stage.
    """

    whole: Whole
    numbers: Sequence[PartNumbers]
    parts: Sequence[Handle]
    workers: TaskWorkers
    stages: Stages = field(default_factory=Stages)

    @cached_property
    def scratch(self) -> tuple[PartitionBlocks, PartitionBlocks, SquareRootFactor]:
        """Blocks and work arrays of a solve."""
        return self.empty_system(), self.empty_system(), self.whole.arrowhead.empty_rows()

    def empty_system(self) -> PartitionBlocks:
        """Return blocks that `linearise` overwrites."""
        return PartitionBlocks(self.whole.arrowhead.empty_system())

    def linearise(
        self, state: State, odometry_loss: Loss, observation_loss: Loss, out: PartitionBlocks | None = None
    ) -> tuple[PartitionBlocks, float]:
        """Return normal equations and cost; see `Arrowhead.linearise`."""
        system = out if out is not None else self.empty_system()
        losses, linearised = (odometry_loss, observation_loss), [None] * len(self.parts)
        system.parts = linearised

        def submit(i: int) -> Handle:
            own = self.numbers[i]
            values = State(state.poses[own.first : own.end], state.tags[own.tags], state.calibration[own.calibration])
            linearised[i] = self.workers.call("linearise", linearise, self.parts[i], values, losses)
            return self.workers.call("cost", cost_of, linearised[i])

        _, cost = self.whole.arrowhead.linearise(self.whole.top_state(state), out=system.top)
        costs = self.results_of_parts("linearising parts", submit)
        return system, cost + float(sum(costs))

    def factorise(
        self, system: PartitionBlocks, damping: float, out: SquareRootFactor | None = None
    ) -> "PartitionedFactorisation":
        """Factorise H + damping diag(H): parts are eliminated, and the sum of what remains is factorised here.

        Raises:
            UnderDeterminedError: the matrix is not positive definite.
        """
        n_top = len(self.whole.arrowhead.top_columns)
        eliminated: list[Handle] = [None] * len(self.parts)

        def submit(_: int) -> Handle:
            reduced = []
            for i, part in enumerate(self.parts):
                eliminated[i] = self.workers.call("eliminate", eliminate, part, system.parts[i], damping)
                reduced.append(self.workers.call("reduce", reduce, part, eliminated[i], n_top))
            return sum_in_tree(reduced, partial(self.workers.call, "add", add))

        with self.stages.stage("eliminating parts"):
            total: Reduced = self.workers.results(submit, ["the sum of all parts"], _nothing)[1][0]
        with self.stages.stage("factorising the top"):
            arrowhead = self.whole.arrowhead
            rows = out if out is not None else arrowhead.empty_rows()
            front = arrowhead.reduce_to_top(system.top, damping, rows)
            add_to_front(total, front)
            top = arrowhead.factorise_top(system.top, rows, front)
        return PartitionedFactorisation(self, tuple(system.parts), eliminated, top, total.gradient)

    def retract(self, state: State, step: FloatArray, anchor: IntArray) -> State:
        """Return the state after a step, pose by pose; see `Arrowhead.retract`."""
        return retract(state, step, anchor, self.whole.columns.calibration >= 0)

    def retract_relative(self, before: State, step: FloatArray, anchor: IntArray, moved: State) -> State:
        """Return the state after the same step as `moved`, motion by motion; see `Arrowhead.retract_relative`."""
        return retract_relative(before, step, anchor, self.whole.segment_start, moved)

    def results_of_parts(self, stage: str, submit: Callable[[int], Handle]) -> list[Any]:
        """Return a result for each part; `submit` is called with its number."""
        names = [f"poses {own.first} to {own.end - 1}" for own in self.numbers]
        with self.stages.stage(stage, len(names)) as tick:
            return self.workers.results(submit, names, tick)[1]

    def join(self, of_top: FloatArray, of_parts: Sequence[FloatArray]) -> FloatArray:
        """Return a vector of all variables (3P + 2T + C,) from those of the top (t,) and of the parts."""
        n_poses, n_tags = len(self.whole.columns.poses), len(self.whole.columns.tags)
        n_starts, n_top_tags = len(self.whole.segment_start) - 1, len(self.whole.top_tags)
        is_free, in_top = self.whole.columns.calibration >= 0, self.whole.top_calibration
        poses, tags, calibration = np.zeros((n_poses, 3)), np.zeros((n_tags, 2)), np.zeros(len(is_free))
        for own, vector in zip(self.numbers, of_parts, strict=True):
            n = 3 * (own.end - own.first)
            poses[own.first : own.end] = vector[:n].reshape(-1, 3)
            tags[own.tags] = vector[n : n + 2 * len(own.tags)].reshape(-1, 2)
            calibration[own.calibration[is_free[own.calibration]]] = vector[n + 2 * len(own.tags) :]
        ends = 3 * n_starts, 3 * n_starts + 2 * n_top_tags
        tags[self.whole.top_tags] = of_top[ends[0] : ends[1]].reshape(-1, 2)
        calibration[in_top[is_free[in_top]]] = of_top[ends[1] :]
        return np.concatenate([poses.reshape(-1), tags.reshape(-1), calibration[is_free]])

    def without_scratch(self) -> None:
        """Release the work arrays, which a factorisation that is kept may be in."""
        vars(self).pop("scratch", None)


@dataclass(frozen=True)
class PartitionedFactorisation:
    """A factorisation of H + damping diag(H) whose parts are with workers.

    Attributes:
        linear: the system.
        linearised: handle of each `LinearisedPart`.
        eliminated: handle of each `EliminatedPart`.
        top: factorisation of the top.
        gradient: (t,) sum of the parts' reduced gradients.
    """

    linear: PartitionedSystem
    linearised: Sequence[Handle]
    eliminated: Sequence[Handle]
    top: Factorisation
    gradient: FloatArray

    def step(self, damping: float) -> tuple[FloatArray, float]:
        """Return the step of all variables (3P + 2T + C,) and its predicted decrease; see `Factorisation.step`."""
        linear, numbers = self.linear, self.linear.numbers
        with linear.stages.stage("solving the top"):
            of_top = -self.top.solve_in_order(self.top.system.gradient + self.gradient)

        def submit(i: int) -> Handle:
            in_top = of_top[numbers[i].in_top]
            own = linear.parts[i], self.linearised[i], self.eliminated[i]
            return linear.workers.call("substitute", substitute, *own, in_top)

        steps: list[PartStep] = linear.results_of_parts("substituting back", submit)
        along = float(self.top.system.gradient @ of_top) + sum(each.along for each in steps)
        square = diagonal_square(self.top.system, of_top) + sum(each.square for each in steps)
        return linear.join(of_top, [each.step for each in steps]), 0.5 * (damping * square - along)

    def covariance_of_top(self) -> FloatArray:
        """Return the joint covariance (t, t) of the top's columns."""
        return covariance_of_top(self.top.top)

    def pose_covariances(self, of_top: FloatArray) -> FloatArray:
        """Return the covariances (P, 3, 3) of all poses, each in its own axes; 0 where fixed.

        Args:
            of_top: (t, t) covariance of the top's columns.
        """
        linear = self.linear

        def submit(i: int) -> Handle:
            in_top = linear.numbers[i].in_top
            own = linear.parts[i], self.linearised[i], self.eliminated[i]
            return linear.workers.call("covariances", pose_covariances, *own, of_top[in_top[:, None], in_top])

        return np.concatenate(linear.results_of_parts("covariances of poses", submit))


def _nothing() -> None:
    """Report no progress."""
