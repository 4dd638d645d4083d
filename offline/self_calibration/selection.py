"""Which calibration numbers the drives may set themselves, and why the others stay as robot.yaml has them.

What a segment of a drive tells of the calibration c, everything else eliminated, is a quadratic form: information L_k
and a vector h_k with log p(segment | c) = h_k^T c - c^T L_k c / 2 + constant. Segments have starts and tags of their
own, so they are independent given c, and all questions below are asked of sums of these forms.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import norm

from groundsbot.calib.foundation import BoolArray, FloatArray
from groundsbot.calib.robot import RANGE_OFFSET, TAG_SCALE, TIME_OFFSET, WHEEL_PARAMETERS
from groundsbot.offline.maps import CalibrationChoice
from groundsbot.offline.sam import Parameter
from groundsbot.offline.self_calibration.robot import MOST_SIGMAS, OFF_BY_FAR, OPEN_SIGMAS, OwnedParameter

# Of maps whose robot.yaml is right, one in so many has a number freed that need not have been.
_FALSE_ALARM: Final = 0.01
_NOTHING: Final = 1e-9  # information, as a share of what the sigmas of open numbers hold: rounding
_ODDS_OF_WHEELS: Final = 2.0 * float(np.log(10.0))
# What is off by so many of the sigmas that open ones have is off by far.
_BY_FAR: Final = 0.5
# A number that drives know worse than robot.yaml claims to is freed only where it is off by so many times what is more
# than chance: then the claim is wrong. Not those of which readings on the floor tell with a bias, as roll and pitch.
OFF_BY_ALL: Final = frozenset({*OFF_BY_FAR, RANGE_OFFSET, TAG_SCALE})
_CERTAINLY: Final = 1.5
DOUBTED: Final = "robot.yaml has another number wrong by far, so this one is not believed either"
TELLS_LESS: Final = "the drives tell less of it than robot.yaml does"
_AGREES: Final = "robot.yaml agrees with the drives"
_NOT_ASKED: Final = "it was not asked for"


@dataclass(frozen=True)
class CalibrationInformation:
    """What S segments tell of C numbers.

    Attributes:
        parameters: C, each with the sigma that robot.yaml gives it.
        information: (S, C, C); vector: (S, C).
    """

    parameters: tuple[Parameter, ...]
    information: FloatArray
    vector: FloatArray

    def about(self, values: Mapping[OwnedParameter, float]) -> "CalibrationInformation":
        """The same of numbers that are so much larger, by owner and name: about the files before these were put in."""
        shift = np.array([values.get(OwnedParameter(each.owner, each.name), 0.0) for each in self.parameters])
        return replace(self, vector=self.vector + self.information @ shift)


class _NumberEstimate(NamedTuple):
    """Of one number by data alone; of a variance beyond all measure where they say nothing."""

    value: float
    variance: float


def choose(
    told: CalibrationInformation, asked: Collection[str] = (), late_s: Mapping[str, float] = MappingProxyType({})
) -> list[CalibrationChoice]:
    """What becomes of each number that could be freed.

    First what robot.yaml has wrong by far. With it what the files of these robots say else is not believed either:
    nobody measured the one number and not the other, and one hand writes the files of a fleet. Then what contradicts
    robot.yaml, the worst first; the others are judged with it free.

    Args:
        told: by all drives.
        asked: names of those to be freed whether robot.yaml is contradicted or not; where empty those where it is.
        late_s: by robot, the time offset that passes of tags tell alone: a robot that drives at one speed all the time
            sees no difference between a camera that is late and one that sits elsewhere.
    """
    candidates = [i for i, each in enumerate(told.parameters) if each.name in OPEN_SIGMAS]
    judge = _Selection(told, candidates, asked, late_s)
    by_far = [] if asked else judge.off_by_far()
    judge.open_what_contradicts()
    if not asked and not by_far and judge.is_any_by_far():
        by_far = judge.open_all()
        judge.open_what_contradicts()
    found = {i: judge.look(i) for i in candidates}
    doubted = [i for i in judge.open if i in by_far and found[i].off_sigmas <= judge.at_least]
    return [_free(each, DOUBTED if i in doubted else "") if i in judge.open else each for i, each in found.items()]


def is_overruled(choices: Sequence[CalibrationChoice]) -> bool:
    """Whether robots' files are not believed at all."""
    return all(each.is_freed for each in choices if each.name in OFF_BY_FAR)


class _Selection:
    """Which numbers are open, and what is to be said of each as that is.

    Attributes:
        open: indices.
        at_least: by so many sigmas a number contradicts robot.yaml.
    """

    def __init__(
        self,
        told: CalibrationInformation,
        candidates: Sequence[int],
        asked: Collection[str],
        late_s: Mapping[str, float],
    ) -> None:
        self._told, self._candidates, self._asked, self._late_s = told, candidates, asked, late_s
        self.at_least = float(norm.isf(_FALSE_ALARM / max(len(candidates), 1) / 2.0))
        self.open: list[int] = []

    def off_by_far(self) -> list[int]:
        """Opens what is off by so much that robot.yaml cannot be meant, and what then is not believed either.

        All that may be is open at first. What is off least is held by robot.yaml, and the others are judged anew, until
        all that are left are off by far. So where several explain the same, one is left.
        """
        names, parameters = OFF_BY_ALL, self._told.parameters
        self.open = [i for i in self._candidates if parameters[i].name in names]
        while self.open:
            looked = {i: self.look(i) for i in self.open}
            held = {i: each for i, each in looked.items() if not self._is_by_far(each)}
            if not held:
                break
            self.open.remove(min(held, key=lambda i: held[i].off_sigmas))
        return self.open_all() if any(parameters[i].name in OFF_BY_FAR for i in self.open) else self.open.copy()

    def open_all(self) -> list[int]:
        """Opens what is not believed where anything is off by far, besides what is open."""
        doubted = [i for i in self._candidates if self._told.parameters[i].name in OFF_BY_ALL]
        self.open = [*doubted, *(i for i in self.open if i not in doubted)]
        return doubted

    def open_what_contradicts(self) -> None:
        """Opens what contradicts robot.yaml, the worst first."""
        while True:
            able = {i: each for i in self._candidates if i not in self.open and not (each := self.look(i)).reason}
            if not able:
                return
            self.open.append(max(able, key=lambda i: _plausible(able[i])))

    def is_any_by_far(self) -> bool:
        """Whether what is open is off by so much that robot.yaml cannot be meant."""
        is_one = (self._told.parameters[i].name in OFF_BY_FAR for i in self.open)
        return any(own and self._is_by_far(self.look(i)) for i, own in zip(self.open, is_one, strict=True))

    def _is_by_far(self, choice: CalibrationChoice) -> bool:
        values = [choice.value]
        if choice.name == TIME_OFFSET:
            values.append(self._late_s.get(choice.owner, 0.0))
        is_far = all(_BY_FAR < abs(value) / OPEN_SIGMAS[choice.name] < MOST_SIGMAS for value in values)
        return is_far and choice.off_sigmas > self.at_least and (choice.held_out_gain or 0.0) > 0.0

    def look(self, index: int) -> CalibrationChoice:
        """One number, judged with the others open or not; with the reason why it may not be freed, if there is one."""
        told, parameter = self._told, self._told.parameters[index]
        sigmas = np.array([each.sigma for each in told.parameters])
        sigmas[self.open] = [OPEN_SIGMAS[told.parameters[i].name] for i in self.open]
        prior, is_asked = parameter.sigma, parameter.name in self._asked
        whole = _estimate(told, np.ones(len(told.vector), dtype=np.bool_), sigmas, index)
        gain = _cross_validated_gain(told, sigmas, index)
        off_sigmas = abs(whole.value) / (prior**2 + whole.variance) ** 0.5
        most = MOST_SIGMAS * OPEN_SIGMAS[parameter.name]
        reason = ""
        is_wrong = parameter.name in OFF_BY_ALL and off_sigmas > _CERTAINLY * self.at_least
        if parameter.name == TIME_OFFSET:  # passes of tags must say so too
            is_wrong &= self._late_s.get(parameter.owner, 0.0) * whole.value > 0.5 * whole.value**2
        if whole.variance >= prior**2 and not is_wrong:
            reason = TELLS_LESS
        elif gain is None:
            reason = "a single segment tells of it, and nothing bears that out"
        elif gain <= 0.0:
            reason = "what some segments tell of it does not foretell the others better than robot.yaml does"
        elif abs(whole.value) > most:
            reason = f"it would be off by more than {most:g}, no error of calibration; is the file this robot's?"
        elif self._asked and not is_asked:
            reason = _NOT_ASKED
        elif not is_asked and off_sigmas <= self.at_least:
            reason = _AGREES
        return CalibrationChoice(
            owner=parameter.owner,
            name=parameter.name,
            is_freed=False,
            value=whole.value,
            sigma=whole.variance**0.5,
            prior_sigma=prior,
            off_sigmas=off_sigmas,
            held_out_gain=gain,
            reason=reason,
            is_asked=is_asked,
        )


def _free(choice: CalibrationChoice, reason: str) -> CalibrationChoice:
    """The choice to free a number; with what it is under the sigma that it has from then on."""
    limit = OPEN_SIGMAS[choice.name]
    share = limit**2 / (limit**2 + choice.sigma**2)
    return replace(choice, is_freed=True, value=share * choice.value, sigma=share**0.5 * choice.sigma, reason=reason)


def _plausible(choice: CalibrationChoice) -> float:
    """By how much a number contradicts robot.yaml, in squared sigmas, less what speaks against its being wrong.

    Wheels and tags that contradict each other about the metre contradict robot.yaml by the same sigmas. A radius is
    measured over many turns; tags are printed at another scale, or measured along another edge, ten times as often.
    """
    return choice.off_sigmas**2 - (_ODDS_OF_WHEELS if choice.name == WHEEL_PARAMETERS[0] else 0.0)


def _cross_validated_gain(told: CalibrationInformation, sigmas: FloatArray, index: int) -> float | None:
    """Log likelihood of each segment by what all others tell of the number, over that by robot.yaml; summed.

    None where no two segments tell anything of it.
    """
    prior, limit, gains = told.parameters[index].sigma, OPEN_SIGMAS[told.parameters[index].name], []
    for k in range(len(told.vector)):
        own = np.arange(len(told.vector)) == k
        out, others = (_estimate(told, which, sigmas, index) for which in (own, ~own))
        if max(out.variance, others.variance) < limit**2:
            gains.append(
                _log_density(out.value - others.value, out.variance + others.variance)
                - _log_density(out.value, out.variance + prior**2)
            )
    return sum(gains) if gains else None


def _estimate(told: CalibrationInformation, which: BoolArray, sigmas: FloatArray, index: int) -> _NumberEstimate:
    """By some segments (S,), the others at their sigmas about zero and this one without what holds it."""
    limit = OPEN_SIGMAS[told.parameters[index].name]
    unit = sigmas.copy()
    unit[index] = limit
    information = unit[:, None] * told.information[which].sum(axis=0) * unit
    covariance = np.linalg.inv(information + np.eye(len(unit)))
    mean = (covariance @ (unit * told.vector[which].sum(axis=0)))[index]
    told_alone = 1.0 / covariance[index, index] - 1.0
    if told_alone < _NOTHING:
        return _NumberEstimate(0.0, limit**2 / _NOTHING)
    return _NumberEstimate(float(limit * mean / covariance[index, index] / told_alone), float(limit**2 / told_alone))


def _log_density(off: float, variance: float) -> float:
    return -0.5 * float(off**2 / variance + np.log(variance))
