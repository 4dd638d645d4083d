"""Estimates of single calibration parameters from sections of drives, with everything else eliminated.

The log likelihood of a section of a segment, with everything but the calibration c eliminated, is a quadratic form with
information L_k and vector h_k: log p(section | c) = h_k^T c - c^T L_k c / 2 + constant. Sections have their own starts
and tags, so they are independent given c, and sums of these forms are the form of all.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.robot import TAG_SCALE
from groundsbot.offline.sam import Parameter
from groundsbot.offline.self_calibration.robot import OwnedParameter, freed_sigma

_NOTHING: Final = 1e-9  # information relative to the prior of freed parameters: rounding


class SectionInformation(NamedTuple):
    """Information (c, c) and information vector (c,) of a section about some parameters, and their indices (c,)."""

    at: IntArray
    information: FloatArray
    vector: FloatArray


@dataclass(frozen=True)
class CalibrationInformation:
    """Information of all sections about C parameters; each about those of its robot, or a fleet would take gigabytes.

    Attributes:
        parameters: C, each with the sigma that robot.yaml gives it.
        sections: in order of the drives.
    """

    parameters: tuple[Parameter, ...]
    sections: tuple[SectionInformation, ...]

    def relative_to(self, values: Mapping[OwnedParameter, float]) -> "CalibrationInformation":
        """Return the same relative to the files before these corrections, by owner and name, were applied."""
        shift = np.array([values.get(OwnedParameter(each.owner, each.name), 0.0) for each in self.parameters])
        moved = (each._replace(vector=each.vector + each.information @ shift[each.at]) for each in self.sections)
        return replace(self, sections=tuple(moved))


class NumberEstimate(NamedTuple):
    """Estimate of one parameter by data alone; its variance is huge where the data contain no information."""

    value: float
    variance: float


class SectionEstimates:
    """Estimates without a prior on the parameter in question, and with priors (C,) `sigmas` on all others.

    Robots have only tag scales in common. So the parameters of each other robot are eliminated on their own, and a
    fleet takes time in proportion to its robots.
    """

    def __init__(self, information: CalibrationInformation) -> None:
        self._information = information
        is_scale = np.array([each.name == TAG_SCALE for each in information.parameters], dtype=np.bool_)
        self._scales = np.flatnonzero(is_scale)
        owners = np.array([each.owner for each in information.parameters])
        self._own = {str(owner): np.flatnonzero((owners == owner) & ~is_scale) for owner in np.unique(owners)}
        informed = [each.at[np.diag(each.information) > 0.0] for each in information.sections]
        self._robot = [str(owners[min(each[~is_scale[each]], default=0)]) for each in informed]
        self._about: list[list[int]] = [[] for _ in owners]
        for k, each in enumerate(informed):
            for i in each.tolist():
                self._about[i].append(k)
        self._sections = {
            robot: np.array([k for k, each in enumerate(self._robot) if each == robot], dtype=np.int64)
            for robot in dict.fromkeys(self._robot)
        }
        self._sums: dict[tuple[str, bytes], tuple[IntArray, FloatArray, FloatArray]] = {}
        self._eliminated: dict[tuple[str, bytes], FloatArray] = {}
        self._others: tuple[bytes, dict[str, FloatArray]] = b"", {}

    def of_all(self, index: int, sigmas: FloatArray) -> NumberEstimate:
        """Return the estimate from all sections."""
        owner = self._information.parameters[index].owner
        robot = owner if index not in self._scales else next(iter(self._sections), owner)
        return self._estimate(index, robot, self._sections.get(robot, np.empty(0, dtype=np.int64)), sigmas)

    def one_against_others(self, index: int, sigmas: FloatArray) -> Iterator[tuple[NumberEstimate, NumberEstimate]]:
        """Yield, for each section that has information about the parameter, its estimate and that of all others."""
        for k in self._about[index]:
            robot = self._robot[k]
            others = self._sections[robot][self._sections[robot] != k]
            yield (
                self._estimate(index, robot, np.array([k]), sigmas, other_robots=False),
                self._estimate(index, robot, others, sigmas),
            )

    def _estimate(
        self, index: int, robot: str, sections: IntArray, sigmas: FloatArray, *, other_robots: bool = True
    ) -> NumberEstimate:
        """Return the estimate from some sections of one robot, and from all of the other robots."""
        limit = freed_sigma(self._information.parameters[index].name)
        at, information, vector = self._sum(robot, sections)
        own = int(np.flatnonzero(at == index)[0])
        if other_robots and robot in self._sections and len(self._scales):
            information, vector = information.copy(), vector.copy()
            scales, more = slice(len(at) - len(self._scales), None), self._of_others(robot, sigmas)
            information[scales, scales] += more[:, :-1]
            vector[scales] += more[:, -1]
        unit = sigmas[at]
        unit[own] = limit
        covariance = np.linalg.inv(unit[:, None] * information * unit + np.eye(len(unit)))
        mean = (covariance @ (unit * vector))[own]
        told_alone = 1.0 / covariance[own, own] - 1.0
        if told_alone < _NOTHING:
            return NumberEstimate(0.0, limit**2 / _NOTHING)
        return NumberEstimate(float(limit * mean / covariance[own, own] / told_alone), float(limit**2 / told_alone))

    def _sum(self, robot: str, sections: IntArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Return the indices (N,) of a robot's parameters, and information (N, N) and vector (N,) of some sections."""
        key = robot, sections.tobytes()
        if key not in self._sums:
            at = np.concatenate([self._own.get(robot, self._scales[:0]), self._scales])
            place = np.full(len(self._information.parameters), -1)
            place[at] = np.arange(len(at))
            information, vector = np.zeros((len(at), len(at))), np.zeros(len(at))
            for section in (self._information.sections[k] for k in sections.tolist()):
                there = place[section.at] >= 0
                own = place[section.at[there]]
                information[np.ix_(own, own)] += section.information[np.ix_(there, there)]
                vector[own] += section.vector[there]
            self._sums[key] = at, information, vector
        return self._sums[key]

    def _of_others(self, robot: str, sigmas: FloatArray) -> FloatArray:
        """Return information (T, T) and vector in one (T, T + 1) of all other robots about the T tag scales."""
        key = sigmas.tobytes()
        if key != self._others[0]:
            about = np.array([self._about_scales(each, sigmas) for each in self._sections])
            before, after = np.cumsum(about, axis=0), np.cumsum(about[::-1], axis=0)[::-1]
            nothing = np.zeros_like(about[:1])
            others = np.concatenate([nothing, before[:-1]]) + np.concatenate([after[1:], nothing])
            self._others = key, dict(zip(self._sections, others, strict=True))
        return self._others[1][robot]

    def _about_scales(self, robot: str, sigmas: FloatArray) -> FloatArray:
        """Return information and vector (T, T + 1) of all sections of a robot about the T tag scales."""
        key = robot, sigmas[self._own[robot]].tobytes()
        if key not in self._eliminated:
            at, information, vector = self._sum(robot, self._sections[robot])
            n = len(at) - len(self._scales)
            both = np.column_stack([information, vector])
            of_own = information[:n, :n] + np.diag(sigmas[at[:n]] ** -2.0)
            self._eliminated[key] = both[n:, n:] - information[n:, :n] @ np.linalg.solve(of_own, both[:n, n:])
        return self._eliminated[key]
