"""All covariances of a component grow by one factor; files keep it, and old ones read as if there were none."""

import json
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.offline.commands.map_drives import exit_code
from groundsbot.offline.commands.map_summary import summary
from groundsbot.offline.maps.archive import ArchivedCalibration, nominal_row
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.fit_results import Misfit
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.maps.result import Component, GraphEdges, TagPose
from groundsbot.offline.maps.widening import TagScatter, inflate_covariances
from groundsbot.offline.report.sentences import sentences
from groundsbot.offline.report.verdict import contradiction_sentence
from tests.support.data.maps import make_component, make_map, suspect_entry

MISFIT = Misfit("joins", "blue_two", 90.0, 40)
QUIET = TagScatter(np.ones(3), np.zeros((3, 2, 2)))


def full_component() -> Component:
    made = make_component()
    kept = ArchivedCalibration(
        ("red",), ("wheel_scale",), nominal_row((0.1,))[None], np.ones(1), np.full((1, 1), 4e-6), np.full((1, 6), 1e-5)
    )
    one: np.ndarray = np.zeros(1, dtype=np.int64)
    edges = GraphEdges(one, np.ones((1, 3)), np.eye(3)[None], one, one, np.ones((1, 2)), np.eye(2)[None])
    pose = TagPose(1.0, np.array([0.0, 0.0, 0.0, 1.0]), 1e-4 * np.eye(6))
    return replace(made, tags=(replace(made.tags[0], pose=pose), *made.tags[1:]), calibration=kept, edges=edges)


def test_everything_reported_grows_by_the_factor() -> None:
    before = full_component()
    after = inflate_covariances(deepcopy(before), MISFIT, QUIET)
    assert (after.sigma_factor, after.misfit) == (1.5, MISFIT)
    pairs = [
        (after.joint_covariance, before.joint_covariance),
        *((a.covariance, b.covariance) for a, b in zip(after.runs, before.runs, strict=True)),
        *((a.covariance, b.covariance) for a, b in zip(after.tags, before.tags, strict=True)),
        *((a.covariance, b.covariance) for a, b in zip(after.start_to_start, before.start_to_start, strict=True)),
    ]
    assert before.edges
    assert before.calibration
    assert before.tags[0].pose
    assert after.edges
    assert after.calibration
    assert after.tags[0].pose
    pairs += [
        (after.tags[0].pose.covariance, before.tags[0].pose.covariance),
        (after.calibration.covariance, before.calibration.covariance),
        (after.calibration.with_tags, before.calibration.with_tags),
        (before.edges.motion_information, after.edges.motion_information),
        (before.edges.place_information, after.edges.place_information),
    ]
    for large, small in pairs:
        np.testing.assert_allclose(large, 2.25 * small)
    assert inflate_covariances(before, None, QUIET) is before


def test_what_passes_add_is_an_error_of_the_tags_own() -> None:
    before = full_component()
    added_m2 = np.zeros((3, 2, 2))
    added_m2[0] = 0.01 * np.eye(2)
    after = inflate_covariances(deepcopy(before), None, TagScatter(np.array([3.0, 1.0, 1.0]), added_m2))
    grown = after.joint_covariance - before.joint_covariance
    np.testing.assert_allclose(grown[6:8, 6:8], added_m2[0])
    assert np.count_nonzero(grown) == 2
    np.testing.assert_allclose(after.tags[0].covariance, before.tags[0].covariance + added_m2[0])
    assert after.tags[0].pose
    assert before.tags[0].pose
    np.testing.assert_allclose(
        after.tags[0].pose.covariance - before.tags[0].pose.covariance, np.diag([0.01, 0.01, 0, 0, 0, 0])
    )
    assert [tag.sigma_factor for tag in after.tags] == [3.0, 1.0, 1.0]


def test_files_keep_the_factor_and_old_ones_have_none(tmp_path: Path) -> None:
    scatter = TagScatter(np.array([3.0, 1.0, 1.0]), np.zeros((3, 2, 2)))
    write_map(make_map(inflate_covariances(make_component(), MISFIT, scatter)), tmp_path)
    (found,) = read_map(tmp_path).components
    assert (found.sigma_factor, found.misfit, found.tags[0].sigma_factor) == (1.5, MISFIT, 3.0)
    document = json.loads((tmp_path / "map.json").read_text())
    assert document["components"][0]["sigma_factor"] == 1.5
    assert document["tags"][0]["sigma_factor"] == 3.0
    for entry in (*document["components"], *document["tags"]):
        del entry["sigma_factor"]
        entry.pop("misfit", None)
    (tmp_path / "map.json").write_text(json.dumps(document))
    with np.load(tmp_path / "map.npz") as arrays:
        older = {name: value for name, value in arrays.items() if not name.endswith("sigma_factor")}
    np.savez(tmp_path / "map.npz", allow_pickle=False, **older)
    (found,) = read_map(tmp_path).components
    assert (found.sigma_factor, found.misfit, found.tags[0].sigma_factor) == (1.0, None, 1.0)


@pytest.mark.parametrize(("kind", "said"), [("joins", "each other"), ("windows", "the model")])
def test_terminal_and_report_say_it_first(kind: str, said: str) -> None:
    result = make_map(inflate_covariances(make_component(), replace(MISFIT, kind=kind), QUIET))
    verdict, first = summary(result, Path("out"))[:2]
    assert verdict.startswith(f"Use this map with care, because these drives contradict {said} (all sigmas were multip")
    assert first.startswith(f"These drives contradict {said} by more than chance explains (chi-square 90, 40 expec")
    assert "all sigmas were multiplied by 1.5." in first
    assert "blue_two fits worst" in first
    document = map_as_json(result)
    assert sentences(document)[0] == first
    assert "suspect" not in first
    assert "Check suspect tags" in sentences(document | {"suspect_tags": [suspect_entry(3)]})[0]
    assert exit_code(result) == 3


def test_gentle_maps_say_nothing_of_it() -> None:
    result = make_map()
    assert contradiction_sentence(map_as_json(result)) == ""
    assert summary(result, Path("out"))[0].startswith("Use this map: nothing in it contradicts")
    assert exit_code(result) == 0


def test_of_several_components_the_worst_is_named() -> None:
    result = make_map(
        inflate_covariances(make_component(), MISFIT, QUIET),
        inflate_covariances(make_component("a_b", "c_d"), Misfit("joins", "c_d", 360.0, 40), QUIET),
    )
    assert contradiction_sentence(map_as_json(result)).startswith("In component 2 drives contradict each other")
    lines = summary(result, Path("out"))
    assert lines[0].startswith(
        "Use each component of this map alone, with care, because in component 2 drives contradict each other (all"
    )
    assert "component 2, in the frame of a_b: 3 tags; 2 runs, 3.8 m driven" in lines
