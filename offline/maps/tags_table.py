"""tags.csv: the table of tags. docs/formats.md describes its columns."""

import csv
import io
from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.calib.foundation import FloatArray
from groundsbot.offline.maps.result import Component, TagResult
from groundsbot.offline.maps.shape import shape_of

TAG_COLUMNS: Final = (
    "tag_id",
    "x_m",
    "y_m",
    "z_m",
    "yaw_rad",
    "sigma_x_m",
    "sigma_y_m",
    "n_observations",
    "runs",
    "family",
    "instance",
    "covariance_xy_m2",
    "shape_sigma_x_m",
    "shape_sigma_y_m",
    "shape_covariance_xy_m2",
)


def tags_csv(components: Sequence[Component]) -> str:
    """Return the content of tags.csv."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(TAG_COLUMNS)
    for component in components:
        shape = shape_of(component)
        for i, tag in enumerate(component.tags):
            own = np.full((2, 2), np.nan) if shape is None else shape.tag_covariances[i]
            writer.writerow((*_tag_row(tag), *_sigmas(own), _number(own[0, 1])))
    return stream.getvalue()


def _tag_row(tag: TagResult) -> Sequence[str | int]:
    return (
        tag.tag_id,
        _decimal(tag.position_m[0]),
        _decimal(tag.position_m[1]),
        "" if tag.pose is None else _decimal(tag.pose.height_m),
        "" if tag.pose is None else _decimal(tag.pose.yaw_rad),
        *_sigmas(tag.covariance),
        tag.n_observations,
        " ".join(tag.runs),
        tag.family,
        tag.instance,
        _number(tag.covariance[0, 1]),
    )


def _sigmas(covariance: FloatArray) -> list[str]:
    return [_decimal(sigma_m) for sigma_m in np.sqrt(np.maximum(np.diag(covariance), 0.0))]


def _number(value: float) -> str:
    return f"{value:.9g}" if np.isfinite(value) else ""


def _decimal(value: float) -> str:
    return f"{value:.6f}" if np.isfinite(value) else ""
