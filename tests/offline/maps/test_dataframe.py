"""Tags and trajectories as dataframes."""

import csv
import io
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.localization.result import LocatedRun
from groundsbot.offline.maps.dataframe import to_dataframe
from groundsbot.offline.maps.tags_table import tags_csv
from tests.support.data.maps import make_component, make_map


def test_tags_have_the_columns_and_values_of_the_file() -> None:
    result = make_map(make_component(), make_component("green_one", "grey_two"))
    table = to_dataframe(result)
    assert table.pop("component").tolist() == [0, 0, 0, 1, 1, 1]
    rows = list(csv.DictReader(io.StringIO(tags_csv(result.components))))
    assert list(table.columns) == list(rows[0])
    for name in ("tag_id", "x_m", "shape_sigma_y_m", "covariance_xy_m2", "n_observations"):
        np.testing.assert_allclose(table[name], [float(row[name]) for row in rows], atol=1e-6)
    assert table["runs"].tolist() == [row["runs"] for row in rows]
    assert table["z_m"].isna().all()
    assert list(to_dataframe(result.components[0]).columns) == list(rows[0])


def test_a_trajectory_has_a_row_for_each_keyframe_with_sigmas_where_known() -> None:
    run = make_map().run("blue")
    table = to_dataframe(run)
    assert list(table.columns) == ["t_ns", "x_m", "y_m", "theta_rad"]
    assert table["t_ns"].tolist() == run.stamps_ns.tolist()
    np.testing.assert_array_equal(table[["x_m", "y_m", "theta_rad"]], run.T_map_base)
    covariance = np.tile(np.diag([0.01, 0.04, 0.09]), (run.n_keyframes, 1, 1))
    located = LocatedRun("a", "a", run.stamps_ns, run.T_map_base, covariance, (), 1.0)
    sigmas = to_dataframe(located)[["sigma_x_m", "sigma_y_m", "sigma_theta_rad"]]
    np.testing.assert_allclose(sigmas, np.tile([0.1, 0.2, 0.3], (run.n_keyframes, 1)))


def test_polars_does_where_pandas_is_not_and_neither_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    monkeypatch.setitem(sys.modules, "polars", SimpleNamespace(DataFrame=list))
    assert to_dataframe(make_map().run("red")) == ["t_ns", "x_m", "y_m", "theta_rad"]
    monkeypatch.setitem(sys.modules, "polars", None)
    with pytest.raises(OfflineError, match=r"needs pandas or polars, and neither is installed; pip install pandas$"):
        to_dataframe(make_map())
