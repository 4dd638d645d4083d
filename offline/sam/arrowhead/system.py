"""The arrowhead system: normal equations of segments that are coupled through tags and calibration only.

Linearisation, elimination of each segment, solution in the small top, and back substitution, after Dellaert and Kaess,
"Square Root SAM" (2006). The order of elimination is nested dissection along the segments; see `arrowhead.tree`.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy import linalg

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam.arrowhead import block_substitution, substitution
from groundsbot.offline.sam.arrowhead.covariance import SquareRoot, joint_covariance, pair_covariances, square_root
from groundsbot.offline.sam.arrowhead.elimination import eliminate
from groundsbot.offline.sam.arrowhead.marginals import covariance_of_top, pose_marginals
from groundsbot.offline.sam.arrowhead.prior_blocks import PriorBlocks
from groundsbot.offline.sam.arrowhead.retraction import retract, retract_relative
from groundsbot.offline.sam.arrowhead.tree import Tree
from groundsbot.offline.sam.factors.odometry_and_observations import CalibrationPrior, State
from groundsbot.offline.sam.linearisation import kernels as linearise_kernels
from groundsbot.offline.sam.linearisation import observations as linearise_observations
from groundsbot.offline.sam.linearisation import odometry as linearise_odometry
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor
from groundsbot.offline.sam.linearisation.kernels import Free, ObservationArrays, OdometryArrays, Values
from groundsbot.offline.sam.linearisation.robust_losses import SQUARES, Loss

# Poses whose blocks are held before and after a step; those of so many take 50 MiB.
_MOST_WITH_SPARE: Final = 100_000


class UnderDeterminedError(ValueError):
    """The error of a column of the tangent vector that is not determined."""

    def __init__(self, column: int) -> None:
        super().__init__(f"column {column} of the normal equations has no positive pivot")
        self.column = column

    def __reduce__(self) -> tuple[type["UnderDeterminedError"], tuple[int]]:
        return type(self), (self.column,)


@dataclass(frozen=True)
class Arrowhead:
    """The parts of the system that are constant during a solve: sorted factors and the order of elimination.

    Attributes:
        tangent: (n,) column of the arrowhead for each column of the tangent vector.
    """

    tree: Tree
    odometry: OdometryArrays
    observations: ObservationArrays
    prior: CalibrationPrior
    free: Free
    tangent: IntArray
    measured: PriorBlocks | None = None

    def linearise(
        self,
        state: State,
        odometry_loss: Loss = SQUARES,
        observation_loss: Loss = SQUARES,
        out: NormalEquations | None = None,
    ) -> tuple[NormalEquations, float]:
        """Return H = J^T J and g = J^T r in blocks, and the cost: half the sum of all losses.

        Args:
            state: point of linearisation.
            odometry_loss: loss of each odometry factor.
            observation_loss: loss of each tag observation.
            out: blocks that are overwritten.
        """
        system = out if out is not None else self.empty_system()
        values = Values(state.poses, state.tags, state.calibration)
        linearise_kernels.clear(system)
        total = linearise_odometry.add_odometry(self.odometry, odometry_loss, values, self.free, system)
        total += linearise_observations.add_observations(self.observations, observation_loss, values, self.free, system)
        total += linearise_observations.add_priors(self.prior.sigma, values, self.free, system)
        if len(self.prior.rows):
            total += self._add_joint_prior(state, system)
        if self.measured is not None:
            total += self.measured.add(state, system)
        tree, own = self.tree, self.observations
        linearise_kernels.hold(own.pose, own.tag, tree.tag_segment_start, self.free, system)
        return system, 0.5 * total

    def _add_joint_prior(self, state: State, system: NormalEquations) -> float:
        """Add the joint factor of the calibration prior; return the sum of squares."""
        residual = self.prior.joint_residual(state)
        rows = self.prior.rows[:, self.free.calibration >= 0]
        system.calibration[:] += rows.T @ rows
        system.gradient[len(system.gradient) - len(system.calibration) :] += rows.T @ residual
        return float(residual @ residual)

    def retract(self, state: State, step: FloatArray, anchor: IntArray) -> State:
        """Return the state after a step in the arrowhead's order; tags move with their anchor poses (T,)."""
        return retract(state, step, anchor, self.free.calibration >= 0)

    def retract_relative(self, before: State, step: FloatArray, anchor: IntArray, moved: State) -> State:
        """Return the state after the same step as `moved`, motion by motion along each segment."""
        return retract_relative(before, step, anchor, self.tree.segment_start, moved)

    @cached_property
    def scratch(self) -> tuple[NormalEquations, NormalEquations, SquareRootFactor]:
        """Work arrays of a solve, reused by the next one since allocation is slow; not for concurrent solves.

        A fleet has one set of blocks, which is computed again after a step that fails.
        """
        system = self.empty_system()
        spare = system if self.tree.n_poses > _MOST_WITH_SPARE else self.empty_system()
        return system, spare, self.empty_rows()

    def without_scratch(self) -> None:
        """Release the work arrays of a problem that is kept but not solved again."""
        vars(self).pop("scratch", None)

    def empty_system(self) -> NormalEquations:
        """Return uninitialised blocks."""
        tree = self.tree
        return NormalEquations(
            pose=np.empty((tree.n_poses, 3, 3)),
            pose_next=np.empty((tree.n_poses, 3, 3)),
            pose_calibration=np.empty((tree.n_poses, 3, tree.n_slots)),
            pose_tag=np.empty((len(tree.observation_tag), 3, 2)),
            tag=np.empty((tree.n_tags, 2, 2)),
            tag_calibration=np.empty((len(tree.tag_segments), 2, tree.n_slots)),
            calibration=np.empty((tree.n_calibration, tree.n_calibration)),
            gradient=np.empty(3 * tree.n_poses + 2 * tree.n_tags + tree.n_calibration),
            distance=np.empty((0 if self.measured is None else len(self.measured.ends), 2, 5)),
        )

    def empty_rows(self) -> SquareRootFactor:
        """Return arrays for a factorisation."""
        tree = self.tree
        return SquareRootFactor(
            pose=np.zeros((tree.n_poses, 3, 3)),
            pose_next=np.zeros((tree.n_poses, 3, 3)),
            inner=np.empty(int(tree.rows_start[-1])),
            workspace=np.empty(int(tree.workspace_start[-1])),
            border=np.empty((2, 3, int(np.diff(tree.front_start)[tree.level == 0].max(initial=0)))),
            blocks=np.empty((2, 3, 3)),
            inside=np.empty((int((tree.end - tree.first)[tree.level == 0].max(initial=0)), 3)),
        )

    def factorise(
        self, system: NormalEquations, damping: float = 0.0, out: SquareRootFactor | None = None
    ) -> "Factorisation":
        """Factorise H + damping diag(H) as R^T R.

        Args:
            system: normal equations; the factorisation refers to them.
            damping: Levenberg-Marquardt damping, relative to the diagonal.
            out: arrays that are overwritten, which invalidates a factorisation that uses them.

        Raises:
            UnderDeterminedError: the matrix is not positive definite.
        """
        rows = out if out is not None else self.empty_rows()
        return self.factorise_top(system, rows, self.reduce_to_top(system, damping, rows))

    def reduce_to_top(self, system: NormalEquations, damping: float, rows: SquareRootFactor) -> FloatArray:
        """Eliminate all but the top; return its front (t, t), whose upper triangle is the Schur complement.

        Args:
            system: normal equations.
            damping: relative to the diagonal.
            rows: overwritten; the front is part of its workspace.

        Raises:
            UnderDeterminedError: an eliminated column has no positive pivot.
        """
        tree = self.tree
        rows.workspace[:] = 0.0
        failed = eliminate(tree, system, damping, rows)
        if failed >= 0:
            raise UnderDeterminedError(self.tangent_column(failed))
        n = len(self.top_columns)
        front = rows.workspace[int(tree.workspace_start[-2]) :].reshape(n, n)
        if n and self.measured is not None:
            self.measured.add_to_top(system, front)
        return front

    def factorise_top(self, system: NormalEquations, rows: SquareRootFactor, front: FloatArray) -> "Factorisation":
        """Return the factorisation by that of the top's front (t, t), which is overwritten.

        Raises:
            UnderDeterminedError: the front is not positive definite.
        """
        if not len(front):
            return Factorisation(self, system, rows, front)
        top, info = linalg.lapack.dpotrf(front.T, lower=1, clean=0, overwrite_a=1)
        if info:
            raise UnderDeterminedError(self.tangent_column(int(self.top_columns[info - 1])))
        return Factorisation(self, system, rows, top)

    @property
    def top_columns(self) -> IntArray:
        """Columns (t,) of the top's front, in the arrowhead's order."""
        return self.tree.front[self.tree.front_start[-2] :]

    def in_order(self, tangent: FloatArray) -> FloatArray:
        """Return tangent vectors (n, ...) in the arrowhead's order; zero where fixed."""
        out = np.zeros((3 * self.tree.n_poses + 2 * self.tree.n_tags + self.tree.n_calibration, *tangent.shape[1:]))
        out[self.tangent] = tangent
        return out

    def product(self, system: NormalEquations, x: FloatArray) -> FloatArray:
        """Return H x, in the arrowhead's order."""
        y = substitution.product(self.tree, system, x)
        if self.measured is not None:
            self.measured.add_product(system, x, y)
        return y

    def tangent_column(self, column: int) -> int:
        """Return the column of the tangent vector of a column in the arrowhead's order."""
        return int(np.flatnonzero(self.tangent == column)[0])


@dataclass(frozen=True)
class Factorisation:
    """The square-root factor R of H = R^T R.

    Attributes:
        top: lower triangular R^T of the top; entries above the diagonal are undefined.
    """

    arrowhead: Arrowhead
    system: NormalEquations = field(repr=False)
    rows: SquareRootFactor = field(repr=False)
    top: FloatArray = field(repr=False)

    def without_poses(self) -> "Factorisation":
        """Return the same for `square_root_of_tags` alone, which needs few of the arrays of a fleet."""
        none = np.zeros((0, 0, 0))
        names = ("pose", "pose_next", "pose_calibration", "pose_tag", "tag_calibration")
        return replace(
            self,
            system=self.system._replace(**dict.fromkeys(names, none)),
            rows=self.rows._replace(pose=none, pose_next=none),
        )

    def step(self, damping: float) -> tuple[FloatArray, float]:
        """Return the step s of (H + damping D) s = -g, in the arrowhead's order, and its predicted decrease.

        The decrease of the cost is -g s - s H s / 2, with D the diagonal of H.
        """
        step = -self.solve_in_order(self.system.gradient)
        along = -float(self.system.gradient @ step)
        return step, 0.5 * (
            along + damping * linearise_kernels.diagonal_square(self.system, step) if damping else along
        )

    def solve_in_order(self, vector: FloatArray) -> FloatArray:
        """Return H^-1 vector (3P + 2T + C,), in the arrowhead's order."""
        tree = self.arrowhead.tree
        solution = vector.copy()
        substitution.forward(tree, self.system, self.rows, solution)
        columns = self.arrowhead.top_columns
        if len(columns):
            solution[columns], _ = linalg.lapack.dpotrs(self.top, solution[columns], lower=1)
        substitution.backward(tree, self.system, self.rows, solution)
        return solution

    def solve(self, vector: FloatArray) -> FloatArray:
        """Return H^-1 vector (n,), in the order of the tangent vector."""
        return self.solve_in_order(self.arrowhead.in_order(vector))[self.arrowhead.tangent]

    def solve_many(self, vectors: FloatArray) -> FloatArray:
        """Return H^-1 vectors (n, k), in the order of the tangent vector; faster than `solve` for several vectors."""
        tree, k = self.arrowhead.tree, vectors.shape[1]
        solutions = self.arrowhead.in_order(vectors)
        arrays = block_substitution.substitution_arrays(tree, self.system, self.rows)
        room = np.empty((3 * len(self.rows.inside), k)), np.empty((self.rows.border.shape[2], k))
        block_substitution.substitute(arrays, solutions, True, *room)
        columns = self.arrowhead.top_columns
        if len(columns):
            solutions[columns], _ = linalg.lapack.dpotrs(self.top, solutions[columns], lower=1)
        block_substitution.substitute(arrays, solutions, False, *room)
        return np.asarray(solutions[self.arrowhead.tangent])

    def covariance(self, columns: IntArray, first: int = 0) -> FloatArray:
        """Return the joint covariance (k, k) of k columns of the tangent vector, 0 where fixed (-1), from `first` on.

        Columns of the covariance before `first` are not computed.
        """
        wanted = np.append(self.arrowhead.tangent, -1)[columns]
        return joint_covariance(self.arrowhead.tree, self.system, self.rows, self.top, wanted, first)

    def tag_covariances(self) -> FloatArray:
        """Return the covariances (T, 2, 2) of all tags, without those between them; 0 where fixed."""
        tree = self.arrowhead.tree
        columns = 3 * tree.n_poses + np.arange(2 * tree.n_tags).reshape(-1, 2)
        free = self.arrowhead.free.tags
        return pair_covariances(tree, self.rows, self.top, columns) * (free[:, :, None] * free[:, None, :])

    def square_root_of_tags(self, tags: IntArray) -> SquareRoot:
        """Return the square root of the joint covariance (2 k, 2 k) of k tags."""
        wanted = (3 * self.arrowhead.tree.n_poses + 2 * tags[:, None] + np.arange(2)).reshape(-1)
        return square_root(self.arrowhead.tree, self.rows, self.top, wanted)

    def pose_covariances(self, poses: IntArray) -> FloatArray:
        """Return the covariances (k, 3, 3) of k poses in their right tangent spaces; 0 where fixed."""
        wanted = np.zeros(self.arrowhead.tree.n_poses, dtype=np.bool_)
        wanted[poses] = True
        covariance = covariance_of_top(self.top)
        marginals = pose_marginals(self.arrowhead.tree, self.system, self.rows, covariance, wanted)[poses]
        free = self.arrowhead.free.poses[poses]
        return marginals * (free[:, :, None] * free[:, None, :])

    def relative_error(self) -> float:
        """Estimate the relative error of solutions from rounding: the length of one step of iterative refinement.

        See Higham, "Accuracy and stability of numerical algorithms" (2002), chapter 12. Unlike the condition number it
        does not depend on units. The right-hand side is random, so that the least certain directions dominate.
        """
        vector = self.arrowhead.in_order(np.random.default_rng(0).standard_normal(len(self.arrowhead.tangent)))
        solution = self.solve_in_order(vector)
        residual = vector - self.arrowhead.product(self.system, solution)
        length = float(np.linalg.norm(solution))
        return float(np.linalg.norm(self.solve_in_order(residual))) / length if length else 0.0
