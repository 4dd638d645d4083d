"""Time offset between tag sensor and wheels, searched within a second of robot.yaml's, from passes of tags alone.

The likelihood of all passes is profiled over a grid of offsets: at each offset the other parameters (`pass_model`) and
the tag positions are estimated. From the best grid points the offset is estimated too. Errors have Student's t
distribution, so that outliers have bounded influence (Lange, Little and Taylor 1989, Robust statistical modeling using
the t distribution); its scales are estimated. Only the offset is used: the other parameters also absorb wheel errors
within a pass.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.measurements import Run
from groundsbot.offline.self_calibration.pass_kernels import add_squares
from groundsbot.offline.self_calibration.pass_model import (
    PARAMETERS,
    PRIOR_SIGMA,
    LinearisedTracks,
    linearise,
    tag_positions,
)
from groundsbot.offline.self_calibration.passes import REACH_S, Passes, find_passes

_STEP_S: Final = 0.1
_GRID_STEPS: Final = 5
_FINAL_STEPS: Final = 15
_MOST_STARTS: Final = 2
_CONVERGED: Final = 1e-3  # in prior sigmas
_NEARLY: Final = 1e-2  # sufficient for the profile
# Bounds on one Gauss-Newton step.
_LONGEST_STEP: Final = np.array([0.2, 0.02, 0.2, 0.3, 0.3, 0.1, 0.1, 0.1])
_LONGEST_TAG_STEP_M: Final = 1.0
# Bounds on the parameters: at -1 turn factor and tag scale are singular.
_LARGEST: Final = np.array([2.0, 0.5, 0.9, 5.0, 5.0, 2.0, 5.0, 0.9])
_DEGREES_OF_FREEDOM: Final = 3.0

# Fewer passes do not form enough blocks.
_FEWEST_PASSES: Final = 12
_BLOCKS: Final = 20
_PASSES_OF_A_BLOCK: Final = 2
_FEWEST_BLOCKS: Final = 4
# Error common to all blocks: a driver who corrects for the floor's disturbances makes stamps look late, by 4 ms on
# average in ten simulated floors of the paper.
_COMMON_SIGMA_S: Final = 0.005
# All offsets farther than this must be worse by this chi-square, corrected for correlated errors.
_APART_S: Final = 0.3
_CLEAR_CHI2: Final = 10.0
_LARGEST_SIGMA_S: Final = 0.1


@dataclass(frozen=True)
class TimeOffsetSearch:
    """Time offset of a robot's tag sensor against its wheels.

    Attributes:
        offset_s: delay of the tag sensor's stamps against the wheels', beyond robot.yaml's `time_offset_s`.
        sigma_s: its standard deviation, from the differences between blocks of the drives.
        grid_s: (G,) offsets tried, increasing.
        cost: (G,) negative log-likelihood at each, relative to `offset_s` and divided by the variance inflation of
            correlated errors within blocks: 0.5 is one sigma.
    """

    offset_s: float
    sigma_s: float
    grid_s: FloatArray
    cost: FloatArray


class PassEstimate(NamedTuple):
    """Of passes of tags: parameters (8,), tag positions (G, 2) and scales (2,) of the sigmas."""

    parameters: FloatArray
    tags_m: FloatArray
    scale: FloatArray

    @classmethod
    def start(cls, passes: Passes) -> "PassEstimate":
        """Return where to begin."""
        zero = np.zeros(len(PARAMETERS))
        return cls(zero, tag_positions(passes, zero), np.full(2, 2.0))

    def at_offset(self, offset_s: float) -> "PassEstimate":
        """Return the estimate with another time offset."""
        return self._replace(parameters=np.concatenate([[offset_s], self.parameters[1:]]))


class _PassEquations(NamedTuple):
    """Normal equations of the parameters from each of G passes, its tag position eliminated."""

    information: FloatArray  # (G, 8, 8)
    gradient: FloatArray  # (G, 8)
    tag_step_m: FloatArray  # to the optimal position at the current parameters
    tag_by_parameters: FloatArray  # derivative of the optimal position


def search_time_offset(runs: Sequence[Run]) -> TimeOffsetSearch | None:
    """Return the time offset of one robot, within a second to either side of robot.yaml's.

    Neither a map nor a good initial guess is needed: the wheels carry the robot through each pass of a tag, and only at
    the right offset do the observations of all passes agree with one mounting of the sensor.

    Args:
        runs: all with the same robot.yaml, their stamps shifted by its time_offset_s as `load_run` does.

    Returns:
        None where it is not observable: for robots that stand still or drive at one speed and turning rate, too few
        observations, an offset beyond a second, or several equally good offsets.
    """
    passes = find_passes(runs)
    if passes is None or len(passes) < _FEWEST_PASSES:
        return None
    curve = _curve(passes)
    grid_s = np.array(sorted(curve))
    costs = np.array([curve[offset_s][1] for offset_s in grid_s.tolist()])
    found, least = min((fit_passes(passes, curve[each][0]) for each in _best(grid_s, costs)), key=lambda each: each[1])
    if not (np.isfinite(costs).all() and np.isfinite(least)):
        return None
    offset_s, (sigma_s, repeats) = float(found.parameters[0]), _scatter(passes, found)
    cost = (costs - least) / repeats
    is_inside = abs(offset_s) < REACH_S - _STEP_S / 2
    if not (is_inside and sigma_s < _LARGEST_SIGMA_S):
        return None
    apart = np.abs(grid_s - offset_s) > _APART_S
    if 2.0 * cost[apart].min() < _CLEAR_CHI2:
        return None
    return TimeOffsetSearch(offset_s, sigma_s, grid_s, cost)


def _curve(passes: Passes) -> dict[float, tuple[PassEstimate, float]]:
    """Return the optimum and its cost by offset; each starts from its neighbour's towards zero."""
    found = {0.0: fit_passes(passes, PassEstimate.start(passes), free_offset=False, most_steps=2 * _GRID_STEPS)}
    for sign in (1.0, -1.0):
        last = found[0.0][0]
        for i in range(1, round(REACH_S / _STEP_S) + 1):
            offset_s = sign * i * _STEP_S
            found[offset_s] = fit_passes(passes, last.at_offset(offset_s), free_offset=False, most_steps=_GRID_STEPS)
            last = found[offset_s][0]
    return found


def _best(grid_s: FloatArray, costs: FloatArray) -> list[float]:
    """Return the offsets of the lowest minima."""
    padded = np.pad(costs, 1, constant_values=np.inf)
    minima = np.flatnonzero((costs <= padded[:-2]) & (costs <= padded[2:]))
    lowest = minima[np.argsort(costs[minima])][:_MOST_STARTS]
    return [float(each) for each in grid_s[lowest if len(lowest) else [len(costs) // 2]]]


def fit_passes(
    passes: Passes, estimate: PassEstimate, *, free_offset: bool = True, most_steps: int = _FINAL_STEPS
) -> tuple[PassEstimate, float]:
    """Return the estimate after Gauss-Newton steps with Student's t weights, and its cost."""
    free = slice(0 if free_offset else 1, None)
    for _ in range(most_steps):
        model = linearise(passes, estimate.parameters, estimate.tags_m)
        estimate = estimate._replace(scale=_scale(passes, model.residual, estimate.scale))
        weights = _weights(passes, model.residual, estimate.scale)[0]
        pulls = _pass_equations(passes, model, weights)
        information = pulls.information.sum(axis=0) + np.diag(PRIOR_SIGMA**-2)
        gradient = pulls.gradient.sum(axis=0) + estimate.parameters / PRIOR_SIGMA**2
        step = np.zeros(len(PARAMETERS))
        step[free] = -np.linalg.solve(information[free, free], gradient[free])
        step /= max(1.0, float(np.abs(step / _LONGEST_STEP).max()))
        tag_step_m = pulls.tag_step_m + pulls.tag_by_parameters @ step
        estimate = estimate._replace(
            parameters=np.clip(estimate.parameters + step, -_LARGEST, _LARGEST),
            tags_m=estimate.tags_m + np.clip(tag_step_m, -_LONGEST_TAG_STEP_M, _LONGEST_TAG_STEP_M),
        )
        if np.abs(step / PRIOR_SIGMA).max() < (_CONVERGED if free_offset else _NEARLY):
            break
    return estimate, _cost(passes, estimate)


def _scale(passes: Passes, residual: FloatArray, scale: FloatArray) -> FloatArray:
    """Return (2,) maximum-likelihood scales of the sigmas, by three EM steps; each pass costs a degree of freedom."""
    square = (residual / passes.sigma) ** 2
    for _ in range(3):
        weighed = (_DEGREES_OF_FREEDOM + 1.0) / (_DEGREES_OF_FREEDOM + square / scale**2) * square
        scale = np.sqrt(weighed.sum(axis=0) / (len(square) - len(passes)))
    return np.maximum(scale, 1e-3)


def _weights(passes: Passes, residual: FloatArray, scale: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (M, 2) weights of squared residuals, and (2,) mean curvature of the loss relative to these weights."""
    sigma, nu = passes.sigma * scale, _DEGREES_OF_FREEDOM
    square = (residual / sigma) ** 2
    weights = (nu + 1.0) / (nu + square)
    curvature = (nu + 1.0) * (nu - square) / (nu + square) ** 2
    return weights / sigma**2, np.maximum(curvature.mean(axis=0) / weights.mean(axis=0), 0.1)


def _cost(passes: Passes, estimate: PassEstimate) -> float:
    """Return the negative log-likelihood with the priors, up to a constant."""
    return float(pass_losses(passes, estimate).sum() + 0.5 * ((estimate.parameters / PRIOR_SIGMA) ** 2).sum())


def pass_losses(passes: Passes, estimate: PassEstimate) -> FloatArray:
    """Return (G,) the negative log-likelihood of each pass, up to a constant."""
    residual, nu = linearise(passes, estimate.parameters, estimate.tags_m).residual, _DEGREES_OF_FREEDOM
    losses = 0.5 * (nu + 1.0) * np.log1p((residual / (passes.sigma * estimate.scale)) ** 2 / nu)
    n = np.bincount(passes.group)
    return np.asarray(np.add.reduceat(losses.sum(axis=-1), passes.first) + (n - 1) * np.log(estimate.scale).sum())


def _pass_equations(passes: Passes, model: LinearisedTracks, weights: FloatArray) -> _PassEquations:
    """Return normal equations of each pass from weights (M, 2), its tag position eliminated by the Schur complement."""
    n = 2 + len(PARAMETERS) + 1
    sums = np.zeros((len(passes), n, n))
    add_squares(passes.group, model.residual, model.by_tag, model.by_parameters, weights, sums)
    of_tag, cross, own = sums[:, :2, :2], sums[:, :2, 2:], sums[:, 2:, 2:]
    least = 1e-9 * (1.0 + np.trace(of_tag, axis1=-2, axis2=-1))
    solved = np.linalg.solve(of_tag + least[:, None, None] * np.eye(2), cross)
    left = own - cross.swapaxes(-1, -2) @ solved
    return _PassEquations(left[:, :-1, :-1], left[:, :-1, -1], -solved[..., -1], -solved[..., :-1])


def _scatter(passes: Passes, found: PassEstimate) -> tuple[float, float]:
    """Return the offset's sigma, and the variance inflation by correlated errors within blocks, at least 1.

    By the jackknife: the change of the estimate, to first order, when a block of passes is left out (CR3 of Bell and
    McCaffrey 2002, Bias reduction in standard errors for linear regression with multi-stage samples). A block is
    contiguous in time, and all have about the same information about the offset. Infinite if there are too few blocks.
    """
    model = linearise(passes, found.parameters, found.tags_m)
    weights, curvature = _weights(passes, model.residual, found.scale)
    gradient = _pass_equations(passes, model, weights).gradient
    information = _pass_equations(passes, model, weights * curvature).information
    whole = information.sum(axis=0) + np.diag(PRIOR_SIGMA**-2)
    by_offset = np.linalg.inv(whole)[0]
    until = np.cumsum(by_offset @ information @ by_offset)
    n = min(_BLOCKS, len(passes) // _PASSES_OF_A_BLOCK)
    first = np.unique(np.searchsorted(until, until[-1] * np.arange(n) / n))
    n = len(first)
    if n < _FEWEST_BLOCKS:
        return np.inf, 1.0
    blocks, pulls = np.add.reduceat(information, first), np.add.reduceat(gradient, first)
    moves = np.linalg.solve(whole - blocks, pulls[..., None])[:, 0, 0]
    variance = (n - 1) / n * float((moves**2).sum())
    alone = float(by_offset[0])
    return float(np.sqrt(max(variance, alone) + _COMMON_SIGMA_S**2)), max(variance / alone, 1.0)
