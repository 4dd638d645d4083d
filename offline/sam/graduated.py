"""Graduated non-convexity: a robust solve that need not begin among the right readings.

Yang, Antonante, Tzoumas and Carlone, "Graduated non-convexity for robust spatial perception" (2020).
"""

from dataclasses import replace
from typing import Final

import numpy as np

from groundsbot.offline.sam.factors.odometry_and_readings import State
from groundsbot.offline.sam.factors.robust_losses import SQUARES, Loss, forgets, graduated
from groundsbot.offline.sam.solver import Losses, Problem, Solution, solve

# The control falls by this each time, as in the paper.
_FALL: Final = 1.4
# A stage is only the next one's start: it ends where another step would lower the cost by a smaller share.
_STAGE_TOLERANCE: Final = 1e-3


def solve_graduated(problem: Problem, start: State, losses: Losses) -> Solution:
    """Minimises a cost whose losses forget what is far off, from one without that choice to the cost itself.

    First all readings count as squares. Then each loss that forgets is replaced by Geman and McClure's surrogate with
    threshold^2 times a control; the control begins at 2 r^2 / threshold^2, r the longest residual, where the surrogate
    is convex, and falls by 1.4 to 1, each solve from the solution of the last. At 1 it is Geman and McClure's loss; the
    given losses have the last word, under the stop rule of `solve`.

    Args:
        problem: the factors.
        start: values to begin from.
        losses: of each kind of factor; `factors.losses.truncated` and `robust.graduated(threshold, 1.0)` are approached
            gradually, squares, Huber's and Cauchy's stay as they are throughout.

    Returns:
        The last solve, whose costs are those of the given losses; `n_linearised` counts all of them.
    """
    stage = _stage(problem, start, Losses(*(SQUARES if forgets(loss) else loss for loss in losses)))
    n_linearised = stage.n_linearised
    control = _first_control(problem, stage.state, losses)
    while control > 1.0:
        stage = _stage(problem, stage.state, Losses(*(_surrogate(loss, control) for loss in losses)))
        n_linearised += stage.n_linearised
        control /= _FALL
    stage = _stage(problem, stage.state, Losses(*(_surrogate(loss, 1.0) for loss in losses)))
    final = solve(problem, stage.state, losses=losses)
    return replace(final, n_linearised=n_linearised + stage.n_linearised + final.n_linearised)


def _stage(problem: Problem, start: State, losses: Losses) -> Solution:
    return solve(problem, start, losses=losses, relative_tolerance=_STAGE_TOLERANCE)


def _surrogate(loss: Loss, control: float) -> Loss:
    return graduated(loss.threshold, control) if forgets(loss) else loss


def _first_control(problem: Problem, state: State, losses: Losses) -> float:
    """Of the paper: above it all surrogates are convex in the residuals."""
    residuals = (problem.odometry.residual(state), problem.readings.residual(state))
    largest = 1.0
    for loss, residual in zip(losses, residuals, strict=True):
        if forgets(loss):
            square = float((residual**2).sum(axis=1).max(initial=0.0))
            largest = max(largest, 2.0 * square / np.square(loss.threshold))
    return largest
