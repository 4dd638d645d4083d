"""The picture of a map and a survey: what is drawn where, and which tags are named as off."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.commands.map_drives import MapOptions
from groundsbot.offline.commands.map_drives import make_map as write_map_of
from groundsbot.offline.evaluation.survey import evaluate_survey
from groundsbot.offline.evaluation.survey_file import SurveyEntry
from groundsbot.offline.maps.files import write_map
from groundsbot.offline.maps.result import Component, TagResult
from groundsbot.offline.report.survey_picture import draw_survey
from tests.support.browser import Page
from tests.support.data.map_cases import TAGS
from tests.support.data.maps import make_component, make_map
from tests.support.programs import Run

T_SURVEY_MAP = np.array([300.0, -40.0, 2.5])
PLACES = np.array([[3.0 * (i % 4), 4.0 * (i // 4) + 0.3 * (i % 2)] for i in range(12)])
NOT_IN_MAP = np.array([13.0, 1.0])
ODD = (0.3, 0.2)  # of tag 5
SAID = "entry tag36h11 5 looks wrong"


def component_of(a: str = "red_one", b: str = "blue_two", first_id: int = 0) -> Component:
    """Tags with a sigma of 1 cm each, exactly where the survey has them but for the sixth; two hang swapped."""
    places = PLACES.copy()
    places[5] += ODD
    places[[2, 7]] = places[[7, 2]]
    tags = tuple(
        TagResult("tag36h11", first_id + i, "", 0.15, place, 1e-4 * np.eye(2), 9, (a,))
        for i, place in enumerate(places)
    )
    joint = np.zeros((6 + 2 * len(tags), 6 + 2 * len(tags)))
    joint[6:, 6:] = 1e-4 * np.eye(2 * len(tags))
    return replace(make_component(a, b), tags=tags, joint_covariance=joint)


def survey_of(first_id: int = 0) -> list[SurveyEntry]:
    measured = se2.apply(T_SURVEY_MAP, np.concatenate([PLACES, [NOT_IN_MAP]]))
    ids = [*range(first_id, first_id + len(PLACES)), 99]
    return [SurveyEntry("", tag_id, "", place, 0.02) for tag_id, place in zip(ids, measured, strict=True)]


@pytest.fixture
def axes() -> Axes:
    result = make_map(component_of())
    (axes,) = draw_survey(result, evaluate_survey(result, survey_of())).axes
    return axes


def xy(line: object) -> FloatArray:
    return np.asarray(line.get_xydata())  # type: ignore[attr-defined]


def test_the_survey_lies_over_the_map(axes: Axes) -> None:
    circles = [line for line in axes.lines if line.get_marker() == "o"]
    drawn = np.concatenate([xy(line) for line in circles])
    np.testing.assert_allclose(drawn, [*PLACES, NOT_IN_MAP], atol=1e-6)
    red = to_rgb("#C00000")
    assert [to_rgb(line.get_color()) == red for line in circles] == [i in (2, 5, 7) for i in range(13)]
    joins = [xy(line) for line in axes.lines if to_rgb(line.get_color()) == red and len(xy(line)) == 2]
    assert len(joins) == 3
    np.testing.assert_allclose(joins[1], [PLACES[5], PLACES[5] + ODD], atol=1e-6)
    (low_x, high_x), (low_y, high_y) = axes.get_xlim(), axes.get_ylim()
    assert ((drawn > [low_x, low_y]) & (drawn < [high_x, high_y])).all()


def test_tags_that_are_off_are_named_with_metres_and_sigmas(axes: Axes) -> None:
    result = make_map(component_of())
    found = evaluate_survey(result, survey_of()).components[0].entries
    texts = {text.get_text(): to_rgb(text.get_color()) for text in axes.texts}
    odd = {text for text, colour in texts.items() if colour == to_rgb("#C00000")}
    shifts = {i: f"{np.linalg.norm(found[i].shift_m):.2f} m, {found[i].sigmas:.0f} sigmas" for i in (2, 5, 7)}
    assert shifts[5].startswith("0.36 m")
    assert odd == {f"2: swapped with 7? {shifts[2]}", f"5: {shifts[5]}", f"7: swapped with 2? {shifts[7]}"}
    assert set(texts) - odd == {*(str(i) for i in range(12) if i not in (2, 5, 7)), "99"}
    assert texts["99"] != texts["0"]


def test_a_title_counts_and_components_are_panels() -> None:
    result = make_map(component_of(), component_of("green_one", "grey_two", first_id=100))
    entries = [*survey_of()[:-1], *survey_of(first_id=100)]
    figure = draw_survey(result, evaluate_survey(result, entries))
    assert [axes.get_title() for axes in figure.axes] == ["frame: start of red_one", "frame: start of green_one"]
    said = "24 surveyed tags in the map, 18 where the survey has them, 6 not; 1 not in the map"
    assert said in figure.get_suptitle()


@pytest.fixture
def compared(tmp_path: Path) -> Path:
    (tmp_path / "map").mkdir()
    write_map(make_map(component_of()), tmp_path / "map")
    rows = [",".join(map(str, [each.tag_id, *each.position_m.tolist()])) for each in survey_of()]
    text = "\n".join(["tag_id,x_m,y_m", *rows])
    (tmp_path / "survey.csv").write_text(text + "\n")
    return tmp_path


def test_compare_writes_it(run: Run, compared: Path) -> None:
    arguments = ("compare", compared / "map", "--survey", compared / "survey.csv")
    without, outcome = run(*arguments), run(*arguments, "--picture", compared / "a.png")
    assert outcome.code == 0, outcome.err
    assert SAID in outcome.out
    assert outcome.out == f"{without.out}picture: {compared / 'a.png'}\n"
    image = cv2.imread(str(compared / "a.png"))
    assert image is not None
    assert image.shape[1] == 1600
    assert run(*arguments, "--picture", compared / "b.png", "--json").out == run(*arguments, "--json").out
    assert (compared / "a.png").read_bytes() == (compared / "b.png").read_bytes()


def test_pictures_that_cannot_be_are_refused_in_a_line(run: Run, compared: Path) -> None:
    (compared / "a.png").write_text("mine")
    survey = ("--survey", compared / "survey.csv")
    for arguments, said in (
        ((*survey, "--picture", compared / "a.png"), "a.png: exists already and is not overwritten"),
        ((*survey, "--picture", compared / "none" / "a.png"), "cannot be written (No such file or directory)"),
        (("--truth", compared / "truth.json", "--picture", compared / "b.png"), "--picture: draws a survey"),
    ):
        outcome = run("compare", compared / "map", *arguments)
        assert (outcome.code, outcome.out) == (1, "")
        assert said in outcome.err
        assert outcome.err.count("\n") == 1
    assert (compared / "a.png").read_text() == "mine"
    assert not (compared / "b.png").exists()


def test_the_report_of_a_map_in_the_frame_of_a_survey_shows_its_places(
    window: Page, logs: list[Path], tmp_path: Path
) -> None:
    """A place that looks wrong has a line to its tag; the one of a tag that is not in the map has its id."""
    places = {tag.tag_id: np.array(tag.position_m[:2]) for tag in TAGS} | {9: np.array([2.0, -1.0])}
    places[3] = places[3] + [1.2, 0.5]
    rows = [f"{tag_id},{x_m:.3f},{y_m:.3f}" for tag_id, (x_m, y_m) in places.items()]
    (tmp_path / "survey.csv").write_text("\n".join(["tag_id,x_m,y_m", *rows]) + "\n")
    result, _ = write_map_of(MapOptions(logs, tmp_path / "map", frame=str(tmp_path / "survey.csv")))
    window.open(tmp_path / "map" / "report.html")
    drawn = {
        trace["name"]: trace
        for trace in window.look(
            "document.querySelector('.plot.map').data.filter((each) => each.name && each.name.includes('survey'))"
            ".map(({ name, x, y, text }) => ({ name, x, y, text }))"
        )
    }
    for name, ids in (
        ("place by the survey", [0, 1, 2]), ("survey, looks wrong", [3]), ("survey, not in this map", [9])
    ):  # fmt: skip
        np.testing.assert_allclose(np.column_stack([drawn[name]["x"], drawn[name]["y"]]), [places[i] for i in ids])
    assert drawn["survey, not in this map"]["text"] == ["9"]
    (line,) = window.look(
        "document.querySelector('.plot.map').data.filter((each) => each.x.length === 3 && each.x[2] === null)"
        ".map(({ x, y }) => [[x[0], y[0]], [x[1], y[1]]])"
    )
    (tag,) = (each for each in result.components[0].tags if each.tag_id == 3)
    np.testing.assert_allclose(line, [places[3], tag.position_m], atol=1e-5)
