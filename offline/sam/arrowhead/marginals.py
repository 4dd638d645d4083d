"""Covariances of many poses at once, from the top of the tree down.

With R = [R1 R2] the rows of a node and C22 the covariance of the columns of its front that it does not eliminate,

    C12 = -R1^-1 R2 C22,    C11 = R1^-1 R1^-T - C12 (R1^-1 R2)^T,

and C22 is part of the covariance of the parent's front. This is the recursion of Takahashi, Fagan and Chen, "Formation
of a sparse bus impedance matrix" (1973), by fronts instead of entries. All poses together take as long as a few
eliminations, whereas `arrowhead.covariance` visits all ancestors for each pose.
"""

import numpy as np
from scipy import linalg

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.offline.foundation import BoolVector, FloatBlocks, FloatMatrix, borrow, inner, njit
from groundsbot.offline.sam.arrowhead import substitution
from groundsbot.offline.sam.arrowhead.dissection import LEVELS
from groundsbot.offline.sam.arrowhead.tree import Tree
from groundsbot.offline.sam.linearisation.blocks import NormalEquations, SquareRootFactor


def pose_marginals(
    tree: Tree, system: NormalEquations, rows: SquareRootFactor, top: FloatArray, wanted: BoolArray
) -> FloatArray:
    """Return the diagonal blocks (P, 3, 3) of H^-1 of the poses; zero for those that are not wanted.

    Args:
        tree: order of elimination.
        system: normal equations.
        rows: rows of R.
        top: lower triangular R^T of the top.
        wanted: (P,) mask of poses.
    """
    marginals = np.zeros((tree.n_poses, 3, 3))
    n_before = np.concatenate([[0], np.cumsum(wanted)])
    # Children precede their parents, subtree by subtree. In reverse order the parent is the last node one level above.
    fronts = [np.zeros((0, 0))] * LEVELS
    for node in range(len(tree.level) - 1, -1, -1):
        level = int(tree.level[node])
        if level < LEVELS - 1 and n_before[tree.first[node]] == n_before[tree.end[node]]:
            continue
        if level == LEVELS - 1:
            fronts[level] = _inverse(top)
        else:
            up = tree.up[tree.front_start[node] + tree.n_eliminated[node] : tree.front_start[node + 1]]
            C22 = fronts[level + 1][up[:, None], up]
            if level == 0:
                _add_leaf(tree, system, rows, node, C22, wanted, marginals)
                continue
            fronts[level] = _front_covariance(tree, rows, node, C22)
        separators = tree.separators[tree.separator_start[node] : tree.separator_start[node + 1]]
        for k, pose in enumerate(separators.tolist()):
            if wanted[pose]:
                marginals[pose] = fronts[level][3 * k : 3 * k + 3, 3 * k : 3 * k + 3]
    return marginals


def _inverse(top: FloatArray) -> FloatArray:
    """Return (R^T R)^-1 of a lower triangular R^T."""
    if not len(top):
        return np.zeros((0, 0))
    inverse, _ = linalg.lapack.dpotri(top, lower=1)
    lower: FloatArray = np.tril(inverse)
    return lower + np.tril(lower, -1).T


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
    tree: Tree,
    system: NormalEquations,
    rows: SquareRootFactor,
    leaf: int,
    front: FloatMatrix,
    wanted: BoolVector,
    marginals: FloatBlocks,
) -> None:
    """Set E^T A^-1 E + (E^T A^-1 B) C22 (B^T A^-1 E) for each wanted pose of a leaf."""
    tree, system, rows = borrow(tree), borrow(system), borrow(rows)
    first, n, size = tree.first[leaf], tree.end[leaf] - tree.first[leaf], len(front)
    inside, outside = np.empty((n, 3)), np.empty((3, size))
    for k in range(n):
        if not wanted[first + k]:
            continue
        for i in range(3):
            for j in range(n):
                for axis in range(3):
                    inside[j, axis] = 0.0
            inside[k, i] = 1.0
            substitution.solve_leaf(tree, rows, leaf, inside)
            for j in range(3):
                marginals[first + k, i, j] = inside[k, j]
            for a in range(size):
                outside[i, a] = 0.0
            substitution.leaf_to_front(tree, system, leaf, inside, outside[i])
        _add_square(outside, front, marginals[first + k])


@inner
def _add_square(outside: FloatArray, front: FloatArray, out: FloatArray) -> None:
    """Add G C G^T of G (3, w) to out (3, 3), and make out symmetric."""
    weighted = np.empty(len(front))
    for i in range(3):
        for a in range(len(front)):
            weighted[a] = 0.0
        for b in range(len(front)):
            if outside[i, b] != 0.0:
                for a in range(len(front)):
                    weighted[a] += outside[i, b] * front[b, a]
        for j in range(i, 3):
            total = 0.5 * (out[i, j] + out[j, i])
            for a in range(len(front)):
                total += weighted[a] * outside[j, a]
            out[i, j], out[j, i] = total, total
