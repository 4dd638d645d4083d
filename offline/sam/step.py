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
_WORTHWHILE: Final = 0.5  # share of the decrease predicted for a shorter step that is as good as it


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
    """Apply a step by the retraction that lowers the cost more; shorten it if a shorter one lowers it far more.

    Where residuals are large, the second derivative of the cost may be twice that of the linear model, and each step
    ends almost as far beyond the minimum as it began before it. Steps also move a weakly determined part of the map by
    metres for a small predicted decrease. Damping would slow down that part in all later steps, whereas a shorter step
    affects this one only.

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

    best = last = try_share(1.0, relative=before.relative)
    if best.cost < before.cost - _GOOD_GAIN * expected:
        return best
    last = try_share(1.0, relative=not before.relative)
    best = min(best, last, key=_cost_or_infinity)
    for _ in range(_MOST_SHORTENED):
        share = _interpolate_share(best, before.cost, expected)
        if not share > _LEAST_SHARE or before.cost - best.cost >= _WORTHWHILE * expected * share:
            break
        last = try_share(share, relative=best.relative)
        best = min(best, last, key=_cost_or_infinity)
        if best is not last or best.cost < before.cost:
            break
    if not best.cost < before.cost:
        return StepResult(before.state, np.inf, before.relative, 1.0, n_linearised)
    if best is not last:
        linear.linearise(best.state, *losses, out=spare)  # repeated, since blocks for both take hundreds of MiB
    return best._replace(n_linearised=n_linearised)


def _interpolate_share(tried: StepResult, cost: float, expected: float) -> float:
    """Return the minimum of the parabola through the costs before and after a step, with slope -2 expected before."""
    return tried.share * 0.5 / (1.0 + (tried.cost - cost) / (2.0 * expected * tried.share))


def _cost_or_infinity(tried: StepResult) -> float:
    return tried.cost if np.isfinite(tried.cost) else np.inf
