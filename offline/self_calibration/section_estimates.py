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


@dataclass(frozen=True)
class CalibrationInformation:
    """Information of S sections about C parameters.

    Attributes:
        parameters: C, each with the sigma that robot.yaml gives it.
        information: (S, C, C); vector: (S, C).
    """

    parameters: tuple[Parameter, ...]
    information: FloatArray
    vector: FloatArray

    def relative_to(self, values: Mapping[OwnedParameter, float]) -> "CalibrationInformation":
        """Return the same relative to the files before these corrections, by owner and name, were applied."""
        shift = np.array([values.get(OwnedParameter(each.owner, each.name), 0.0) for each in self.parameters])
        return replace(self, vector=self.vector + self.information @ shift)


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
        informative = np.einsum("sii->si", information.information) > 0.0
        self._robot = [str(owners[np.argmax(each)]) for each in informative & ~is_scale]
        self._sections = {
            robot: np.array([k for k, each in enumerate(self._robot) if each == robot], dtype=np.int64)
            for robot in dict.fromkeys(self._robot)
        }
        self._sums: dict[tuple[str, bytes], tuple[IntArray, FloatArray, FloatArray]] = {}
        self._eliminated: dict[tuple[str, bytes], tuple[FloatArray, FloatArray]] = {}

    def of_all(self, index: int, sigmas: FloatArray) -> NumberEstimate:
        """Return the estimate from all sections."""
        owner = self._information.parameters[index].owner
        robot = owner if index not in self._scales else next(iter(self._sections), owner)
        return self._estimate(index, robot, self._sections.get(robot, np.empty(0, dtype=np.int64)), sigmas)

    def one_against_others(self, index: int, sigmas: FloatArray) -> Iterator[tuple[NumberEstimate, NumberEstimate]]:
        """Yield, for each section that has information about the parameter, its estimate and that of all others."""
        for k in np.flatnonzero(self._information.information[:, index, index] > 0.0).tolist():
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
        if other_robots and len(self._scales):
            information, vector = information.copy(), vector.copy()
            scales = slice(len(at) - len(self._scales), None)
            for other in self._sections:
                if other != robot:
                    more, more_vector = self._about_scales(other, sigmas)
                    information[scales, scales] += more
                    vector[scales] += more_vector
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
            information = self._information.information[np.ix_(sections, at, at)].sum(axis=0)
            self._sums[key] = at, information, self._information.vector[np.ix_(sections, at)].sum(axis=0)
        return self._sums[key]

    def _about_scales(self, robot: str, sigmas: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return information (T, T) and vector (T,) of all sections of a robot about the T tag scales."""
        own, scales = self._own[robot], self._scales
        key = robot, sigmas[own].tobytes()
        if key not in self._eliminated:
            information = self._information.information[self._sections[robot]].sum(axis=0)
            vector = self._information.vector[self._sections[robot]].sum(axis=0)
            of_own = information[np.ix_(own, own)] + np.diag(sigmas[own] ** -2.0)
            cross = information[np.ix_(own, scales)]
            solved = np.linalg.solve(of_own, np.column_stack([cross, vector[own]]))
            self._eliminated[key] = (
                information[np.ix_(scales, scales)] - cross.T @ solved[:, :-1],
                vector[scales] - cross.T @ solved[:, -1],
            )
        return self._eliminated[key]
