"""A map against a survey: figures, wrong entries, swapped pairs, scale, bad files."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.evaluation.survey import evaluate_survey
from groundsbot.offline.evaluation.survey_file import SurveyEntry, read_survey
from groundsbot.offline.maps.result import Component, MapResult, TagResult
from tests.support.data.maps import make_component, make_map
from tests.support.paper_recordings import RECORDINGS

_N_TAGS = 15
ONE_TAG = '{"ID": 1, "pose": {"translation": {"x": 1.0, "y": 2.0}}}'
_SIGMA_M = 0.02
T_SURVEY_MAP = np.array([300.0, -40.0, 2.5])


def _places() -> FloatArray:
    return np.array([[4.0 * (i // 3), 3.0 * (i % 3) + 0.4 * (i % 2)] for i in range(_N_TAGS)])


def _component(rng: np.random.Generator) -> tuple[Component, FloatArray]:
    """A map whose errors are drawn from its joint covariance: a common turn and noise. And the true places."""
    true = _places()
    turn = np.stack([-true[:, 1], true[:, 0]], axis=-1).reshape(-1, 1)
    covariance = (0.01 * turn) @ (0.01 * turn).T + 0.01**2 * np.eye(2 * _N_TAGS)
    found = true + rng.multivariate_normal(np.zeros(2 * _N_TAGS), covariance).reshape(-1, 2)
    like = make_component()
    joint = np.zeros((6 + 2 * _N_TAGS, 6 + 2 * _N_TAGS))
    joint[6:, 6:] = covariance
    tags = tuple(
        TagResult("tag36h11", i, "", 0.15, place, covariance[2 * i : 2 * i + 2, 2 * i : 2 * i + 2], 9, ("red_one",))
        for i, place in enumerate(found)
    )
    return replace(like, tags=tags, joint_covariance=joint), true


def _survey(rng: np.random.Generator, true: FloatArray, scale: float = 1.0) -> list[SurveyEntry]:
    measured = scale * se2.apply(T_SURVEY_MAP, true) + rng.normal(0.0, _SIGMA_M, true.shape)
    return [SurveyEntry("", i, "", place, _SIGMA_M) for i, place in enumerate(measured)]


def _map_and_survey(seed: int) -> tuple[MapResult, list[SurveyEntry]]:
    rng = np.random.default_rng(seed)
    component, true = _component(rng)
    return make_map(component), _survey(rng, true)


def test_a_good_survey_fits_with_consistent_sigmas() -> None:
    squares, flagged = [], 0
    for seed in range(30):
        result, survey = _map_and_survey(seed)
        (judged,) = evaluate_survey(result, survey).components
        flagged += len(judged.outliers)
        squares.append((judged.nees_per_dim or 0.0) * (2 * _N_TAGS - 3))
        assert judged.rmse_m == pytest.approx(np.sqrt(2) * np.hypot(_SIGMA_M, 0.01), rel=0.5)
        assert abs(judged.scale_error) < 4.0 * judged.scale_sigma
    n = 30 * (2 * _N_TAGS - 3)
    assert chi2.ppf(0.0005, n) < sum(squares) < chi2.ppf(0.9995, n)
    assert flagged <= 1  # one in a thousand surveys


def test_wrong_entries_are_named_with_their_shift() -> None:
    result, survey = _map_and_survey(1)
    d = np.array([0.3, -0.2])
    survey[4] = replace(survey[4], position_m=survey[4].position_m + d)
    survey[11] = replace(survey[11], position_m=survey[11].position_m + np.array([0.0, 15.0]))
    (judged,) = evaluate_survey(result, survey).components
    assert [(entry.tag.tag_id, entry.verdict) for entry in judged.outliers] == [(4, "wrong"), (11, "wrong")]
    assert np.linalg.norm(judged.outliers[0].shift_m) == pytest.approx(np.linalg.norm(d), abs=0.1)
    assert "entry tag36h11 4 looks wrong" in "\n".join(judged.lines())
    assert judged.rmse_m < 0.06  # of those that fit


def test_a_swapped_pair_is_named_as_one() -> None:
    result, survey = _map_and_survey(2)
    survey[3], survey[8] = (
        replace(survey[3], position_m=survey[8].position_m),
        replace(survey[8], position_m=survey[3].position_m),
    )
    (judged,) = evaluate_survey(result, survey).components
    assert [(e.tag.tag_id, e.verdict, e.swapped_with) for e in judged.outliers] == [
        (3, "swapped", 8),
        (8, "swapped", 3),
    ]
    assert "entry tag36h11 3 looks swapped with 8" in "\n".join(judged.lines())


def test_a_wrong_scale_is_found_with_its_sigma() -> None:
    rng = np.random.default_rng(3)
    component, true = _component(rng)
    (judged,) = evaluate_survey(make_map(component), _survey(rng, true, scale=0.99)).components
    assert judged.scale_error == pytest.approx(0.01, abs=4.0 * judged.scale_sigma)
    assert judged.scale_sigma < 0.003


def test_a_tag_that_two_families_share_needs_its_family() -> None:
    result, survey = _map_and_survey(4)
    component = result.components[0]
    other = replace(component.tags[1], family="tag25h9", tag_id=0)
    result = make_map(replace(component, tags=(component.tags[0], other, *component.tags[2:])))
    notes = evaluate_survey(result, survey).notes
    assert notes == ("not in the map: tags 0, 1",)
    survey[0] = replace(survey[0], family="tag36h11")
    assert evaluate_survey(result, survey).notes == ("not in the map: tags 1",)


@pytest.mark.parametrize(("column", "value", "is_told"), [("", "", True), (",sigma_m", ",0.02", False)])
def test_an_assumed_sigma_is_told(tmp_path: Path, column: str, value: str, is_told: bool) -> None:
    result, survey = _map_and_survey(7)
    path = tmp_path / "survey.csv"
    rows = [f"{entry.tag_id},{entry.position_m[0]},{entry.position_m[1]}{value}" for entry in survey]
    path.write_text("\n".join([f"tag_id,x_m,y_m{column}", *rows]))
    lines = evaluate_survey(result, read_survey(path)).lines()
    assert any("0.02 m is assumed for each coordinate" in line for line in lines) == is_told


def test_two_shared_tags_are_too_few() -> None:
    result, survey = _map_and_survey(5)
    with pytest.raises(OfflineError, match="shares 2 tags with the map, at least three"):
        evaluate_survey(result, survey[:2])


def test_a_tag_with_and_without_its_family_is_no_third_tag() -> None:
    result, survey = _map_and_survey(5)
    again = replace(survey[1], family="tag36h11")
    with pytest.raises(OfflineError, match="has tag 1 of tag36h11 twice, once without its family"):
        evaluate_survey(result, [*survey[:2], again])


def test_entries_at_one_position_determine_no_direction() -> None:
    result, survey = _map_and_survey(6)
    piled = [replace(entry, position_m=np.zeros(2)) for entry in survey]
    with pytest.raises(OfflineError, match="all in one place"):
        evaluate_survey(result, piled)


def test_three_entries_in_one_place_and_one_apart_are_judged() -> None:
    """The odd one is left out, and the others determine no direction then."""
    result, survey = _map_and_survey(6)
    (component,) = result.components
    board = tuple(replace(tag, position_m=np.zeros(2)) for tag in component.tags[:3])
    result = make_map(replace(component, tags=(*board, *component.tags[3:])))
    piled = [replace(entry, position_m=np.zeros(2)) for entry in survey[:3]]
    (judged,) = evaluate_survey(result, [*piled, replace(survey[14], position_m=np.array([1e3, 0.0]))]).components
    assert [entry.tag.tag_id for entry in judged.outliers] == [14]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tag_id,x_m\n1,2\n", "has no column y_m"),
        ("tag_id,x_m,y_m\n1,2,3\n1,4,5\n", "line 3, column tag_id: '1' is there twice"),
        ("tag_id,x_m,y_m\n1,2,1e200\n", "line 2, column y_m: '1e200' must be below 1e"),
        ("tag_id,x_m,y_m,sigma_m\n1,2,3,1e200\n", "line 2, column sigma_m: '1e200' must be below 1000"),
        ("tag_id,x_m,y_m\n1,2,nan\n", "line 2, column y_m: 'nan' is not finite"),
        ("tag_id,x_m,y_m,sigma_m\n1,2,3,0\n", "column sigma_m: '0' must be above 0"),
        ("", "is empty"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "survey.csv"
    path.write_text(text)
    with pytest.raises(OfflineError, match=said) as error:
        read_survey(path)
    assert "\n" not in str(error.value)


def test_a_maps_own_tags_file_is_a_survey(tmp_path: Path) -> None:
    path = tmp_path / "tags.csv"
    path.write_text("tag_id,x_m,y_m,z_m,family,instance\n7,1.5,-2,,tag36h11,a\n")
    (entry,) = read_survey(path)
    assert (entry.family, entry.tag_id, entry.instance, entry.position_m.tolist()) == ("tag36h11", 7, "a", [1.5, -2.0])


LAYOUTS = RECORDINGS.parent / "frc" / "layouts"


@pytest.mark.skipif(not LAYOUTS.is_dir(), reason="WPILib's layouts are not here")
def test_a_map_on_a_field_is_judged_by_wpilibs_layout(tmp_path: Path) -> None:
    """Tags of Crescendo at their places, in another frame, but for one that is 0.3 m off; in both forms."""
    path = LAYOUTS / "2024-crescendo.json"
    survey = read_survey(path)
    assert [entry.tag_id for entry in survey] == list(range(1, 17))
    rng = np.random.default_rng(0)
    places = se2.apply(T_SURVEY_MAP, np.array([entry.position_m for entry in survey]))
    places += rng.normal(0.0, 0.01, places.shape)
    places[4] += [0.3, 0.0]
    component, _ = _component(rng)
    tags = tuple(
        TagResult("tag36h11", entry.tag_id, "", 0.165, place, 1e-4 * np.eye(2), 9, ("red_one",))
        for entry, place in zip(survey, places, strict=True)
    )
    joint = np.zeros((6 + 2 * len(tags), 6 + 2 * len(tags)))
    joint[6:, 6:] = 1e-4 * np.eye(2 * len(tags))
    older = tmp_path / "older.json"
    data = json.loads(path.read_text())
    older.write_text(json.dumps({"tags": data["field-tags"], "field": data["field-dimensions"]}))
    for layout in (path, older):
        result = make_map(replace(component, tags=tags, joint_covariance=joint))
        (judged,) = evaluate_survey(result, read_survey(layout)).components
        assert [each.tag.tag_id for each in judged.outliers] == [5]
        np.testing.assert_allclose(judged.outliers[0].shift_m, [0.3, 0.0], atol=0.05)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is not JSON"),
        ("[]", "has no list 'tags' or 'field-tags'"),
        ('{"tags": 3}', "has no list 'tags' or 'field-tags'"),
        ('{"tags": [3]}', r"tags\[0\]: has no ID and pose.translation"),
        ('{"tags": [{"ID": -1, "pose": {"translation": {"x": 1, "y": 2}}}]}', "ID is -1, must be a whole number"),
        ('{"tags": [{"ID": 1, "pose": {"translation": {"x": NaN, "y": 2}}}]}', "x is nan, must be a number of metres"),
        ('{"tags": [{"ID": 1, "pose": {"translation": {"x": 1, "y": "2"}}}]}', "y is '2', must be a number"),
        (f'{{"tags": [{",".join(2 * [ONE_TAG])}]}}', "tag 1 is there twice"),
    ],
)
def test_bad_layouts_are_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "layout.json"
    path.write_text(text)
    with pytest.raises(OfflineError, match=said) as error:
        read_survey(path)
    assert "\n" not in str(error.value)
