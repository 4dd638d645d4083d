"""Overdispersion of a joint solve: its residuals exceed chance by a factor, and its covariances are too small.

The cost of the conditions that drives, consistent each by itself, share tags and calibration is chi-square with as many
degrees of freedom as there are conditions (nested linear models, see `local_map.goodness_of_fit`). Cost per degree of
freedom is the factor on the variance of errors between drives (Birge, "The calculation of errors by the method of least
squares", 1932). The same holds within drives, for joining their windows. A factor is applied only where chance hardly
explains the cost: otherwise the sigmas of a good map would vary with the noise.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from scipy.special import fdtri

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.local_map import GoodnessOfFit, LocalMap, degrees_of_freedom
from groundsbot.offline.maps import Misfit
from groundsbot.offline.sam import Graph, Solution, build_graph, losses_and_weights, solve

# False alarm rate of the test of joins.
_FALSE_ALARM: Final = 1e-2


def misfit_of(
    maps: Sequence[LocalMap], graph: Graph, solution: Solution, together: GoodnessOfFit | None = None
) -> Misfit | None:
    """Return the largest contradiction to the model; None where chance explains all of them.

    Args:
        maps: local maps of the graph's segments in order, solved under the noise of the graph.
        graph: graph of the component.
        solution: solution of that graph, on tag positions.
        together: goodness of fit of several drives as one map; None where a drive alone does not fit.
    """
    alone = [_solve_alone(each, graph, solution, segment) for segment, each in enumerate(maps)]
    found = (_misfit_of_joins(maps, graph, solution, alone), _misfit_of_windows(maps, graph, solution, alone, together))
    misfits = [each for each in found if each is not None and each.variance_factor > 1.0]
    return max(misfits, key=lambda each: each.variance_factor, default=None)


def noise_degrees_of_freedom(maps: Sequence[LocalMap]) -> int:
    """Return the degrees of freedom of the noise estimate, from the conditions that join the windows of drives."""
    return max(1, sum(each.goodness.expected for each in maps))


def _misfit_of_joins(
    maps: Sequence[LocalMap], graph: Graph, solution: Solution, alone: Sequence[Solution]
) -> Misfit | None:
    """Return the cost of sharing tags and calibration, without measurements by a person, which are tested apart."""
    measured = graph.problem.measured
    n = (
        degrees_of_freedom(graph.problem)
        - measured.n_residuals
        - sum(degrees_of_freedom(each.problem) for each in alone)
    )
    if len(maps) == 1 or n <= 0:
        return None
    rise = 2.0 * (solution.cost - sum(each.cost for each in alone)) - measured.sum_of_squares(solution.state)
    if rise <= n * float(fdtri(n, noise_degrees_of_freedom(maps), 1.0 - _FALSE_ALARM)):
        return None
    return Misfit("joins", graph.segments[_worst(graph, solution, alone)].name, rise, n)


def _misfit_of_windows(
    maps: Sequence[LocalMap],
    graph: Graph,
    solution: Solution,
    alone: Sequence[Solution],
    together: GoodnessOfFit | None,
) -> Misfit | None:
    """Return the cost of joining the windows of a drive, or of all drives."""
    runs = [each.goodness for each in maps]
    if not all(each.fits for each in runs):
        cost = [_cost(each) for each in runs]
        worst = int(np.argmax([square / max(1, each.expected) for square, each in zip(cost, runs, strict=True)]))
        return Misfit("windows", graph.segments[worst].name, sum(cost), noise_degrees_of_freedom(maps))
    if together is None or together.fits:
        return None
    name = graph.segments[_worst(graph, solution, alone)].name
    return Misfit("windows", name, _cost(together), max(1, together.expected))


def _cost(goodness: GoodnessOfFit) -> float:
    """Return the cost in squared sigmas of the windows' noise, or of the solve's noise where that is larger."""
    return goodness.chi_square * min(1.0, max(goodness.odometry_factor, goodness.observation_factor)) ** 2


def _solve_alone(local_map: LocalMap, graph: Graph, solution: Solution, segment: int) -> Solution:
    """Return the solution of one segment alone: its local map's, unless its tags were split differently since."""
    now = graph.segments[segment]
    if _same_places(local_map.segment.observations.tag, now.observations.tag):
        return local_map.solution
    own = build_graph([now])
    poses, tags = graph.poses_of(solution.state, segment), graph.tags_of(solution.state)
    back = se2.inverse(poses[0])
    start = own.start(
        se2.compose(back, poses),
        {tag: se2.apply(back, tags[tag]) for tag in now.tags},
        graph.calibration_of(solution.state),
    )
    return solve(own.problem, start)


def _same_places(tag: IntArray, other: IntArray) -> bool:
    """Return whether two numberings of tags group the observations (M,) alike."""
    if len(tag) != len(other):
        return False
    pairs = len(np.unique(np.column_stack([tag, other]), axis=0))
    return pairs == len(np.unique(tag)) == len(np.unique(other))


def _worst(graph: Graph, solution: Solution, alone: Sequence[Solution]) -> int:
    """Return the segment whose motions and observations cost most beyond their cost alone."""
    together = np.zeros(len(alone))
    for first, losses in zip(
        (graph.problem.odometry.first, graph.problem.observations.pose), _losses(solution), strict=True
    ):
        segment = np.searchsorted(graph.first_pose, first, side="right") - 1
        together += np.bincount(segment, losses, len(alone))
    return int(np.argmax(together - [sum(losses.sum() for losses in _losses(each)) for each in alone]))


def _losses(solution: Solution) -> tuple[FloatArray, FloatArray]:
    """Return losses (M,) of motions and (N,) of observations."""
    problem, state = solution.problem, solution.state
    odometry, _ = losses_and_weights(solution.losses.odometry, problem.odometry.residual(state))
    observations, _ = losses_and_weights(solution.losses.observations, problem.observations.residual(state))
    return odometry, observations
