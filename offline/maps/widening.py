"""Inflation of a component's covariances by its lack of fit; no other module does this."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.maps.archive import ArchivedCalibration
from groundsbot.offline.maps.fit_results import Misfit
from groundsbot.offline.maps.result import Component, GraphEdges, TagPose, TagResult


@dataclass(frozen=True)
class TagScatter:
    """Scatter of each tag's passes beyond its expectation.

    Attributes:
        factors: (T,) in sigmas; exactly 1 where the scatter is as expected.
        added_m2: (T, 2, 2) covariance to add to that of the tag's position; 0 there.
    """

    factors: FloatArray
    added_m2: FloatArray


def inflate_covariances(component: Component, misfit: Misfit | None, scatter: TagScatter) -> Component:
    """Return the component with all covariances times the misfit's factor, plus the scatter of each tag's passes.

    The scatter is an error of the tag alone, so covariances of and with other tags are not changed by it. The joint
    covariance is overwritten, since a copy of thousands of tags takes hundreds of MiB.
    """
    if misfit is None and not scatter.added_m2.any():
        return component
    factor = 1.0 if misfit is None else misfit.variance_factor
    joint = component.joint_covariance
    joint *= factor
    for rows, added_m2 in zip(_rows_of_tags(component), scatter.added_m2, strict=True):
        joint[rows, rows] += added_m2
    return replace(
        component,
        runs=tuple(replace(run, covariance=factor * run.covariance) for run in component.runs),
        tags=_tags(component.tags, factor, scatter),
        joint_covariance=joint,
        start_to_start=tuple(replace(each, covariance=factor * each.covariance) for each in component.start_to_start),
        edges=None if component.edges is None else inflate_edges(component.edges, factor),
        calibration=None if component.calibration is None else _calibration(component.calibration, factor),
        sigma_factor=factor**0.5,
        misfit=misfit,
    )


def _rows_of_tags(component: Component) -> list[slice]:
    first = 3 * len(component.runs)
    return [slice(first + 2 * t, first + 2 * t + 2) for t in range(len(component.tags))]


def _tags(tags: Sequence[TagResult], factor: float, scatter: TagScatter) -> tuple[TagResult, ...]:
    return tuple(
        replace(
            tag,
            covariance=factor * tag.covariance + added_m2,
            pose=None if tag.pose is None else _pose(tag.pose, factor, added_m2),
            sigma_factor=float(own),
        )
        for tag, own, added_m2 in zip(tags, scatter.factors, scatter.added_m2, strict=True)
    )


def _pose(pose: TagPose, factor: float, added_m2: FloatArray) -> TagPose:
    return replace(pose, covariance=factor * pose.covariance + np.pad(added_m2, (0, 4)))


def inflate_edges(edges: GraphEdges, factor: float) -> GraphEdges:
    """Return the edges with all variances multiplied by a factor."""
    return replace(
        edges,
        motion_information=edges.motion_information / factor,
        place_information=edges.place_information / factor,
    )


def _calibration(kept: ArchivedCalibration, factor: float) -> ArchivedCalibration:
    return replace(kept, covariance=factor * kept.covariance, with_tags=factor * kept.with_tags)
