"""Covariances of many poses at once, from the top of the tree down.

With R = [R1 R2] the rows of a node and C22 the covariance of the columns of its front that it does not eliminate,

    C12 = -R1^-1 R2 C22,    C11 = R1^-1 R1^-T - C12 (R1^-1 R2)^T,

and C22 is part of the covariance of the parent's front. This is the recursion of Takahashi, Fagan and Chen, "Formation
of a sparse bus impedance matrix" (1973), by fronts instead of entries. All poses together take as long as a few
eliminations, whereas `arrowhead.covariance` visits all ancestors for each pose.
"""

from typing import Final

import numpy as np
from scipy import linalg

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.offline.foundation import BoolVector, FloatBlocks, FloatMatrix, borrow, inner, njit
from groundsbot.offline.sam.arrowhead.block_substitution import (
    SubstitutionArrays,
    add_coupling,
    leaf_backward,
    leaf_forward,
    substitution_arrays,
)
from groundsbot.offline.sam.arrowhead.dissection import LEVELS
from groundsbot.offline.sam.arrowhead.tree import Tree
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor

_AT_ONCE: Final = 1024


def pose_marginals(
    tree: Tree, system: NormalEquations, rows: SquareRootFactor, top_covariance: FloatArray, wanted: BoolArray
) -> FloatArray:
    """Return the diagonal blocks (P, 3, 3) of H^-1 of the poses; zero for those that are not wanted.

    Args:
        tree: order of elimination.
        system: normal equations.
        rows: rows of R.
        top_covariance: (t, t) covariance of the top's columns.
        wanted: (P,) mask of poses.
    """
    marginals, arrays = np.zeros((tree.n_poses, 3, 3)), substitution_arrays(tree, system, rows)
    n_before = np.concatenate([[0], np.cumsum(wanted)])
    # Children precede their parents, subtree by subtree. In reverse order the parent is the last node of its level.
    fronts = [np.zeros((0, 0))] * LEVELS
    for node in range(len(tree.level) - 1, -1, -1):
        level = int(tree.level[node])
        if level < LEVELS - 1 and n_before[tree.first[node]] == n_before[tree.end[node]]:
            continue
        if level == LEVELS - 1:
            fronts[level] = top_covariance
        else:
            up = tree.up[tree.front_start[node] + tree.n_eliminated[node] : tree.front_start[node + 1]]
            C22 = fronts[int(tree.level[tree.parent[node]])][up[:, None], up]
            if level == 0:
                _add_leaf(arrays, node, C22, wanted, marginals)
                continue
            fronts[level] = _front_covariance(tree, rows, node, C22)
        separators = tree.separators[tree.separator_start[node] : tree.separator_start[node + 1]]
        for k, pose in enumerate(separators.tolist()):
            if wanted[pose]:
                marginals[pose] = fronts[level][3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
    return marginals


def covariance_of_top(top: FloatArray) -> FloatArray:
    """Return (R^T R)^-1 (t, t) of the lower triangular R^T of the top."""
    if not len(top):
        return np.zeros((0, 0))
    inverse, _ = linalg.lapack.dpotri(top, lower=1)
    covariance: FloatArray = inverse
    for begin in range(0, len(covariance), _AT_ONCE):  # bounds the memory of copies
        end = begin + _AT_ONCE
        within = np.tril(covariance[begin:end, begin:end])
        covariance[begin:end, begin:end] = within + np.tril(within, -1).T
        covariance[begin:end, end:] = covariance[end:, begin:end].T
    return covariance


def _front_covariance(tree: Tree, rows: SquareRootFactor, node: int, C22: FloatArray) -> FloatArray:
    """Return the covariance (w, w) of a node's front from that of the columns it does not eliminate."""
    n, size = int(tree.n_eliminated[node]), int(tree.front_start[node + 1] - tree.front_start[node])
    R = rows.inner[tree.rows_start[node] : tree.rows_start[node] + n * size].reshape(n, size)
    covariance = np.empty((size, size))
    covariance[n:, n:] = C22
    if n:
        inverse = linalg.solve_triangular(R[:, :n], np.eye(n), check_finite=False)
        gain = inverse @ R[:, n:]
        covariance[:n, n:] = -gain @ C22
        covariance[n:, :n] = covariance[:n, n:].T
        own = inverse @ inverse.T - covariance[:n, n:] @ gain.T
        covariance[:n, :n] = 0.5 * (own + own.T)
    return covariance


@njit
def _add_leaf(
    arrays: SubstitutionArrays, leaf: int, front: FloatMatrix, wanted: BoolVector, marginals: FloatBlocks
) -> None:
    """Set S + G C22 G^T for each wanted pose of a leaf, with S its block of A^-1, and G its rows of A^-1 B."""
    arrays = borrow(arrays)
    first, n, size = arrays.first[leaf], arrays.end[leaf] - arrays.first[leaf], len(front)
    inside, identity = np.zeros((3 * n, size)), np.zeros((size, size))
    for a in range(size):
        identity[a, a] = 1.0
    add_coupling(arrays, leaf, inside, identity, False)  # -B
    leaf_forward(arrays.pose_rows, arrays.next_rows, first, first + n, inside)
    leaf_backward(arrays.pose_rows, arrays.next_rows, first, first + n, inside)
    W, S, weighted = np.empty((2, 3, 3)), np.empty((3, 3)), np.empty((3, size))
    for k in range(n - 1, -1, -1):
        block_of_inverse(arrays.pose_rows[first + k], arrays.next_rows[first + k], k + 1 < n, W, S)
        if wanted[first + k]:
            _set_marginal(S, inside[3 * k : 3 * k + 3], front, weighted, marginals[first + k])


@inner
def block_of_inverse(U: FloatArray, Z: FloatArray, has_next: bool, W: FloatArray, S: FloatArray) -> None:
    """Replace S (3, 3), the diagonal block of A^-1 of the next pose, by (D U)^-1 U^-T + (D U)^-1 Z S ((D U)^-1 Z)^T."""
    u01, u02, u12 = U[0, 1], U[0, 2], U[1, 2]
    for j in range(3):  # W[0] = (D U)^-1 Z, then W[1] = W[0] S
        w2 = U[2, 2] * Z[2, j] if has_next else 0.0
        w1 = U[1, 1] * Z[1, j] - u12 * w2 if has_next else 0.0
        w0 = U[0, 0] * Z[0, j] - u01 * w1 - u02 * w2 if has_next else 0.0
        W[0, 0, j], W[0, 1, j], W[0, 2, j] = w0, w1, w2
    for i in range(3):
        for j in range(3):
            W[1, i, j] = W[0, i, 0] * S[0, j] + W[0, i, 1] * S[1, j] + W[0, i, 2] * S[2, j] if has_next else 0.0
    v02, d0, d1, d2 = u01 * u12 - u02, U[0, 0], U[1, 1], U[2, 2]  # U^-1 has rows (1, -u01, v02), (0, 1, -u12)
    own_01, own_02, own_12 = -u01 * d1 - v02 * u12 * d2, v02 * d2, -u12 * d2
    S[0, 0], S[1, 1], S[2, 2] = d0 + u01 * u01 * d1 + v02 * v02 * d2, d1 + u12 * u12 * d2, d2
    S[0, 1], S[0, 2], S[1, 2] = own_01, own_02, own_12
    for i in range(3):
        for j in range(i, 3):
            S[i, j] += W[1, i, 0] * W[0, j, 0] + W[1, i, 1] * W[0, j, 1] + W[1, i, 2] * W[0, j, 2]
            S[j, i] = S[i, j]


@inner
def _set_marginal(S: FloatArray, G: FloatArray, front: FloatArray, weighted: FloatArray, out: FloatArray) -> None:
    """Set out (3, 3) to S + G C G^T of G (3, w), symmetric."""
    for i in range(3):
        row = weighted[i]
        for a in range(len(row)):
            row[a] = 0.0
        for b in range(len(front)):
            factor, other = G[i, b], front[b]
            if factor != 0.0:
                for a in range(len(row)):
                    row[a] += factor * other[a]
    for i in range(3):
        for j in range(i, 3):
            total, row, other = S[i, j], weighted[i], G[j]
            for a in range(len(row)):
                total += row[a] * other[a]
            out[i, j], out[j, i] = total, total
