"""A local map reduced to its tags and their joint covariance, in coordinates that stay linear for large heading errors.

The joint covariance of a solve holds for small errors. The heading of a long drive errs by degrees, and what turns by
phi moves on an arc. Two tags 2 m apart, whose distance is known to a millimetre, come out 2 m phi^2 / 2 nearer when
their errors are taken in map axes (11 mm at 6 degrees). So each tag is expressed in the frame of a pose that observed
it, and these anchor poses relative to each other along a tree of the most certain relations. Errors are right
perturbations there, T o exp(delta), as in odometry. To first order the covariance is the same, but a drive bent by
heading errors is no longer a contradiction.

Andersson and Nygards, "C-SAM: Multi-robot SLAM using square root information smoothing" (2008), and Cunningham et al.,
"DDF-SAM" (2010), condense local maps too, in map axes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.local_map import LocalMap
from groundsbot.offline.measurements import TagKey
from groundsbot.offline.sam import covariance_with_bias


@dataclass(frozen=True)
class CondensedMap:
    """Some tags of a local map.

    Attributes:
        name: name of the segment.
        tags: sorted.
        T_start_anchor: (T, 3) a pose that observed each tag.
        tag_m: (T, 2) each tag in its anchor's frame.
        covariance: (5 T, 5 T) of right tangents of all anchors, (x, y, theta) each, then of all tags in their anchors.
        root: the index of the anchor that carries the frame: it is fixed when errors are drawn.
    """

    name: str
    tags: tuple[TagKey, ...]
    T_start_anchor: FloatArray
    tag_m: FloatArray
    covariance: FloatArray
    root: int

    @property
    def tags_m(self) -> FloatArray:
        """Tag positions (T, 2) in the frame of the start."""
        return se2.apply(self.T_start_anchor, self.tag_m)

    @property
    def extent_m(self) -> float:
        """Length of the longer side of the tags' bounding box."""
        return float(np.ptp(self.tags_m, axis=0).max())

    @property
    def frame_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the start in a frame fixed to the root anchor, as a twist (x, y, theta) at the start."""
        columns = 3 * self.root + np.arange(3)
        carried = se2.adjoint(self.T_start_anchor[self.root])
        covariance: FloatArray = carried @ self.covariance[np.ix_(columns, columns)] @ carried.T
        return covariance

    def tree(self, tags: Sequence[TagKey]) -> "AnchorTree":
        """Return the anchor tree of some of the tags."""
        index = {tag: i for i, tag in enumerate(self.tags)}
        return _anchor_tree(self, np.array([index[tag] for tag in tags], dtype=np.int64))


@dataclass(frozen=True)
class AnchorTree:
    """Tag positions as a function of errors xi ~ N(0, covariance) of anchors relative to parents and tags to anchors.

    Attributes:
        root: (3,) T_start_root, exact.
        order: (n,) nodes with parents first.
        parent: (n,) of each node; -1: the root.
        step: (n, 3) T_parent_anchor.
        tag_m: (n, 2) in the anchor's frame.
        is_ancestor: (n, n) whether node k is on the path from the root to node i, i itself included.
        covariance: (5 n, 5 n) of xi: the n steps' right tangents, then the n tags in their anchors.
    """

    root: FloatArray
    order: IntArray
    parent: IntArray
    step: FloatArray
    tag_m: FloatArray
    is_ancestor: FloatArray
    covariance: FloatArray

    def places(self, xi: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (n, 2) tag positions in the frame of the start, and (n, 3) anchors."""
        n = len(self.step)
        moved = se2.compose(self.step, se2.exp(xi[: 3 * n].reshape(n, 3))).tolist()
        parent = self.parent.tolist()
        along = [*moved, self.root.tolist()]  # overwritten in order; plain floats are faster than arrays of three
        for node in self.order.tolist():
            x, y, theta = along[parent[node]]
            cos, sin = math.cos(theta), math.sin(theta)
            dx, dy, turn = moved[node]
            along[node] = x + cos * dx - sin * dy, y + sin * dx + cos * dy, theta + turn
        anchors = np.array(along[:n])
        return se2.apply(anchors, self.tag_m + xi[3 * n :].reshape(n, 2)), anchors

    def jacobian(self, xi: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return tag positions (n, 2) in the frame of the start, and their Jacobian (2 n, 5 n) with respect to xi."""
        n = len(self.step)
        places, anchors = self.places(xi)
        # A node's step moves its whole subtree by the twist Ad(T) Jr dxi in the frame of the start.
        by_step = se2.adjoint(anchors) @ se2.right_jacobian(xi[: 3 * n].reshape(n, 3))
        moved = by_step[None, :, :2] + rotate_quarter(places)[:, None, :, None] * by_step[None, :, None, 2]
        out = np.zeros((n, 2, 5 * n))
        out[..., : 3 * n] = (moved * self.is_ancestor[:, :, None, None]).transpose(0, 2, 1, 3).reshape(n, 2, 3 * n)
        cos, sin = np.cos(anchors[:, 2]), np.sin(anchors[:, 2])
        each = np.arange(n)
        out[each, 0, 3 * n + 2 * each], out[each, 0, 3 * n + 2 * each + 1] = cos, -sin
        out[each, 1, 3 * n + 2 * each], out[each, 1, 3 * n + 2 * each + 1] = sin, cos
        return places, out.reshape(2 * n, 5 * n)


def condense(local_map: LocalMap, tags: Sequence[TagKey], variance_factor: float = 1.0) -> CondensedMap:
    """Reduce a local map to some of its tags.

    Args:
        local_map: solved.
        tags: sorted, one at least.
        variance_factor: multiplies the covariance where the noise is larger than the solve assumed.
    """
    problem, state = local_map.graph.problem, local_map.solution.state
    index = {tag: i for i, tag in enumerate(local_map.graph.tags)}
    which = np.array([index[tag] for tag in tags], dtype=np.int64)
    pose = problem.anchor[which]
    columns = np.concatenate([problem.columns.poses[pose].reshape(-1), problem.columns.tags[which].reshape(-1)])
    joint = variance_factor * covariance_with_bias(local_map.solution, columns)
    T_start_anchor = state.poses[pose]
    tag_m = se2.apply(se2.inverse(T_start_anchor), state.tags[which])
    return CondensedMap(
        name=local_map.segment.name,
        tags=tuple(tags),
        T_start_anchor=T_start_anchor,
        tag_m=tag_m,
        covariance=_in_anchors(joint, T_start_anchor, tag_m),
        root=_most_certain_anchor(joint, len(which)),
    )


def rotate_quarter(vectors: FloatArray) -> FloatArray:
    """Return vectors (..., 2) rotated by +90 degrees: the derivative of points with respect to a rotation."""
    return np.stack([-vectors[..., 1], vectors[..., 0]], axis=-1)


def _in_anchors(joint: FloatArray, T_start_anchor: FloatArray, tag_m: FloatArray) -> FloatArray:
    """Transform the covariance from tags in the start's frame to tags in anchors: de = R^T dl - d_xy - d_theta J e."""
    n = len(tag_m)
    cos, sin = np.cos(T_start_anchor[:, 2]), np.sin(T_start_anchor[:, 2])
    turn = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], axis=-2)
    quarter = rotate_quarter(tag_m)

    def rows(matrix: FloatArray) -> FloatArray:
        out = matrix.copy()
        anchors, tags = matrix[: 3 * n].reshape(n, 3, -1), matrix[3 * n :].reshape(n, 2, -1)
        moved = turn @ tags - anchors[:, :2] - quarter[:, :, None] * anchors[:, 2:]
        out[3 * n :] = moved.reshape(2 * n, -1)
        return out

    return rows(np.ascontiguousarray(rows(joint).T))


def _most_certain_anchor(joint: FloatArray, n: int) -> int:
    """Return the anchor with the least summed variance of heading relative to the others."""
    return int(np.argmin(_heading_variance(joint, n).sum(axis=1)))


def _heading_variance(joint: FloatArray, n: int) -> FloatArray:
    """Return (n, n) variances of the heading differences between anchors."""
    headings = joint[2 : 3 * n : 3, 2 : 3 * n : 3]
    own = np.diag(headings)
    return np.maximum(own[:, None] + own - 2.0 * headings, 0.0)


def _anchor_tree(condensed: CondensedMap, which: IntArray) -> AnchorTree:
    n_all, n = len(condensed.tags), len(which)
    nodes = np.append(which, condensed.root)
    parent, order = _minimum_variance_tree(condensed, nodes)
    T_start_node = condensed.T_start_anchor[nodes]
    step = se2.between(T_start_node[parent], T_start_node[:n])
    columns = np.concatenate(
        [(3 * nodes[:, None] + np.arange(3)).reshape(-1), (3 * n_all + 2 * which[:, None] + np.arange(2)).reshape(-1)]
    )
    joint = condensed.covariance[np.ix_(columns, columns)]
    carried = se2.adjoint(se2.inverse(step))

    def rows(matrix: FloatArray) -> FloatArray:
        """T_p o exp(d_p) o D o exp(r) = T_c o exp(d_c): r = d_c - Ad(D^-1) d_p."""
        anchors = matrix[: 3 * (n + 1)].reshape(n + 1, 3, -1)
        steps = anchors[:n] - carried @ anchors[parent]
        return np.concatenate([steps.reshape(3 * n, -1), matrix[3 * (n + 1) :]])

    above = np.zeros((n + 1, n))
    for node in order:
        above[node] = above[parent[node]]
        above[node, node] = 1.0
    return AnchorTree(
        root=T_start_node[-1],
        order=order,
        parent=np.where(parent == n, -1, parent),
        step=step,
        tag_m=condensed.tag_m[which],
        is_ancestor=above[:n],
        covariance=rows(np.ascontiguousarray(rows(joint).T)),
    )


def _minimum_variance_tree(condensed: CondensedMap, nodes: IntArray) -> tuple[IntArray, IntArray]:
    """Return (n,) the parent of each node but the last, which is the root, and (n,) these nodes with parents first.

    The tree minimises the variances of relative heading along its edges: there rotation errors are smallest, and with
    them the second-order errors of position.
    """
    n = len(nodes)
    variance = _heading_variance(condensed.covariance, len(condensed.tags))[np.ix_(nodes, nodes)]
    # Only the order of weights counts; a weight near zero (tags observed from one pose) would be no edge.
    weight = 1.0 + variance / max(float(variance.max()), 1e-30)
    np.fill_diagonal(weight, 0.0)
    tree = minimum_spanning_tree(weight)
    found, before = breadth_first_order(tree + tree.T, n - 1, directed=False)
    return np.asarray(before[: n - 1], dtype=np.int64), np.asarray(found[1:], dtype=np.int64)
