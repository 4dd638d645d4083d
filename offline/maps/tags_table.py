"""tags.csv: the table of tags. docs/formats.md describes its columns."""

import csv
import io
from collections.abc import Sequence
from typing import Final

import numpy as np

from groundsbot.offline.maps.result import Component, TagResult

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
)


def tags_csv(components: Sequence[Component]) -> str:
    """Return the content of tags.csv."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(TAG_COLUMNS)
    for component in components:
        for tag in component.tags:
            writer.writerow(_tag_row(tag))
    return stream.getvalue()


def _tag_row(tag: TagResult) -> Sequence[str | int]:
    sigma_x_m, sigma_y_m = np.sqrt(np.diag(tag.covariance))
    return (
        tag.tag_id,
        _decimal(tag.position_m[0]),
        _decimal(tag.position_m[1]),
        "" if tag.pose is None else _decimal(tag.pose.height_m),
        "" if tag.pose is None else _decimal(tag.pose.yaw_rad),
        _decimal(sigma_x_m),
        _decimal(sigma_y_m),
        tag.n_observations,
        " ".join(tag.runs),
        tag.family,
        tag.instance,
        "" if not np.isfinite(tag.covariance[0, 1]) else f"{tag.covariance[0, 1]:.9g}",
    )


def _decimal(value: float) -> str:
    return f"{value:.6f}" if np.isfinite(value) else ""
