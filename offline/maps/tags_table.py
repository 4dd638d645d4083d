"""tags.csv: the table of tags. docs/formats.md describes its columns."""

import csv
import io
from collections.abc import Iterator, Sequence
from math import isfinite, nan
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


_NINE_DIGITS: Final = frozenset({"covariance_xy_m2", "shape_covariance_xy_m2"})


def tags_csv(components: Sequence[Component]) -> str:
    """Return the content of tags.csv."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(TAG_COLUMNS)
    for component in components:
        for row in tag_rows(component):
            writer.writerow(_text(name, value) for name, value in zip(TAG_COLUMNS, row, strict=True))
    return stream.getvalue()


def tag_rows(component: Component) -> Iterator[Sequence[str | int | float]]:
    """Yield the values of each tag under `TAG_COLUMNS`; NaN where unknown."""
    shape = shape_of(component)
    for i, tag in enumerate(component.tags):
        own = np.full((2, 2), np.nan) if shape is None else shape.tag_covariances[i]
        yield (*_tag_row(tag), *_sigmas(own), float(own[0, 1]))


def _tag_row(tag: TagResult) -> Sequence[str | int | float]:
    return (
        tag.tag_id,
        *tag.position_m.tolist(),
        nan if tag.pose is None else tag.pose.height_m,
        nan if tag.pose is None else tag.pose.yaw_rad,
        *_sigmas(tag.covariance),
        tag.n_observations,
        " ".join(tag.runs),
        tag.family,
        tag.instance,
        float(tag.covariance[0, 1]),
    )


def _sigmas(covariance: FloatArray) -> list[float]:
    sigmas: list[float] = np.sqrt(np.maximum(np.diag(covariance), 0.0)).tolist()
    return sigmas


def _text(column: str, value: str | int | float) -> str | int:
    if not isinstance(value, float):
        return value
    if not isfinite(value):
        return ""
    return f"{value:.9g}" if column in _NINE_DIGITS else f"{value:.6f}"
