"""Scatter of tag positions between passes, and tags whose sigmas it increases.

About the solved poses, each pass of a tag (its observations while a drive passed by once) gives a position with the
information of these observations. The map's position is their weighted mean. Poses adapt to observations, so the passes
scatter by less than chi-square predicts; larger scatter is in no covariance. Then the variance of all passes of the tag
is scaled to the scatter (Birge, "The calculation of errors by the method of least squares", 1932).
"""

from typing import Final

import numpy as np
from scipy.special import fdtri

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.maps import TagScatter
from groundsbot.offline.measurements import passes_of
from groundsbot.offline.sam import Graph, Solution, losses_and_weights

# Share of good maps in which any tag is found to scatter.
_FALSE_ALARM: Final = 1e-3
_MOST_NAMED: Final = 12


def scatter_of_passes(graph: Graph, solution: Solution, variance_factor: float, freedom: float) -> TagScatter:
    """Return the scatter of each tag of a component.

    Args:
        graph: graph of the component.
        solution: solution of that graph, on tag positions.
        variance_factor: factor by which all covariances of the component are inflated anyway.
        freedom: degrees of freedom of the noise estimate.
    """
    n_tags = len(graph.tags)
    factors, added_m2 = np.ones(n_tags), np.zeros((n_tags, 2, 2))
    of_pass, tag_of_pass = _passes(graph)
    information, pull = _sums(graph, solution, of_pass, len(tag_of_pass))
    squares = np.einsum("pi,pi->p", pull, np.linalg.solve(information, pull[..., None])[..., 0])
    n_free = 2 * (np.bincount(tag_of_pass, minlength=n_tags) - 1)
    tested = np.flatnonzero(n_free > 0)
    if not len(tested):
        return TagScatter(factors, added_m2)
    ratio = np.bincount(tag_of_pass, squares, n_tags)[tested] / (variance_factor * n_free[tested])
    found = ratio > fdtri(n_free[tested], freedom, 1.0 - _FALSE_ALARM / len(tested))
    whole = np.zeros((n_tags, 2, 2))
    np.add.at(whole, tag_of_pass, information)
    which, grown = tested[found], ratio[found]
    factors[which] = np.sqrt(grown)
    added_m2[which] = variance_factor * (grown - 1.0)[:, None, None] * np.linalg.inv(whole[which])
    return TagScatter(factors, added_m2)


def scatter_warnings(graph: Graph, scatter: TagScatter) -> list[str]:
    """Return a warning that names tags whose passes contradict each other."""
    which = np.flatnonzero(scatter.factors > 1.0)
    if not len(which):
        return []
    worst = which[np.argsort(-scatter.factors[which], kind="stable")]
    named = [
        f"{graph.tags[t].tag_id}{graph.tags[t].instance} ({scatter.factors[t]:.1f} times)" for t in worst[:_MOST_NAMED]
    ]
    more = f" and {len(worst) - _MOST_NAMED} more" if len(worst) > _MOST_NAMED else ""
    sentence = (
        f"passes of tags {', '.join(named)}{more} scatter by these multiples of what chance explains, and their sigmas "
        "were scaled accordingly; check that they are mounted firmly and flat, and drive past them again"
    )
    return [sentence]


def _passes(graph: Graph) -> tuple[IntArray, IntArray]:
    """Return (M,) the pass of each observation, counted through all segments, and (P,) the tag of each pass."""
    n_passes, of_pass = 0, []
    for segment in graph.segments:
        own = passes_of(segment)
        of_pass.append(n_passes + own)
        n_passes += int(own.max(initial=-1)) + 1
    found = np.concatenate(of_pass)
    tag_of_pass = np.zeros(n_passes, dtype=np.int64)
    tag_of_pass[found] = graph.problem.observations.tag
    return found, tag_of_pass


def _sums(graph: Graph, solution: Solution, of_pass: IntArray, n_passes: int) -> tuple[FloatArray, FloatArray]:
    """Return each pass's information (P, 2, 2) about the tag position, about the solved poses, and gradient (P, 2)."""
    observations, state = graph.problem.observations, solution.state
    residual, blocks = observations.linearise(state, graph.problem.columns)
    _, weight = losses_and_weights(solution.losses.observations, residual)
    theta = state.poses[observations.pose, 2]
    cos, sin = np.cos(theta), np.sin(theta)
    to_base = np.stack([np.stack([cos, sin], -1), np.stack([-sin, cos], -1)], axis=-2)
    # Whitened; minus the derivative with respect to the pose's position.
    by_place = -blocks[0][1][..., :2] @ to_base
    weighted = weight[:, None, None] * by_place.swapaxes(-1, -2)
    information, pull = np.zeros((n_passes, 2, 2)), np.zeros((n_passes, 2))
    np.add.at(information, of_pass, weighted @ by_place)
    np.add.at(pull, of_pass, -(weighted @ residual[..., None])[..., 0])
    return information, pull
