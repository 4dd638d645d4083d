"""Information about the calibration from sections of segments, each section solved on its own.

Each segment is cut into a few sections. A section is solved with its own start, its own tag positions and every
parameter that might be freed under a wide prior. Its information about the calibration is the information of this
estimate less the prior. This needs no map and no alignment, and a tag moved between sections does no harm. The noise is
fitted to windows of the segment (`local_map.goodness_of_fit`), so the given noise matters little.

The estimates are biased (`sam.bias`), all sections of a robot by the same share of their bias. The mean share is taken
off, and its variance added to the covariance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.calib.robot import FOCAL_SCALE, RANGE_OFFSET, NoiseParameters, Robot, split_camera_parameter
from groundsbot.offline.corners import CornerSolution, corner_graph, solve_corners
from groundsbot.offline.local_map import WINDOW_M, LocalMap, fit_windows
from groundsbot.offline.measurements import ODOMETRY_NOISE, Segment, least_shared_variance
from groundsbot.offline.noise import in_cell, inflation_of_corners
from groundsbot.offline.sam import (
    MEAN_SHARE,
    SHARE_VARIANCE,
    Budget,
    Parameter,
    Solution,
    bias_of,
    build_graph,
    is_of_segment,
    solve,
)
from groundsbot.offline.self_calibration.section_estimates import CalibrationInformation, SectionInformation

# Sections of a segment, where it is as long as this many windows. Holding out one of five is the usual share.
_SECTIONS: Final = 5
_FEWEST: Final = 2  # of a short segment
# Shares of a segment's solve budget: for its windows, and for each section, whose solve is correspondingly smaller.
_WINDOWS_SHARE: Final = 0.2
_SOLVING_SHARE: Final = 0.2

# Sigmas where robot.yaml gives none: a board calibration's focal length, and the depth error of tag prints.
_SIGMAS_NOT_GIVEN: Final[Mapping[str, float]] = MappingProxyType({FOCAL_SCALE: 1e-3, RANGE_OFFSET: 0.002})


class SegmentInformation(NamedTuple):
    """Information (C, C) and information vector (C,) of one section, and their parameters with the sigmas given."""

    parameters: tuple[Parameter, ...]
    information: FloatArray
    vector: FloatArray


class RobotInformation(NamedTuple):
    """What the drives of one robot say of its calibration, section by section.

    Attributes:
        sections: those that have information.
        priors: its parameters with the sigmas of robot.yaml, by owner, name and segments.
    """

    sections: list[SegmentInformation]
    priors: dict[tuple[object, ...], Parameter]


def robot_information(
    maps: Sequence[LocalMap], robot: Robot, noise: NoiseParameters, budgets: Sequence[Budget], *, corners: bool
) -> RobotInformation:
    """Return the information of all sections of the drives of one robot about its calibration.

    Args:
        maps: local maps of the drives, solved with every parameter free that may ever be freed.
        robot: robot with the sigmas of robot.yaml.
        noise: the noise model at which the fit of each segment's noise starts.
        budgets: the remaining solve budget of each map.
        corners: use the tags' corners in pixels where logs have them, else tag positions on the floor.
    """
    found = RobotInformation([], {})
    cuts = [_cuts(each.segment) for each in maps]
    n = sum(map(len, cuts))
    for each, own, budget in zip(maps, cuts, budgets, strict=True):
        given = build_graph([replace(each.segment, run=replace(each.segment.run, robot=robot))])
        of_robot = [parameter for parameter in given.parameters if not is_of_segment(parameter)]
        found.priors.update({parameter[:3]: _with_file_sigma(parameter, robot) for parameter in of_robot})
        segment = _with_window_noise(each, noise, budget)
        for first, end in own:
            part = _information_of_segment(segment, each, first, end, budget, n_sections=n, corners=corners)
            if part is not None:
                found.sections.append(part)
                for parameter in part.parameters:
                    found.priors.setdefault(parameter[:3], _with_file_sigma(parameter, robot))
    return found


def stack_information(robots: Sequence[RobotInformation]) -> CalibrationInformation:
    """Return the information of all sections of several robots about all their parameters."""
    priors = {key: parameter for each in robots for key, parameter in each.priors.items()}
    parts = [part for each in robots for part in each.sections]
    parameters = tuple(priors[key] for key in sorted(priors) if priors[key].sigma > 0.0)
    index = {parameter[:3]: i for i, parameter in enumerate(parameters)}
    sections = (
        SectionInformation(np.array([index[each[:3]] for each in part.parameters]), part.information, part.vector)
        for part in parts
    )
    return CalibrationInformation(parameters, tuple(sections))


def _with_file_sigma(parameter: Parameter, robot: Robot) -> Parameter:
    """Return the parameter with the sigma under which freeing it is judged, which robot.yaml may not give."""
    name, camera = split_camera_parameter(parameter.name)
    if name not in _SIGMAS_NOT_GIVEN:
        return parameter
    if camera:
        robot = robot.with_camera(camera)
    given = {FOCAL_SCALE: robot.focal_scale_sigma, RANGE_OFFSET: robot.range_offset_m_sigma}
    return parameter._replace(sigma=given[name] or _SIGMAS_NOT_GIVEN[name])


def _with_window_noise(local_map: LocalMap, noise: NoiseParameters, budget: Budget) -> Segment:
    """Return the segment under the noise fitted to its windows, including correlated errors of observations."""
    least = least_shared_variance(local_map.segment.observations)
    windows = fit_windows(local_map.graph.problem, budget=budget, share=_WINDOWS_SHARE, least_shared=least)
    of_wheels, of_observations = windows.factors.tolist()
    times = {name: of_wheels if name in ODOMETRY_NOISE else of_observations for name in NoiseParameters.model_fields}
    own = noise.model_copy(update={name: factor * getattr(noise, name) for name, factor in times.items()})
    segment = local_map.segment.with_noise(own)
    if not len(segment.observations):
        return segment
    of_corners = inflation_of_corners(segment, in_cell(segment), own.sigma_corner_px)
    of_corners = np.maximum(windows.correlated_error_factors.max(axis=-1), of_corners)
    return replace(segment, observations=segment.observations.inflate(windows.correlated_error_factors, of_corners))


def _cuts(segment: Segment) -> list[tuple[int, int]]:
    """Return the first keyframe and the end of each section; all are equally long."""
    along_m = segment.along_m
    n = int(np.clip(along_m[-1] / WINDOW_M, _FEWEST, _SECTIONS))
    ends = np.searchsorted(along_m, along_m[-1] * np.arange(1, n) / n, side="right").tolist()
    return list(zip([0, *ends], [*ends, len(along_m)], strict=True))


def _information_of_segment(
    segment: Segment, whole: LocalMap, first: int, end: int, budget: Budget, *, n_sections: int, corners: bool
) -> SegmentInformation | None:
    """Return the information of one of `n_sections` of a robot; None without tags or where its solve fails."""
    part = segment.part(first, end)
    if not len(part.observations):
        return None
    graph = build_graph([part])
    calibration = {parameter[:3]: value for parameter, value in whole.calibration.items()}
    start = graph.start(
        whole.T_start_base[first:end], whole.tags_m, {p: calibration.get(p[:3], 0.0) for p in graph.parameters}
    )
    on_floor = solve(graph.problem, start, most_tries=budget.max_linearisations(graph.problem, _SOLVING_SHARE))
    budget.spend(on_floor)
    solution: Solution | CornerSolution = on_floor
    parameters = graph.parameters
    if corners and graph.has_corners:
        on_corners, spatial = corner_graph(graph, on_floor.state)
        solution, parameters = solve_corners(on_corners.problem, spatial), on_corners.parameters
    if not solution.converged:
        return None
    columns = solution.problem.columns.calibration
    free = np.flatnonzero((columns >= 0) & [not is_of_segment(each) for each in parameters])
    value, covariance = solution.state.calibration[free], solution.covariance(columns[free])
    if solution is on_floor:
        bias = bias_of(on_floor)[columns[free]]
        value = value + MEAN_SHARE * bias
        # As independent sections are summed, an error they have in common would be averaged away.
        covariance = covariance + n_sections * SHARE_VARIANCE * np.outer(bias, bias)
    return _without_prior(tuple(parameters[i] for i in free), covariance, value)


def _without_prior(parameters: tuple[Parameter, ...], covariance: FloatArray, value: FloatArray) -> SegmentInformation:
    """Return the information of an estimate (C,) with its covariance (C, C), less that of its zero-mean priors."""
    sigma = np.array([each.sigma for each in parameters])
    information = np.linalg.inv(covariance / np.outer(sigma, sigma))  # in these sigmas
    vector = information @ (value / sigma)
    values, vectors = np.linalg.eigh(information - np.eye(len(sigma)))
    own = (vectors * np.maximum(values, 0.0)) @ vectors.T  # rounding may make eigenvalues negative
    return SegmentInformation(parameters, own / np.outer(sigma, sigma), vector / sigma)
