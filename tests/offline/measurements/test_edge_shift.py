"""A camera that sees the sides of tags too far in: what tags show, and the map if it is not estimated."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.tags.edges import shift_edges
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.model import MapModel
from groundsbot.offline.maps.parameter_results import CalibrationResult
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import Run, load_run
from tests.support.data.drives import MadeTag, make_drive, make_robot, write_drive

START = [0.5, 2.0, 0.0]
LEGS = [(0.4, 0.4, 8.0), (-0.3, 0.3, 5.3), (0.4, 0.4, 8.0), (-0.3, 0.3, 5.3)]
# Along both walls of a hall of eight metres, so that each is seen from near and from afar.
TAGS = [
    MadeTag(4 * i + j, (1.0 + 2.0 * i, 4.0 * (j % 2), 0.3 + 0.1 * i), (0.5 - (j % 2)) * np.pi + lean)
    for i in range(4)
    for j, lean in ((0, 0.7), (1, -0.7), (2, 2.4 - np.pi / 2), (3, np.pi / 2 - 2.4))
    if j < 2 or i % 2
]
SIGMA_PX, SHIFT_PX = 0.05, -0.05
NOISE = NoiseParameters(sigma_corner_px=SIGMA_PX)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """All sides seen 0.05 px too far in."""
    folder: Path = tmp_path_factory.mktemp("shifted")
    plain = load_run(write_drive(folder, make_drive(START, LEGS), TAGS, make_robot("a"), corner_sigma_px=SIGMA_PX))
    corners_px = shift_edges(plain.detections.corners_px, SHIFT_PX)
    return replace(plain, detections=replace(plain.detections, corners_px=corners_px))


def map_runs(run: Run, edge_sigma_px: float, *, corners: bool) -> MapResult:
    robot = run.robot.model_copy(update={"edge_shift_px_sigma": edge_sigma_px})
    result = build_map([replace(run, robot=robot)], NOISE, corners=corners)
    assert result.components[0].model is (MapModel.CORNERS if corners else MapModel.FLOOR)
    return result


def edges_of(result: MapResult) -> list[CalibrationResult]:
    return [each for each in result.calibration if each.name == "edge_shift_px"]


def tags_chi2(result: MapResult) -> float:
    """Of all tags' places together."""
    (component,) = result.components
    true = {tag.tag_id: se2.apply(se2.inverse(START), tag.position_m[:2]) for tag in TAGS}
    off: FloatArray = np.concatenate([tag.position_m - true[tag.tag_id] for tag in component.tags])
    covariance = component.joint_covariance[-len(off) :, -len(off) :]
    return float(off @ np.linalg.solve(covariance, off))


@pytest.mark.parametrize("corners", [False, True], ids=["places", "corners"])
def test_sides_seen_too_far_in_are_found_and_the_map_is_consistent(run: Run, corners: bool) -> None:
    result = map_runs(run, 0.1, corners=corners)
    (found,) = edges_of(result)
    assert found.owner == "a"
    assert found.sigma < 0.02  # of 0.1 before
    assert found.value == pytest.approx(SHIFT_PX, abs=3.0 * found.sigma)
    n = 2 * len(result.components[0].tags)
    assert tags_chi2(result) < chi2.ppf(0.999, n)


@pytest.mark.parametrize("corners", [False, True], ids=["places", "corners"])
def test_a_file_with_small_camera_sigmas_holds_it_and_errs(run: Run, corners: bool) -> None:
    """Without the number the same drive's covariances are no longer true."""
    result = map_runs(run, 0.0, corners=corners)
    assert [each.value for each in edges_of(result)] in ([], [0.0])
    n = 2 * len(result.components[0].tags)
    assert tags_chi2(result) > chi2.ppf(0.999, n)
