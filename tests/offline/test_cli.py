"""groundsbot-offline as a person meets it: text, JSON, exit codes."""

import json
import shutil
import struct
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from groundsbot.offline.cli import app
from groundsbot.offline.maps.files import write_map
from groundsbot.onboard.log.messages import Event
from tests.support.data.logs import START_NS, Entry, write_log
from tests.support.data.maps import make_component, make_map, make_truth
from tests.support.programs import Run

ODOMETRY = "t_s,left_m_s,right_m_s\n0,0,0\n1,1,1\n2,0.5,1\n"
OBSERVATIONS = "t_s,tag_id,x_m,y_m\n0.5,7,3,1\n1.5,7,2,1\n1.5,9,4,-1\n"


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    folder = tmp_path / "drive"
    folder.mkdir()
    (folder / "odometry.csv").write_text(ODOMETRY)
    (folder / "observations.csv").write_text(OBSERVATIONS)
    return folder


@pytest.fixture
def truth_file(tmp_path: Path) -> Path:
    truth = make_truth(make_component())
    data = {
        "runs": {
            name: {"poses": [[int(t), *map(float, pose)] for t, pose in zip(r.stamps_ns, r.T_world_base, strict=True)]}
            for name, r in truth.runs.items()
        },
        "tags": [
            {"family": family, "tag_id": tag_id, "position_m": [*map(float, place), 1.0], "quaternion_xyzw": None}
            for (family, tag_id, _), place in truth.tags_m.items()
        ],
    }
    path = tmp_path / "truth.json"
    path.write_text(json.dumps(data))
    return path


def test_a_folder_is_imported_and_described(run: Run, drive: Path, tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    outcome = run("import", drive, "-o", logs, "--track-width-m", "0.5")
    assert outcome.code == 0
    assert "3 odometry readings over 2.0 s and 1.75 m; 3 observations of 2 tags" in outcome.out
    assert "each the mean since the row before" in outcome.out
    assert f"wrote {logs / 'drive'}" in outcome.out
    outcome = run("info", logs)
    assert outcome.code == 0
    assert "robot drive, run drive" in outcome.out
    (described,) = json.loads(run("info", logs, "--json").out)
    assert described["distance_m"] == pytest.approx(1.75)


def test_several_recordings_are_imported_as_each_alone(run: Run, drive: Path, tmp_path: Path) -> None:
    shutil.copytree(drive, tmp_path / "other")
    options = ("--track-width-m", "0.5", "--robot-id", "carl")
    for n in (1, 2):
        outcome = run("import", drive, tmp_path / "other", "-o", tmp_path / f"by_{n}", *options, "--workers", n)
        assert (outcome.code, outcome.err) == (0, "")
        assert [line for line in outcome.out.splitlines() if line.startswith("wrote")] == [
            f"wrote {tmp_path / f'by_{n}' / name}" for name in ("drive", "other")
        ]
    for recording in (drive, tmp_path / "other"):
        assert run("import", recording, "-o", tmp_path / "alone", *options).code == 0
    files = [
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (tmp_path / "alone", tmp_path / "by_1", tmp_path / "by_2")
    ]
    assert len(files[0]) == 2
    assert files[0] == files[1] == files[2]


def test_of_several_recordings_all_or_none_is_imported(run: Run, drive: Path, tmp_path: Path) -> None:
    same = tmp_path / "elsewhere" / "drive"
    shutil.copytree(drive, same)
    (tmp_path / "empty").mkdir()
    run("import", drive, "-o", tmp_path / "there", "--track-width-m", "0.5")
    (tmp_path / "file").touch()
    before = sorted(tmp_path.rglob("*"))
    for second, output, options, said in (
        (tmp_path / "empty", "new", (), "empty: holds none of the pairs"),
        (same, "new", (), f"{same}: would be run drive, as {drive} is; import them one by one, with --run-id"),
        (same, "new/deeper", ("--run-id", "a"), "--run-id a: names one run, but there are 2 recordings"),
        (same, "file", (), "file: is not a folder"),
        (same, "empty/../drive", (), "is not empty"),
        (tmp_path / "nowhere", "there", (), "nowhere: is not a folder"),
    ):
        outcome = run("import", drive, second, "-o", tmp_path / output, "--track-width-m", "0.5", *options)
        assert (outcome.code, outcome.out, outcome.err.count("\n")) == (1, "", 1)
        assert said in outcome.err
        assert sorted(tmp_path.rglob("*")) == before


def test_info_describes_the_good_and_names_the_bad(run: Run, drive: Path, tmp_path: Path) -> None:
    run("import", drive, "-o", tmp_path / "logs", "--track-width-m", "0.5")
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_bytes(b"nonsense")
    outcome = run("info", tmp_path / "a.mcap", tmp_path / "logs", tmp_path / "b.mcap")
    assert outcome.code == 1
    assert "run drive" in outcome.out
    assert [line.partition(": ")[0] for line in outcome.err.splitlines()] == ["error", "error"]
    assert "a.mcap" in outcome.err.splitlines()[0]
    assert "b.mcap" in outcome.err.splitlines()[1]
    missing = run("info", tmp_path / "nowhere")
    assert (missing.code, missing.out) == (1, "")
    assert "nowhere" in missing.err


def test_info_of_a_damaged_log_ends_with_exit_code_3(run: Run, drive: Path, tmp_path: Path) -> None:
    run("import", drive, "-o", tmp_path / "logs", "--track-width-m", "0.5")
    (file,) = (tmp_path / "logs").rglob("*.mcap")
    whole = file.read_bytes()
    data_end = whole.index(struct.pack("<BQ", 0x0F, 4))
    file.write_bytes(whole[:data_end] + b"x" * 100 + whole[data_end:])
    outcome = run("info", tmp_path / "logs")
    assert outcome.code == 3
    assert "lost: 1 damaged place of " in outcome.out
    file.unlink()
    file.with_name(file.name + ".active").write_bytes(whole[:data_end])
    outcome = run("info", tmp_path / "logs")
    assert outcome.code == 0
    assert "was never finished" in outcome.out


def test_compare_prints_figures_as_text_and_json(run: Run, truth_file: Path, tmp_path: Path) -> None:
    folder = tmp_path / "map"
    folder.mkdir()
    write_map(make_map(), folder)
    outcome = run("compare", folder, "--truth", truth_file)
    assert outcome.code == 0
    assert "start of red_one to start of blue_two: 10.198 m found, 10.198 m true" in outcome.out
    assert "tags RMSE, without alignment: 0.000 m" in outcome.out
    data = json.loads(run("compare", folder, "--truth", truth_file, "--json").out)
    wanted = {"start_to_start_vector_error_m", "start_to_start_distance_error_m", "start_to_start_percent"}
    wanted |= {"tags_rmse_m", "tags_rmse_aligned_m", "trajectory_rmse_m", "nees_tags_per_dim", "nees_start_per_dim"}
    assert wanted <= set(data)
    assert data["tags_rmse_m"] == pytest.approx(0, abs=1e-9)


def test_compare_without_a_map_is_one_line_and_exit_1(run: Run, truth_file: Path, tmp_path: Path) -> None:
    outcome = run("compare", tmp_path, "--truth", truth_file)
    assert outcome.code == 1
    assert "map.json: cannot be read" in outcome.err
    assert run("compare", tmp_path).code == 2  # wrong usage


def test_control_characters_of_a_log_do_not_reach_the_terminal(run: Run, tmp_path: Path) -> None:
    event = Event(stamp_ns=START_NS, kind="\x1b]0;owned\x07\x1b[2J", text="\x1b[31m")
    write_log(tmp_path / "run1", [Entry("/events", event, START_NS, START_NS)])
    (tmp_path / "a\x1b[2J.mcap").write_bytes(b"no log")
    for command in (("info", tmp_path), ("salvage", tmp_path / "run1", "-o", tmp_path / "new\x1b[31m")):
        outcome = run(*command)
        assert "\x1b" not in outcome.out + outcome.err
        assert "\\x1b" in outcome.out + outcome.err


def test_help_lists_commands_in_groups_with_whole_sentences(run: Run) -> None:
    text = " ".join(run("-h").out.split())
    assert "Recordings: import Make a run log, DIR/RUN_ID/0000.core.mcap, from CSV files, a ROS bag or a" in text
    assert "Maps: map Make one map of all tags and trajectories from the drives in logs. live" in text
    assert "Finished maps: compare" in text
    assert "..." not in text.replace("[ARGS]...", "")
    long = run("map", "-h").out
    assert long.index("\nOptions:") < long.index("\nInputs besides the logs:") < long.index("  --distance")
    assert long.index("  --distance") < long.index("\nEstimate:") < long.index("  --model")


def test_the_example_in_each_help_is_valid(run: Run) -> None:
    group: Any = get_command(app)
    for name, command in group.commands.items():
        example = run(name, "-h").out.rstrip().splitlines()[-1].split()
        assert example[:2] == ["groundsbot-offline", name]
        command.make_context(name, example[2:])
