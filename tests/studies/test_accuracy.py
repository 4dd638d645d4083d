"""The study of accuracy in small: tests/benchmarks/accuracy/against_bound.py."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.fixtures.drives.calibration import nominal_robot
from groundsbot.fixtures.simulate import simulate
from groundsbot.fixtures.worlds.world import Noise, load_world
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from tests.benchmarks.accuracy.accuracy_study import Figures, figures_of
from tests.benchmarks.accuracy.against_bound import (
    METHODS,
    Drives,
    Method,
    Tally,
    broken_pairs,
    exact,
    rough,
    run_study,
    study_worlds,
    with_wide_priors,
)
from tests.benchmarks.accuracy.cramer_rao_world import bound_of
from tests.benchmarks.accuracy.from_truth import most_likely_from_truth

COLUMNS = [
    "world", "method", "seeds", "start_to_start_rmse_m", "tags_rmse_m", "trajectory_rmse_m", "bound_start_to_start_m",
    "bound_tags_m", "nees_tags_per_dim", "nees_start_per_dim",
]  # fmt: skip


def test_some_seeds_of_the_room_by_every_method(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = tmp_path / "build" / "accuracy.jsonl"
    methods, seeds = ["dead reckoning", "paper", "2D"], range(4)
    tallies = run_study({"room": load_world("room")}, methods, seeds, output)
    rows = {row["method"]: row for row in map(json.loads, output.read_text().splitlines())}
    assert [list(row) for row in rows.values()] == [COLUMNS] * len(methods)
    assert all(row["world"] == "room" and row["seeds"] == len(seeds) for row in rows.values())
    assert len(capsys.readouterr().out.splitlines()) == 1 + len(methods) * len(seeds)
    two_d, wheels, paper = rows["2D"], rows["dead reckoning"], rows["paper"]
    for what in ("start_to_start", "tags"):
        assert 0.4 < two_d[f"{what}_rmse_m"] / two_d[f"bound_{what}_m"] < 2.5
        assert wheels[f"{what}_rmse_m"] > 1.5 * two_d[f"{what}_rmse_m"]
        # A tag observation with a variance of 25 m^2 says next to nothing beside the wheels.
        assert 0.5 < paper[f"{what}_rmse_m"] / wheels[f"{what}_rmse_m"] < 2.0
    assert two_d["nees_tags_per_dim"] is not None
    assert wheels["nees_tags_per_dim"] is None
    assert [each.broken_bounds() for each in tallies] == [[], [], []]


def test_where_nothing_errs_what_is_compared_with_finds_the_truth(tmp_path: Path) -> None:
    room = load_world("room")
    world = room.model_copy(update={"noise": Noise(**dict.fromkeys(Noise.model_fields, 0.0))})
    simulate(world, 1, tmp_path / "drives", render=False, exact_calibration=True)
    drives = Drives(world, 1, tmp_path / "drives")
    # One in five speeds, each from ticks of 0.15 mm in 10 ms, leaves the paper's scheme some centimetres off.
    for method, near_m in (("dead reckoning", 0.03), ("paper", 0.1)):
        found = figures_of(1, METHODS[method].estimate(drives), drives.truth)
        assert max(found.start_rmse_m, found.tags_rmse_m, found.trajectory_rmse_m) < near_m


def test_what_is_promised_is_held_against_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(METHODS, "sharp", Method(lambda drives: METHODS["2D"].estimate(drives), most_times_bound=1.1))
    bound = bound_of(load_world("room"), 0, exact_calibration=False)
    good = _figures_at(bound.start_to_start_m, bound.tags_m)
    for figures, expected in (
        (good, []),
        (replace(good, start_rmse_m=1.2 * bound.start_to_start_m), ["start_to_start_rmse_m is 1.200"]),
        (replace(good, tags_rmse_m=1.3 * bound.tags_m, nees_tags=1.2), ["tags_rmse_m is 1.300", "nees_tags_per_dim"]),
    ):
        missed = Tally("room", "sharp", [figures], [bound]).broken_bounds()
        assert len(missed) == len(expected)
        assert all(text in sentence for text, sentence in zip(expected, missed, strict=True))
    assert Tally("room", "2D", in_parts=[3]).broken_bounds() == ["room, 2D, seed 3: the map is in parts"]


def test_what_is_found_is_held_against_the_most_likely_map_of_the_same_seeds() -> None:
    bound = bound_of(load_world("room"), 0, exact_calibration=False)
    good = _figures_at(0.03, 0.02)
    worse = replace(good, start_rmse_m=1.03 * good.start_rmse_m)
    elsewhere = replace(good, seed=1, tags_rmse_m=0.5)  # of a seed that the other was not given
    likeliest = Tally("room", "corners from the truth", [good], [bound])
    found = Tally("room", "corners", [worse, elsewhere], [bound, bound])
    (sentence,) = broken_pairs([found, likeliest])
    assert sentence.startswith("room: start_rmse_m is 1.030 times that of the most likely map")
    assert broken_pairs([found]) == broken_pairs([replace(found, figures=[good]), likeliest]) == []


def test_the_most_likely_map_is_where_a_solve_from_the_wheels_ends_too(tmp_path: Path) -> None:
    simulate("room", 1000, tmp_path / "drives", render=False)
    drives = Drives(load_world("room"), 1000, tmp_path / "drives")
    found = build_map(drives.runs, NoiseParameters(), corners=True).components[0]
    likeliest = most_likely_from_truth(drives.runs, drives.truth).components[0]
    assert likeliest.cost == pytest.approx(found.cost, rel=1e-6)
    np.testing.assert_allclose(
        [tag.position_m for tag in likeliest.tags], [tag.position_m for tag in found.tags], atol=1e-4
    )


def test_wide_methods_get_drives_of_uncalibrated_robots_and_their_bound(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Drives] = []

    def estimate(drives: Drives) -> MapResult:
        given.append(drives)
        return METHODS["dead reckoning"].estimate(drives)

    monkeypatch.setitem(METHODS, "wide", Method(estimate, wide=True))
    (tally,) = run_study({"room": load_world("room")}, ["wide"], [0], tmp_path / "accuracy.jsonl")
    (drives,) = given
    wheels = drives.runs[0].robot.wheels
    assert wheels.track_m_sigma == pytest.approx(0.03 * wheels.track_m)
    wide = bound_of(with_wide_priors(load_world("room")), 0, exact_calibration=False)
    assert tally.bounds[0].tags_m == wide.tags_m
    sure = exact(drives.runs[0]).robot
    assert sure.wheels.track_m_sigma == pytest.approx(1e-4 * wheels.track_m_sigma)
    assert sure.mount.yaw_rad_sigma < 1e-5
    assert sure.time_offset_s_sigma < 1e-5
    assert sure.wheels.track_m == wheels.track_m


def _figures_at(start_m: float, tags_m: float) -> Figures:
    return Figures(0, 0.1, start_m, start_m, start_m, tags_m, tags_m, tags_m, 1.0, 1.0)


def test_the_worlds_of_the_study_are_what_its_page_says() -> None:
    worlds = study_worlds()
    assert list(worlds) == ["nsh", "nsh_flat", "room", "nsh_rough"]
    assert worlds["nsh_rough"] == rough(worlds["nsh"])
    assert np.degrees(worlds["nsh_rough"].noise.sigma_tilt_rad) == pytest.approx(0.3)
    assert {robot.robot["readout_s"] for robot in worlds["nsh_rough"].robots} == {0.02}
    for world in (with_wide_priors(each) for each in worlds.values()):
        for each in world.robots:
            robot = nominal_robot(world, each)
            wheels = robot.wheels
            assert wheels.radius_left_m_sigma == pytest.approx(0.02 * wheels.radius_left_m)
            assert wheels.track_m_sigma == pytest.approx(0.03 * wheels.track_m)
            assert np.degrees(robot.mount.yaw_rad_sigma) == pytest.approx(1.0)
            assert robot.time_offset_s_sigma == 0.02
            assert robot.tags[0].relative_sigma < 1e-7
