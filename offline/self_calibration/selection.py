"""Which calibration parameters the drives may correct, and why the others stay as robot.yaml has them.

All tests use estimates from sections of the drives, which are independent (`section_estimates`).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Final

import numpy as np
from scipy.special import ndtri

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.robot import RANGE_OFFSET, TAG_SCALE, TIME_OFFSET, WHEEL_PARAMETERS, without_camera
from groundsbot.offline.maps import CalibrationChoice
from groundsbot.offline.sam import Parameter
from groundsbot.offline.self_calibration.robot import (
    FREED_SIGMAS,
    GROSS_ERROR_NAMES,
    MAX_FREED_SIGMAS,
    OwnedParameter,
    freed_sigma,
)
from groundsbot.offline.self_calibration.section_estimates import CalibrationInformation, SectionEstimates

# Share of maps with a correct robot.yaml in which any parameter is freed.
_FALSE_ALARM: Final = 0.01
_ODDS_OF_WHEELS: Final = 2.0 * float(np.log(10.0))
# An error beyond this many of the sigmas of freed parameters is a gross error.
_GROSS_SHARE: Final = 0.5
# A parameter less certain from data than from robot.yaml is freed only if its estimates from some sections predict the
# others better than robot.yaml by as much as the threshold is in log likelihood: then the claimed sigma is wrong. Roll
# and pitch, which floor observations estimate with a bias, are excluded.
DISTRUSTED_NAMES: Final = frozenset({*GROSS_ERROR_NAMES, RANGE_OFFSET, TAG_SCALE})
GROSS_ERROR_ELSEWHERE: Final = "robot.yaml has a gross error in another number, so this one is not trusted either"
LESS_CERTAIN: Final = "the drives determine it less well than robot.yaml does"
_AGREES: Final = "robot.yaml agrees with the drives"
_NOT_ASKED: Final = "it was not requested"


def choose(
    information: CalibrationInformation,
    asked: Collection[str] = (),
    late_s: Mapping[OwnedParameter, float] = MappingProxyType({}),
) -> list[CalibrationChoice]:
    """Decide for each candidate parameter whether it is freed.

    First find gross errors of robot.yaml. If there is one, the other parameters that may be grossly wrong are not
    trusted either: they were hardly measured separately, and the files of a fleet usually have one author. Then free
    the parameters that contradict robot.yaml, the worst first; the others are judged with these free.

    Args:
        information: information of all drives.
        asked: names of parameters to free whether or not they contradict robot.yaml, for all cameras where no camera
            is named; if empty, those that do.
        late_s: time offsets, estimated from passes of tags alone. At constant speed a late camera and a displaced
            camera cannot be distinguished.
    """
    candidates = [i for i, each in enumerate(information.parameters) if without_camera(each.name) in FREED_SIGMAS]
    judge = _Selection(information, candidates, asked, late_s)
    by_far = [] if asked else judge.free_gross_errors()
    judge.free_contradicting()
    if not asked and not by_far and judge.has_gross_error():
        by_far = judge.free_doubtful()
        judge.free_contradicting()
    found = {i: judge.assess(i) for i in candidates}
    doubted = [i for i in judge.open if i in by_far and found[i].off_sigmas <= judge.at_least]
    return [
        _free(each, GROSS_ERROR_ELSEWHERE if i in doubted else "") if i in judge.open else each
        for i, each in found.items()
    ]


def is_overruled(choices: Sequence[CalibrationChoice]) -> bool:
    """Return whether every parameter that may be grossly wrong was freed."""
    return all(each.is_freed for each in choices if without_camera(each.name) in GROSS_ERROR_NAMES)


class _Selection:
    """Which parameters are free, and the assessment of each given these.

    Attributes:
        open: indices of free parameters.
        at_least: the number of sigmas at which a parameter contradicts robot.yaml.
    """

    def __init__(
        self,
        information: CalibrationInformation,
        candidates: Sequence[int],
        asked: Collection[str],
        late_s: Mapping[OwnedParameter, float],
    ) -> None:
        self._information, self._candidates, self._asked, self._late_s = information, candidates, asked, late_s
        self._estimates = SectionEstimates(information)
        self._sigmas = np.array([each.sigma for each in information.parameters])
        self.at_least = float(-ndtri(_FALSE_ALARM / max(len(candidates), 1) / 2.0))
        self.open: list[int] = []

    def free_gross_errors(self) -> list[int]:
        """Free parameters with a gross error, and return those that are then not trusted either.

        By backward elimination: all candidates are free at first. The one with the smallest deviation is fixed and the
        others are judged again, until all free ones are grossly wrong. So of several that explain the same, one
        remains.
        """
        self.open = [i for i in self._candidates if self._is_one_of(DISTRUSTED_NAMES, i)]
        while self.open:
            looked = {i: self.assess(i) for i in self.open}
            held = {i: each for i, each in looked.items() if not self._is_gross_error(each)}
            if not held:
                break
            self.open.remove(min(held, key=lambda i: held[i].off_sigmas))
        return (
            self.free_doubtful() if any(self._is_one_of(GROSS_ERROR_NAMES, i) for i in self.open) else self.open.copy()
        )

    def free_doubtful(self) -> list[int]:
        """Free what is not trusted after a gross error, besides what is free; return the former."""
        doubted = [i for i in self._candidates if self._is_one_of(DISTRUSTED_NAMES, i)]
        self.open = [*doubted, *(i for i in self.open if i not in doubted)]
        return doubted

    def free_contradicting(self) -> None:
        """Free parameters that contradict robot.yaml, the worst first."""
        while True:
            able = {i: each for i in self._candidates if i not in self.open and not (each := self.assess(i)).reason}
            if not able:
                return
            self.open.append(max(able, key=lambda i: _contradiction_score(able[i])))

    def has_gross_error(self) -> bool:
        """Return whether a free parameter is a gross error."""
        return any(self._is_one_of(GROSS_ERROR_NAMES, i) and self._is_gross_error(self.assess(i)) for i in self.open)

    def _is_one_of(self, names: Collection[str], index: int) -> bool:
        """Return whether a parameter, of any camera, has one of these names."""
        return without_camera(self._information.parameters[index].name) in names

    def _is_gross_error(self, choice: CalibrationChoice) -> bool:
        values = [choice.value]
        if without_camera(choice.name) == TIME_OFFSET:
            values.append(self._late_s.get(OwnedParameter(choice.owner, choice.name), 0.0))
        is_far = all(_GROSS_SHARE < abs(value) / freed_sigma(choice.name) < MAX_FREED_SIGMAS for value in values)
        return is_far and choice.off_sigmas > self.at_least and (choice.held_out_gain or 0.0) > 0.0

    def assess(self, index: int) -> CalibrationChoice:
        """Return the assessment of one parameter given the free ones, with the reason if it may not be freed."""
        information, parameter = self._information, self._information.parameters[index]
        sigmas = self._sigmas.copy()
        sigmas[self.open] = [freed_sigma(information.parameters[i].name) for i in self.open]
        prior, name = parameter.sigma, without_camera(parameter.name)
        is_asked = parameter.name in self._asked or name in self._asked
        whole = self._estimates.of_all(index, sigmas)
        gain = _cross_validated_gain(self._estimates, parameter, index, sigmas)
        off_sigmas = abs(whole.value) / (prior**2 + whole.variance) ** 0.5
        most = MAX_FREED_SIGMAS * freed_sigma(parameter.name)
        reason = ""
        is_wrong = name in DISTRUSTED_NAMES and off_sigmas > self.at_least
        if name == TIME_OFFSET:  # passes of tags must agree
            late_s = self._late_s.get(OwnedParameter(parameter.owner, parameter.name), 0.0)
            is_wrong &= late_s * whole.value > 0.5 * whole.value**2
        is_less_certain = whole.variance >= prior**2
        if is_less_certain and not is_wrong:
            reason = LESS_CERTAIN
        elif gain is None:
            reason = "only one section of the drives determines it, and no other confirms that"
        elif gain <= (0.5 * self.at_least**2 if is_less_certain else 0.0):
            reason = "its estimates from some sections of the drives predict the others no better than robot.yaml does"
        elif abs(whole.value) > most:
            reason = f"its error would exceed {most:g}, too much for a calibration error; is the file this robot's?"
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
    """Return the choice to free a parameter, with its estimate under the prior that it then has."""
    limit = freed_sigma(choice.name)
    share = limit**2 / (limit**2 + choice.sigma**2)
    return replace(choice, is_freed=True, value=share * choice.value, sigma=share**0.5 * choice.sigma, reason=reason)


def _contradiction_score(choice: CalibrationChoice) -> float:
    """Return the squared sigmas of the contradiction with robot.yaml, less the prior log odds against an error.

    A contradiction between wheels and tags about the scale has the same sigmas for both. A radius is measured over many
    turns; tags are ten times as often printed at another scale or measured along another edge.
    """
    return choice.off_sigmas**2 - (_ODDS_OF_WHEELS if choice.name == WHEEL_PARAMETERS[0] else 0.0)


def _cross_validated_gain(
    estimates: SectionEstimates, parameter: Parameter, index: int, sigmas: FloatArray
) -> float | None:
    """Return the leave-one-out log-likelihood gain over robot.yaml, summed over sections.

    Each section's likelihood is taken under the estimate of all others, and under robot.yaml. None where no two
    sections have information about the parameter.
    """
    prior, limit = parameter.sigma, freed_sigma(parameter.name)
    gains = [
        _log_density(out.value - others.value, out.variance + others.variance)
        - _log_density(out.value, out.variance + prior**2)
        for out, others in estimates.one_against_others(index, sigmas)
        if max(out.variance, others.variance) < limit**2
    ]
    return sum(gains) if gains else None


def _log_density(off: float, variance: float) -> float:
    return -0.5 * float(off**2 / variance + np.log(variance))
