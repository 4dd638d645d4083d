"""The solve on tag corners: where whole steps overshoot."""

from groundsbot.offline.corners.graph import corner_graph
from groundsbot.offline.corners.solver import solve_corners
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.workings import Diagnostics
from tests.support.data.simulated_runs import simulated_runs


def test_a_step_that_swings_the_far_end_by_a_metre_is_taken_in_part() -> None:
    """Drives whose far end the first step would move by 1.1 m, to where the cost is higher.

    With damping instead, this took more than 40 steps and the map stayed on the floor.
    """
    workings = Diagnostics()
    build_map(simulated_runs("nsh_flat", 2)[0], workings=workings)
    (solved,) = workings.components
    corners, start = corner_graph(solved.graph, solved.solution.state)
    found = solve_corners(corners.problem, start)
    assert found.converged, found.reason
    assert len(found.costs) < 10
    assert all(later < before for before, later in zip(found.costs, found.costs[1:], strict=False))
