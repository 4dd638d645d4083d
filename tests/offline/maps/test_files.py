"""A map's files hold what the map holds, and come back."""

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.maps.datum import DatumKind, SurveyedTag, TagDatum
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.maps.shape import shape_of
from groundsbot.offline.maps.tum import read_tum, write_tum
from tests.support.data.maps import START_B, make_component, make_map, make_run


def assert_equal(left: object, right: object) -> None:
    """Equal all the way down, arrays to a nanometre."""
    if isinstance(left, np.ndarray):
        np.testing.assert_allclose(left, np.asarray(right), rtol=0, atol=1e-9)
    elif isinstance(left, tuple | list):
        assert isinstance(right, tuple | list)
        assert len(left) == len(right)
        for a, b in zip(left, right, strict=True):
            assert_equal(a, b)
    elif hasattr(left, "__dataclass_fields__"):
        for name in left.__dataclass_fields__:
            assert_equal(getattr(left, name), getattr(right, name))
    else:
        assert left == right


def write_file(result: MapResult, folder: Path) -> dict[str, Any]:
    write_map(result, folder)
    data: dict[str, Any] = json.loads((folder / "map.json").read_text())
    return data


def test_a_map_comes_back_as_it_was(tmp_path: Path) -> None:
    other = make_component("green_one", "grey_two")
    stretch = replace(other.runs[1], name="grey_two_stretch2")
    joint = np.pad(other.joint_covariance, ((0, 3), (0, 3)))
    result = make_map(make_component(), replace(other, runs=(*other.runs, stretch), joint_covariance=joint))
    write_map(result, tmp_path)
    assert_equal(read_map(tmp_path), result)


def test_the_frame_that_tags_hold_comes_back(tmp_path: Path) -> None:
    places = (SurveyedTag(4, "", np.array([1.5, -2.0]), 2), SurveyedTag(9, "b", np.array([0.0, 3.0]), None))
    datum = TagDatum(DatumKind.SURVEY, np.array([1.0, 0.0, 0.25]), places)
    result = make_map(replace(make_component(), frame_run=None, datum=datum), make_component("green_one", "grey_two"))
    data = write_file(result, tmp_path)
    own, other = data["components"]
    assert own["datum"] == {
        "kind": "survey",
        "weights": [1.0, 0.0, 0.25],
        "survey": [
            {"tag_id": 4, "instance": "", "position_m": [1.5, -2.0], "tag": 2},
            {"tag_id": 9, "instance": "b", "position_m": [0.0, 3.0], "tag": None},
        ],
    }
    assert "datum" not in other
    assert [entry["frame_run"] for entry in data["components"]] == [None, "green_one"]
    assert_equal(read_map(tmp_path), result)


def test_map_json_has_the_keys_that_are_documented(tmp_path: Path) -> None:
    data = write_file(make_map(), tmp_path)
    assert list(data) == [
        *("format_version", "frame", "components", "runs", "tags", "alignments", "start_to_start"),
        *("noise", "noise_fit", "calibration", "choices", "robot_numbers", "measurements", "checks", "metres"),
        *("suspect_tags", "advice", "warnings", "losses"),
    ]
    assert data["components"][0]["runs"] == ["red_one", "blue_two"]
    wanted = {"run", "log", "robot", "T_map_start", "covariance", "n_keyframes", "distance_m"}
    assert wanted <= set(data["runs"][1])
    assert data["runs"][1]["T_map_start"] == START_B.tolist()
    wanted = {"family", "tag_id", "instance", "size_m", "position_m", "quaternion_xyzw", "covariance"}
    assert wanted | {"n_observations", "runs"} <= set(data["tags"][0])
    assert data["tags"][0]["quaternion_xyzw"] is None
    assert {"from", "to", "transform", "n_shared", "n_inliers", "rivals"} <= set(data["alignments"][0])
    assert {"a", "b", "vector_m", "distance_m", "sigma_m"} <= set(data["start_to_start"][0])
    assert data["start_to_start"][0]["distance_m"] == pytest.approx(np.hypot(10, 2))


def test_map_json_does_not_grow_with_a_drive(tmp_path: Path) -> None:
    texts = []
    for n in (20, 2000):
        component = make_component()
        runs = tuple(
            replace(make_run(run.name, run.T_map_start, run.covariance, n), distance_m=1.0) for run in component.runs
        )
        (tmp_path / str(n)).mkdir()
        data = write_file(make_map(replace(component, runs=runs)), tmp_path / str(n))
        assert [run.pop("n_keyframes") for run in data["runs"]] == [n, n]
        assert [len(run.stamps_ns) for run in read_map(tmp_path / str(n)).runs] == [n, n]
        texts.append(json.dumps(data))
    assert texts[0] == texts[1]


def test_what_is_not_a_number_is_null_in_json_and_empty_in_csv(tmp_path: Path) -> None:
    component = make_component()
    unknown = replace(component.tags[0], covariance=np.full((2, 2), np.nan), size_m=None)
    result = make_map(replace(component, tags=(unknown, *component.tags[1:]), cost=float("inf")))
    data = write_file(result, tmp_path)
    assert "NaN" not in (tmp_path / "map.json").read_text()
    assert data["tags"][0]["covariance"] == [[None, None], [None, None]]
    assert data["tags"][0]["size_m"] is None
    assert data["components"][0]["cost"] is None
    with (tmp_path / "tags.csv").open() as stream:
        row = next(csv.DictReader(stream))
    assert (row["sigma_x_m"], row["covariance_xy_m2"]) == ("", "")


def test_tags_csv_has_one_row_a_tag(tmp_path: Path) -> None:
    result = make_map()
    write_map(result, tmp_path)
    lines = (tmp_path / "tags.csv").read_text().splitlines()
    assert lines[0] == (
        "tag_id,x_m,y_m,z_m,yaw_rad,sigma_x_m,sigma_y_m,n_observations,runs,family,instance,covariance_xy_m2,"
        "shape_sigma_x_m,shape_sigma_y_m,shape_covariance_xy_m2"
    )
    rows = list(csv.DictReader(lines))
    tags = result.components[0].tags
    assert [int(row["tag_id"]) for row in rows] == [3, 7, 3]
    assert [row["family"] for row in rows] == ["tag36h11", "tag36h11", "tag25h9"]
    assert rows[0]["runs"] == "red_one blue_two"
    assert (rows[0]["z_m"], rows[0]["yaw_rad"], rows[0]["instance"]) == ("", "", "")
    shape = shape_of(result.components[0])
    assert shape is not None
    for row, tag, own in zip(rows, tags, shape.tag_covariances, strict=True):
        sigmas_m = [float(row[name]) for name in ("shape_sigma_x_m", "shape_sigma_y_m")]
        assert sigmas_m == pytest.approx(np.sqrt(np.diag(own)), abs=1e-6)
        assert float(row["shape_covariance_xy_m2"]) == pytest.approx(own[0, 1], rel=1e-6)
        assert [float(row["x_m"]), float(row["y_m"])] == tag.position_m.tolist()
        assert float(row["sigma_y_m"]) == pytest.approx(tag.covariance[1, 1] ** 0.5, abs=1e-6)
        assert float(row["covariance_xy_m2"]) == pytest.approx(tag.covariance[0, 1], rel=1e-6)


def test_map_json_has_sigmas_from_the_frame_and_of_the_shape(tmp_path: Path) -> None:
    result = make_map()
    data = write_file(result, tmp_path)
    shape = shape_of(result.components[0])
    assert shape is not None
    for entry, tag, own in zip(data["tags"], result.components[0].tags, shape.tag_covariances, strict=True):
        assert entry["sigma_m"] == pytest.approx(np.linalg.eigvalsh(tag.covariance)[-1] ** 0.5)
        assert entry["shape_sigma_m"] == pytest.approx(np.linalg.eigvalsh(own)[-1] ** 0.5)
        np.testing.assert_allclose(entry["shape_covariance"], own)


def test_a_map_of_an_older_program_has_a_shape_too(tmp_path: Path) -> None:
    """Its files have no sigmas of it, and its advice is for sigmas from the start."""
    data = write_file(make_map(), tmp_path)
    for tag in data["tags"]:
        del tag["sigma_m"], tag["shape_covariance"], tag["shape_sigma_m"]
    for advice in data["advice"]:
        del advice["of_shape"]
    (tmp_path / "map.json").write_text(json.dumps(data))
    (tmp_path / "tags.csv").unlink()
    read = read_map(tmp_path)
    assert [each.of_shape for each in read.advice] == [False, False]
    before, after = (shape_of(each.components[0]) for each in (make_map(), read))
    assert before is not None
    assert after is not None
    np.testing.assert_array_equal(before.tag_covariances, after.tag_covariances)


def test_a_trajectory_keeps_its_nanoseconds_and_headings_at_any_turn(tmp_path: Path) -> None:
    stamps_ns = np.array([0, 1, 1_800_000_000_123_456_789], dtype=np.int64)
    poses = np.array([[0, 0, np.pi], [1.5, -2.25, -3.1], [-7, 1e-9, 1e-9]])
    write_tum(tmp_path / "a.tum", stamps_ns, poses)
    first = (tmp_path / "a.tum").read_text().splitlines()[0].split()
    assert first[0] == "0.000000000"
    assert [float(cell) for cell in first[1:]] == pytest.approx([0, 0, 0, 0, 0, 1, 0])  # half a turn about z
    stamps_back, poses_back = read_tum(tmp_path / "a.tum")
    assert stamps_back.tolist() == stamps_ns.tolist()
    np.testing.assert_allclose(se2.log(se2.between(poses, poses_back)), 0, atol=2e-9)


def _spoilt_in_the_middle(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)


def _change(path: Path, **changes: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def _of_another_frame(path: Path) -> None:
    components = json.loads(path.read_text())["components"]
    _change(path, components=[components[0] | {"frame_run": "nobody"}, *components[1:]])


def _change_first(path: Path, key: str, **entries: object) -> None:
    first, *others = json.loads(path.read_text())[key]
    _change(path, **{key: [first | entries, *others]})


def _of_datum(path: Path, *weights: float | None, kind: str = "tags", **survey: object) -> None:
    components = json.loads(path.read_text())["components"]
    entry = {"frame_run": None, "datum": {"kind": kind, "weights": weights} | survey}
    _change(path, components=[components[0] | entry, *components[1:]])


def _of_survey(path: Path, **spoilt: object) -> None:
    place = {"tag_id": 4, "instance": "", "position_m": [1.0, 2.0], "tag": None} | spoilt
    _of_datum(path, 1.0, 1.0, 1.0, kind="survey", survey=[place])


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda d: (d / "map.json").unlink(), "map.json: cannot be read"),
        (lambda d: (d / "map.json").write_text("{"), "is not JSON"),
        (lambda d: (d / "map.json").write_text("[]"), "holds no object"),
        (lambda d: (d / "map.json").write_text('{"format_version": 9}'), "format_version is 9, this program reads 1"),
        (lambda d: (d / "map.npz").unlink(), "map.npz: cannot be read"),
        (lambda d: (d / "map.npz").write_bytes(b"nonsense"), "damaged"),
        (lambda d: (d / "map.npz").write_bytes(b""), "damaged"),
        (lambda d: (d / "map.npz").write_bytes((d / "map.npz").read_bytes()[:-300]), "damaged"),
        (lambda d: _spoilt_in_the_middle(d / "map.npz"), "damaged"),
        (lambda d: _change(d / "map.json", components=[]), "damaged or incomplete (no components)"),
        (lambda d: _change(d / "map.json", runs=None), "damaged"),
        (lambda d: _change(d / "map.json", metres=[7]), "damaged"),
        (
            lambda d: _change_first(d / "map.json", "tags", tag_id="x"),
            "TagResult: tag_id is 'x' but must be a valid integer",
        ),
        (
            lambda d: _change_first(d / "map.json", "tags", runs=[7]),
            "TagResult: runs[0] is 7 but must be a valid string",
        ),
        (lambda d: _change_first(d / "map.json", "calibration", sigma={}), "CalibrationResult: sigma is {} but"),
        (lambda d: _of_another_frame(d / "map.json"), "frame_run 'nobody' is none of its runs"),
        (lambda d: _of_datum(d / "map.json", 1.0, 1.0), "weights are not 3 finite numbers from 0 on"),
        (lambda d: _of_datum(d / "map.json", 1.0, 1.0, None), "weights are not 3 finite numbers from 0 on"),
        (lambda d: _of_datum(d / "map.json", 1.0, 1.0, -1.0), "weights are not 3 finite numbers from 0 on"),
        (lambda d: _of_datum(d / "map.json", 1.0, 0.0, 0.0), "these tags determine no frame"),
        (lambda d: _of_datum(d / "map.json", 1.0, 1.0, 1.0, kind="stars"), "'stars' is not a valid DatumKind"),
        (lambda d: _of_survey(d / "map.json", position_m=[1.0]), "position of tag 4 is not two finite numbers"),
        (lambda d: _of_survey(d / "map.json", position_m=[1.0, None]), "position of tag 4 is not two finite numbers"),
        (lambda d: _of_survey(d / "map.json", tag=3), "datum.survey: 3 is the index of none of 3 tags"),
        (lambda d: _of_survey(d / "map.json", tag_id="x"), "SurveyedTag: tag_id is 'x' but must be a valid integer"),
        (lambda d: (d / "red_one.tum").unlink(), "red_one.tum: cannot be read"),
        (lambda d: (d / "red_one.tum").write_text("1 2 3\n"), "line 1: '1 2 3' is not a pose"),
        (lambda d: (d / "red_one.tum").write_text(""), "holds no pose"),
        (lambda d: (d / "red_one.tum").write_text("Infinity 0 0 0 0 0 0 1\n"), "line 1: 'Infinity"),
        (lambda d: (d / "red_one.tum").write_text("1e30 0 0 0 0 0 0 1\n"), "line 1: '1e30"),
    ],
)
def test_a_damaged_map_is_refused_in_one_line(tmp_path: Path, spoil: Callable[[Path], object], said: str) -> None:
    write_map(make_map(), tmp_path)
    spoil(tmp_path)
    with pytest.raises(OfflineError) as caught:
        read_map(tmp_path)
    assert said in str(caught.value)
