"""How a step is taken: pose by pose or motion by motion, all of it or less, whichever goes down."""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam.arrowhead.system import Arrowhead
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.linearisation.blocks import NormalEquations
from groundsbot.offline.sam.linearisation.robust_losses import Loss

# A step that brings less than this share of what the linear model says is also tried in the other way.
_GOOD_GAIN: Final = 0.75
_SHARES: Final = (1.0, 0.5, 0.2)


class StepStart(NamedTuple):
    """Where a step begins, its cost, and whether the last step was rolled: taken motion by motion."""

    state: State
    cost: float
    rolled: bool


class StepResult(NamedTuple):
    """What came of a step: how much of it was taken, in which way, and how often factors were linearised for that."""

    state: State
    cost: float
    rolled: bool
    share: float
    n_linearised: int


def take_step(
    arrowhead: Arrowhead,
    losses: tuple[Loss, Loss],
    anchor: IntArray,
    before: StepStart,
    step: FloatArray,
    expected: float,
    out: NormalEquations,
) -> StepResult:
    """Takes a step: the other way too where the first is not good, and less of it where none goes down.

    Where a part hangs loose, a step swings it by metres for next to nothing. Damping holds that back for good, less of
    the step does not.

    Args:
        arrowhead: of the problem.
        losses: of motions and of observations.
        anchor: (T,) poses that tags go along with.
        before: where it begins; the way that was best last time is tried first.
        step: (n,) in the arrowhead's order.
        expected: by how much the linear model says that the cost falls.
        out: takes the blocks of the state that is returned.

    Returns:
        The outcome; its cost is infinite where nothing helped.
    """
    n_linearised = 0

    def try_share(share: float, *, rolled: bool) -> StepResult:
        nonlocal n_linearised
        n_linearised += 1
        part = share * step
        moved = arrowhead.retract(before.state, part, anchor)
        moved = arrowhead.retract_relative(before.state, part, anchor, moved) if rolled else moved
        return StepResult(moved, arrowhead.linearise(moved, *losses, out=out)[1], rolled, share, n_linearised)

    for share in _SHARES:
        first = try_share(share, rolled=before.rolled)
        if first.cost < before.cost - _GOOD_GAIN * share * (2.0 - share) * expected:
            return first
        other = try_share(share, rolled=not before.rolled)
        if other.cost < min(before.cost, first.cost):
            return other
        if first.cost < before.cost:
            return try_share(share, rolled=before.rolled)
    return StepResult(before.state, np.inf, before.rolled, 1.0, n_linearised)
