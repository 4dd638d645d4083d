"""Minimisation of the cost by Gauss-Newton and Levenberg-Marquardt steps, wherever the normal equations are kept."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Generic, NamedTuple, TypeVar

import numpy as np

from groundsbot.calib.foundation import IntArray
from groundsbot.offline.sam.arrowhead.system import UnderDeterminedError
from groundsbot.offline.sam.curvature import Curvature
from groundsbot.offline.sam.damping import Damping
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.linear_system import Blocks, Factor, LinearSystem, Rows
from groundsbot.offline.sam.linearisation.robust_losses import Loss
from groundsbot.offline.sam.step import StepStart, take_step

_T = TypeVar("_T")

MAX_STEPS: Final = 100
# `take_step` linearises once if the cost decreases as predicted, and at most six times.
MAX_TRIES: Final = 7 * MAX_STEPS
# In squared sigmas; a step with this predicted decrease is about 1e-5 sigma long.
COST_TOLERANCE: Final = 1e-10
# Where many residuals exceed the loss's threshold, steps become short; a thousandth of a sigma suffices there.
NOISY_COST_TOLERANCE: Final = 1e-6
COST_ROUNDING: Final = 1e-14  # relative
# If rounding makes H indefinite, the damping is raised from the first of these to the second in factors of ten.
_LEAST_FLOOR: Final = 1e-16
_MOST_FLOOR: Final = 1e-3
_SAFETY_FACTOR: Final = 10.0
_NEAR: Final = 0.01  # predicted decrease relative to the cost, beyond which nothing is concluded from the gain
_N_SLOW: Final = 5  # consecutive steps whose total decrease is compared with `least_progress`


class Stopping(NamedTuple):
    """When a solve ends; see `solver.solve`."""

    cost_tolerance: float = COST_TOLERANCE
    relative_tolerance: float = COST_ROUNDING
    most_steps: int = MAX_STEPS
    most_tries: int = MAX_TRIES
    least_progress: float = 0.0


@dataclass(frozen=True)
class Minimum(Generic[Factor]):
    """Where the minimisation ended; fields as in `solver.Solution`.

    Attributes:
        factorisation: that at the state, without damping and with the given losses; None if the last one is another.
    """

    state: State
    costs: tuple[float, ...]
    reason: str
    converged: bool
    n_linearised: int
    factorisation: Factor | None = None


def minimise(
    linear: LinearSystem[Blocks, Rows, Factor],
    anchor: IntArray,
    start: State,
    losses: tuple[Loss, Loss],
    stopping: Stopping,
) -> Minimum[Factor]:
    """Minimise the cost; see `solver.solve`.

    Args:
        linear: normal equations.
        anchor: (T,) pose index with which each tag moves.
        start: initial state.
        losses: losses of odometry and observations.
        stopping: when to end.
    """
    curvature = Curvature(losses)
    system, spare, rows = linear.scratch
    state, n_linearised = start, 1
    _, cost = linear.linearise(state, *losses, out=system)
    costs = [cost]
    last, n_steps, damping, relative = n_linearised + stopping.most_tries, 0, Damping(), False

    def finish(reason: str, *, converged: bool, factorisation: Factor | None = None) -> Minimum[Factor]:
        return Minimum(state, tuple(costs), reason, converged, n_linearised, factorisation)

    if not np.isfinite(cost):
        return finish("the cost is not a number at the start", converged=False)
    while n_steps < stopping.most_steps and n_linearised < last and not damping.is_exhausted:
        n_steps += 1
        try:
            factorisation, used = factorise(linear, system, damping.share, rows)
        except UnderDeterminedError:
            return finish("a variable is in no factor", converged=False)
        damping.require(used)
        step, expected = factorisation.step(damping.share)
        if expected <= stopping.cost_tolerance + stopping.relative_tolerance * cost:
            is_at_state = damping.share == 0.0 and curvature.losses == losses
            return finish("converged", converged=True, factorisation=factorisation if is_at_state else None)
        before = StepStart(state, cost, relative)
        taken = take_step(linear, curvature.losses, anchor, before, step, expected, spare)
        n_linearised += taken.n_linearised
        if not taken.cost < cost:
            if not curvature.reject_step():
                damping.reject_step()
            linear.linearise(state, *curvature.losses, out=system)
            n_linearised += 1
            continue
        whole_gain = (cost - taken.cost) / expected
        expected *= taken.share * (2.0 - taken.share)
        gain = (cost - taken.cost) / expected
        state, cost, relative = taken.state, taken.cost, taken.relative
        system, spare = spare, system
        costs.append(cost)
        if curvature.accept_step(whole_gain, costs[-2] - cost, cost):
            linear.linearise(state, *curvature.losses, out=system)
            n_linearised += 1
        is_near = damping.is_least and _is_near_enough(expected, gain, stopping.relative_tolerance, cost)
        if is_near or _is_slow(costs, stopping.least_progress):
            return finish("converged" if is_near else "the last steps lowered the cost too little", converged=is_near)
        damping.accept_step(gain)
    reason = "no step lowers the cost" if damping.is_exhausted else f"stopped after {n_steps} steps"
    return finish(reason, converged=False)


def _is_slow(costs: list[float], least_progress: float) -> bool:
    """Return whether the last steps together lowered the cost by less than a share of it."""
    return len(costs) > _N_SLOW and costs[-1 - _N_SLOW] - costs[-1] < least_progress * costs[-1]


def _is_near_enough(expected: float, gain: float, relative_tolerance: float, cost: float) -> bool:
    """Return whether the predicted decrease after a step is within a relative tolerance above the default.

    If the linear model was off by a share, the next gradient is that share of this one, and its predicted decrease the
    square of it. Far from the optimum the two decreases may agree by chance, so there this is not used, nor for the
    default tolerance.
    """
    remaining = _SAFETY_FACTOR * expected * (1.0 - gain) ** 2
    is_loose = relative_tolerance > COST_ROUNDING
    return is_loose and expected <= _NEAR * cost and remaining <= relative_tolerance * cost


def factorise(
    linear: LinearSystem[Blocks, Rows, Factor], system: Blocks, damping: float, out: Rows | None = None
) -> tuple[Factor, float]:
    """Factorise H + damping diag(H), with more damping if double precision requires it.

    Returns:
        The factorisation and the damping used.

    Raises:
        UnderDeterminedError: H is not positive definite at any damping.
    """
    return with_least_damping(lambda damped: linear.factorise(system, damped, out), damping)


def with_least_damping(function: Callable[[float], _T], damping: float = 0.0) -> tuple[_T, float]:
    """Return what a function of the damping returns, and the damping: as given, or the least that it works with.

    Raises:
        UnderDeterminedError: raised by the function at any damping.
    """
    while True:
        try:
            return function(damping), damping
        except UnderDeterminedError:
            if damping > _MOST_FLOOR:
                raise
            damping = max(10.0 * damping, _LEAST_FLOOR)
