"""Test whether runs that fit together each by itself also fit together as one map.

From windows to runs and from runs to the map, more and more parameters are equated. The cost increase of each of these
conditions is chi-square, and so is their sum (nested linear models, see `local_map.goodness_of_fit`). The first part
was computed by the checks of the single runs. The second is the cost of the joint solve less those of the runs' own
solves, known where the noise has been fitted, so no further solve is needed. Where sigmas were given by the user, or a
tape measurement also constrains the map, the windows of all runs are fitted anew.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import fdtri

from groundsbot.offline.local_map import FALSE_ALARM, GoodnessOfFit, LocalMap, degrees_of_freedom, fit_windows
from groundsbot.offline.sam import Solution


def joint_goodness_of_fit(maps: Sequence[LocalMap], solution: Solution) -> GoodnessOfFit:
    """Return the goodness of fit of the condition that all windows of several runs are one map.

    Args:
        maps: local maps of the runs, solved under the noise of the joint solve.
        solution: solution of all of them.
    """
    runs = [each.goodness for each in maps]
    is_fitted = all(
        each.is_noisy or each.goodness.odometry_factor == each.goodness.observation_factor == 1.0 for each in maps
    )
    if not is_fitted or len(solution.problem.measured):
        return fit_windows(solution.problem).goodness_of_fit(solution.state)
    alone = [each.solution for each in maps]
    n = max(0, degrees_of_freedom(solution.problem) - sum(degrees_of_freedom(each.problem) for each in alone))
    rise = max(0.0, 2.0 * (solution.cost - sum(each.cost for each in alone)))
    # The noise has the degrees of freedom of the conditions within the runs.
    n_expected = max(1, sum(each.expected for each in runs))
    bound = n * float(fdtri(n, n_expected, 1.0 - FALSE_ALARM)) if n else 0.0
    # The margins of the bounds over the expected values add in quadrature.
    parts = [(each.expected, each.bound - each.expected) for each in runs] + [(n, bound - n)]
    expected = sum(each for each, _ in parts)
    margin = float(np.linalg.norm([each for _, each in parts]))
    chi_square = rise + sum(each.chi_square for each in runs)
    return replace(runs[0], chi_square=chi_square, expected=expected, bound=expected + margin)
