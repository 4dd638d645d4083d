"""The normal equations of chains that meet in tags and calibration: an arrowhead, eliminated chain by chain.

Linearise all factors, eliminate every piece of every chain on its own, meet in the small border, substitute back.
Dellaert and Kaess, "Square Root SAM" (2006); the order is that of nested dissection along the chains, see
`arrowhead_tree`.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from scipy import linalg

from calib.arrays import FloatArray, IntArray
from offline import arrowhead_kernels, arrowhead_substitution, linearise_kernels, linearise_readings
from offline.arrowhead_covariance import joint_covariance
from offline.arrowhead_kernels import Rows, System
from offline.arrowhead_marginals import pose_marginals
from offline.arrowhead_tree import Tree, build_tree
from offline.factors import CalibrationPrior, Columns, OdometryFactors, ReadingFactors, State
from offline.linearise_kernels import Free, Odometry, Readings, Values
from offline.robust import SQUARES, Loss
from offline.rolled_step import rolled
from offline.starting_pass import starting_pass

_CONDITION_STEPS: Final = 12


class UnderDeterminedError(ValueError):
    """A column of the tangent vector that nothing ties down."""

    def __init__(self, column: int) -> None:
        super().__init__(f"column {column} of the normal equations has no positive pivot")
        self.column = column


@dataclass(frozen=True)
class Arrowhead:
    """What stays the same from step to step: factors in the order of poses, and the order of elimination.

    Attributes:
        relaxed: the readings as places (x, y), whatever form they were read in: nearly linear in the poses.
        tangent: (n,) column of the arrowhead for each column of the tangent vector.
    """

    tree: Tree
    odometry: Odometry
    readings: Readings
    relaxed: Readings
    prior_sigma: FloatArray
    free: Free
    tangent: IntArray

    def linearise(
        self, state: State, odometry_loss: Loss = SQUARES, reading_loss: Loss = SQUARES, out: System | None = None
    ) -> tuple[System, float]:
        """H = J^T J and g = J^T r in blocks, and the cost: half the sum of all losses.

        Args:
            state: where.
            odometry_loss: of each motion.
            reading_loss: of each tag reading.
            out: blocks to write into.
        """
        system = out if out is not None else self.empty_system()
        values = Values(state.poses, state.tags, state.calibration)
        linearise_kernels.clear(system)
        total = linearise_kernels.add_odometry(self.odometry, odometry_loss, values, self.free, system)
        total += linearise_readings.add_readings(self.readings, reading_loss, values, self.free, system)
        total += linearise_readings.add_priors(self.prior_sigma, values, self.free, system)
        linearise_kernels.hold(self.readings.pose, self.readings.tag, self.free, system)
        return system, 0.5 * total

    def moved(self, state: State, step: FloatArray, anchor: IntArray) -> State:
        """The state after a step in the arrowhead's order; tags move along with their anchor poses (T,)."""
        tree = self.tree
        values = Values(state.poses, state.tags, state.calibration)
        out = Values(np.empty_like(state.poses), np.empty_like(state.tags), state.calibration.copy())
        linearise_kernels.moved(values, step, anchor, out)
        is_free = self.free.calibration >= 0
        out.calibration[is_free] += step[len(step) - tree.n_calibration :]
        return State(*out)

    def rolled(self, before: State, step: FloatArray, anchor: IntArray, moved: State) -> State:
        """The state after the same step as `moved`, taken motion by motion along each chain."""
        values = Values(before.poses, before.tags, before.calibration)
        by_pose = Values(moved.poses, moved.tags, moved.calibration)
        out = Values(np.empty_like(moved.poses), np.empty_like(moved.tags), moved.calibration)
        rolled(values, step, anchor, self.tree.chain_start, by_pose, out)
        return State(*out)

    def starting_values(self, state: State, start_sigma: FloatArray) -> State:
        """Poses and tags from one pass in order of time.

        Args:
            state: its calibration counts, and the pose at the start of each chain.
            start_sigma: (number of chains, 3) how far off these starts may be, in their own axes.
        """
        values = Values(state.poses, state.tags, state.calibration)
        out = Values(np.empty_like(state.poses), np.empty_like(state.tags), np.empty_like(state.calibration))
        starting_pass(self.tree, self.odometry, self.readings, values, np.square(start_sigma), out)
        return State(*out)

    def relaxed_step(self, state: State, anchor: IntArray) -> State:
        """The state after a Gauss-Newton step on the relaxed readings.

        Range and bearing are far from linear where a start is metres off; places are not.

        Raises:
            UnderDeterminedError: something is not tied down.
        """
        system, _, rows = self.scratch
        replace(self, readings=self.relaxed).linearise(state, out=system)
        return self.moved(state, -self.factorise(system, out=rows).solve_in_order(system.gradient), anchor)

    @cached_property
    def scratch(self) -> tuple[System, System, Rows]:
        """Room for a solve, kept for the next: new memory costs as much as filling it. For one at a time."""
        return self.empty_system(), self.empty_system(), self.empty_rows()

    def empty_system(self) -> System:
        """Blocks without values."""
        tree = self.tree
        return System(
            pose=np.empty((tree.n_poses, 3, 3)),
            pose_next=np.empty((tree.n_poses, 3, 3)),
            pose_calibration=np.empty((tree.n_poses, 3, tree.n_slots)),
            pose_tag=np.empty((len(tree.reading_tag), 3, 2)),
            tag=np.empty((tree.n_tags, 2, 2)),
            tag_calibration=np.empty((tree.n_tags, 2, tree.n_calibration)),
            calibration=np.empty((tree.n_calibration, tree.n_calibration)),
            gradient=np.empty(3 * tree.n_poses + 2 * tree.n_tags + tree.n_calibration),
        )

    def empty_rows(self) -> Rows:
        """Room for a factorisation."""
        tree = self.tree
        return Rows(
            pose=np.zeros((tree.n_poses, 3, 3)),
            pose_next=np.zeros((tree.n_poses, 3, 3)),
            inner=np.empty(int(tree.rows_start[-1])),
            workspace=np.empty(int(tree.workspace_start[-1])),
        )

    def factorise(self, system: System, damping: float = 0.0, out: Rows | None = None) -> "Factorisation":
        """R with R^T R = H + damping diag(H).

        Args:
            system: the blocks; they are used again by the factorisation.
            damping: Levenberg-Marquardt's, as a share of the diagonal.
            out: room to write into; a factorisation that used it before is lost.

        Raises:
            UnderDeterminedError: something is not tied down.
        """
        tree = self.tree
        rows = out if out is not None else self.empty_rows()
        failed = arrowhead_kernels.eliminate(tree, system, damping, rows)
        if failed >= 0:
            raise UnderDeterminedError(self._tangent_column(failed))
        columns = tree.front[tree.front_start[-2] :]
        front = rows.workspace[int(tree.workspace_start[-2]) :].reshape(len(columns), len(columns))
        if not len(columns):
            return Factorisation(self, system, rows, front)
        top, info = linalg.lapack.dpotrf(front.T, lower=1, clean=0, overwrite_a=1)
        if info:
            raise UnderDeterminedError(self._tangent_column(int(columns[info - 1])))
        return Factorisation(self, system, rows, top)

    def in_order(self, tangent: FloatArray) -> FloatArray:
        """Vectors (n, ...) of the tangent space by the arrowhead's columns, zero where held."""
        out = np.zeros((3 * self.tree.n_poses + 2 * self.tree.n_tags + self.tree.n_calibration, *tangent.shape[1:]))
        out[self.tangent] = tangent
        return out

    def _tangent_column(self, column: int) -> int:
        return int(np.flatnonzero(self.tangent == column)[0])


@dataclass(frozen=True)
class Factorisation:
    """R with R^T R = H.

    Attributes:
        top: lower triangular R^T of what meets in the top; entries above the diagonal mean nothing.
    """

    arrowhead: Arrowhead
    system: System = field(repr=False)
    rows: Rows = field(repr=False)
    top: FloatArray = field(repr=False)

    def solve_in_order(self, vector: FloatArray) -> FloatArray:
        """H^-1 vector (3P + 2T + C,), in the arrowhead's own order."""
        tree = self.arrowhead.tree
        solution = vector.copy()
        arrowhead_substitution.forward(tree, self.system, self.rows, solution)
        columns = tree.front[tree.front_start[-2] :]
        if len(columns):
            solution[columns], _ = linalg.lapack.dpotrs(self.top, solution[columns], lower=1)
        arrowhead_substitution.backward(tree, self.system, self.rows, solution)
        return solution

    def solve(self, vector: FloatArray) -> FloatArray:
        """H^-1 vector (n,), in the order of the tangent vector."""
        return self.solve_in_order(self.arrowhead.in_order(vector))[self.arrowhead.tangent]

    def covariance(self, columns: IntArray) -> FloatArray:
        """Joint covariance (k, k) of k columns of the tangent vector: their block of H^-1; 0 where held (-1)."""
        free = np.flatnonzero(columns >= 0)
        wanted = self.arrowhead.tangent[columns[free]]
        covariance = np.zeros((len(columns), len(columns)))
        covariance[np.ix_(free, free)] = joint_covariance(self.arrowhead.tree, self.system, self.rows, self.top, wanted)
        return covariance

    def pose_covariances(self, poses: IntArray) -> FloatArray:
        """(k, 3, 3) of k poses, by their right perturbation; all at once, and 0 where held."""
        wanted = np.zeros(self.arrowhead.tree.n_poses, dtype=np.bool_)
        wanted[poses] = True
        marginals = pose_marginals(self.arrowhead.tree, self.system, self.rows, self.top, wanted)[poses]
        free = self.arrowhead.free.poses[poses]
        return marginals * (free[:, :, None] * free[:, None, :])

    def condition(self) -> float:
        """Estimate, from below, of the ratio of H's largest and smallest eigenvalue: power iteration on both ends."""
        rng = np.random.default_rng(0)
        held = np.ones(len(self.system.gradient))
        held[self.arrowhead.tangent] = 0.0
        largest = smallest = rng.standard_normal(len(held)) * (1.0 - held)
        up = down = 1.0
        for _ in range(_CONDITION_STEPS):
            largest = arrowhead_substitution.product(self.arrowhead.tree, self.system, largest)
            smallest = self.solve_in_order(smallest)
            up, down = float(np.linalg.norm(largest)), float(np.linalg.norm(smallest))
            largest, smallest = largest / up, smallest / down
        return up * down


def build_arrowhead(
    odometry: OdometryFactors, readings: ReadingFactors, prior: CalibrationPrior, columns: Columns
) -> Arrowhead:
    """Sorts factors by pose and settles the order of elimination.

    Poses that odometry joins to the next one form a chain.
    """
    n_poses, n_tags = len(columns.poses), len(columns.tags)
    starts_chain = np.ones(n_poses + 1, dtype=np.bool_)
    starts_chain[odometry.first + 1] = False
    chain_start = np.flatnonzero(starts_chain)
    chain_of = np.cumsum(starts_chain[:-1]) - 1
    order = np.argsort(readings.pose, kind="stable")
    pose, tag = readings.pose[order], readings.tag[order]
    reading_parameters = np.column_stack([readings.mount_parameters, readings.scale_parameter])[order]
    is_free = columns.calibration >= 0
    free = Free(
        poses=(columns.poses >= 0).astype(np.float64),
        tags=(columns.tags >= 0).astype(np.float64),
        calibration=np.where(is_free, np.cumsum(is_free) - 1, -1),
    )
    users = (
        (chain_of[odometry.first], free.calibration[odometry.parameters]),
        (chain_of[pose], free.calibration[reading_parameters]),
    )
    uses = np.zeros((len(chain_start) - 1, len(is_free) + 1), dtype=np.bool_)
    for chain, parameters in users:
        uses[chain[:, None], parameters] = True
    uses[:, -1] = False  # where held
    slot = np.where(uses, np.cumsum(uses, axis=1) - 1, -1)
    slots = [np.flatnonzero(own) for own in uses]
    tree = build_tree(chain_start, pose, tag, n_tags, slots, int(is_free.sum()))
    sorted_readings = Readings(
        pose=pose,
        tag=tag,
        value=readings.value[order],
        polar=readings.polar[order],
        whitening=readings.whitening[order],
        mount=readings.mount[order],
        parameters=reading_parameters,
        slots=slot[users[1][0][:, None], users[1][1]],
    )
    return Arrowhead(
        tree=tree,
        odometry=Odometry(
            first=np.ascontiguousarray(odometry.first),
            motion=np.ascontiguousarray(odometry.motion),
            information=np.ascontiguousarray(odometry.whitening.swapaxes(-1, -2) @ odometry.whitening),
            jacobian=np.ascontiguousarray(odometry.jacobian),
            parameters=np.ascontiguousarray(odometry.parameters),
            slots=slot[users[0][0][:, None], users[0][1]],
        ),
        readings=sorted_readings,
        relaxed=_relaxed(sorted_readings),
        prior_sigma=prior.sigma,
        free=free,
        tangent=_tangent_order(columns),
    )


def _relaxed(readings: Readings) -> Readings:
    """The same as places (x, y), with the covariance that the reading had there."""
    x, y = readings.value.T
    range_m, cos, sin = np.maximum(x, 1e-6), np.cos(y), np.sin(y)
    by_place = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1) / range_m[:, None]], axis=-2)
    polar = readings.polar[:, None]
    return readings._replace(
        value=np.where(polar, np.column_stack([x * cos, x * sin]), readings.value),
        polar=np.zeros_like(readings.polar),
        whitening=np.where(polar[..., None], readings.whitening @ by_place, readings.whitening),
    )


def _tangent_order(columns: Columns) -> IntArray:
    """(n,) the arrowhead's column of each column of the tangent vector."""
    tangent = np.empty(columns.n, dtype=np.int64)
    is_free = columns.calibration >= 0
    all_columns = np.concatenate([columns.poses.reshape(-1), columns.tags.reshape(-1), columns.calibration[is_free]])
    free = all_columns >= 0
    tangent[all_columns[free]] = np.flatnonzero(free)
    return tangent
