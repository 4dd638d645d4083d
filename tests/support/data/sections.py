"""Information of sections about calibration parameters, from dense matrices."""

from collections.abc import Sequence

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.sam.parameters import Parameter
from groundsbot.offline.self_calibration.section_estimates import CalibrationInformation, SectionInformation


def information_of(
    parameters: Sequence[Parameter], information: FloatArray, vector: FloatArray
) -> CalibrationInformation:
    """Of S sections about C parameters: information (S, C, C) and vectors (S, C)."""
    at = np.arange(len(parameters))
    sections = (SectionInformation(at, own, own_vector) for own, own_vector in zip(information, vector, strict=True))
    return CalibrationInformation(tuple(parameters), tuple(sections))


def dense_of(told: CalibrationInformation) -> tuple[FloatArray, FloatArray]:
    """Information (S, C, C) and vectors (S, C) of all sections."""
    n, n_sections = len(told.parameters), len(told.sections)
    information, vector = np.zeros((n_sections, n, n)), np.zeros((n_sections, n))
    for k, each in enumerate(told.sections):
        information[k][np.ix_(each.at, each.at)], vector[k, each.at] = each.information, each.vector
    return information, vector
