"""Covariances of poses given tags and calibration: each segment is then a chain, whose H is block tridiagonal.

Such a chain is eliminated pose by pose, without an order of elimination, and only its own blocks are linearised.
"""

from functools import partial
from itertools import pairwise

import numpy as np

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.offline.foundation import FloatBlocks, njit
from groundsbot.offline.sam.arrowhead.leaf_elimination import block_square_root, propagate_to_next, solve_next
from groundsbot.offline.sam.arrowhead.marginals import block_of_inverse
from groundsbot.offline.sam.arrowhead.system import Arrowhead, UnderDeterminedError
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.linearisation import kernels as linearise_kernels
from groundsbot.offline.sam.linearisation import observations as linearise_observations
from groundsbot.offline.sam.linearisation import odometry as linearise_odometry
from groundsbot.offline.sam.linearisation.blocks import NormalEquations
from groundsbot.offline.sam.linearisation.kernels import Free, ObservationArrays, OdometryArrays, Values
from groundsbot.offline.sam.linearisation.robust_losses import SQUARES, Loss
from groundsbot.offline.sam.minimisation import with_least_damping


def chain_covariances(arrowhead: Arrowhead, state: State, observation_loss: Loss, is_free: BoolArray) -> FloatArray:
    """Return the covariances (P, 3, 3) of poses given all else, in their right tangent spaces; 0 where not free (P, 3).

    Segments are computed one by one, since their blocks together take hundreds of MiB of a fleet; one that is not
    determined, as without observations, is damped. Measured distances and starts, which couple them, are left out.
    """
    covariances = np.empty((len(is_free), 3, 3))
    for first, end in pairwise(arrowhead.tree.segment_start.tolist()):
        system = _linearise_chain(arrowhead, state, observation_loss, is_free, first, end)
        with_least_damping(partial(_set_covariances, system, covariances[first:end]))
    covariances *= is_free[:, :, None] & is_free[:, None, :]
    return covariances


def _linearise_chain(
    arrowhead: Arrowhead, state: State, observation_loss: Loss, is_free: BoolArray, first: int, end: int
) -> NormalEquations:
    """Return the normal equations of the poses from `first` to `end` alone, without blocks of the calibration."""
    odometry, observations = arrowhead.odometry, arrowhead.observations
    driven = slice(*np.searchsorted(odometry.first, [first, end]).tolist())
    seen = slice(*np.searchsorted(observations.pose, [first, end]).tolist())
    odometry = OdometryArrays(*(getattr(odometry, name)[driven] for name in odometry._fields))
    odometry = odometry._replace(first=odometry.first - first, slots=np.full_like(odometry.slots, -1))
    observations = ObservationArrays(*(getattr(observations, name)[seen] for name in observations._fields))
    observations = observations._replace(pose=observations.pose - first)
    n, n_tags, none = end - first, len(state.tags), np.zeros(0, dtype=np.int64)
    system = NormalEquations(
        pose=np.empty((n, 3, 3)),
        pose_next=np.empty((n, 3, 3)),
        pose_calibration=np.empty((n, 3, 0)),
        pose_tag=np.empty((len(observations.pose), 3, 2)),
        tag=np.empty((n_tags, 2, 2)),
        tag_calibration=np.empty((n_tags, 2, 0)),
        calibration=np.empty((0, 0)),
        gradient=np.empty(3 * n + 2 * n_tags),
        distance=np.empty((0, 2, 5)),
    )
    own = is_free[first:end]
    free = Free(
        poses=own.astype(np.float64),
        tags=arrowhead.free.tags,
        calibration=arrowhead.free.calibration,
        held_poses=np.flatnonzero(~own.all(axis=1)),
        held_tags=none,
        held_observations=none,
    )
    values = Values(state.poses[first:end], state.tags, state.calibration)
    linearise_kernels.clear(system)
    linearise_odometry.add_odometry(odometry, SQUARES, values, free, system)
    linearise_observations.add_observations(observations, observation_loss, values, free, system)
    linearise_kernels.hold(observations.pose, observations.tag, arrowhead.tree.tag_segment_start, free, system)
    return system


def _set_covariances(system: NormalEquations, out: FloatArray, damping: float) -> None:
    failed = set_diagonal_of_inverse(system.pose, system.pose_next, damping, out)
    if failed >= 0:
        raise UnderDeterminedError(failed)


@njit
def set_diagonal_of_inverse(diagonal: FloatBlocks, following: FloatBlocks, damping: float, out: FloatBlocks) -> int:
    """Set out (P, 3, 3) to the diagonal blocks of the inverse of a block tridiagonal matrix.

    Args:
        diagonal: (P, 3, 3) diagonal blocks.
        following: (P, 3, 3) blocks to the right of these; the last is not used.
        damping: share of the diagonal that is added to it.
        out: result.

    Returns:
        -1, or the column without a positive pivot.
    """
    n, Z, S, W = len(diagonal), np.empty(diagonal.shape), np.zeros((3, 3)), np.empty((2, 3, 3))
    carried, none = np.zeros((3, 3)), np.empty((3, 0))
    for k in range(n):  # out becomes U of U^T D U, as in the elimination of a leaf
        for i in range(3):
            for j in range(3):
                S[i, j] = diagonal[k, i, j] + carried[i, j]
            S[i, i] += damping * diagonal[k, i, i]
        failed = block_square_root(S, out[k])
        if failed >= 0:
            return int(3 * k + failed)
        if k + 1 < n:
            solve_next(out[k], following[k], Z[k])
            propagate_to_next(out[k], Z[k], none, 0, carried, none)
    for k in range(n - 1, -1, -1):
        block_of_inverse(out[k], Z[k], k + 1 < n, W, S)
        out[k] = S
    return -1
