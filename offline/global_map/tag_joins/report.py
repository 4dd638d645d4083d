"""Joins over single tags, as sentences and as typed results."""

from collections.abc import Sequence
from math import degrees

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.global_map.solve_component import SolvedComponent
from groundsbot.offline.global_map.tag_joins.join import TagJoin
from groundsbot.offline.maps import AlignmentResult, AlternativeResult


def join_results(components: Sequence[SolvedComponent], joins: Sequence[TagJoin]) -> tuple[AlignmentResult, ...]:
    """Return a result for each join made, as in the map, and for each ambiguous one."""
    return tuple(_result(components, join) for join in joins if not join.reason or join.alternatives)


def join_warnings(joins: Sequence[TagJoin], results: Sequence[AlignmentResult]) -> list[str]:
    """Return warnings about joins made over one tag.

    Args:
        joins: all.
        results: results of `join_results`.
    """
    covariance = {(each.from_run, each.to_run): each.covariance for each in results}
    return [
        f"{join.b} is joined to {join.a} by tag {join.tags[0].tag_id} alone ({_sigmas(covariance[join.a, join.b])}): "
        "a move of that tag in between would go unnoticed; drive past one more shared tag to confirm the join"
        for join in joins
        if join.is_weak and not join.reason
    ]


def _result(components: Sequence[SolvedComponent], join: TagJoin) -> AlignmentResult:
    tags = tuple((tag.family, tag.tag_id) for tag in join.tags)
    T_a_b, covariance = (join.T_a_b, None) if join.reason else _in_map(components, join)
    fit = join.verdict.best
    apart_m = fit.a.place_m[:, :2] - se2.apply(fit.T_anchors, fit.b.place_m[:, :2])
    return AlignmentResult(
        from_run=join.a,
        to_run=join.b,
        T_from_to=T_a_b,
        n_shared=len(tags),
        n_inliers=len(tags),
        inlier_rmse_m=float(np.sqrt((apart_m**2).sum(axis=1).mean())),
        outliers=(),
        is_accepted=not join.reason,
        alternatives=tuple(AlternativeResult(T, tags) for T in join.alternatives),
        is_weak=join.is_weak,
        covariance=covariance,
    )


def _in_map(components: Sequence[SolvedComponent], join: TagJoin) -> tuple[FloatArray, FloatArray | None]:
    """Return T_a_b (3,) of two starts in the map, and its covariance (3, 3) as x, y, theta in a's frame."""
    for graph, refined in ((each.graph, each.refined) for each in components):
        names = [segment.name for segment in graph.segments]
        if refined is None or not {join.a, join.b} <= {*names}:
            continue
        a, b = (int(graph.first_pose[names.index(name)]) for name in (join.a, join.b))
        poses, columns = refined.solution.state.poses, refined.solution.problem.columns.poses
        T_a_b = se2.between(poses[a], poses[b])
        joint = refined.solution.covariance(np.concatenate([columns[a], columns[b]]))
        by = np.concatenate([-se2.adjoint(se2.inverse(T_a_b)), np.eye(3)], axis=1)  # d_ab = d_b - Ad(T_ab^-1) d_a
        to_coordinates = np.linalg.inv(se2.right_tangent_from_coordinates(T_a_b)) @ by
        return T_a_b, to_coordinates @ joint @ to_coordinates.T
    return join.T_a_b, None


def _sigmas(covariance: FloatArray | None) -> str:
    if covariance is None:
        return "no covariance"
    x_m, y_m, theta_rad = np.sqrt(np.diag(covariance)).tolist()
    return f"weak: its start is known to {x_m:.2f} m, {y_m:.2f} m and {degrees(theta_rad):.2f} deg"
