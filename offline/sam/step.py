"""Application of a step: pose by pose or motion by motion, in full or shortened, whichever lowers the cost.

The length of a shortened step is by quadratic interpolation of the cost along it (Nocedal and Wright, "Numerical
Optimization", 2006, chapter 3.5).
"""

from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.linear_system import Blocks, Factor, LinearSystem, Rows
from groundsbot.offline.sam.linearisation.robust_losses import Loss

# Below this share of the predicted decrease the other retraction is tried too.
_GOOD_GAIN: Final = 0.75
_MOST_SHORTENED: Final = 2
_LEAST_SHARE: Final = 0.05  # a step that must be shorter is better damped


class StepStart(NamedTuple):
    """The state before a step, its cost, and whether the last step was retracted motion by motion."""

    state: State
    cost: float
    relative: bool


class StepResult(NamedTuple):
    """The state after a step, the retraction and the share of the step used, and the number of linearisations."""

    state: State
    cost: float
    relative: bool
    share: float
    n_linearised: int


def take_step(
    linear: LinearSystem[Blocks, Rows, Factor],
    losses: tuple[Loss, Loss],
    anchor: IntArray,
    before: StepStart,
    step: FloatArray,
    expected: float,
    spare: Blocks,
) -> StepResult:
    """Apply a step by the retraction that lowers the cost more; shorten it if neither lowers the cost.

    A step moves a weakly determined part of the map by metres for a small predicted decrease. Damping would slow down
    that part in all later steps, whereas a shorter step affects this one only.

    Args:
        linear: normal equations of the problem.
        losses: losses of odometry and observations.
        anchor: (T,) pose index with which each tag moves.
        before: state and cost before the step; the retraction of the last step is tried first.
        step: (n,) step in the order of the system.
        expected: predicted decrease of the cost.
        spare: overwritten with the normal equations at the state that is returned, where its cost is lower.

    Returns:
        The result; its cost is infinite if no share lowers the cost.
    """
    n_linearised = 0

    def try_share(share: float, *, relative: bool) -> StepResult:
        nonlocal n_linearised
        n_linearised += 1
        part = share * step
        moved = linear.retract(before.state, part, anchor)
        moved = linear.retract_relative(before.state, part, anchor, moved) if relative else moved
        cost = linear.linearise(moved, *losses, out=spare)[1]
        return StepResult(moved, cost, relative, share, n_linearised)

    first = try_share(1.0, relative=before.relative)
    if first.cost < before.cost - _GOOD_GAIN * expected:
        return first
    other = try_share(1.0, relative=not before.relative)
    if other.cost < min(before.cost, first.cost):
        return other
    if first.cost < before.cost:
        linear.linearise(first.state, *losses, out=spare)  # repeated, since blocks for both take hundreds of MiB
        return first._replace(n_linearised=n_linearised)
    shortened = min(first, other, key=lambda each: each.cost)
    for _ in range(_MOST_SHORTENED):
        # The parabola through both costs with the slope -2 expected at the start has its minimum at this share.
        share = shortened.share
        share *= 0.5 / (1.0 + (shortened.cost - before.cost) / (2.0 * expected * share))
        if not share > _LEAST_SHARE:
            break
        shortened = try_share(share, relative=shortened.relative)
        if shortened.cost < before.cost:
            return shortened
    return StepResult(before.state, np.inf, before.relative, 1.0, n_linearised)
