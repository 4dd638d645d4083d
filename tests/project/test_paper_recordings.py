"""The paper's own two runs, from CSV to one map. Bounds come from the data's description; nothing is tuned on them."""

import json
import re
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from groundsbot.offline.cli import app
from tests.support.paper_recordings import RECORDINGS, needs_recordings
from tests.support.paths import ROOT

MEASURED_BY_HAND_M = 38.05

pytestmark = needs_recordings


@pytest.fixture(scope="module")
def mapped(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Result]:
    """The map's document, and what the command said."""
    folder = tmp_path_factory.mktemp("paper")
    for run in ("hallway", "loop"):
        words = ("--state-rate-hz", 4.2, "--track-width-m", 0.508)
        done = _run("import", RECORDINGS / run, "-o", folder / "logs", *words)
        assert done.exit_code == 0, done.output
    done = _run("map", folder / "logs", "-o", folder / "map")
    assert done.exit_code == 3, done.output  # the drives contradict each other, which its first line says
    return json.loads((folder / "map" / "map.json").read_text()), done


@pytest.fixture
def merged(mapped: tuple[dict[str, Any], Result]) -> dict[str, Any]:
    return mapped[0]


def test_the_two_runs_merge_into_one_map_of_all_tags(merged: dict[str, list[dict[str, object]]]) -> None:
    assert len(merged["components"]) == 1
    assert len(merged["tags"]) == 43
    (alignment,) = merged["alignments"]
    assert alignment["n_shared"] == 12
    assert isinstance(alignment["n_inliers"], int)
    assert alignment["n_inliers"] >= 11
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


def test_clocks_and_lever_arm_are_found(merged: dict[str, list[Any]]) -> None:
    """Detections were late by 0.42 s (the data's description), and the authors' code has a lever arm of 0.932 m."""
    found = {(each["owner"], each["name"]): each for each in merged["calibration"]}
    for drive in ("hallway", "loop"):
        assert found[drive, "time_offset_s"]["value"] == pytest.approx(0.42, abs=0.05)
        arm = found[drive, "mount_x_m"]
        assert abs(arm["value"] - 0.932) < 2.0 * arm["sigma"]


def test_no_tag_is_named_and_the_truth_lies_within_two_sigmas(merged: dict[str, list[Any]]) -> None:
    assert merged["suspect_tags"] == []
    (pair,) = merged["start_to_start"]
    assert abs(pair["distance_m"] - MEASURED_BY_HAND_M) < 2.0 * pair["sigma_m"]
    assert pair["sigma_m"] < 1.5


def test_increased_sigmas_are_reported_first(mapped: tuple[dict[str, Any], Result]) -> None:
    (component,) = mapped[0]["components"]
    assert component["sigma_factor"] > 1.0
    assert f"all sigmas were multiplied by {component['sigma_factor']:.1f}" in mapped[1].stdout.splitlines()[0]


def _run(*words: object) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])
