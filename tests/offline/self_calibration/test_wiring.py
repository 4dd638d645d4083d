"""Encoders wired otherwise than robot.yaml says are named before anything is mapped, and no others are."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.calib.robot.robot_yaml import write_robot_yaml
from groundsbot.calib.robot.wiring import WIRINGS, Wiring
from groundsbot.fixtures.drives.harsh import Harsh
from groundsbot.fixtures.simulate import simulate
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.foundation.workers import Workers
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.measurements.run import RobotFile, Run, load_run
from groundsbot.offline.self_calibration.wiring_test import check_wiring, fitting_wirings
from groundsbot.onboard.log.reading.reader import find_logs
from tests.support.data.drives import HALL, MadeDrive, make_drive, make_robot, write_drive
from tests.support.programs import Run as Program

AS_SAID = Wiring()
WRONG = [each for each in WIRINGS if each != AS_SAID]
FIELDS = ("encoders_exchanged", "left_encoder_reversed", "right_encoder_reversed")
STRAIGHT = [(0.4, 0.4, 9.0)]


def as_wired(run: Run, wiring: Wiring) -> Run:
    """The run as robot.yaml's wiring would read it, were the encoders truly wired so that `wiring` mends them."""
    segments = []
    for each in run.wheel_segments:
        left_m, right_m = (sign * way for sign, way in zip(wiring.signs, (each.left_m, each.right_m), strict=True))
        left_m, right_m = wiring.order(left_m, right_m)
        segments.append(replace(each, left_m=left_m, right_m=right_m))
    return replace(run, wheel_segments=tuple(segments))


@pytest.fixture(scope="module")
def harsh(tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    folder = tmp_path_factory.mktemp("harsh") / "drives"
    simulate("nsh", 1, folder, render=False, harsh=list(Harsh))
    return read_runs(find_logs([folder]))


@pytest.mark.parametrize("wiring", WIRINGS)
def test_each_wiring_is_found_in_drives_of_seconds_and_in_harsh_ones(
    wiring: Wiring, room: Path, harsh: list[Run]
) -> None:
    for run in [*read_runs(find_logs([room])), *harsh]:
        assert fitting_wirings(as_wired(run, wiring)) == [wiring], run.name


def load_as(log: Path, true: Run, given: dict[str, bool]) -> Run:
    wheels = true.robot.wheels.model_copy(update=given)
    assert true.camera is not None
    file = RobotFile(true.robot.model_copy(update={"wheels": wheels}), {"": true.camera})
    return load_run(log, {true.robot_id: file})


def test_what_is_named_mends_the_drive(tmp_path: Path, room: Path) -> None:
    """From any wiring in robot.yaml to the true one, by the settings that the error names."""
    log = find_logs([room])[0]
    true = load_run(log)
    for wiring in WRONG:
        given = dict(zip(FIELDS, wiring, strict=True))
        with pytest.raises(OfflineError, match="--robot") as caught:
            check_wiring([load_as(log, true, given)], Stages(), Workers())
        settings = str(caught.value).split("; set ")[1].split(" in its robot.yaml")[0].split(" and ")
        named = (each.split(": ") for each in settings)
        given |= {name.removeprefix("wheels."): value == "true" for name, value in named}
        run = load_as(log, true, given)
        check_wiring([run], Stages(), Workers())
        assert not any(given.values()), wiring
        for mine, its in zip(run.wheel_segments, true.wheel_segments, strict=True):
            np.testing.assert_array_equal(mine.left_m, its.left_m)
            np.testing.assert_array_equal(mine.right_m, its.right_m)


def test_map_names_it_in_one_line_and_writes_nothing(run: Program, tmp_path: Path, room: Path) -> None:
    log = find_logs([room])[0]
    robot = load_run(log).robot
    wheels = robot.wheels.model_copy(update={"left_encoder_reversed": True, "right_encoder_reversed": True})
    write_robot_yaml(robot.model_copy(update={"wheels": wheels, "camera": None}), tmp_path / "robot.yaml")
    outcome = run("map", log, "-o", tmp_path / "map", "--robot", tmp_path / "robot.yaml")
    assert outcome.code == 1
    (line,) = outcome.err.strip().splitlines()
    for part in (str(log), "both encoders count backward", "wheels.left_encoder_reversed: false"):
        assert part in line
    assert not (tmp_path / "map").exists()


def test_an_undetermined_wiring_is_not_claimed(tmp_path: Path) -> None:
    """Straight ahead, exchanged encoders look like right ones; those that count backward do not."""
    straight = load_run(write_drive(tmp_path, make_drive([1.0, 2.0, 0.0], STRAIGHT), HALL, make_robot("straight")))
    assert set(fitting_wirings(straight)) >= {AS_SAID, Wiring(exchanged=True)}
    assert AS_SAID in fitting_wirings(as_wired(straight, Wiring(exchanged=True)))
    back = as_wired(straight, Wiring(left_reversed=True, right_reversed=True))
    assert AS_SAID not in fitting_wirings(back)
    with pytest.raises(OfflineError, match="check --push"):
        check_wiring([back], Stages(), Workers())


def test_exact_drives_of_arcs_alone_are_as_wired(tmp_path: Path) -> None:
    legs = [(-0.25, 0.25, 4.0), (0.4, 0.5, 4.0), (0.45, 0.35, 4.0), (-0.3, -0.3, 1.0), (-0.25, 0.25, 4.0)]
    drive: MadeDrive = make_drive([4.5, 2.5, 2.9], legs)
    assert AS_SAID in fitting_wirings(load_run(write_drive(tmp_path, drive, HALL, make_robot("b"))))


def test_a_drive_without_tags_or_motion_is_as_wired(tmp_path: Path) -> None:
    for name, legs in (("still", [(0.0, 0.0, 5.0)]), ("blind", STRAIGHT)):
        tags = HALL if name == "still" else []
        log = write_drive(tmp_path, make_drive([1.0, 2.0, 0.0], legs), tags, make_robot(name))
        assert fitting_wirings(load_run(log)) == [AS_SAID]
