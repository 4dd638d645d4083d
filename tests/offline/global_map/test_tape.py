"""What a person measured, in the map: exact figures where they follow by hand, and words where it contradicts."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.robot_yaml import Robot
from groundsbot.offline.commands.map_drives import exit_code
from groundsbot.offline.commands.map_summary import summary
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.files import read_map
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.measurements.tape import TapeOptions
from groundsbot.offline.report.parameter_tables import measurements
from groundsbot.offline.sam.partition.solver import solve_with_workers
from groundsbot.offline.sam.solver import Solution
from tests.support.data.drives import FAMILY, MadeTag, make_drive, make_positions, make_robot, make_run, write_drive
from tests.support.data.map_cases import DRIVES, TAGS
from tests.support.programs import Outcome
from tests.support.programs import Run as Program

LEGS = [(0.5, 0.5, 2.0), (0.4, 0.5, 2.0), (0.5, 0.4, 2.0)]
PLACES = {1: (2.0, 1.0), 2: (1.0, -2.0), 3: (7.0, 1.0), 4: (8.0, 3.0), 5: (0.0, 4.0)}
STARTS = {"a": (0.0, 0.0, 0.0), "b": (5.0, 0.0, 2.0), "c": (4.0, 3.0, -1.0)}


def run_of(
    name: str,
    tags: Sequence[int],
    scale: float = 1.0,
    robot: Robot | None = None,
    places: dict[int, tuple[float, float]] = PLACES,
) -> Run:
    """A drive that reads each of some tags ten times; lengths are given `scale` times too short."""
    drive = make_drive(STARTS[name], LEGS, step_ns=100_000_000)
    at, tag = (index.reshape(-1) for index in np.mgrid[0:50:5, 0 : len(tags)])
    tag_m = np.array([places[key] for key in tags]).reshape(-1, 2)[tag]
    seen = se2.apply(se2.inverse(drive.T_world_base[at]), tag_m) / scale
    track = drive.track
    shrunk = type(track)(track.stamps_ns, track.left_m / scale, track.right_m / scale)
    return make_run(
        [shrunk],
        robot=robot or make_robot(name),
        tags=[TagKey(FAMILY, key) for key in tags],
        positions=make_positions(drive.stamps_ns[at], tag, seen),
    )


def map_runs(runs: Sequence[Run], starts: Sequence[str] = (), distances: Sequence[str] = ()) -> MapResult:
    return build_map(runs, NoiseParameters(), Stages(), TapeOptions(starts, distances))


def test_a_measured_start_joins_runs_that_share_no_tag() -> None:
    runs = [run_of("a", (1, 2)), run_of("b", (3, 4))]
    assert len(map_runs(runs).components) == 2
    result = map_runs(runs, ["b_one=5,0.5,2,0.3,0.1,0.05"])
    (component,) = result.components
    b = component.runs[1]
    np.testing.assert_allclose(b.T_map_start, [5.0, 0.5, 2.0], atol=1e-9)
    np.testing.assert_allclose(b.covariance, np.diag([0.3, 0.1, 0.05]) ** 2, rtol=1e-6, atol=1e-9)
    (told,) = result.measurements
    assert told.component == 0
    assert told.off_sigmas is None
    assert told.residual_sigmas == pytest.approx(0.0, abs=1e-6)
    assert not any("--start" in warning for warning in result.warnings)


def test_a_start_and_a_distance_are_weighed_by_their_sigmas() -> None:
    runs = [run_of("a", (1, 2)), run_of("b", (3, 4))]
    result = map_runs(runs, ["b_one=5.1,0,2,0.2,0.1,0.05"], ["a_one,b_one=5.0,0.1"])
    b = result.components[0].runs[1]
    # 5.1 and 5.0 at weights of 25 and 100.
    np.testing.assert_allclose(b.T_map_start, [5.02, 0.0, 2.0], atol=1e-8)
    assert b.covariance[0, 0] == pytest.approx(1.0 / 125.0, rel=1e-6)
    start, distance = result.measurements
    assert start.residual_sigmas == pytest.approx(0.4, rel=1e-6)
    assert distance.residual_sigmas == pytest.approx(0.2, rel=1e-6)
    for told in (start, distance):
        assert told.off_sigmas == pytest.approx(0.1 / np.hypot(0.2, 0.1), rel=1e-6)
        assert not told.contradicts


def test_a_distance_that_contradicts_is_reported_with_its_sigmas() -> None:
    runs = [run_of("a", (1, 2)), run_of("b", (3, 4))]
    result = map_runs(runs, ["b_one=5,0,2,0.03,0.1,0.05"], ["a_one,b_one=5.25,0.04"])
    assert [told.contradicts for told in result.measurements] == [True, True]
    assert result.measurements[1].off_sigmas == pytest.approx(5.0, rel=1e-6)
    (said,) = [warning for warning in result.warnings if warning.startswith("--distance a_one,b_one")]
    assert "measured 5.250 m, which contradicts everything else by 5.0 sigma" in said


@pytest.mark.parametrize(("distance_m", "is_used"), [(5.495, True), (5.505, False)])
def test_a_distance_is_used_up_to_ten_sigma_of_both_together(distance_m: float, is_used: bool) -> None:
    """The map has 5 m, known to 0.03 m by the start, and the tape's sigma is 0.04 m: 0.05 m together."""
    runs = [run_of("a", (1, 2)), run_of("b", (3, 4))]
    starts = ["b_one=5,0,2,0.03,0.1,0.05"]
    result = map_runs(runs, starts, [f"a_one,b_one={distance_m},0.04"])
    (told,) = [each for each in result.measurements if each.kind == "distance"]
    assert told.off_sigmas == pytest.approx((distance_m - 5.0) / 0.05, rel=1e-6)
    assert told.component == (0 if is_used else None)
    assert told.contradicts
    b_m = result.components[0].runs[1].T_map_start[0]
    assert (b_m > 5.1) == is_used
    if not is_used:
        assert told.in_map == pytest.approx([5.0])
        assert b_m == pytest.approx(5.0, abs=1e-9)
        (said,) = [warning for warning in result.warnings if warning.startswith("--distance a_one,b_one")]
        assert "measured 5.505 m, but the map made without it has 5.000 m, off by 10.1 sigma" in said
        assert "(of both together: 0.05 m), so it is not used; check its number, unit and ends" in said


@pytest.mark.parametrize("distance_m", [0.0, 66.0, 6600.0])
@pytest.mark.parametrize("names", ["a", "ab"])
def test_a_wrong_distance_does_not_change_the_map(names: str, distance_m: float) -> None:
    runs = [run_of(name, (1, 2, 3)) for name in names]
    good = f"1,3={np.linalg.norm(np.subtract(PLACES[1], PLACES[3])).item()!r},0.005"
    free, taped = map_runs(runs, distances=[good]), map_runs(runs, distances=[f"1,2={distance_m},0.01", good])
    for key in (1, 2, 3):
        assert tag(taped, key).tolist() == tag(free, key).tolist()
    used, unused = taped.measurements
    assert (used.component, unused.component) == (0, None)
    assert unused.in_map == pytest.approx([np.linalg.norm(np.subtract(PLACES[1], PLACES[2]))])
    assert exit_code(taped) == exit_code(free) == 0
    words = [row[-1] for row in measurements(map_as_json(taped)).rows]
    assert words == ["", "contradicts the rest, so not used"]
    assert any(f"measured {distance_m:.3f} m, but the map made without it has 3.162 m" in w for w in taped.warnings)
    (line,) = [each for each in summary(taped, Path()) if each.startswith("measured tag36h11:1 to tag36h11:2: ")]
    assert f"{distance_m:.3f} m given, 3.162 m without it (off by " in line
    assert line.endswith(" sigma; not used)")


def test_a_wrong_distance_is_not_used_on_corners_either(run: Program, tmp_path: Path) -> None:
    logs = [write_drive(tmp_path / "logs", DRIVES[name], TAGS, make_robot(name)) for name in "ab"]
    done = run("map", *logs, "-o", tmp_path / "out", "--model", "corners", "--distance", "0,1=100,0.01")
    assert done.code == 0
    (told,) = json.loads((tmp_path / "out" / "map.json").read_text())["measurements"]
    assert (told["component"], told["contradicts"]) == (None, True)
    assert told["in_map"] == pytest.approx([1.0], abs=0.02)
    kept = read_map(tmp_path / "out")
    assert kept.measurements[0].in_map == pytest.approx(told["in_map"])


def test_a_solve_that_did_not_converge_is_no_success(
    run: Program, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = [write_drive(tmp_path / "logs", DRIVES[name], TAGS, make_robot(name)) for name in "ab"]
    assert run("map", *logs, "-o", tmp_path / "good").code == 0

    def stop_early(*arguments: Any, **options: Any) -> Solution:
        return replace(solve_with_workers(*arguments, **options), converged=False, reason="stopped after 100 steps")

    monkeypatch.setattr("groundsbot.offline.global_map.joint_solve.solve_with_workers", stop_early)
    done = run("map", *logs, "-o", tmp_path / "out")
    assert done.code == 3
    assert "the solve did not converge (stopped after 100 steps); do not trust this map" in done.out
    assert not read_map(tmp_path / "out").components[0].converged
    assert read_map(tmp_path / "good").components[0].converged
    assert run("calibrate", *logs, "-o", tmp_path / "calibrated").code == 3


def test_a_measured_distance_holds_the_scale_where_wheels_and_tags_have_large_sigmas() -> None:
    """All lengths are given 3 % too short, by robots whose sigmas for them are 10 %."""
    wide = {
        "wheels": {
            "radius_left_m": 0.1, "radius_left_m_sigma": 0.01, "radius_right_m": 0.1, "radius_right_m_sigma": 0.01,
            "track_m": 0.5, "track_m_sigma": 0.05, "ticks_per_turn": 1e9,
        },
        "tags": [{"family": FAMILY, "default_size_m": 0.15, "sigma_size_m": 0.015}],
    }  # fmt: skip
    runs = [run_of(name, (1, 2, 3), 1.03, make_robot(name, **wide)) for name in ("a", "b")]
    apart_m = float(np.linalg.norm(np.subtract(PLACES[1], PLACES[3])))
    free = map_runs(runs)
    (metre,) = free.scale_budgets
    assert metre.sigma > 0.02
    assert metre.shares["distances"] == 0.0
    assert np.linalg.norm(tag(free, 1) - tag(free, 3)) < 0.985 * apart_m
    taped = map_runs(runs, distances=[f"1,3={apart_m!r},0.001"])
    (metre,) = taped.scale_budgets
    assert metre.sigma == pytest.approx(0.001 / apart_m, rel=0.01)
    assert metre.shares["distances"] > 0.99
    assert sum(metre.shares.values()) == pytest.approx(1.0)
    np.testing.assert_allclose(tag(taped, 2), PLACES[2], atol=0.005)
    np.testing.assert_allclose(taped.components[0].runs[1].T_map_start, STARTS["b"], atol=0.005)
    scale = {entry.owner: entry.value for entry in taped.calibration if entry.name == "wheel_scale"}
    assert scale == pytest.approx({"a": 0.03, "b": 0.03}, abs=0.002)


def test_a_distance_within_one_run_counts() -> None:
    apart_m = float(np.linalg.norm(np.subtract(PLACES[1], PLACES[2])))
    result = map_runs([run_of("a", (1, 2))], distances=[f"1,2={apart_m + 0.01!r},0.0001"])
    assert np.linalg.norm(tag(result, 1) - tag(result, 2)) == pytest.approx(apart_m + 0.01, abs=1e-4)


def test_a_measurement_between_two_components_is_not_used_and_reported() -> None:
    runs = [run_of("a", (1, 2, 5)), run_of("b", (3, 4))]
    result = map_runs(runs, distances=["1,3=5,0.1"])
    assert len(result.components) == 2
    assert [told.component for told in result.measurements] == [None]
    assert any("--distance tag36h11:1,tag36h11:3: not used" in warning for warning in result.warnings)


def test_tags_outvote_a_start_that_was_written_down_wrong() -> None:
    """One of them was moved, so that they do not all agree."""
    ids = (1, 2, 3, 4, 5)
    runs = [run_of("a", ids), run_of("b", ids, places=PLACES | {5: (2.0, 2.0)})]
    result = map_runs(runs, ["b_one=15,0,2,0.05,0.05,0.02"])
    assert result.alignments[0].is_accepted
    np.testing.assert_allclose(result.alignments[0].T_from_to, STARTS["b"], atol=1e-3)
    assert any("--start b_one: measured (15.000, 0.000) m" in warning for warning in result.warnings)


@pytest.mark.parametrize(
    ("starts", "distances", "told"),
    [
        (["z_one=1,2,3,1,1,1"], [], "the logs hold no run 'z_one'; use one of a_one, b_one"),
        (["a_one=1,2,3,1,1,1"], [], "a_one is the first run, whose start is the frame"),
        (["b_one=1,2,3,1,1,1"] * 2, [], "given twice"),
        ([], ["1,9=1,0.1"], "'9' is neither a run (a_one, b_one) nor a tag"),
    ],
)
def test_what_cannot_be_is_refused(starts: list[str], distances: list[str], told: str) -> None:
    with pytest.raises(OfflineError) as caught:
        map_runs([run_of("a", (1, 2)), run_of("b", (1, 2))], starts, distances)
    assert told in str(caught.value)


def test_the_command_takes_and_prints_them(run: Program, tmp_path: Path) -> None:
    tags = [MadeTag(0, (6.0, 1.0, 0.5), np.pi), MadeTag(1, (6.0, 2.0, 0.4), np.pi)]
    ahead = [(0.0, 0.0, 0.5), (0.5, 0.52, 3.0), (0.5, 0.44, 2.0)]
    for name, at in (("a", [0.0, 0.0, 0.2]), ("b", [0.5, 1.0, -0.1])):
        write_drive(tmp_path / "logs", make_drive(at, ahead), tags, make_robot(name))

    def call(*options: str) -> Outcome:
        return run("map", tmp_path / "logs", "-o", tmp_path / "out", *options)

    done = call("--distance", "a_one,b_one=1.118,0.01", "--start", "b_one=0.69,0.88,-0.3,0.05,0.05,0.05")
    assert (done.code, done.err) == (0, "")
    assert "measured a_one to b_one: 1.118 m in the map" in done.out
    assert "measured start of b_one: x 0.689 m, y 0.881 m" in done.out
    assert "scale: known to" in done.out
    for option, given, told in (
        ("--start", "b_one=nan,0,0,1,1,1", "'nan' is not a number"),
        ("--distance", "0,0=1,1", "must name two different"),
        ("--distance", "0,1=1,-1", "sigma_m is -1, must be from 1e-05 to 1000"),
    ):
        refused = run("map", tmp_path / "logs", "-o", tmp_path / "none", option, given)
        assert refused.code == 1
        assert told in refused.err
        assert refused.err.count("\n") == 1
        assert not (tmp_path / "none").exists()


def tag(result: MapResult, tag_id: int) -> FloatArray:
    (place,) = [each.position_m for each in result.components[0].tags if each.tag_id == tag_id]
    return place
