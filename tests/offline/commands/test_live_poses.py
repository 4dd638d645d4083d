"""`live --map` as programs and people meet it: lines of JSON on a port, lines on the terminal."""

import json
import re
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundsbot.fixtures.simulate import simulate
from groundsbot.offline.commands.live_poses import PosesClock, PosesOptions, follow_poses, pose_json, pose_line
from groundsbot.offline.live.poses import StampedPose
from groundsbot.offline.localization.online.localizer import OnlinePose
from tests.support.data.played_logs import PlayedLog
from tests.support.programs import Run

COVARIANCE = np.diag([0.01, 0.04, 0.0001]) ** 2
POSE = StampedPose("c_one", 1_000_000_000, OnlinePose(np.array([1.0, -2.0, 0.5]), COVARIANCE), "")
UNKNOWN = StampedPose("c_one", 1_000_000_000, None, "no tag of the map was observed yet")


@pytest.fixture(scope="module")
def folder(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    from groundsbot.offline.commands.map_drives import MapOptions, make_map

    output = tmp_path_factory.mktemp("map") / "map"
    make_map(MapOptions([room / "a", room / "b", room / "c"], output, workers=1))
    return output


def test_poses_go_to_programs_and_to_the_terminal(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    simulate("room", 4, tmp_path / "later", ["c"], render=False)
    log, at_s = PlayedLog(tmp_path / "later" / "c" / "seed4", tmp_path / "c"), [0.0]
    clients: list[socket.socket] = []
    said: list[str] = []

    def pause(_seconds: float) -> None:
        said.append(capsys.readouterr().out)
        if not clients:
            (port,) = re.findall(r"poses: port (\d+) of this computer", said[0])
            clients.append(socket.create_connection(("127.0.0.1", int(port)), timeout=120.0))
        at_s[0] += 0.5
        log.play(at_s[0])

    def wall_ns() -> int:
        return 1_767_261_600_000_000_000

    options = PosesOptions([str(tmp_path / "c")], folder / "map.json", poses="0")
    follow_poses(options, PosesClock(lambda: at_s[0], wall_ns, pause))
    with clients[0] as client:
        poses: list[dict[str, Any]] = [json.loads(line) for line in client.makefile()]
    assert len(poses) > 50
    assert {pose["run"] for pose in poses} == {"c_seed4"}
    assert poses[0]["reason"]
    assert np.array(poses[-1]["covariance"]).shape == (3, 3)
    assert [pose["age_s"] for pose in poses] == [round((wall_ns() - pose["stamp_ns"]) * 1e-9, 6) for pose in poses]
    text = "".join(said) + capsys.readouterr().out
    assert f"{tmp_path / 'c'}: holds" not in text
    assert re.search(r"c_seed4: not located: .*; -?[\d.]+ s old", text)
    assert re.search(r"c_seed4: x .* m, y .* m, .* deg \(sigma .*\); -?[\d.]+ s old", text)


def test_runs_that_the_map_was_made_of_are_one_line(run: Run, folder: Path, room: Path) -> None:
    outcome = run("live", room / "c" / "seed3", "--map", folder)
    assert outcome.code == 1
    assert "c_seed3 is in the map already; follow a run that the map was not made of" in outcome.err


def test_a_pose_is_a_line_with_its_age() -> None:
    assert json.loads(pose_json(POSE, 1_020_000_000)) == {
        "run": "c_one",
        "stamp_ns": 1_000_000_000,
        "age_s": 0.02,
        "x_m": 1.0,
        "y_m": -2.0,
        "theta_rad": 0.5,
        "covariance": COVARIANCE.tolist(),
    }
    assert json.loads(pose_json(UNKNOWN, 1_500_000_000))["reason"] == "no tag of the map was observed yet"
    assert pose_line(POSE, 1_250_000_000) == (
        "c_one: x 1.000 m, y -2.000 m, 28.65 deg (sigma 0.010 m, 0.040 m, 0.01 deg); 0.25 s old"
    )
    assert pose_line(UNKNOWN, 1_250_000_000).endswith("not located: no tag of the map was observed yet; 0.25 s old")


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ((), "give either -o, for a map of the runs, or --map"),
        (("-o", "out", "--map", "map"), "give either -o, for a map of the runs, or --map"),
        (("-o", "out", "--poses", "1"), "--poses: is not for -o"),
        (("--map", "map", "--page", "1"), "--page: is not for --map"),
        (("--map", "map", "--overwrite"), "--overwrite: is not for --map"),
        (("--map", "map"), "map: no such folder"),
        (("-o", "out", "--foxglove", "x"), "--foxglove 'x' is not PORT or HOST:PORT"),
        (("-o", "out", "--page", "http://x"), "--page 'http://x' is not PORT or HOST:PORT"),
    ],
)
def test_options_that_do_not_go_together_are_refused(run: Run, options: tuple[str, ...], reason: str) -> None:
    outcome = run("live", "run", *options)
    assert outcome.code in (1, 2)
    assert reason in " ".join(outcome.err.replace("│", " ").split())
