"""Figures against ground truth, worked out by hand."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import TrueRun, Truth, read_truth
from groundsbot.offline.maps.datum import DatumKind, TagDatum
from groundsbot.offline.maps.frame import CrossCovariances, move_to_tags
from groundsbot.offline.maps.result import Component
from tests.support.data.maps import STEP_NS, make_component, make_map, make_truth


def perturb(component: Component, d_tags_m: FloatArray, d_start_m: FloatArray) -> Component:
    """The component with tags (T, 2) and the second run's start (2,) found elsewhere."""
    tags = tuple(replace(tag, position_m=tag.position_m + d) for tag, d in zip(component.tags, d_tags_m, strict=True))
    first, second = component.runs
    second = replace(second, T_map_start=second.T_map_start + np.append(d_start_m, 0.0))
    return replace(component, tags=tags, runs=(first, second))


@given(st.tuples(*[st.floats(-100, 100)] * 2, st.floats(-3.1, 3.1)))
@settings(max_examples=20)
def test_a_right_map_has_no_error_wherever_the_world_has_its_origin(T_world_map: tuple[float, ...]) -> None:
    component = make_component()
    errors = evaluate(make_map(component), make_truth(component, np.array(T_world_map))).components[0]
    assert errors.tags_rmse_m == pytest.approx(0, abs=1e-9)
    assert errors.tags_rmse_aligned_m == pytest.approx(0, abs=1e-9)
    assert errors.trajectory_rmse_m == pytest.approx(0, abs=1e-9)
    assert errors.nees_tags_per_dim == pytest.approx(0, abs=1e-9)
    assert errors.starts[0].vector_error_m == pytest.approx(0, abs=1e-9)
    assert errors.starts[0].percent == pytest.approx(0, abs=1e-9)


def test_tag_figures_are_those_worked_out_by_hand() -> None:
    component = make_component()
    off = np.array([[0.03, 0.04], [0.0, 0.0], [0.0, -0.12]])  # lengths 0.05, 0, 0.12
    errors = evaluate(make_map(perturb(component, off, np.zeros(2))), make_truth(component)).components[0]
    assert errors.tags_rmse_m == pytest.approx(0.13 / np.sqrt(3))  # sqrt((0.05^2 + 0.12^2) / 3)
    assert [tag.error_m for tag in errors.tags] == pytest.approx([0.05, 0.0, 0.12])
    assert errors.tags[0].sigma_m == pytest.approx(np.trace(component.joint_covariance[6:8, 6:8]) ** 0.5)


def test_start_figures_are_those_worked_out_by_hand() -> None:
    component = make_component()
    d = np.array([0.3, -0.4])
    errors = evaluate(make_map(perturb(component, np.zeros((3, 2)), d)), make_truth(component)).components[0]
    (pair,) = errors.starts
    assert (pair.a, pair.b) == ("red_one", "blue_two")
    assert pair.vector_error_m == pytest.approx(0.5)
    assert pair.true_distance_m == pytest.approx(np.hypot(10, 2))
    assert pair.distance_error_m == pytest.approx(np.hypot(10.3, 1.6) - np.hypot(10, 2))
    assert pair.percent == pytest.approx(100 * pair.distance_error_m / np.hypot(10, 2))


def test_nees_of_small_errors_is_that_worked_out_by_hand() -> None:
    """Of large ones lengths and directions count (test_nees)."""
    component = make_component()
    off, d = 1e-4 * np.array([[3.0, 4.0], [0.0, 0.0], [0.0, -12.0]]), 1e-4 * np.array([3.0, -4.0])
    errors = evaluate(make_map(perturb(component, off, d)), make_truth(component)).components[0]
    for name, rows, error in (("tags", slice(6, 12), off.reshape(-1)), ("start", slice(3, 5), d)):
        wanted = error @ np.linalg.inv(component.joint_covariance[rows, rows]) @ error / len(error)
        assert getattr(errors, f"nees_{name}_per_dim") == pytest.approx(wanted, rel=1e-3), name


def test_a_turned_map_is_wrong_as_it_stands_and_right_when_aligned() -> None:
    component = make_component()
    turned = np.array([se2.apply([0.5, -0.2, 0.1], tag.position_m) - tag.position_m for tag in component.tags])
    errors = evaluate(make_map(perturb(component, turned, np.zeros(2))), make_truth(component)).components[0]
    assert errors.tags_rmse_m is not None
    assert errors.tags_rmse_m > 0.5
    assert errors.tags_rmse_aligned_m == pytest.approx(0, abs=1e-9)


def test_the_trajectory_is_compared_at_its_own_times() -> None:
    component = make_component()
    runs = {}
    for run in component.runs:  # truth at other times than the keyframes, on the same arc
        between = se2.interpolate(run.T_map_base[:-1], run.T_map_base[1:], np.full(run.n_keyframes - 1, 0.5))
        stamps_ns = np.concatenate([run.stamps_ns[:1], run.stamps_ns[:-1] + STEP_NS // 2, run.stamps_ns[-1:]])
        runs[run.name] = TrueRun(stamps_ns, np.concatenate([run.T_map_base[:1], between, run.T_map_base[-1:]]))
    truth = replace(make_truth(component), runs=runs)
    errors = evaluate(make_map(component), truth).components[0]
    assert errors.trajectory_rmse_m == pytest.approx(0, abs=1e-8)
    shifted = {name: TrueRun(run.stamps_ns + STEP_NS // 2, run.T_world_base) for name, run in runs.items()}
    late = evaluate(make_map(component), replace(truth, runs=shifted)).components[0]
    assert late.trajectory_rmse_m == pytest.approx(0.05, rel=0.1)  # half of 0.1 m a step


def test_what_the_truth_does_not_know_is_named_and_left_out() -> None:
    component = make_component()
    truth = make_truth(component)
    known_tags = {name: place for name, place in truth.tags_m.items() if name[1] != 7}
    partial = Truth({"red_one": truth.runs["red_one"]}, known_tags, frozenset({("tag25h9", 3, "")}))
    errors = evaluate(make_map(component), partial).components[0]
    assert errors.notes == (
        "not in the truth, left out: runs blue_two",
        "not in the truth, or there more than once, left out: tags tag36h11:7, tag25h9:3",
    )
    assert [tag.tag_id for tag in errors.tags] == [3]
    assert errors.starts == ()
    assert errors.nees_start_per_dim is None
    assert errors.tags_rmse_aligned_m is None


def test_without_the_frames_own_run_there_is_no_comparison() -> None:
    component = make_component()
    truth = make_truth(component)
    with pytest.raises(OfflineError, match=r"no 'red_one' at its start's time.*it has blue_two"):
        evaluate(make_map(component), replace(truth, runs={"blue_two": truth.runs["blue_two"]}))


def test_each_component_is_judged_in_its_own_frame() -> None:
    large, small = make_component(), make_component("green_one", "grey_two")
    T_world_small = np.array([50.0, 60.0, 2.0])
    truth, other = make_truth(large), make_truth(small, T_world_small)
    both = replace(truth, runs=truth.runs | other.runs, tags_m=other.tags_m)
    errors = evaluate(make_map(large, small), both)
    assert errors.components[1].tags_rmse_m == pytest.approx(0, abs=1e-9)
    data = errors.as_json()
    assert data["frame_run"] == "red_one"
    assert data["tags_rmse_m"] == data["components"][0]["tags_rmse_m"]
    assert data["tags_rmse_m"] > 10
    assert "2 components, each evaluated in its own frame, largest first" in errors.lines()[0]
    unknown = evaluate(make_map(large, small), truth).components[1]
    assert unknown.tags_rmse_m is None
    assert "lacks the start of green_one" in unknown.notes[0]


def test_a_covariance_that_is_none_gives_no_figure_but_a_reason() -> None:
    component = make_component()
    flat = replace(component, joint_covariance=np.zeros_like(component.joint_covariance))
    errors = evaluate(make_map(flat), make_truth(component)).components[0]
    assert errors.nees_tags_per_dim is None
    assert sum("not positive definite" in note for note in errors.notes) == 2


def test_a_single_run_has_no_start_figures() -> None:
    component = make_component()
    rows = np.r_[0:3, 6:12]
    alone = replace(component, runs=component.runs[:1], joint_covariance=component.joint_covariance[np.ix_(rows, rows)])
    data = evaluate(make_map(alone), make_truth(component)).as_json()
    assert data["start_to_start_vector_error_m"] is None
    assert data["nees_start_per_dim"] is None
    assert data["nees_tags_per_dim"] == pytest.approx(0, abs=1e-9)
    json.dumps(data, allow_nan=False)


def test_truth_json_is_read_without_losing_nanoseconds(tmp_path: Path) -> None:
    stamp = 1_800_000_000_123_456_789
    data = {
        "runs": {"red_one": {"poses": [[stamp, 1, 2, 3], [stamp + 1, 1, 2, 3]], "parameters": {}}},
        "tags": [
            {"family": "tag36h11", "tag_id": 3, "position_m": [1, 2, 3], "quaternion_xyzw": None},
            {"family": "tag36h11", "tag_id": 4, "position_m": [1, 2, 3], "quaternion_xyzw": None},
            {"family": "tag36h11", "tag_id": 4, "position_m": [5, 2, 3], "quaternion_xyzw": None},
        ],
    }
    path = tmp_path / "truth.json"
    path.write_text(json.dumps(data))
    truth = read_truth(path)
    assert truth.runs["red_one"].stamps_ns.tolist() == [stamp, stamp + 1]
    assert truth.tags_m["tag36h11", 3, ""].tolist() == [1, 2]
    assert truth.ambiguous == {("tag36h11", 4, "")}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "is not JSON"),
        ("[]", "is JSON, not ground truth, which holds runs"),
        ('{"runs": {}}', "is JSON, not ground truth, which holds runs"),
        ('{"runs": {"a": []}, "tags": []}', "lacks or misspells a key"),
        ('{"runs": {"a": {"poses": []}}, "tags": []}', "runs.a.poses must hold rows"),
        ('{"runs": {"a": {"poses": [[1, 2, 3]]}}, "tags": []}', "runs.a.poses must hold rows"),
        ('{"runs": {"a": {"poses": [[2, 0, 0, 0], [1, 0, 0, 0]]}}, "tags": []}', "times not increasing"),
        ('{"runs": {"a": {"poses": [[2, NaN, 0, 0]]}}, "tags": []}', "not finite"),
        ('{"runs": {"a": {"poses": [[1%s, 0, 0, 0]]}}, "tags": []}' % ("0" * 30), "lacks or misspells a key"),
        ('{"runs": {}, "tags": [{"family": "a", "tag_id": Infinity, "position_m": [0, 0]}]}', "lacks or misspells"),
        ('{"runs": {}, "tags": [{"family": "a", "tag_id": 3, "position_m": [0]}]}', "tag 3 is [0.0], must be two"),
        (
            '{"runs": {}, "tags": [{"family": "a", "tag_id": 3, "position_m": [NaN, 0]}]}',
            "tag 3 is [nan, 0.0], must",
        ),
    ],
)
def test_a_bad_truth_is_refused_in_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "truth.json"
    path.write_text(text)
    with pytest.raises(OfflineError) as caught:
        read_truth(path)
    assert str(path) in str(caught.value)
    assert said in str(caught.value)


def held_by_tags(weights: FloatArray) -> Component:
    """The component in a frame that its tags hold."""
    made = make_component()
    cross = CrossCovariances(np.zeros((0, 6)), None)
    return move_to_tags(made, TagDatum(DatumKind.SURVEY, weights), np.array([3.0, -1.0, 0.7]), cross)


@pytest.mark.parametrize("weights", [(1.0, 1.0, 1.0), (1.0, 0.0, 0.25)])
def test_a_frame_that_tags_hold_is_where_the_truth_has_them(weights: tuple[float, ...]) -> None:
    component = held_by_tags(np.array(weights))
    errors = evaluate(make_map(component), make_truth(component, np.array([40.0, 5.0, 2.0]))).components[0]
    for figure in (errors.tags_rmse_m, errors.trajectory_rmse_m, errors.nees_tags_per_dim, errors.nees_start_per_dim):
        assert figure == pytest.approx(0, abs=1e-9)
    assert errors.as_json()["frame_run"] is None
    assert errors.lines()[0].startswith("frame: survey's frame; runs red_one")


@pytest.mark.parametrize("missing", [None, 3])
def test_errors_in_a_frame_that_tags_hold_have_a_nees_of_one(missing: int | None) -> None:
    """Also where the truth lacks one of them, and the others hold it."""
    component = held_by_tags(np.array([1.0, 0.5, 0.25]))
    truth = make_truth(component)
    if missing is not None:
        truth = replace(truth, tags_m={k: v for k, v in truth.tags_m.items() if k != ("tag36h11", missing, "")})
    first = component.runs[0]
    drawn = np.random.default_rng(12).multivariate_normal(np.zeros(12), component.joint_covariance, size=300)
    figures = []
    for error in drawn:
        moved = perturb(component, error[6:].reshape(3, 2), error[3:5])
        at = replace(first, T_map_start=first.T_map_start + np.append(error[:2], 0.0))
        figures.append(evaluate(make_map(replace(moved, runs=(at, moved.runs[1]))), truth).components[0])
    # 300 draws of 3 dimensions (one with two tags) and of 4.
    bound = 3.0 * np.sqrt(2.0 / (300 * (3 if missing is None else 1)))
    assert np.mean([f.nees_tags_per_dim or np.nan for f in figures]) == pytest.approx(1, abs=bound)
    assert np.mean([f.nees_start_per_dim or np.nan for f in figures]) == pytest.approx(1, abs=0.17)
    tags = [f.tags for f in figures]
    squares = sum(tag.error_m**2 for each in tags for tag in each), sum(t.sigma_m**2 for each in tags for t in each)
    assert squares[0] / squares[1] == pytest.approx(1.0, abs=0.2)


def test_without_the_tags_that_hold_the_frame_there_is_no_comparison() -> None:
    component = held_by_tags(np.array([1.0, 1.0, 0.0]))
    truth = make_truth(component)
    known = {name: place for name, place in truth.tags_m.items() if name[1] != 7}
    with pytest.raises(OfflineError, match="fewer than two of those that hold the map's frame"):
        evaluate(make_map(component), replace(truth, tags_m=known))
