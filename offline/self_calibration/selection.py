"""Which calibration numbers the drives may set themselves, and why the others stay as robot.yaml has them.

What a stretch of a drive tells of the calibration c, everything else eliminated, is a quadratic form: information L_k
and a vector h_k with log p(stretch | c) = h_k^T c - c^T L_k c / 2 + constant. Stretches have starts and tags of their
own, so they are independent given c, and all questions below are asked of sums of these forms.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import norm

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.offline.maps import CalibrationChoice
from groundsbot.offline.sam import Parameter
from groundsbot.offline.self_calibration.robot import LIMITS

# Of maps whose robot.yaml is right, one in so many has a number freed that need not have been.
_FALSE_ALARM: Final = 0.01
_NOTHING: Final = 1e-9  # information, as a share of what the limits hold: rounding
TELLS_LESS: Final = "the drives tell less of it than robot.yaml does"
_AGREES: Final = "robot.yaml agrees with the drives"
_NOT_ASKED: Final = "it was not asked for"


@dataclass(frozen=True)
class Told:
    """What S stretches tell of C numbers.

    Attributes:
        parameters: C, each with the sigma that robot.yaml gives it.
        information: (S, C, C); vector: (S, C).
    """

    parameters: tuple[Parameter, ...]
    information: FloatArray
    vector: FloatArray


class _Estimate(NamedTuple):
    """Of one number by data alone; of a variance beyond all measure where they say nothing."""

    value: float
    variance: float


def choose(told: Told, asked: Collection[str] = ()) -> list[CalibrationChoice]:
    """What becomes of each number that could be freed.

    The one that contradicts robot.yaml most is freed first, and the others are judged with it free.

    Args:
        told: by all drives.
        asked: names of those to be freed whether robot.yaml is contradicted or not; where empty those where it is.
    """
    sigmas = np.array([each.sigma for each in told.parameters])
    candidates = [i for i, each in enumerate(told.parameters) if each.name in LIMITS]
    at_least = float(norm.isf(_FALSE_ALARM / max(len(candidates), 1) / 2.0))
    chosen: dict[int, CalibrationChoice] = {}
    while True:
        looked = {
            i: _look(told, sigmas, i, is_asked=told.parameters[i].name in asked) for i in candidates if i not in chosen
        }
        able = {
            i: each
            for i, each in looked.items()
            if not each.reason and (each.name in asked if asked else each.off_sigmas > at_least)
        }
        if not able:
            break
        first = max(able, key=lambda i: able[i].off_sigmas)
        chosen[first] = replace(able[first], is_freed=True)
        sigmas[first] = LIMITS[told.parameters[first].name]
    for i, each in looked.items():
        chosen[i] = each if each.reason else replace(each, reason=_NOT_ASKED if asked else _AGREES)
    return [chosen[i] for i in candidates]


def _look(told: Told, sigmas: FloatArray, index: int, *, is_asked: bool) -> CalibrationChoice:
    """One number, judged with the others at these sigmas; with the reason why it may not be freed, if there is one."""
    parameter = told.parameters[index]
    limit, prior = LIMITS[parameter.name], parameter.sigma
    whole = _estimate(told, np.ones(len(told.vector), dtype=np.bool_), sigmas, index)
    gain = _held_out_gain(told, sigmas, index)
    reason = ""
    if whole.variance >= prior**2:
        reason = TELLS_LESS
    elif gain is None:
        reason = "a single stretch tells of it, and nothing bears that out"
    elif gain <= 0.0:
        reason = "what some stretches tell of it does not foretell the others better than robot.yaml does"
    elif abs(whole.value) > limit:
        reason = f"it would be off by more than {limit:g}, which is no error of calibration; is the file this robot's?"
    return CalibrationChoice(
        owner=parameter.owner,
        name=parameter.name,
        is_freed=False,
        value=whole.value,
        sigma=whole.variance**0.5,
        prior_sigma=prior,
        off_sigmas=abs(whole.value) / (prior**2 + whole.variance) ** 0.5,
        held_out_gain=gain,
        reason=reason,
        is_asked=is_asked,
    )


def _held_out_gain(told: Told, sigmas: FloatArray, index: int) -> float | None:
    """Log likelihood of each stretch by what all others tell of the number, over that by robot.yaml; summed.

    None where no two stretches tell anything of it.
    """
    prior, limit, gains = told.parameters[index].sigma, LIMITS[told.parameters[index].name], []
    for k in range(len(told.vector)):
        own = np.arange(len(told.vector)) == k
        out, others = (_estimate(told, which, sigmas, index) for which in (own, ~own))
        if max(out.variance, others.variance) < limit**2:
            gains.append(
                _log_density(out.value - others.value, out.variance + others.variance)
                - _log_density(out.value, out.variance + prior**2)
            )
    return sum(gains) if gains else None


def _estimate(told: Told, which: BoolArray, sigmas: FloatArray, index: int) -> _Estimate:
    """By some stretches (S,), the others at their sigmas about zero and this one without what holds it."""
    limit = LIMITS[told.parameters[index].name]
    unit = sigmas.copy()
    unit[index] = limit
    information = unit[:, None] * told.information[which].sum(axis=0) * unit
    covariance = np.linalg.inv(information + np.eye(len(unit)))
    mean = (covariance @ (unit * told.vector[which].sum(axis=0)))[index]
    told_alone = 1.0 / covariance[index, index] - 1.0
    if told_alone < _NOTHING:
        return _Estimate(0.0, limit**2 / _NOTHING)
    return _Estimate(float(limit * mean / covariance[index, index] / told_alone), float(limit**2 / told_alone))


def _log_density(off: float, variance: float) -> float:
    return -0.5 * float(off**2 / variance + np.log(variance))
