"""Maps of robots with two cameras, each with its own mount and clock in the estimate."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.robot import NoiseParameters
from groundsbot.fixtures.drives.harsh import Harsh
from groundsbot.fixtures.errors import FixturesError
from groundsbot.fixtures.simulate import TRUTH_FILE, simulate
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import Truth, read_truth
from groundsbot.offline.live.poses import RunLocalizer
from groundsbot.offline.localization.localization import localize
from groundsbot.offline.localization.online.drive import TagMeasurement
from groundsbot.offline.localization.online.localizer import OnlineLocalizer
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.growing_run import GrowingRun
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.onboard.log.reading.reader import find_logs
from tests.benchmarks.trust.camera_study import alone, study_seed
from tests.support.data.played_logs import PlayedLog

Drives = tuple[list[Run], Truth]
OF_CAMERA = ("mount_x_m", "mount_y_m", "mount_yaw_rad", "time_offset_s")


@pytest.fixture(scope="module")
def drives(two_camera_drives: Path) -> Drives:
    return read_runs(find_logs([two_camera_drives])), read_truth(two_camera_drives / TRUTH_FILE)


@pytest.fixture(scope="module")
def mapped(drives: Drives) -> MapResult:
    return build_map(drives[0])


def test_mount_and_clock_of_each_camera_are_found(two_camera_drives: Path, drives: Drives, mapped: MapResult) -> None:
    """Drawn from the sigmas of robot.yaml, they are off by what the map says, which is much less for the yaw."""
    true = json.loads((two_camera_drives / TRUTH_FILE).read_text())["runs"]
    runs = {run.robot_id: run for run in drives[0]}
    errors, yaw_sigmas = [], []
    for each in mapped.calibration:
        name, _, camera = each.name.partition(".")
        if name in OF_CAMERA:
            assert camera in ("front", "left")
            own = runs[each.owner].robot.with_camera(camera)
            given = own.time_offset_s if name == "time_offset_s" else getattr(own.mount, name.removeprefix("mount_"))
            errors.append((given + each.value - true[runs[each.owner].name]["parameters"][each.name]) / each.sigma)
            yaw_sigmas += [each.sigma] if name == "mount_yaw_rad" else []
    assert len(errors) == 3 * 2 * len(OF_CAMERA)
    assert np.abs(errors).max() < 4.0
    assert np.sqrt(np.mean(np.square(errors))) < 1.7
    assert max(yaw_sigmas) < 0.004


def test_tags_are_where_they_are(drives: tuple[list[Run], Truth], mapped: MapResult) -> None:
    errors = evaluate(mapped, drives[1]).components[0]
    assert errors.tags_rmse_aligned_m is not None
    assert errors.tags_rmse_aligned_m < 0.015
    assert errors.nees_tags_per_dim is not None
    assert 0.2 < errors.nees_tags_per_dim < 3.0


def test_what_two_cameras_see_is_what_each_sees(drives: Drives) -> None:
    """A tag in both is two observations; those of a camera are the same as if it were alone."""
    run = drives[0][0]
    (both,) = segments_of(run, NoiseParameters())
    for camera in range(2):
        (one,) = segments_of(alone(run, camera), NoiseParameters())
        own = both.observations.where(both.observations.camera == camera)
        shared = np.isin(both.stamps_ns[own.keyframe], one.stamps_ns)
        assert shared.mean() > 0.5
        values = {
            (int(both.stamps_ns[k]), both.tags[t]): tuple(value)
            for k, t, value in zip(own.keyframe, own.tag, own.value, strict=True)
        }
        same = [
            values.get((int(one.stamps_ns[k]), one.tags[t])) == tuple(value)
            for k, t, value in zip(one.observations.keyframe, one.observations.tag, one.observations.value, strict=True)
        ]
        assert np.mean(same) > 0.5


def test_a_kept_map_is_extended(drives: Drives, mapped: MapResult, tmp_path: Path) -> None:
    """With the observations of each camera as they were: the same shape as of all runs mapped at once."""
    write_map(build_map(drives[0][:2]), tmp_path)
    extended = build_map(drives[0][2:], extending=read_map(tmp_path))
    errors = evaluate(extended, drives[1]).components[0]
    assert len(extended.components) == 1
    assert errors.tags_rmse_aligned_m is not None
    assert errors.tags_rmse_aligned_m < 0.015
    own = {(each.owner, each.name): each.sigma for each in mapped.calibration if ".left" in each.name}
    found = {(each.owner, each.name): each.sigma for each in extended.calibration if ".left" in each.name}
    assert found == pytest.approx(own, rel=0.3)


def test_a_run_is_localised_while_it_is_recorded(two_camera_drives: Path, drives: Drives, tmp_path: Path) -> None:
    """By the tags of both cameras, as well as the whole run at once; a camera that is not there is named."""
    known = build_map([replace(run, name=f"earlier_{run.robot_id}") for run in drives[0]])
    run = drives[0][2]
    (whole,) = localize(run, known, noise=known.noise).runs
    localizer = RunLocalizer(GrowingRun(tmp_path / "c"), known)
    log = PlayedLog(find_logs([two_camera_drives / "c"])[0], tmp_path / "c")
    found, at_s = [], 0.0
    while log.play(at_s := at_s + 0.5):
        found += localizer.advance()
    found += localizer.advance()
    last = found[-1].pose
    assert last is not None
    off = last.T_map_base - whole.T_map_base[-1]
    assert np.abs(off / np.sqrt(np.diag(whole.covariance[-1]))).max() < 0.5
    assert np.sqrt(np.diag(last.covariance)) == pytest.approx(np.sqrt(np.diag(whole.covariance[-1])), rel=0.3)
    online = OnlineLocalizer(known, run.robot)
    with pytest.raises(OfflineError, match="tag 0: the robot has no camera 'rear'; its cameras are 'front', 'left'"):
        online.add_observation(TagMeasurement("tag36h11", 0, np.ones(2), np.eye(2), camera="rear"))


def test_the_study_in_small() -> None:
    found = study_seed("room", 4)
    both, front = found["both"], found["front"]
    assert both is not None
    assert front is not None
    assert both.aligned_m < front.aligned_m


def test_errors_of_the_harsh_world_are_for_one_camera(tmp_path: Path) -> None:
    with pytest.raises(FixturesError, match="--harsh is for robots with one camera"):
        simulate("room", 3, tmp_path / "a", render=False, two_cameras=True, harsh=[next(iter(Harsh))])
