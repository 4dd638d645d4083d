"""What `--frame` may name: a survey, two tags, a run; or one clear line."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.mapping.frame import in_frame, parse_frame
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.datum import DatumKind
from groundsbot.offline.maps.frame import CrossCovariances
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.report.accuracy_texts import headline
from tests.offline.mapping.framed_maps import NOISE, OWN_AXES, places_of, run_of, write_survey


def test_wrong_entries_of_a_survey_do_not_hold_the_frame(known: MapResult, tmp_path: Path) -> None:
    text = write_survey(tmp_path / "survey.csv", (1, 2, 3, 4, 5, 6), {4: (0.8, 0.0)})
    found = build_map([run_of("a"), run_of("b")], NOISE, frame=parse_frame(text))
    (component,) = found.components
    assert component.datum is not None
    assert [tag.tag_id for tag, weight in zip(component.tags, component.datum.weights, strict=True) if not weight] == [
        4
    ]
    # Weights are of 1 / sigma^2, and sigmas in the survey are in proportion to the tags' numbers.
    np.testing.assert_allclose(component.datum.weights, [1.0, 1 / 4, 1 / 9, 0.0, 1 / 25, 1 / 36], rtol=1e-6)
    (warning,) = set(found.warnings) - set(known.warnings)
    assert "entry tag36h11 4 looks wrong" in warning


def test_a_survey_that_contradicts_the_drives_is_told(known: MapResult, tmp_path: Path) -> None:
    path = tmp_path / "survey.csv"
    path.write_text("tag_id,x_m,y_m\n1,0,0\n3,7,0\n")  # 5 m in truth
    found = build_map([run_of("a"), run_of("b")], NOISE, frame=parse_frame(f"survey:{path}"))
    (warning,) = set(found.warnings) - set(known.warnings)
    assert "survey and drives contradict each other" in warning


def test_a_component_whose_tags_hold_no_frame_keeps_its_start() -> None:
    runs = [run_of("a"), run_of("b", (5,))]
    found = build_map(runs, NOISE, frame=OWN_AXES)
    assert [component.frame_run for component in found.components] == [None, "b_one"]
    assert any(
        "component 2: its frame is the start of b_one, not that of --frame: the map has 1 tag" in warning
        for warning in found.warnings
    )


@pytest.mark.parametrize(
    ("frame", "tags", "told"),
    [
        ("shape", (1,), "the map has 1 tag, at least two in different places are needed"),
        ("tags", (), "the map has 0 tags"),
        ("survey", (1, 5), "the survey has 1 tag of the map, at least two in one component are needed"),
        ("start:nobody", (1, 2), "the logs hold no run 'nobody'; use one of a_one"),
        ("1,9", (1, 2), "the map has no tag 9; name one of 1, 2"),
        ("1,tag36h11:1", (1, 2), "tags 1 and tag36h11:1 are in one place; name two in different places"),
    ],
)
def test_a_frame_that_the_map_cannot_have_is_refused(
    tmp_path: Path, frame: str, tags: tuple[int, ...], told: str
) -> None:
    text = write_survey(tmp_path / "survey.csv", (1, 2, 3)) if frame == "survey" else frame
    with pytest.raises(OfflineError) as caught:
        build_map([run_of("a", tags)], NOISE, frame=parse_frame(text))
    assert str(caught.value).startswith(f"--frame {text}: {told}")


@pytest.mark.parametrize(
    "text", ["", "start:", "tag", "tags:1", "survey", "survey:", "Start", "3", "3,", "3,3", "1,2,3"]
)
def test_an_unknown_frame_is_refused(text: str) -> None:
    with pytest.raises(OfflineError, match=r"must be start, start:RUN, shape, two tags A,B, or a survey"):
        parse_frame(text)


@pytest.mark.parametrize("text", ["3,1", "tag36h11:3, 1"])
def test_two_tags_hold_a_frame(known: MapResult, text: str) -> None:
    """With its origin at one and x towards the other; the error of their distance is in both alike."""
    (before,) = known.components
    found = build_map([run_of("a"), run_of("b")], NOISE, frame=parse_frame(text))
    (after,) = found.components
    assert after.datum is not None
    assert after.frame_name == "the axes of tags 1 and 3"
    assert after.frame_owner == "tags 1 and 3"
    ids = [tag.tag_id for tag in after.tags]
    (a, b), places = (ids.index(3), ids.index(1)), places_of(after)
    distance_m = np.hypot(*(places_of(before)[a] - places_of(before)[b]))
    np.testing.assert_allclose(places[[a, b]], [[0.0, 0.0], [distance_m, 0.0]], atol=1e-9)
    rows = np.array([2 * a, 2 * a + 1, 2 * b, 2 * b + 1])
    own = after.tag_covariance[np.ix_(rows, rows)]
    between = places_of(before)[a] - places_of(before)[b]
    axis = np.concatenate([between, -between]) / distance_m
    variance_m2 = axis @ before.tag_covariance[np.ix_(rows, rows)] @ axis
    pull = np.array([-0.5, 0.0, 0.5, 0.0])
    np.testing.assert_allclose(own, variance_m2 * np.outer(pull, pull), atol=1e-9)
    assert "Relative to the axes of tags 1 and 3, they are known to " in headline(map_as_json(found))


def test_earlier_names_of_frames_are_understood(tmp_path: Path) -> None:
    survey = write_survey(tmp_path / "survey.csv", (1, 2))
    assert parse_frame("tags").datum is parse_frame("shape").datum is DatumKind.TAGS
    for text in (survey, survey.removeprefix("survey:")):
        choice = parse_frame(text)
        assert choice.datum is DatumKind.SURVEY
        assert [entry.tag_id for entry in choice.survey] == [1, 2]


def test_a_tag_in_two_places_is_called_by_its_instance(known: MapResult) -> None:
    (component,) = known.components
    first, second, *others = component.tags
    doubled = replace(component, tags=(replace(first, instance="a"), replace(second, tag_id=1, instance="b"), *others))
    doubled = replace(doubled, calibration=None)
    cross = CrossCovariances(np.zeros((0, 6)), None)
    assert "the map has tag 1 in several places; name one of tag36h11:1a, tag36h11:1b" in (
        in_frame(doubled, parse_frame("1,3"), lambda: cross).reason
    )
    assert not in_frame(doubled, parse_frame("1b,3"), lambda: cross).reason
    families = replace(doubled, tags=(first, replace(second, tag_id=1, family="tag25h9"), *others))
    assert "the map has tag 1 in several places; name one of tag36h11:1, tag25h9:1" in (
        in_frame(families, parse_frame("1,3"), lambda: cross).reason
    )


def test_one_run_has_a_frame_of_its_tags() -> None:
    (component,) = build_map([run_of("a")], NOISE, frame=OWN_AXES).components
    assert component.frame_run is None
    assert component.runs[0].covariance[0, 0] > 0.0
