"""The solved graph as edges between poses and tags, for other tools."""

from dataclasses import replace

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.maps import GraphEdges
from groundsbot.offline.sam import Graph, Solution, State, losses_and_weights


def edges_of(graph: Graph, solution: Solution, refined: State | None = None) -> GraphEdges:
    """Return motions and tag positions, calibration applied, whose least-squares estimate is the solution.

    A solution refined on corners also constrains headings, which edges to positions cannot represent. There the edges
    agree with the refined map, with the information that they have without corners.

    An observation becomes a position in base with the same gradient at pose and tag as in the solve: it is off the
    state's tag position by the residual. For (x, y) that is the observation itself, for range and bearing it is to
    second order in the residual. Information is multiplied by the weight of the solve's loss (the last round of
    iteratively reweighted least squares).
    """
    state, columns = solution.state, graph.problem.columns
    odometry, observations = graph.problem.odometry, graph.problem.observations
    residual, blocks = observations.linearise(state, columns)
    by_place = -blocks[0][1][..., :2]  # whitened; minus the derivative with respect to the pose's position
    in_base = se2.apply(se2.inverse(state.poses[observations.pose]), state.tags[observations.tag])
    _, motion_weight = losses_and_weights(solution.losses.odometry, odometry.residual(state))
    _, place_weight = losses_and_weights(solution.losses.observations, residual)
    edges = GraphEdges(
        first=odometry.first,
        motion=odometry.predict(state),
        motion_information=_information(odometry.scaled_whitening(state), motion_weight),
        pose=observations.pose,
        tag=observations.tag,
        place_m=in_base - np.linalg.solve(by_place, residual[..., None])[..., 0],
        place_information=_information(by_place, place_weight),
    )
    if refined is None:
        return edges
    return replace(
        edges,
        motion=se2.between(refined.poses[odometry.first], refined.poses[odometry.first + 1]),
        place_m=se2.apply(se2.inverse(refined.poses[observations.pose]), refined.tags[observations.tag]),
    )


def _information(roots: FloatArray, weights: FloatArray) -> FloatArray:
    """Return w W^T W (M, n, n)."""
    information: FloatArray = weights[:, None, None] * (roots.swapaxes(-1, -2) @ roots)
    return information
