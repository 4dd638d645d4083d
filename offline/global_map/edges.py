"""The solved graph as plain edges between poses and tags, for other tools to read."""

from dataclasses import replace

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.maps import GraphEdges
from groundsbot.offline.sam import Graph, Solution, State, losses_and_weights


def edges_of(graph: Graph, solution: Solution, refined: State | None = None) -> GraphEdges:
    """Motions and tag places with the solved calibration put in, so that the solution is their least squares.

    A solution refined on corners pulls on headings too, which edges between places cannot say. There the edges are what
    the refined map itself has, with the information that they have without corners.

    A reading is turned into a place in base such that it pulls on pose and tag as it did in the solve: the place lies
    off where the state has the tag by what the reading's residual amounts to there. For (x, y) that is the reading
    itself, for range and bearing it is to second order in the residual. What the solve's loss made count less has its
    information times that weight (iteratively reweighted least squares, whose last round this is).
    """
    state, columns = solution.state, graph.problem.columns
    odometry, readings = graph.problem.odometry, graph.problem.readings
    residual, blocks = readings.linearise(state, columns)
    by_place = -blocks[0][1][..., :2]  # whitened; a step of the pose moves the place in base against it
    in_base = se2.apply(se2.inverse(state.poses[readings.pose]), state.tags[readings.tag])
    _, motion_weight = losses_and_weights(solution.losses.odometry, odometry.residual(state))
    _, place_weight = losses_and_weights(solution.losses.readings, residual)
    edges = GraphEdges(
        first=odometry.first,
        motion=odometry.predict(state),
        motion_information=_information(odometry.scaled_whitening(state), motion_weight),
        pose=readings.pose,
        tag=readings.tag,
        place_m=in_base - np.linalg.solve(by_place, residual[..., None])[..., 0],
        place_information=_information(by_place, place_weight),
    )
    if refined is None:
        return edges
    return replace(
        edges,
        motion=se2.between(refined.poses[odometry.first], refined.poses[odometry.first + 1]),
        place_m=se2.apply(se2.inverse(refined.poses[readings.pose]), refined.tags[readings.tag]),
    )


def _information(roots: FloatArray, weights: FloatArray) -> FloatArray:
    """W W^T W (M, n, n)."""
    information: FloatArray = weights[:, None, None] * (roots.swapaxes(-1, -2) @ roots)
    return information
