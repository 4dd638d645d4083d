"""Budgets: how much work a small file may cause, and that drives stay far below it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.foundation.workers import Workers
from groundsbot.offline.importing.csv.importer import import_folder
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.measurements.run import load_run
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.outliers.split_drives import split_at_breaks
from groundsbot.offline.sam.budget import Budget, BudgetSpentError, budgets_of, step_work
from groundsbot.offline.sam.graph import build_graph
from groundsbot.offline.sam.minimisation import MAX_STEPS
from groundsbot.offline.sam.solver import Solution, solve
from groundsbot.offline.self_calibration.information import robot_information
from groundsbot.offline.self_calibration.self_calibration import free_parameters
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.trust.breaks_study import broken_drive
from tests.support.data.logs import START_NS
from tests.support.data.long_drives import make_long_drive, make_town
from tests.support.hostile.log_bytes import MS
from tests.support.hostile.logs import observe, resets

# As few as noise can be packed into.
BYTES_A_LOOK = 50
BYTES_A_OBSERVATION = 12


def write_file(data: bytes, folder: Path) -> Path:
    path = folder / "made.mcap"
    path.write_bytes(data)
    return path


def refusal(log: Path) -> str:
    with pytest.raises(OfflineError) as refused:
        load_run(log)
    (line,) = str(refused.value).splitlines()
    return line


def test_more_tags_than_all_families_have_are_refused(tmp_path: Path) -> None:
    line = refusal(write_file(observe(652), tmp_path))
    assert line.endswith(
        "made.mcap: 653 different tags, limit 652 (as many as all families have); correct the tag ids in it"
    )
    assert len(load_run(write_file(observe(651), tmp_path)).tags) == 652


@pytest.mark.parametrize(("size_bytes", "most"), [(1 << 18, 17), (1 << 20, 25), (1 << 22, 40)])
def test_more_restarts_of_the_controller_than_the_limit_of_the_log_are_refused(
    tmp_path: Path, size_bytes: int, most: int
) -> None:
    log = write_file(resets(most + 2, 1, size_bytes=size_bytes), tmp_path)
    line = refusal(log)
    assert "made.mcap" in line
    assert f"restarted {most + 1} times, limit {most} for a log of {log.stat().st_size} bytes" in line
    assert len(load_run(write_file(resets(most + 1, 1, size_bytes=size_bytes), tmp_path)).wheel_segments) == most + 1


def test_more_observations_than_a_log_of_its_size_can_hold_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_file(observe(4000, 10), tmp_path)
    assert len(load_run(log).positions.tag) == 8000
    monkeypatch.setattr("groundsbot.offline.measurements.tag_messages._FREE_OBSERVATIONS", 0)
    most = log.stat().st_size // 10
    assert most < 8000
    assert f"more than {most} tag observations, the limit for a log of {log.stat().st_size} bytes" in refusal(log)


def test_a_dense_import_is_used_whole(tmp_path: Path) -> None:
    """Ten tags a look at fifty looks a second, to the millimetre: as much as a robot records, in as few bytes."""
    rng = np.random.default_rng(3)
    folder = tmp_path / "dense"
    folder.mkdir()
    times = np.arange(2000) / 50.0
    rows = [
        f"{t:.3f},{tag},{3.0 + 0.1 * tag + 0.01 * noise[0]:.3f},{0.1 * tag - 0.5 + 0.005 * noise[1]:.4f}"
        for t in times
        for tag, noise in enumerate(rng.standard_normal((10, 2)))
    ]
    speeds = [f"{t:.3f},0.500,{0.01 * each:.4f}" for t, each in zip(times, rng.standard_normal(2000), strict=True)]
    (folder / "odometry.csv").write_text("\n".join(["t_s,v_m_s,omega_rad_s", *speeds]))
    (folder / "observations.csv").write_text("\n".join(["t_s,tag_id,range_m,bearing_rad", *rows]))
    import_folder(folder, tmp_path / "logs", ImportOptions())
    (log,) = find_logs([tmp_path / "logs"])
    assert sum(each.stat().st_size for each in log.rglob("*.mcap")) < 24 * len(rows)
    run = load_run(log)
    assert len(run.positions.tag) == len(rows)
    assert not [each for each in run.warnings if "one picture in" in each]


def test_detections_beyond_the_limit_of_the_log_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("groundsbot.offline.measurements.tag_messages._FREE_TO_USE", 0)
    monkeypatch.setattr("groundsbot.offline.measurements.tag_messages._BYTES_TO_USE", 64)
    log = write_file(observe(2000, 10), tmp_path)
    size = log.stat().st_size
    every = -(-4000 // (size // 64))
    assert every > 1
    run = load_run(log)
    used_ns = [START_NS + index * 100 * MS for index in range(0, 2000, every)]
    assert run.positions.stamps_ns.tolist() == [each for each in used_ns for _ in range(2)]
    assert len(run.wheel_segments[0].stamps_ns) == 2000
    (warning,) = [each for each in run.warnings if "one picture in" in each]
    assert (
        warning
        == f"gb1_r: 4000 tag observations exceed what is used of a log of {size} bytes; one picture in {every} is used"
    )


def test_a_picture_that_is_left_out_is_not_one_that_saw_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("groundsbot.offline.measurements.tag_messages._FREE_TO_USE", 0)
    monkeypatch.setattr("groundsbot.offline.measurements.tag_messages._BYTES_TO_USE", 64)
    run = load_run(write_file(resets(1, 3, 500), tmp_path))
    assert 0 < len(run.picture_stamps_ns) < 500
    assert len(run.detections.tag) == 3 * len(run.picture_stamps_ns)
    assert set(run.detections.stamps_ns) == set(run.picture_stamps_ns)


def test_observations_that_are_too_much_to_solve_are_refused_before_the_work(tmp_path: Path) -> None:
    (segment,) = segments_of(load_run(write_file(observe(80, 650, 100), tmp_path)), NoiseParameters())
    with pytest.raises(OfflineError) as refused:
        solve_local_map(segment)
    (line,) = str(refused.value).splitlines()
    for words in ("made.mcap: gb1_r: 8000 observations of 650 tags from 80 keyframes", "limit 1.0e9", "leave out some"):
        assert words in line


def test_segments_with_more_tags_than_their_log_can_hold_are_refused(tmp_path: Path) -> None:
    run = load_run(write_file(resets(3, 400, size_bytes=1_010_000), tmp_path))
    segments = segments_of(run, NoiseParameters())
    assert len(budgets_of(segments[:2])) == 2
    with pytest.raises(OfflineError, match="gb1_r_stretch3: the run's segments observe more tags"):
        budgets_of(segments)


def test_a_log_with_too_many_tags_is_refused_before_self_calibration_solves_sections(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their tags are seen once each, and unconfirmed tags are left out there: the refusal came 50 s later."""
    run = load_run(write_file(resets(3, 400, size_bytes=1_010_000), tmp_path))
    monkeypatch.setattr(
        "groundsbot.offline.self_calibration.self_calibration.estimate_start_values",
        lambda *_: pytest.fail("sections are solved"),
    )
    with pytest.raises(OfflineError, match="gb1_r_stretch3: the run's segments observe more tags"):
        free_parameters([run], NoiseParameters(), (), Stages(), Workers(), corners=False)


def test_segments_share_the_budget_of_their_log(monkeypatch: pytest.MonkeyPatch) -> None:
    segment = make_long_drive(4, 100.0).segment
    segment = replace(segment, run=replace(segment.run, log_bytes=0))
    work = step_work(build_graph([segment]).problem)
    monkeypatch.setattr("groundsbot.offline.sam.budget._FREE_WORK", 2.5 * 30 * work)
    assert len(budgets_of([segment] * 2)) == 2
    with pytest.raises(OfflineError, match="multiplications"):
        budgets_of([segment] * 3)


def test_each_segment_has_its_share_of_the_budget_of_its_log(tmp_path: Path) -> None:
    run = load_run(write_file(resets(3, 10, 20), tmp_path))
    segments = [segment.part(0, 5 * (i + 1)) for i, segment in enumerate(segments_of(run, NoiseParameters()))]
    whole, budgets = Budget.of_log(run.log_bytes), budgets_of(segments)
    assert sum(each.allowed for each in budgets) == pytest.approx(whole.allowed)
    assert [each.allowed / budgets[0].allowed for each in budgets] == pytest.approx(
        [len(segment.stamps_ns) / len(segments[0].stamps_ns) for segment in segments]
    )
    assert [each.left for each in budgets] == [each.allowed for each in budgets]


def test_the_budget_grows_with_the_size_of_the_log() -> None:
    small, large = Budget.of_log(1 << 20), Budget.of_log(10 << 20)
    with pytest.raises(BudgetSpentError):
        small.charge(1e11)
    large.charge(1e11)


def test_a_solve_takes_no_more_tries_than_it_may(tmp_path: Path) -> None:
    """A step may take seven, and one that was begun is ended."""
    (segment,) = segments_of(load_run(write_file(resets(1, 10, 60), tmp_path)), NoiseParameters())
    graph = build_graph([segment])
    start = graph.start(np.zeros((len(segment.stamps_ns), 3)), {}, {})
    whole, some = solve(graph.problem, start), solve(graph.problem, start, most_tries=5)
    assert 5 < some.n_linearised <= 1 + 5 + 6 < whole.n_linearised
    assert some.reason.startswith("stopped after ")


def test_self_calibration_keeps_to_the_budget_of_the_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (segment,) = segments_of(load_run(write_file(resets(1, 10, 100), tmp_path)), NoiseParameters())
    budget = Budget(2e9, 1e9)
    found, taken = solve_local_map(segment, budget), list[float]()

    def counted(*args: object, **kwargs: object) -> Solution:
        solution = solve(*args, **kwargs)  # type: ignore[arg-type]  # as it was called
        taken.append(solution.n_linearised * step_work(solution.problem))
        return solution

    monkeypatch.setattr("groundsbot.offline.local_map.goodness_of_fit.solve", counted)
    robot_information([found], segment.run.robot, NoiseParameters(), [budget], corners=False)
    assert 0.0 < sum(taken) < 0.5 * budget.allowed


def test_a_search_for_breaks_beyond_the_budget_is_reported() -> None:
    local_map = solve_local_map(broken_drive("carried", 1).drive.segment)
    maps, warnings = split_at_breaks([local_map], [Budget(1e8, 1e9)])
    assert maps == [local_map]
    (warning,) = warnings
    assert "search for breaks of odometry was not finished within the budget for a log of this size" in warning


def test_a_log_that_contradicts_itself_all_along_is_mapped_with_little_work(tmp_path: Path) -> None:
    """Tags seem to travel along with the robot. That is said, not refused."""
    (segment,) = segments_of(load_run(write_file(observe(1500, 20), tmp_path)), NoiseParameters())
    budget = Budget(6e9, 1e9)
    found = solve_local_map(segment, budget)
    assert not found.goodness.fits
    assert "contradict each other" in found.goodness.warnings("it")[0]
    assert budget.left > -0.5 * budget.allowed


@pytest.mark.parametrize(("length_m", "picture_every"), [(250.0, 1), (500.0, 5)])
def test_a_drive_past_many_tags_is_not_held_back(length_m: float, picture_every: int) -> None:
    """Even where its log is as small as it can be."""
    segment = make_long_drive(3, length_m, picture_every, town=make_town(3, (0.5, 1.5))).segment
    log_bytes = BYTES_A_LOOK * len(segment.stamps_ns) + BYTES_A_OBSERVATION * len(segment.observations.tag)
    budget = Budget.of_log(log_bytes)
    found = solve_local_map(segment, budget)
    assert found.solution.converged
    assert found.goodness.fits
    assert budget.left > 0.5 * budget.allowed
    assert budget.max_linearisations(found.graph.problem, 0.2) >= 0.5 * MAX_STEPS
    everything = solve_local_map(segment, Budget.of_log(1 << 30))
    np.testing.assert_allclose(found.T_start_base, everything.T_start_base, atol=1e-9)
