"""Do runs that fit together each by itself fit together as one map?

From windows to runs and from runs to the map, more and more numbers become one. What each of these conditions costs is
chi-square, and so is what all of them cost (nested linear models, see `local_map.goodness_of_fit`). What the first part
cost, the checks of the runs alone have found; what the second does is the rise from the costs of the runs' own solves
to that of the joint one, which are both known where the noise has been fitted. So nothing has to be solved again. Where
sigmas are those that somebody told, or a tape holds the map too, the windows of all runs are fitted anew.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from groundsbot.offline.local_map import FALSE_ALARM, GoodnessOfFit, LocalMap, fit_windows, freedom_of
from groundsbot.offline.sam import Solution


def joint_goodness_of_fit(maps: Sequence[LocalMap], solution: Solution) -> GoodnessOfFit:
    """What it costs that all windows of several runs are one map.

    Args:
        maps: of the runs, solved under the noise that the joint solve has.
        solution: of all of them.
    """
    runs = [each.goodness for each in maps]
    is_fitted = all(
        each.is_noisy or each.goodness.odometry_factor == each.goodness.reading_factor == 1.0 for each in maps
    )
    if not is_fitted or len(solution.problem.measured):
        return fit_windows(solution.problem).judge(solution.state)
    alone = [each.solution for each in maps]
    n = max(0, freedom_of(solution.problem) - sum(freedom_of(each.problem) for each in alone))
    rise = max(0.0, 2.0 * (solution.cost - sum(each.cost for each in alone)))
    # The noise is known as well as the conditions within the runs tell it.
    told = max(1, sum(each.expected for each in runs))
    bound = n * float(stats.f.isf(FALSE_ALARM, n, told)) if n else 0.0
    # Each bound is so many sigmas above what is expected; of a sum these add up by their squares.
    parts = [(each.expected, each.bound - each.expected) for each in runs] + [(n, bound - n)]
    expected = sum(each for each, _ in parts)
    margin = float(np.linalg.norm([each for _, each in parts]))
    chi_square = rise + sum(each.chi_square for each in runs)
    return replace(runs[0], chi_square=chi_square, expected=expected, bound=expected + margin)
