"""What a worker does with a part, as functions of their inputs alone, so that what is lost is computed again."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import linalg

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam.arrowhead import substitution
from groundsbot.offline.sam.arrowhead.build import Kept, build_arrowhead, segment_starts
from groundsbot.offline.sam.arrowhead.marginals import pose_marginals
from groundsbot.offline.sam.arrowhead.system import Arrowhead, UnderDeterminedError
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.factors.priors import NO_PRIORS, Priors
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor
from groundsbot.offline.sam.linearisation.kernels import diagonal_square
from groundsbot.offline.sam.linearisation.robust_losses import Loss
from groundsbot.offline.sam.partition.division import ProblemPart
from groundsbot.offline.sam.partition.reduced import Reduced, reduction_of


@dataclass(frozen=True)
class PartSystem:
    """The arrowhead of a part, and the columns of its own top.

    Attributes:
        arrowhead: its top contains starts, kept tags and calibration, and whatever else dissection leaves there.
        inside: (m,) positions in its top's front that the part eliminates itself.
        kept: (k,) positions that remain.
        in_top: (k,) columns of these in the top of the whole, in ascending order.
    """

    arrowhead: Arrowhead
    inside: IntArray
    kept: IntArray
    in_top: IntArray

    def __sizeof__(self) -> int:
        """Return the bytes of the arrays; by these Dask judges whether to compute where they are."""
        arrowhead = self.arrowhead
        arrays = (*arrowhead.tree, *arrowhead.odometry, *arrowhead.observations, arrowhead.tangent)
        return sum(each.nbytes for each in arrays if isinstance(each, np.ndarray))


class LinearisedPart(NamedTuple):
    """The normal equations of a part at a state, and half the sum of its losses."""

    system: NormalEquations
    cost: float


class EliminatedPart(NamedTuple):
    """A part after elimination.

    Attributes:
        rows: rows of R up to the part's top.
        root: (m, m) lower triangular L with L L^T the block A of the columns inside of the top.
        coupling: (m, k) L^-1 B, with B the block between these and the kept columns.
        vector: (3P + 2T + C,) gradient after forward substitution up to the top.
        inside: (m,) L^-1 of its entries inside of the top.
        complement: (k, k) Schur complement C - B^T A^-1 B.
        gradient: (k,) reduced gradient.
    """

    rows: SquareRootFactor
    root: FloatArray
    coupling: FloatArray
    vector: FloatArray
    inside: FloatArray
    complement: FloatArray
    gradient: FloatArray


class PartStep(NamedTuple):
    """The step of a part's variables.

    Attributes:
        step: (3P + 2T + C,) in the order of its arrowhead.
        along: product of gradient and step.
        square: product of the step's squares with the diagonal of H.
    """

    step: FloatArray
    along: float
    square: float


def build(part: ProblemPart) -> PartSystem:
    """Return the part with its order of elimination."""
    columns, n_poses, n_tags = part.columns, len(part.columns.poses), len(part.columns.tags)
    starts = segment_starts(part.odometry, n_poses)[:-1]
    measured, is_free = Priors(part.starts, NO_PRIORS.distances), columns.calibration >= 0
    arrowhead = build_arrowhead(
        part.odometry,
        part.observations,
        part.prior,
        columns,
        measured,
        Kept(np.arange(len(starts)), part.kept_tags),
    )
    own = [
        (3 * starts[:, None] + np.arange(3)).reshape(-1),
        (3 * n_poses + 2 * part.kept_tags[:, None] + np.arange(2)).reshape(-1),
        3 * n_poses + 2 * n_tags + (np.cumsum(is_free) - 1)[part.kept_calibration[is_free[part.kept_calibration]]],
    ]
    place = np.full(3 * n_poses + 2 * n_tags + int(is_free.sum()), -1)
    front = arrowhead.top_columns
    place[front] = np.arange(len(front))
    kept = place[np.concatenate(own)]
    return PartSystem(arrowhead, np.setdiff1d(np.arange(len(front)), kept), kept, part.numbers.in_top)


def linearise(part: PartSystem, state: State, losses: tuple[Loss, Loss]) -> LinearisedPart:
    """Return the normal equations at a state of the part's variables."""
    return LinearisedPart(*part.arrowhead.linearise(state, *losses))


def cost_of(linearised: LinearisedPart) -> float:
    """Return half the sum of the part's losses."""
    return linearised.cost


def eliminate(part: PartSystem, linearised: LinearisedPart, damping: float) -> EliminatedPart:
    """Eliminate all but the kept columns of H + damping diag(H).

    Raises:
        UnderDeterminedError: a column has no positive pivot.
    """
    arrowhead, system = part.arrowhead, linearised.system
    rows = arrowhead.empty_rows()
    front = np.triu(arrowhead.reduce_to_top(system, damping, rows))
    front += np.triu(front, 1).T
    rows = rows._replace(workspace=np.empty(0))
    vector = system.gradient.copy()
    substitution.forward(arrowhead.tree, system, rows, vector)
    reduced = vector[arrowhead.top_columns]
    inside, kept = part.inside, part.kept
    root: FloatArray = np.zeros((0, 0))
    coupling: FloatArray = np.zeros((0, len(kept)))
    complement, gradient = front[np.ix_(kept, kept)], reduced[kept]
    forward: FloatArray = np.zeros(0)
    if len(inside):
        root, failed = linalg.lapack.dpotrf(front[np.ix_(inside, inside)], lower=1)
        if failed:
            raise UnderDeterminedError(arrowhead.tangent_column(int(arrowhead.top_columns[inside[failed - 1]])))
        coupling = linalg.solve_triangular(root, front[np.ix_(inside, kept)], lower=True, check_finite=False)
        forward = linalg.solve_triangular(root, reduced[inside], lower=True, check_finite=False)
        complement = complement - coupling.T @ coupling
        gradient = gradient - coupling.T @ forward
    return EliminatedPart(rows, root, coupling, vector, forward, complement, gradient)


def reduce(part: PartSystem, eliminated: EliminatedPart, n_top: int) -> Reduced:
    """Return what the part contributes to the n_top columns of the top."""
    return reduction_of(part.in_top, eliminated.complement, eliminated.gradient, n_top)


def substitute(
    part: PartSystem, linearised: LinearisedPart, eliminated: EliminatedPart, in_top: FloatArray
) -> PartStep:
    """Return the step of the part's variables from that of its columns (k,) in the top."""
    arrowhead, system = part.arrowhead, linearised.system
    solution = eliminated.vector.copy()
    top = np.empty(len(part.inside) + len(part.kept))
    top[part.kept] = -in_top
    if len(part.inside):
        right = eliminated.inside + eliminated.coupling @ in_top
        top[part.inside] = linalg.solve_triangular(eliminated.root, right, lower=True, trans="T", check_finite=False)
    solution[arrowhead.top_columns] = top
    substitution.backward(arrowhead.tree, system, eliminated.rows, solution)
    step = -solution
    return PartStep(step, float(system.gradient @ step), diagonal_square(system, step))


def pose_covariances(
    part: PartSystem, linearised: LinearisedPart, eliminated: EliminatedPart, in_top: FloatArray
) -> FloatArray:
    """Return the covariances (P, 3, 3) of all poses, 0 where fixed, from that (k, k) of the columns in the top."""
    arrowhead, inside, kept = part.arrowhead, part.inside, part.kept
    covariance = np.empty((len(inside) + len(kept),) * 2)
    covariance[np.ix_(kept, kept)] = in_top
    if len(inside):
        root = linalg.solve_triangular(
            eliminated.root, np.column_stack([np.eye(len(inside)), eliminated.coupling]), lower=True, trans="T"
        )
        inverse, gain = root[:, : len(inside)], root[:, len(inside) :]
        across = -gain @ in_top
        covariance[np.ix_(inside, kept)] = across
        covariance[np.ix_(kept, inside)] = across.T
        covariance[np.ix_(inside, inside)] = inverse @ inverse.T - across @ gain.T
    wanted = np.ones(arrowhead.tree.n_poses, dtype=np.bool_)
    marginals = pose_marginals(arrowhead.tree, linearised.system, eliminated.rows, covariance, wanted)
    free = arrowhead.free.poses
    return marginals * (free[:, :, None] * free[:, None, :])
