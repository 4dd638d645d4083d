"""Poses in a finished map while a run is recorded: as right as those of the whole run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.fixtures.simulate import simulate
from groundsbot.offline.live.poses import RunLocalizer, StampedPose
from groundsbot.offline.localization.localization import localize
from groundsbot.offline.localization.online.drive import TagMeasurement
from groundsbot.offline.localization.online.localizer import OnlineLocalizer, OnlinePose
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.growing_run import GrowingRun
from groundsbot.offline.measurements.run import load_run
from groundsbot.offline.measurements.run_messages import RunMessages
from groundsbot.onboard.log.messages import PlanarOdometry
from groundsbot.onboard.log.reading.reader import find_logs
from tests.support.data.drives import make_drive, make_robot, write_drive
from tests.support.data.map_cases import TAGS
from tests.support.data.played_logs import PlayedLog


@pytest.fixture(scope="module")
def known(room: Path) -> MapResult:
    runs = read_runs(find_logs([room]))
    result = build_map([replace(run, name=f"earlier_{run.robot_id}") for run in runs])
    assert len(result.components) == 1
    return result


def played(localizer: RunLocalizer, log: PlayedLog, step_s: float) -> list[StampedPose]:
    found, goes_on, at_s = [], True, 0.0
    while goes_on:
        at_s += step_s
        goes_on = log.play(at_s)
        found += localizer.advance()
    return found


def sigmas_between(one: StampedPose, T_map_base: np.ndarray, covariance: np.ndarray) -> float:
    assert one.pose is not None
    off = one.pose.T_map_base - T_map_base
    off[2] = se2.wrap_angle(off[2])
    return float(np.abs(off / np.sqrt(np.diag(covariance))).max())


@pytest.mark.parametrize("step_s", [0.5, 3.0])
def test_the_last_pose_is_that_of_the_whole_run(known: MapResult, room: Path, tmp_path: Path, step_s: float) -> None:
    log = room / "c" / "seed3"
    localizer = RunLocalizer(GrowingRun(tmp_path / "c"), known)
    found = played(localizer, PlayedLog(log, tmp_path / "c"), step_s)
    assert localizer.is_finished
    (whole,) = localize(load_run(log), known, noise=known.noise).runs
    last = found[-1]
    assert sigmas_between(last, whole.T_map_base[-1], whole.covariance[-1]) < 0.5
    assert last.pose is not None
    assert np.sqrt(np.diag(last.pose.covariance)) == pytest.approx(np.sqrt(np.diag(whole.covariance[-1])), rel=0.3)
    stamps_ns = [each.stamp_ns for each in found]
    assert stamps_ns == sorted(stamps_ns)
    assert len(found) > 200


def test_a_gyro_keeps_the_heading_between_tags(tmp_path: Path) -> None:
    """As well as in the whole run solved at once; by the wheels alone the heading has nine times the sigma."""
    simulate("nsh", 1, tmp_path / "logs", render=False, gyro=True)
    first, second = find_logs([tmp_path / "logs"])
    known = build_map(read_runs([first]))
    (whole,) = localize(load_run(second), known, noise=known.noise).runs
    localizer = RunLocalizer(GrowingRun(tmp_path / "played"), known)
    found = played(localizer, PlayedLog(second, tmp_path / "played"), 0.5)
    assert sigmas_between(found[-1], whole.T_map_base[-1], whole.covariance[-1]) < 0.5
    sigmas_rad = [np.sqrt(each.pose.covariance[2, 2]) for each in found if each.pose is not None]
    assert np.mean(sigmas_rad) < 3.0 * np.sqrt(whole.covariance[:, 2, 2]).mean()


def test_before_two_tags_were_seen_the_reason_is_given(known: MapResult, room: Path, tmp_path: Path) -> None:
    log = PlayedLog(room / "c" / "seed3", tmp_path / "c")
    localizer = RunLocalizer(GrowingRun(tmp_path / "c"), known)
    found = played(localizer, log, 0.5)
    assert found[0].pose is None
    assert found[0].reason
    assert found[-1].reason == ""


def test_of_a_place_where_a_robot_stands_each_tag_counts_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    n_observations, whole = [0], OnlineLocalizer.add_observation

    def count(online: OnlineLocalizer, observation: TagMeasurement) -> OnlinePose | None:
        n_observations[0] += 1
        return whole(online, observation)

    monkeypatch.setattr(OnlineLocalizer, "add_observation", count)
    drive = make_drive([0.0, 0.0, 0.2], [(0.0, 0.0, 0.5), (0.5, 0.52, 3.0), (0.0, 0.0, 20.0)])
    log = write_drive(tmp_path / "logs", drive, TAGS, make_robot("a"), corner_sigma_px=0.3)
    known = build_map([replace(run, name="earlier") for run in read_runs([log])])
    localizer = RunLocalizer(GrowingRun(tmp_path / "a"), known)
    log_of_robot = PlayedLog(log, tmp_path / "a")
    log_of_robot.play(5.0)
    localizer.advance()
    n_before = n_observations[0]
    for at_s in range(6, 24):
        log_of_robot.play(at_s)
        assert localizer.advance()[-1].pose is not None
    assert n_before > 10
    assert n_observations[0] <= n_before + 2 * len(TAGS)  # seen at two of its keyframes
    assert len(localizer._growing._collected.wheels) < 500  # what was used is forgotten


def test_a_run_that_the_map_was_made_of_is_refused(room: Path, tmp_path: Path) -> None:
    log = room / "c" / "seed3"
    localizer = RunLocalizer(GrowingRun(log), build_map(read_runs([log])))
    for _ in range(2):  # the reason stays
        assert localizer.advance() == []
        assert "c_seed3 is in the map already" in localizer.trouble
    assert localizer.is_finished


def test_a_run_that_is_not_there_is_waited_for(known: MapResult, room: Path, tmp_path: Path) -> None:
    localizer = RunLocalizer(GrowingRun(tmp_path / "c"), known)
    assert localizer.advance() == []
    assert "no such log" in localizer.trouble
    PlayedLog(room / "c" / "seed3", tmp_path / "c").play(4.0)
    assert localizer.advance()
    assert localizer.trouble == ""
    assert localizer.advance() == []


def test_after_a_reset_of_the_wheel_controller_the_start_is_searched_again(tmp_path: Path) -> None:
    drive = make_drive([0.0, 0.0, 0.2], [(0.0, 0.0, 0.5), (0.5, 0.52, 3.0), (0.5, 0.44, 2.0)])
    n = len(drive.stamps_ns)
    whole = write_drive(tmp_path / "whole", drive, TAGS, make_robot("a"), corner_sigma_px=0.3)
    boots = [7] * (n // 2) + [8] * (n - n // 2)
    log = write_drive(tmp_path / "logs", drive, TAGS, make_robot("a"), boot_of=boots, corner_sigma_px=0.3)
    known = build_map([replace(run, name="earlier") for run in read_runs([whole])])
    localizer = RunLocalizer(GrowingRun(tmp_path / "a"), known)
    found = played(localizer, PlayedLog(log, tmp_path / "a"), 0.5)
    known_at = [each.pose is not None for each in found]
    lost = [i for i in range(1, len(found)) if known_at[i - 1] and not known_at[i]]
    assert len(lost) == 1
    assert known_at[-1]


def test_only_what_the_next_motion_needs_is_kept() -> None:
    """Of each kind the last before the time, where the motion after it begins; so memory does not grow."""
    messages = RunMessages()
    messages.wheels = [(stamp_ns, 1, 0, 0) for stamp_ns in range(10)]
    messages.gyro = [((stamp_ns - 2) * 1_000_000_000, 0.0) for stamp_ns in range(10)]
    for stamp_ns in range(10):
        messages.odometry.add(PlanarOdometry(stamp_ns=stamp_ns, pose=PlanarOdometry.PoseInOdom(x_m=stamp_ns)))
    messages.forget(6, {"": 6})
    assert [each[0] for each in messages.wheels] == [6, 7, 8, 9]
    assert messages.gyro[0][0] == -2_000_000_000  # and of a gyro two seconds, in which a frozen value shows
    assert messages.odometry.stamps_ns.tolist() == messages.odometry.poses[:, 0].tolist() == [6, 7, 8, 9]
    assert len(messages.odometry.wheels_m) == len(messages.odometry.covariances) == 4
