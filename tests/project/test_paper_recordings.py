"""The paper's own two runs, from CSV to one map. Bounds come from the data's description; nothing is tuned on them."""

import json
import re
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from groundsbot.offline.cli import app
from groundsbot.onboard.log.reading.reader import find_logs
from tests.support.data.logs import run_info_of
from tests.support.paper_recordings import RECORDINGS, needs_recordings
from tests.support.paths import ROOT

MEASURED_BY_HAND_M = 38.05

pytestmark = needs_recordings


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("paper") / "logs"
    for run in ("hallway", "loop"):
        _succeeds("import", RECORDINGS / run, "-o", folder, "--state-rate-hz", 4.2, "--track-width-m", 0.508)
    return folder


@pytest.fixture(scope="module")
def merged(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    folder = tmp_path_factory.mktemp("merged") / "map"
    _succeeds("map", logs, "-o", folder)
    found: dict[str, object] = json.loads((folder / "map.json").read_text())
    return found


def test_the_two_runs_merge_into_one_map_of_all_tags(merged: dict[str, list[dict[str, object]]]) -> None:
    assert len(merged["components"]) == 1
    assert len(merged["tags"]) == 43
    (alignment,) = merged["alignments"]
    assert alignment["n_shared"] == 12
    assert isinstance(alignment["n_inliers"], int)
    assert alignment["n_inliers"] >= 10
    assert alignment["is_sure"]


def test_readme_quotes_the_distance_found(merged: dict[str, list[dict[str, float]]]) -> None:
    (pair,) = merged["start_to_start"]
    quoted = re.search(
        r"\*\*([\d.]+) m\*\* \(sigma ([\d.]+) m\); measured by hand ([\d.]+) m", (ROOT / "README.md").read_text()
    )
    assert quoted is not None
    assert float(quoted[1]) == pytest.approx(pair["distance_m"], abs=0.005)
    assert float(quoted[2]) == pytest.approx(pair["sigma_m"], abs=0.005)
    assert float(quoted[3]) == MEASURED_BY_HAND_M


def test_that_wheels_and_tags_disagree_about_the_metre_is_said_with_its_sigma(
    merged: dict[str, list[Any]],
) -> None:
    scales = [check for check in merged["checks"] if check["name"] == "scale"]
    assert [check["robot_id"] for check in scales] == ["hallway", "loop"]
    for check in scales:
        assert check["value"] > 0.0
        assert check["sigmas"] > 4.0
        figures = f"{100.0 * check['value']:.2f} % (sigma {100.0 * check['sigma']:.2f} %) longer by the wheels of"
        (said,) = [warning for warning in merged["warnings"] if f"{figures} {check['robot_id']}" in warning]
        assert "outer edge of the black border" in said


def test_readme_quotes_the_distance_with_the_size_of_tags_open_too(logs: Path, tmp_path: Path) -> None:
    """Wheels then carry the metre, as the robots' files have them."""
    given: list[object] = []
    for log in find_logs([logs]):
        robot = tmp_path / f"{log.name}.yaml"
        robot.write_text(run_info_of(log).robot_yaml + "imported_tag_scale_sigma: 0.3\n")
        given += ["--robot", robot]
    _succeeds("map", logs, "-o", tmp_path / "map", *given)
    found: dict[str, Any] = json.loads((tmp_path / "map" / "map.json").read_text())
    (pair,), (scale,) = found["start_to_start"], [each for each in found["calibration"] if each["name"] == "tag_scale"]
    quoted = re.search(
        r"it is ([\d.]+) m \(sigma ([\d.]+) m\), tags ([\d.]+) % \(([\d.]+) %\) larger",
        (ROOT / "README.md").read_text(),
    )
    assert quoted is not None
    assert float(quoted[1]) == pytest.approx(pair["distance_m"], abs=0.005)
    assert float(quoted[2]) == pytest.approx(pair["sigma_m"], abs=0.005)
    assert float(quoted[3]) == pytest.approx(100.0 * scale["value"], abs=0.05)
    assert float(quoted[4]) == pytest.approx(100.0 * scale["sigma"], abs=0.05)


def _succeeds(*words: object) -> None:
    done = CliRunner().invoke(app, [str(word) for word in words])
    assert done.exit_code == 0, done.output
