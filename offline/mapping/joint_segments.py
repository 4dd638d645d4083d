"""Segments as the joint estimate sees them: measurements corrected by its calibration, with its weights in covariances.

What follows the estimate (the report, exports, advice, maps to extend) works on least squares with normal errors. The
joint estimate is the solution of that problem, with the measurements, weights and places of its last iteration.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.estimate import NU, Joint, errors_of_motions, errors_of_readings
from groundsbot.offline.measurements import CovarianceParts, Observations, Segment, TagKey, index_observed_tags

_LEAST_WEIGHT: Final = 1e-6


class Names(NamedTuple):
    """Names of places: tags that some drives have elsewhere have several, `a`, `b`, ...

    Attributes:
        of_drive: name of the place that a drive has for a tag, where the tag has several.
        points: point of each place.
    """

    of_drive: Mapping[tuple[int, TagKey], TagKey]
    points: Mapping[TagKey, int]


def corrected_segments(joint: Joint, names: Names) -> list[Segment]:
    """Return the segments of a component, with the poses that the estimate has, and with the names of places."""
    problem = joint.problem
    _, of_motions = errors_of_motions(problem.motions, joint.values, NU)
    _, of_readings = errors_of_readings(problem.readings, joint.values, NU)
    found, m, r = [], 0, 0
    for d, drive in enumerate(problem.drives):
        motions, readings = slice(m, m + drive.n_poses - 1), slice(r, r + len(drive.segment.observations))
        segment = _with_motions(drive.segment, joint, motions, of_motions[motions])
        segment = _with_readings(segment, joint, d, np.arange(*readings.indices(len(of_readings))), of_readings, names)
        stamps_ns = drive.stamps_ns
        found.append(replace(segment, stamps_ns=stamps_ns))
        m, r = motions.stop, readings.stop
    return found


def _with_motions(segment: Segment, joint: Joint, own: slice, weight: FloatArray) -> Segment:
    """Return the segment with the motions by the corrected wheels, and with their weighted covariances."""
    motions = joint.problem.motions
    c = joint.values.calibration[motions.parameters[own]]
    turn = motions.turn[own] + (motions.by_turn[own] * c[:, 1:]).sum(axis=1)
    chord = np.exp(c[:, :1]) * (motions.along[own] + np.einsum("mik,mk->mi", motions.by_along[own], c[:, 1:]))
    half = np.column_stack([np.zeros((len(turn), 2)), 0.5 * turn])
    motion = np.column_stack([se2.apply(half, chord), turn])
    scales = np.column_stack([np.exp(c[:, :1]), np.exp(c[:, :1]), np.ones(len(c))])
    variance = (motions.sigma[own] * scales) ** 2 / np.maximum(weight, _LEAST_WEIGHT)
    cos, sin = np.cos(0.5 * turn), np.sin(0.5 * turn)  # from axes halfway through the turn to those at its end
    back = np.zeros((len(turn), 3, 3))
    back[:, 0, 0] = back[:, 1, 1] = cos
    back[:, 0, 1], back[:, 1, 0], back[:, 2, 2] = sin, -sin, 1.0
    covariance = np.einsum("mij,mj,mkj->mik", back, variance, back)
    odometry = replace(
        segment.odometry,
        motion=motion,
        covariance=covariance,
        parts=CovarianceParts.constant(covariance),
        distance_m=np.exp(c[:, 0]) * segment.odometry.distance_m,
        differences=None,
        jacobian=segment.odometry.jacobian[:, :, :3],
    )
    return replace(segment, odometry=odometry)


def _with_readings(
    segment: Segment, joint: Joint, drive: int, own: IntArray, weights: FloatArray,
    names: Names,
) -> Segment:  # fmt: skip
    """Return the segment with readings as ranges and bearings of the places of the map, in nominal axes of the camera.

    A reading keeps its residual against the place of its pass. That place is off the map's by an error that all
    readings of the pass share, so each has as many times its variance as there are readings.
    """
    problem, layout, values = joint.problem, joint.problem.layout, joint.values
    observations = segment.observations
    tags = [names.of_drive.get((drive, tag), tag) for tag in segment.tags]
    point = problem.readings.point[own]
    of_tag = np.array([names.points[tag] for tag in tags], dtype=np.int64)
    in_map = values.points[of_tag[observations.tag]]
    base = values.poses[problem.readings.pose[own]]
    mount = segment.T_base_sensor
    # Where the reading has its place is moved by what its pass is off the map.
    seen = joint.seen[own] + in_map - values.points[point]
    sensor = se2.compose(base, mount)
    x, y = se2.apply(se2.inverse(sensor), seen).T
    range_m = np.maximum(np.hypot(x, y), 1e-3)
    value = np.stack([range_m, np.arctan2(y, x)], axis=-1)
    W = problem.readings.whitening[own]
    covariance = np.linalg.inv(W.swapaxes(-1, -2) @ W) / np.maximum(weights[own], _LEAST_WEIGHT)[:, None, None]
    is_xy = ~observations.polar
    if is_xy.any():
        J = np.stack([np.stack([x, y], -1) / range_m[:, None], np.stack([-y, x], -1) / range_m[:, None] ** 2], axis=1)
        covariance = np.where(is_xy[:, None, None], J @ covariance @ J.swapaxes(-1, -2), covariance)
    n_of_pass = np.bincount(point, minlength=layout.n_points)[point]
    shared = n_of_pass * (problem.places.of_pass_m**2 + problem.places.of_drive_m**2)
    covariance[:, 0, 0] += shared
    covariance[:, 1, 1] += shared / range_m**2
    corrected = replace(
        observations.without_corners(),
        value=value,
        polar=np.ones(len(value), dtype=np.bool_),
        covariance=covariance,
        parts=CovarianceParts.constant(covariance),
    )
    return _with_tags(segment, tags, corrected)


def _with_tags(segment: Segment, tags: Sequence[TagKey], observations: Observations) -> Segment:
    names = tuple(sorted(set(tags)))
    index = np.array([names.index(tag) for tag in tags], dtype=np.int64)
    tags, observations = index_observed_tags(names, replace(observations, tag=index[observations.tag]))
    return replace(segment, tags=tags, observations=observations)
