"""Estimates of single parameters of a fleet, against dense algebra with all parameters of all robots at once."""

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.sam.parameters import Parameter
from groundsbot.offline.self_calibration.robot import FREED_SIGMAS
from groundsbot.offline.self_calibration.section_estimates import (
    CalibrationInformation,
    SectionEstimates,
    SectionInformation,
)
from tests.support.data.sections import dense_of

NAMES = ("track_scale", "mount_x_m", "time_offset_s")


def fleet(rng: np.random.Generator, n_robots: int, n_scales: int, n_sections: int) -> CalibrationInformation:
    """Sections that each have information about one robot and all tag scales."""
    parameters = [Parameter(f"r{robot}", name, (), 0.01) for robot in range(n_robots) for name in NAMES]
    parameters += [Parameter(f"batch{i}", "tag_scale", (), 0.005) for i in range(n_scales)]
    parameters = [parameters[i] for i in rng.permutation(len(parameters))]
    sections = []
    for robot in range(n_robots):
        about = [i for i, each in enumerate(parameters) if each.owner == f"r{robot}" or "batch" in each.owner]
        for _ in range(n_sections):
            root = rng.normal(scale=100.0, size=(len(about), len(about)))
            both = root.T @ root
            sections.append(SectionInformation(np.array(about), both, both @ rng.normal(scale=0.02, size=len(about))))
    return CalibrationInformation(tuple(parameters), tuple(sections))


def dense(told: CalibrationInformation, sections: list[int], index: int, sigmas: FloatArray) -> tuple[float, float]:
    others = np.arange(len(sigmas)) != index
    information, vector = (each[sections].sum(axis=0) for each in dense_of(told))
    posterior = information + np.diag(np.where(others, sigmas**-2.0, 0.0))
    cross, of_others = posterior[index, others], posterior[np.ix_(others, others)]
    left = posterior[index, index] - cross @ np.linalg.solve(of_others, cross)
    return (vector[index] - cross @ np.linalg.solve(of_others, vector[others])) / left, 1.0 / left


@pytest.mark.parametrize(("n_robots", "n_scales"), [(1, 0), (3, 0), (3, 1), (4, 2)])
def test_other_robots_are_eliminated_as_all_at_once(n_robots: int, n_scales: int) -> None:
    told = fleet(np.random.default_rng(n_robots + n_scales), n_robots, n_scales, n_sections=3)
    sigmas = np.array([each.sigma for each in told.parameters])
    sigmas[0] = FREED_SIGMAS[told.parameters[0].name]
    estimates, n = SectionEstimates(told), len(told.sections)
    for index in range(len(sigmas)):
        assert estimates.of_all(index, sigmas) == pytest.approx(dense(told, list(range(n)), index, sigmas), rel=1e-6)
        informative = [k for k in range(n) if index in told.sections[k].at]
        pairs = list(estimates.one_against_others(index, sigmas))
        assert len(pairs) == len(informative)
        for k, (out, others) in zip(informative, pairs, strict=True):
            assert out == pytest.approx(dense(told, [k], index, sigmas), rel=1e-6)
            rest = [other for other in range(n) if other != k]
            assert others == pytest.approx(dense(told, rest, index, sigmas), rel=1e-6)
