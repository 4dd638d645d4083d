"""A map that was kept and one more run are what all runs would have given at once; what was kept stays as it is."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import groundsbot
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.archive import arrays_of, segment_from
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.tape import TapeOptions
from tests.support.data.drives import HALL, MadeTag, make_drive, make_robot, write_drive
from tests.support.programs import Run as Program

TAGS = [HALL[i] for i in (0, 1, 2, 6)]
MOVED = [*TAGS[:3], MadeTag(6, (2.4, 4.0, 0.45), -np.pi / 2)]
NOISE = NoiseParameters(sigma_corner_px=0.3)
TAPE = TapeOptions(["b_one=3.15,0.1,2.6,0.05,0.05,0.05"], ["0,1=2.02,0.02"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three logs, the second of a controller that restarted, the third past a tag that was moved; and a map of two."""
    folder = tmp_path_factory.mktemp("extended")
    for name, start, tags in (
        ("a", [1.0, 1.5, 0.3], TAGS),
        ("b", [4.0, 2.5, 2.9], TAGS),
        ("c", [2.0, 2.0, -1.0], MOVED),
    ):
        drive = make_drive(start, [(-0.3, 0.3, 5.0), (0.4, 0.4, 1.5), (-0.3, 0.3, 5.0)], step_ns=50_000_000)
        boots = None if name != "b" else [1 + (i > 130) for i in range(len(drive.stamps_ns))]
        write_drive(folder / "logs", drive, tags, make_robot(name), corner_sigma_px=0.2, boot_of=boots)
    (folder / "map").mkdir()
    write_map(build_map(runs_of(folder, "ab"), NOISE, tape=TAPE), folder / "map")
    return folder


def runs_of(folder: Path, names: str) -> list[Run]:
    return [groundsbot.load_run(folder / "logs" / name / "one") for name in names]


def test_it_is_the_joint_solve_of_all_runs(folder: Path) -> None:
    extended = build_map(runs_of(folder, "c"), extending=read_map(folder / "map"))
    joint = build_map(runs_of(folder, "abc"), NOISE, tape=TAPE)
    (one,), (other,) = extended.components, joint.components
    assert [run.name for run in one.runs] == [run.name for run in other.runs]
    assert [(tag.tag_id, tag.instance) for tag in one.tags] == [(tag.tag_id, tag.instance) for tag in other.tags]
    assert {tag.instance for tag in one.tags if tag.tag_id == 6} == {"a", "b"}  # which was moved
    sigma_m = np.sqrt(np.array([np.diag(tag.covariance) for tag in other.tags]))
    off_m = np.array([a.position_m - b.position_m for a, b in zip(one.tags, other.tags, strict=True)])
    assert np.abs(off_m / sigma_m).max() < 0.01
    spread = one.joint_covariance[3:, 3:], other.joint_covariance[3:, 3:]
    np.testing.assert_allclose(np.sqrt(np.diag(spread[0])), np.sqrt(np.diag(spread[1])), rtol=0.01)
    assert len(extended.measurements) == len(joint.measurements) == 2
    assert extended.warnings == joint.warnings


def test_drives_of_a_robot_left_open_share_its_calibration(tmp_path: Path) -> None:
    """As those that were imported; once extended and twice."""
    robot = make_robot("a", time_offset_s_sigma=0.3)
    for i, name in enumerate(("one", "two", "three")):
        legs = [(-0.3, 0.3, 5.0), (0.4, 0.4, 1.5), (0.3, -0.3, 5.0)]
        drive = make_drive([1.0 + 0.5 * i, 1.5, 0.3], legs, step_ns=50_000_000)
        write_drive(tmp_path, drive, TAGS, robot, corner_sigma_px=0.2, seed=i, run_id=name)
    runs = [groundsbot.load_run(tmp_path / "a" / name).shift_stamps(0.05) for name in ("one", "two", "three")]
    known = build_map(runs[:1], NOISE)
    (before,) = [each for each in known.calibration if each.name == "time_offset_s"]
    assert before.value == pytest.approx(-0.05, abs=0.01)
    for n, run in enumerate(runs[1:], 2):
        known = build_map([run], extending=known)
        (after,) = [each for each in known.calibration if each.name == "time_offset_s"]
        assert after.sigma < before.sigma
        assert after.value == pytest.approx(-0.05, abs=3.0 * before.sigma)
        assert len({(each.owner, each.name) for each in known.calibration}) == len(known.calibration)
        assert len(known.components[0].runs) == n
        before = after


def test_a_fitted_noise_and_what_observations_share_are_held(folder: Path) -> None:
    known = build_map(runs_of(folder, "a"))
    shared = replace(known, noise_fit=replace(known.noise_fit, shared_range=0.2)) if known.noise_fit else known
    extended = build_map(runs_of(folder, "c"), extending=shared)
    assert (extended.noise, extended.noise_fit) == (shared.noise, shared.noise_fit)
    wide, narrow = (
        build_map(runs_of(folder, "c"), extending=each).archived_segments[-1].reading_covariance[:, 0, 0]
        for each in (shared, known)
    )
    assert (wide > 1.1 * narrow).all()


def test_an_extended_map_can_be_extended_and_reads_back(folder: Path, tmp_path: Path) -> None:
    one = build_map(runs_of(folder, "b"), extending=build_map(runs_of(folder, "a"), NOISE))
    write_map(one, tmp_path)
    again = read_map(tmp_path)
    assert [kept.name for kept in again.archived_segments] == ["a_one", "b_one", "b_one_stretch2"]
    two = build_map(runs_of(folder, "c"), extending=again)
    assert [run.name for run in two.runs] == ["a_one", "b_one", "b_one_stretch2", "c_one"]


def test_what_cannot_be_extended_is_refused(folder: Path) -> None:
    known = read_map(folder / "map")

    def told(**changed: object) -> str:
        with pytest.raises(groundsbot.GroundsbotError) as caught:
            build_map(**{"runs": runs_of(folder, "c"), "extending": known} | changed)  # type: ignore[arg-type]
        return str(caught.value)

    assert "is in the map already" in told(runs=runs_of(folder, "a"))
    assert "does not contain its runs' measurements" in told(extending=replace(known, archived_segments=()))
    kept = arrays_of(known.archived_segments[0], "")
    older = kept | {"reading_by_camera": kept["reading_by_camera"][..., :3]}
    assert (segment_from(kept, "") is None, segment_from(older, "")) == (False, None)
    assert "under its own noise" in told(noise=NoiseParameters())
    assert "has no corners" in told(corners=True)


def test_the_command_writes_elsewhere(run: Program, folder: Path, tmp_path: Path) -> None:
    before = contents(folder / "map")
    log, known = folder / "logs" / "c", folder / "map" / "map.json"
    done = run("map", log, "--extend", known, "-o", tmp_path / "out")
    assert (done.code, done.err) == (0, "")
    assert "in one map, in the frame of a_one's start" in done.out
    result: MapResult = read_map(tmp_path / "out")
    assert len(result.archived_segments) == 4
    for options, words in (
        (["-o", folder / "map", "--overwrite"], "inputs are not changed"),
        (["-o", tmp_path / "new", "--noise", folder / "map" / "map.json"], "--noise: a map is extended with its own"),
    ):
        refused = run("map", log, "--extend", known, *options)
        assert (refused.code, refused.err.count("\n")) == (1, 1)
        assert words in refused.err
    assert contents(folder / "map") == before
    assert not (tmp_path / "new").exists()


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}
