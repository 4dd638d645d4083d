"""What `export --format rerun` writes, as Rerun's own reader reads it."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundsbot.offline.maps.files import read_map
from groundsbot.offline.maps.shape import drawn_covariances
from tests.support.programs import Run

pytest.importorskip("rerun", reason="no rerun-sdk: `make setup` installs it")


def columns(path: Path, *, of_blueprint: bool = False) -> dict[str, dict[str, Any]]:
    """All columns of a recording, or of its blueprint, by entity."""
    from rerun.chunk import RrdReader

    reader = RrdReader(path)
    (store,) = reader.blueprints() if of_blueprint else reader.recordings()
    found: dict[str, dict[str, Any]] = {}
    for chunk in reader.stream(store=store).to_chunks():
        found.setdefault(chunk.entity_path, {}).update(chunk.to_record_batch().to_pydict())
    return found


def test_a_map_opens_in_rerun_with_its_panels(run: Run, folder: Path, tmp_path: Path) -> None:
    output = tmp_path / "map.rrd"
    outcome = run("export", folder, "--format", "rerun", "-o", output)
    assert (outcome.code, outcome.err) == (0, "")
    found = columns(output)
    (component,) = read_map(folder).components
    tags = found["/map/tags"]
    assert tags["Points3D:labels"] == [[tag.label for tag in component.tags]]
    np.testing.assert_allclose(
        np.array(tags["Points3D:positions"][0])[:, :2], [tag.position_m[:2] for tag in component.tags], atol=1e-5
    )
    (ellipse, *others) = found["/map/ellipses"]["LineStrips3D:strips"][0]
    assert len(others) == len(component.tags) - 1
    offsets_m = np.array(ellipse)[:, :2] - component.tags[0].position_m[:2]
    chi_square = (offsets_m @ np.linalg.inv(drawn_covariances(component)[0]) * offsets_m).sum(axis=1)
    np.testing.assert_allclose(chi_square, 5.991, rtol=0.01)
    for each in component.runs:
        robot = found[f"/map/runs/{each.name}/robot"]
        turn = 2.0 * np.arctan2(*np.array(robot["Transform3D:quaternion"])[:, 0, 2:].T)
        np.testing.assert_allclose(np.cos(turn - each.T_map_base[:, 2]), 1.0, atol=1e-6)
        seconds = [stamp.total_seconds() for stamp in robot["time_since_start"]]
        np.testing.assert_allclose(seconds, (each.stamps_ns - each.stamps_ns[0]) / 1e9, atol=1e-6)
        way_m = np.array(found[f"/map/runs/{each.name}"]["LineStrips3D:strips"][0][0])
        np.testing.assert_allclose(way_m[:, :2], each.T_map_base[:, :2], atol=1e-5)
        speeds_m_s = np.array(found[f"/speed/{each.name}"]["Scalars:scalars"])[:, 0]
        assert np.sum(speeds_m_s * np.diff(seconds)) == pytest.approx(
            np.linalg.norm(np.diff(each.T_map_base[:, :2], axis=0), axis=1).sum(), rel=1e-6
        )
    panels = columns(output, of_blueprint=True)
    origins = [
        each["ViewBlueprint:space_origin"][0] for each in panels.values() if "ViewBlueprint:space_origin" in each
    ]
    assert sorted(origin for (origin,) in origins) == ["map", "speed"]


def test_without_rerun_the_error_says_what_to_install(
    run: Run, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    outcome = run("export", folder, "--format", "rerun", "-o", tmp_path / "map.rrd")
    assert outcome.code == 1
    assert "pip install rerun-sdk" in outcome.err
    assert not list(tmp_path.glob("*map.rrd*"))
