"""Tags and trajectories as dataframes of pandas or polars, whichever is installed."""

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any, Final, Protocol

import numpy as np

from groundsbot.calib.foundation import FloatArray, IntArray
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.maps.result import Component, MapResult
from groundsbot.offline.maps.tags_table import TAG_COLUMNS, tag_rows

_LIBRARIES: Final = ("pandas", "polars")


class Trajectory(Protocol):
    """A run in a map: `RunResult` or `LocatedRun`."""

    @property
    def stamps_ns(self) -> IntArray:
        """(K,)."""

    @property
    def T_map_base(self) -> FloatArray:
        """(K, 3) x_m, y_m, theta_rad."""

    @property
    def covariance(self) -> FloatArray:
        """(K, 3, 3) of each pose, or (3, 3) of the start."""


def to_dataframe(what: MapResult | Component | Trajectory) -> Any:  # noqa: ANN401 - of a library that may be missing
    """Return a dataframe of pandas, or of polars where pandas is not installed.

    Args:
        what: a map or a component, for its tags; or one of its runs or a located run, for its trajectory.

    Returns:
        A row for each tag with the columns of tags.csv, NaN where unknown, of a map with the index of its component in
        front. Or a row for each keyframe with t_ns, x_m, y_m and theta_rad; of a located run also sigma_x_m, sigma_y_m
        and sigma_theta_rad.

    Raises:
        OfflineError: neither library is installed.
    """
    if isinstance(what, Component):
        return _dataframe(_columns(TAG_COLUMNS, list(tag_rows(what))))
    if isinstance(what, MapResult):
        rows = [(i, *row) for i, component in enumerate(what.components) for row in tag_rows(component)]
        return _dataframe(_columns(("component", *TAG_COLUMNS), rows))
    columns: dict[str, Any] = {"t_ns": what.stamps_ns}
    columns |= zip(("x_m", "y_m", "theta_rad"), what.T_map_base.T, strict=True)
    if what.covariance.ndim == 3:
        sigmas = np.sqrt(np.einsum("kii->ik", what.covariance))
        columns |= zip(("sigma_x_m", "sigma_y_m", "sigma_theta_rad"), sigmas, strict=True)
    return _dataframe(columns)


def _columns(names: Sequence[str], rows: Sequence[Sequence[object]]) -> dict[str, Any]:
    return {name: [row[i] for row in rows] for i, name in enumerate(names)}


def _dataframe(columns: Mapping[str, Any]) -> Any:  # noqa: ANN401 - as above
    for name in _LIBRARIES:
        try:
            library = import_module(name)
        except ModuleNotFoundError:
            continue
        return library.DataFrame(columns)
    raise OfflineError("to_dataframe: needs pandas or polars, and neither is installed; pip install pandas")
