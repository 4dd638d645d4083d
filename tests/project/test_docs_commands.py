"""Every command that README and docs show, unchanged: run, or for a short list of reasons parsed only.

The commands of docs/robot_setup.md are run by test_robot_page, with a robot that is simulated, and python blocks by
test_library. The others run here, page by page in their order, in a folder with small inputs under the names
that the page uses.
"""

import argparse
import importlib
import re
import shlex
import sys
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import yaml
from markdown_it import MarkdownIt
from typer.main import get_command

from groundsbot.calib.robot.robot_yaml import write_robot_yaml
from groundsbot.fixtures.simulate import simulate
from groundsbot.fixtures.worlds import world
from tests.project.test_robot_page import blocks as blocks_of_robot_setup
from tests.support.data.drives import START_NS, MadeTag, S, make_drive, make_robot, write_drive
from tests.support.data.importing.bags import BagOfLog
from tests.support.data.importing.wpilogs import DataLog, add_modules, add_photon, add_speeds, poses, stamps_us
from tests.support.data.importing.wpilogs import good as good_wpilog
from tests.support.paths import ROOT
from tests.support.tag_pictures import draw_tag

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PROGRAMS = {
    "groundsbot-calib": "groundsbot.calib.cli",
    "groundsbot-onboard": "groundsbot.onboard.cli",
    "groundsbot-offline": "groundsbot.offline.cli",
    "python -m groundsbot.fixtures": "groundsbot.fixtures.__main__",
}
# What is no command of ours is neither run nor parsed.
NOT_OURS = {
    "sudo": "changes the computer",
    "python3 -m venv": "installs",
    ".venv/bin/pip": "installs",
    ". .venv/bin/activate": "installs",
    "pip install": "installs",
    "apt-get": "installs",
}
# Ours, but parsed only: the first words, and why.
PARSED_ONLY = {
    "python -m tests.benchmarks": "studies take minutes to hours; each has a small version among the tests",
    "make": "targets take minutes; what they run is tested on its own",
    "groundsbot-onboard check --robot /etc/groundsbot": "on the robot's computer, by its service's paths",
    "groundsbot-onboard check --robot robot.yaml -o logs --page": "serves until stopped; test_check_page stops one",
    "groundsbot-onboard status": "of a recorder that is running; test_robot_page asks one",
    "groundsbot-onboard record --robot robot.yaml --output logs": "runs until stopped; test_robot_page stops one",
    "groundsbot-offline map recordings -o map --scheduler": "takes a cluster; test_map_cluster has one",
    "groundsbot-offline map s3://bucket/drives": "takes a bucket; test_map_urls has other URLs",
    "groundsbot-offline live": "follows recordings until they end; test_live does",
    "groundsbot-calib camera PICTURES": "takes what `camera pictures` does in test_robot_page",
    "groundsbot-calib check camera.yaml PICTURES": "takes what `check camera.yaml fresh` does in test_robot_page",
}
# Words that stand for something, or brackets round what may be left out: how a command is called, not one to type.
PLACEHOLDER = re.compile(r"\b(LOG|OUT|DIR|FOLDER|BAG|FORMAT|FILE|NAME_OR_FILE)\b|\[|\.\.\.")
COMMAND = re.compile(r"(groundsbot-\w+|python -m \w|make \w|sudo |pip |\.venv/bin/pip|\. \.venv|python3|apt-get )")

TAGS = [
    MadeTag(0, (6.0, 1.0, 0.5), np.pi),
    MadeTag(1, (6.0, 2.0, 0.4), np.pi),
    MadeTag(2, (6.0, -1.0, 0.6), np.pi - 0.2),
    MadeTag(3, (5.0, 3.0, 0.45), -2.2),
]
CORNERS_PX = np.array([[600.0, 300.0], [700.0, 300.0], [700.0, 400.0], [600.0, 400.0]])
AHEAD = [(0.0, 0.0, 0.5), (0.5, 0.52, 3.0), (0.5, 0.44, 2.0)]


class Shown(NamedTuple):
    """A command, and the page that shows it."""

    page: str
    text: str


def show_all() -> list[Shown]:
    """All of them in their order, each once a page."""
    found: list[Shown] = []
    for page in PAGES:
        if page.name == "commands.md":  # what the programs themselves say
            continue
        for token in MarkdownIt("commonmark").enable("table").parse(page.read_text(encoding="utf-8")):
            lines = token.content.splitlines() if token.type in ("fence", "code_block") else []
            lines += [child.content for child in token.children or [] if child.type == "code_inline"]
            found += [Shown(page.name, line.strip()) for line in lines if COMMAND.match(line.strip())]
    return list(dict.fromkeys(found))


def is_whole(text: str) -> bool:
    """Whether it says what to do, and not only which command is meant."""
    return len(shlex.split(text)) > (3 if text.startswith("python") else 2) or text.startswith("make ")


def why_not_run(text: str) -> str:
    """Empty where it is run."""
    reasons = [why for words, why in (NOT_OURS | PARSED_ONLY).items() if text.startswith(words)]
    if PLACEHOLDER.search(text) or not is_whole(text):
        reasons.append("tells how a command is called")
    return reasons[0] if reasons else ""


def program_of(text: str) -> tuple[str, list[str]]:
    """Its module, and the words after its name."""
    name = next(name for name in PROGRAMS if text.startswith(name))
    return PROGRAMS[name], shlex.split(text.removeprefix(name))


def parse(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Has the program's own parser parse the arguments."""
    if text.startswith("make "):
        assert re.search(rf"^{text.split()[1]}:", (ROOT / "Makefile").read_text(), re.MULTILINE), text
    elif text.startswith("python -m tests.benchmarks"):
        words = shlex.split(text)
        parse_args = argparse.ArgumentParser.parse_args

        def parsed(self: argparse.ArgumentParser, _args: Any = None) -> None:
            parse_args(self, words[3:])
            raise InterruptedError

        study = importlib.import_module(words[2])
        monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parsed)
        with pytest.raises(InterruptedError):
            study.main()
        monkeypatch.undo()
    else:
        module, words = program_of(re.sub(r"[\[\]]|\.\.\.", "", text).replace("--seed N", "--seed 1"))
        group: Any = get_command(importlib.import_module(module).app)
        assert words[0] in group.commands, text
        if is_whole(text):
            words = ["--format=g2o" if word == "FORMAT" else word for word in words]
            words = [word for word in words if not (word == "--format" and "--format=g2o" in words)]
            group.commands[words[0]].make_context(words[0], words[1:])


def test_every_command_is_run_or_has_a_reason() -> None:
    found = show_all()
    assert len(found) > 60
    for words in NOT_OURS | PARSED_ONLY:
        assert any(each.text.startswith(words) for each in found), f"{words!r} is on no page any more"
    run_here = {each.text for each in found if not why_not_run(each.text)}
    assert len(run_here) > 15


def test_what_is_not_run_is_parsed(monkeypatch: pytest.MonkeyPatch) -> None:
    parsed = [each for each in show_all() if why_not_run(each.text) and not each.text.startswith(tuple(NOT_OURS))]
    assert len(parsed) > 30
    for each in parsed:
        parse(each.text, monkeypatch)


def inputs(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What the pages take for granted: recordings, drives of other programs, and a small world called nsh."""
    for i, (name, start) in enumerate({"a": [0.0, 0.0, 0.2], "b": [0.5, 1.0, -0.1]}.items()):
        drive = make_drive(start, AHEAD)
        write_drive(folder / "recordings", drive, TAGS, make_robot(name), corner_sigma_px=0.3, seed=i)
    for i, day in enumerate(("friday", "saturday")):
        drive = make_drive([0.2, -0.3, 0.1 * i], AHEAD)
        write_drive(folder / day, drive, TAGS, make_robot("a"), corner_sigma_px=0.3, seed=5 + i, run_id=day)
    bag = BagOfLog.of(folder / "recordings" / "a" / "one").odometry().mount().camera_info()
    bag.picture("mono8", draw_tag("tag36h11", 7, CORNERS_PX, (720, 1280)), START_NS + S)
    bag.write(folder / "drive.bag")
    write_robot_yaml(make_robot("a"), folder / "robot.yaml")
    frc_logs(folder)
    simulate("room", 0, folder / "build" / "demo" / "logs", ["a", "c"], render=False)  # in place of `make demo`
    (folder / "field.csv").write_text("tag_id,x_m,y_m\n0,6.0,4.0\n2,6.0,2.0\n3,5.0,6.0\n")  # TAGS, 3 m to the left
    (folder / "survey.csv").write_text("tag_id,x_m,y_m\n0,3.0,-1.0\n1,3.0,0.0\n2,3.0,1.0\n")
    turning = "".join(f"{0.1 * i:.1f},0.5,0.1\n" for i in range(60))
    seen = "".join(f"{0.1 * i:.1f},{i // 3 % 3},{3.0 - 0.05 * i:.2f},{i // 3 % 3 - 1.0}\n" for i in range(0, 60, 3))
    for day in ("monday", "tuesday"):
        (folder / day).mkdir()
        (folder / day / "odometry.csv").write_text("t_s,v_m_s,omega_rad_s\n" + turning)
        (folder / day / "observations.csv").write_text("t_s,tag_id,x_m,y_m\n" + seen)
    hallway = folder / "paper" / "hallway"
    hallway.mkdir(parents=True)
    (hallway / "odom.csv").write_text("".join(f"{i + 1},0.10,0.10\n" for i in range(40)))
    rows = [f"{i + 1},{tag},{3.0 - 0.024 * i:.3f},{tag - 1.0:.3f},0\n" for i in range(0, 40, 4) for tag in range(3)]
    (hallway / "landmarks.csv").write_text("".join(rows))
    small = world.load_world("room").model_dump(mode="json", exclude_none=True)
    small["robots"] = small["robots"][::2]
    (folder / "worlds").mkdir()
    (folder / "worlds" / "nsh.yaml").write_text(yaml.safe_dump(small))
    places = SimpleNamespace(files=lambda _package: folder / "worlds", as_file=resources.as_file)
    monkeypatch.setattr(world, "resources", places)


def frc_logs(folder: Path) -> None:
    """Logs of FRC robots: with two cameras, with a yaw, and of swerve modules alone."""
    match, shop, swerve = DataLog(), good_wpilog(), DataLog()
    add_speeds(match)
    for camera in ("left", "right"):
        add_photon(match, f"/photonvision/{camera}")
    for stamp, pose in zip(stamps_us(), poses(), strict=True):
        yaw = [np.degrees(pose[2]), 0.0, 0.0, 0.0, 0.0, 0.0]
        shop.doubles("NT:/limelight-front/robot_orientation_set", "double[]", stamp, yaw)
    add_modules(swerve, "/Drive/Modules", "SwerveModulePosition[]")
    add_photon(swerve)
    for name, log in (("match", match), ("shop", shop), ("swerve", swerve)):
        log.write(folder / f"{name}.wpilog")


def run_elsewhere(page: str, text: str) -> bool:
    """Whether test_robot_page runs it: all of its own page, and elsewhere what needs a robot or its pictures."""
    own = {line for kind, lines in blocks_of_robot_setup() if kind == "sh" for line in lines.splitlines()}
    needs_robot = text.startswith(("groundsbot-onboard", "groundsbot-calib camera", "groundsbot-calib check"))
    return text in own and (needs_robot or page != "README.md")


def test_commands_run_as_they_stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs(tmp_path, monkeypatch)
    wanted = [each for each in show_all() if not why_not_run(each.text) and not run_elsewhere(*each)]
    assert {each.page for each in wanted} >= {"README.md"}
    for each in wanted:
        # The paper's recordings make a map of their own, in a folder of their own.
        folder = tmp_path / "paper" if re.search(r" (hallway|logs) -o", each.text) else tmp_path
        run(each.text, folder, monkeypatch)
    for made in (
        "demo_view/foxglove_layout.json",
        "map/report.html",
        "trajectories",
        "layout.json",
        "simulated/truth.json",
        "paper/map",
    ):
        assert (tmp_path / made).exists(), made


def run(text: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command in a folder, which must end well."""
    module, words = program_of(text)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", [module, *words])
    with pytest.raises(SystemExit) as ended:
        importlib.import_module(module).main()
    # Real drives contradict the model, which the map of the paper's recordings says by 3.
    expected = (0, 3) if folder.name == "paper" else (0,)
    assert ended.value.code in expected, text
