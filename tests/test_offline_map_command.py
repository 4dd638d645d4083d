"""`map` as a person meets it: what it says, what it leaves behind, and one line for whatever stands in the way."""

import json
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message
from mcap.reader import make_reader

from calib.camera_file import write_camera_yaml
from calib.command_line import EXIT_WITH_LOSSES
from calib.robot import write_robot_yaml
from offline.map_io import read_map
from onboard.log_head import log_head
from onboard.log_reader import read_log
from onboard.log_writer import LogWriter
from onboard.messages import PlanarOdometry, RunInfo, TagDetections, TagObservation, TagObservations, WheelEncoders
from tests.made_drives import CAMERA, FAMILY, START_NS, MadeTag, S, made_drive, made_robot, write_drive
from tests.programs import Outcome, Run

TAGS = [
    MadeTag(0, (6.0, 1.0, 0.5), np.pi),
    MadeTag(1, (6.0, 2.0, 0.4), np.pi),
    MadeTag(2, (6.0, -1.0, 0.6), np.pi - 0.2),
    MadeTag(3, (5.0, 3.0, 0.45), -2.2),
]
ZSTD_MAGIC = bytes.fromhex("28b52ffd")  # where a chunk's messages begin
AHEAD = [(0.0, 0.0, 0.5), (0.5, 0.52, 3.0), (0.5, 0.44, 2.0)]
DRIVES = {"a": made_drive([0.0, 0.0, 0.2], AHEAD), "b": made_drive([0.5, 1.0, -0.1], AHEAD)}


@pytest.fixture
def map_to(run: Run, tmp_path: Path) -> Run:
    """`groundsbot-offline map ARGUMENTS -o OUT`."""

    def call(*arguments: object, output: Path | None = None) -> Outcome:
        return run("map", *arguments, "-o", output or tmp_path / "out")

    return call


@pytest.fixture
def refused(map_to: Run, tmp_path: Path) -> Callable[..., str]:
    """The one line of a refusal that leaves nothing behind."""

    def call(*arguments: object, output: Path | None = None) -> str:
        before = sorted(tmp_path.rglob("*"))
        outcome = map_to(*arguments, output=output)
        assert outcome.code == 1
        assert outcome.out == ""
        assert outcome.err.startswith("error: ")
        assert outcome.err.count("\n") == 1
        assert sorted(tmp_path.rglob("*")) == before
        return outcome.err

    return call


@pytest.fixture
def logs(tmp_path: Path) -> dict[str, Path]:
    return {name: write_drive(tmp_path / "logs", drive, TAGS, made_robot(name)) for name, drive in DRIVES.items()}


def rewritten(
    log: Path, folder: Path, change: Callable[[Message], object], head: Mapping[str, Message] | None = None
) -> Path:
    """A copy of a log with each message changed in place; those for which `change` is False are left out."""
    entries = list(read_log(log))
    heads: dict[str, Message] = {}
    for entry in entries:
        if change(entry.message) is not False and entry.topic in ("/run", "/camera/calibration", "/tf"):
            heads[entry.topic] = entry.message
    copy = folder / log.name
    with LogWriter(copy, heads | dict(head or {}), START_NS, durable=False) as writer:
        for entry in entries:
            if entry.topic not in heads and change(entry.message) is not False:
                writer.write(entry.topic, entry.message, entry.log_time_ns, entry.publish_time_ns)
    return copy


def test_two_logs_become_one_map(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    outcome = map_to(logs["a"], logs["b"])
    assert (outcome.code, outcome.err) == (0, "")
    for part in ("a_one: ", "4 of 4 shared tags fit", "start of a_one to start of b_one: 1.118 m", "4 tags in one map"):
        assert part in outcome.out
    names = {path.name for path in (tmp_path / "out").iterdir()}
    report = {"report.html"} if find_spec("plotly") else set()
    files = {"map.json", "map.npz", "tags.csv", "map.png", "map.mcap", "a_one.tum", "b_one.tum"}
    assert names == files | report
    assert [tag.tag_id for tag in read_map(tmp_path / "out").components[0].tags] == [0, 1, 2, 3]


def test_a_folder_of_runs_is_several_logs(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    outcome = map_to(tmp_path / "logs", "--json")
    assert outcome.code == 0
    assert [run["run"] for run in json.loads(outcome.out)["runs"]] == ["a_one", "b_one"]


def test_several_components_end_with_exit_3_and_the_reason(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    far = [replace(tag, tag_id=tag.tag_id + 50) for tag in TAGS]
    alone = write_drive(tmp_path / "logs", DRIVES["a"], far, made_robot("c"))
    outcome = map_to(logs["a"], logs["b"], alone)
    assert outcome.code == 3
    assert "c_one shares no tag with the others" in outcome.out
    assert len(read_map(tmp_path / "out").components) == 2


def test_recordings_are_left_alone(map_to: Run, logs: dict[str, Path]) -> None:
    files = sorted(path for log in logs.values() for path in log.iterdir())
    before = [path.read_bytes() for path in files]
    map_to(*logs.values())
    assert [path.read_bytes() for path in files] == before


# What is refused.


def test_no_log(refused: Callable[..., str], tmp_path: Path) -> None:
    assert "nothing-here: no such log" in refused(tmp_path / "nothing-here")
    (tmp_path / "empty").mkdir()
    assert "holds no .mcap file" in refused(tmp_path / "empty")


def test_a_log_without_wheels(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    log = rewritten(logs["a"], tmp_path / "no", lambda message: not isinstance(message, WheelEncoders))
    text = refused(logs["b"], log)
    for part in (str(log), "/wheels", "0 messages", "encoder port"):
        assert part in text


def test_unreadable_files(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    text_file = tmp_path / "notes.mcap"
    for content, reason in (("these are my notes", "is not an MCAP file"), ("", "is empty (0 bytes)")):
        text_file.write_text(content)
        text = refused(text_file)
        assert str(text_file) in text
        assert reason in text
        assert str(text_file) in refused(logs["a"], text_file)


@pytest.mark.parametrize("damage", ["cut short", "one bit"])
def test_a_damaged_log_is_mapped_as_far_as_it_goes(
    map_to: Run, logs: dict[str, Path], tmp_path: Path, damage: str
) -> None:
    whole = (logs["a"] / "0000.core.mcap").read_bytes()
    damaged = tmp_path / "damaged.mcap"
    if damage == "cut short":
        damaged.write_bytes(whole[: len(whole) // 2])
    else:
        flipped = bytearray(whole)
        flipped[whole.index(ZSTD_MAGIC, len(whole) // 2) + 100] ^= 0x10
        damaged.write_bytes(flipped)
    outcome = map_to(damaged)
    assert outcome.code == EXIT_WITH_LOSSES
    assert "damaged.mcap" in outcome.out[outcome.out.index("warning: ") :]
    (said,) = [line for line in outcome.out.splitlines() if line.startswith("lost: ")]
    assert f"what is lost of {damaged}: 1 damaged place of " in said
    found = read_map(tmp_path / "out")
    (run,) = found.runs
    assert run.log == damaged
    assert found.losses == (said.removeprefix("lost: "),)


def test_a_killed_recording_in_a_folder_of_runs_is_mapped_with_a_word(
    map_to: Run, logs: dict[str, Path], tmp_path: Path
) -> None:
    """Its file is still called `.active` and has no end; all whole chunks are there, so nothing is known to be lost."""
    runs = tmp_path / "runs"
    for name in ("a", "b"):
        shutil.copytree(logs[name], runs / name)
    finished = runs / "b" / "0000.core.mcap"
    data = finished.read_bytes()
    finished.unlink()
    with (logs["b"] / "0000.core.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    last = summary.chunk_indexes[-1]
    end = last.chunk_start_offset + last.chunk_length
    active = runs / "b" / "0000.core.mcap.active"
    active.write_bytes(data[:end])
    outcome = map_to(runs)
    assert (outcome.code, outcome.err) == (0, "")
    assert "0000.core.mcap.active: was never finished; read as far as it goes" in outcome.out
    assert {run.log for run in read_map(tmp_path / "out").runs} == {runs / "a", runs / "b"}
    active.write_bytes(data[: end - 7])
    outcome = map_to(runs, "--overwrite")
    assert outcome.code == EXIT_WITH_LOSSES
    assert "lost: b_" in outcome.out


def test_a_camera_file_of_another_size(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    write_robot_yaml(made_robot("a"), tmp_path / "robot.yaml")
    write_camera_yaml(CAMERA.scaled(0.5), tmp_path / "camera.yaml")
    text = refused(logs["a"], "--robot", tmp_path / "robot.yaml")
    for part in (str(logs["a"]), "1280x720", "640x360", "--robot"):
        assert part in text
    (tmp_path / "camera.yaml").unlink()
    assert "camera.yaml" in refused(logs["a"], "--robot", tmp_path / "robot.yaml")


def test_a_tag_size_that_is_missing(refused: Callable[..., str], tmp_path: Path) -> None:
    robot = made_robot("a", tags=[{"family": FAMILY, "sizes_m": {0: 0.15, 1: 0.15, 2: 0.15}}])
    log = write_drive(tmp_path / "logs", DRIVES["a"], TAGS, robot)
    text = refused(log)
    for part in (str(log), FAMILY, "tag 3", "default_size_m", "robot.yaml"):
        assert part in text


def test_a_tag_size_that_is_negative(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    path = tmp_path / "robot.yaml"
    write_robot_yaml(made_robot("a"), path)
    path.write_text(path.read_text().replace("default_size_m: 0.15", "default_size_m: -0.15"))
    text = refused(logs["a"], "--robot", path)
    for part in (str(path), "default_size_m", "-0.15", "above 0"):
        assert part in text.replace("greater than 0", "above 0")


def test_logs_that_disagree_about_a_size(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    other = made_robot("b", tags=[{"family": FAMILY, "default_size_m": 0.16}])
    log = write_drive(tmp_path / "other", DRIVES["b"], TAGS, other)
    text = refused(logs["a"], log)
    for part in (str(log), "tag 0", "0.16", "0.15", "--robot"):
        assert part in text


def test_the_same_run_twice(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    copy = rewritten(logs["a"], tmp_path / "copy", lambda _message: True)
    for twice in ([logs["a"], logs["a"]], [logs["a"], logs["a"] / "0000.core.mcap"], [logs["a"], copy]):
        text = refused(*twice)
        for part in ("run one of robot a", "twice", "leave one out"):
            assert part in text


def test_an_output_folder_that_is_not_empty(
    refused: Callable[..., str], map_to: Run, logs: dict[str, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.tex").write_text("years of work")
    text = refused(logs["a"])
    for part in (str(out), "not empty", "--overwrite"):
        assert part in text
    assert "map.json" in refused(logs["a"], "--overwrite")
    assert (out / "thesis.tex").read_text() == "years of work"
    text = refused(logs["a"], output=out / "thesis.tex")
    assert "is a file" in text
    assert "recordings stay" in refused(logs["a"], output=logs["a"])


def test_a_map_is_replaced_only_when_told_so(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    assert map_to(logs["a"]).code == 0
    assert map_to(logs["a"], logs["b"]).code == 1
    assert len(read_map(tmp_path / "out").runs) == 1
    assert map_to(logs["a"], logs["b"], "--overwrite").code == 0
    assert len(read_map(tmp_path / "out").runs) == 2


def test_a_disk_that_is_full_leaves_everything_as_it_was(
    map_to: Run, refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert map_to(logs["a"]).code == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()}

    def full(_result: object, path: Path) -> None:
        path.write_bytes(b"half a pic")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("offline.map_command.write_picture", full)
    assert "No space left on device" in refused(logs["b"], "--overwrite")
    assert {path.name: path.read_bytes() for path in (tmp_path / "out").iterdir()} == before
    assert "No space left on device" in refused(logs["b"], output=tmp_path / "new")


def test_odometry_that_is_no_number(refused: Callable[..., str], tmp_path: Path) -> None:
    for i, value in enumerate((np.nan, np.inf, 1e300)):
        log = imported_log(tmp_path / "logs" / str(i), odometry_m=value)
        text = refused(log)
        for part in (str(log), "/odometry", "wheels.left_m", f"{value:g}", "reading 3"):
            assert part in text


def test_ticks_that_no_wheel_can_count(refused: Callable[..., str], logs: dict[str, Path], tmp_path: Path) -> None:
    def leap(message: Message) -> object:
        if isinstance(message, WheelEncoders) and message.stamp_ns == START_NS + S:
            message.ticks_left = 2**61
        return True

    log = rewritten(logs["a"], tmp_path / "leap", leap)
    text = refused(log)
    for part in (str(log), "/wheels", "100 m/s"):
        assert part in text


def imported_log(folder: Path, odometry_m: float = 0.2, place_m: float = 3.0) -> Path:
    robot = made_robot("i")
    head = log_head(robot, robot.model_dump_json(), None, "one", START_NS, 0)
    log = folder / "one"
    with LogWriter(log, head, START_NS, durable=False) as writer:
        for i, left_m in enumerate((0.0, 0.1, odometry_m, 0.3, 0.4)):
            at = START_NS + i * S
            distances = PlanarOdometry.WheelDistances(left_m=left_m, right_m=0.1 * i)
            writer.write("/odometry", PlanarOdometry(stamp_ns=at, wheels=distances), at, at)
            places = [TagObservation.Cartesian(x_m=place_m if i == 2 else 3.0 - 0.1 * i, y_m=y) for y in (1.0, -1.0)]
            seen = [TagObservation(family=FAMILY, tag_id=j, cartesian=place) for j, place in enumerate(places)]
            writer.write("/tags/observations", TagObservations(stamp_ns=at, frame="base", observations=seen), at, at)
    return log


# What is mapped all the same, with a sentence where it matters.


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_tag_places_that_are_no_number_are_left_out(map_to: Run, tmp_path: Path, value: float) -> None:
    outcome = map_to(imported_log(tmp_path / "logs", place_m=value))
    assert outcome.code == 0
    assert "2 of 10 tag positions left out" in outcome.out


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_corners_that_are_no_number_are_left_out(
    map_to: Run, logs: dict[str, Path], tmp_path: Path, value: float
) -> None:
    def spoil(message: Message) -> object:
        if isinstance(message, TagDetections):
            for detection in message.detections:
                if detection.tag_id == 3:
                    detection.corners_px[5] = value
        return True

    outcome = map_to(rewritten(logs["a"], tmp_path / "spoilt", spoil), logs["b"])
    assert outcome.code == 0
    assert "tag 3 (tag36h11) was detected, but no reading of it can be used" in outcome.out
    tags = {tag.tag_id: tag for tag in read_map(tmp_path / "out").components[0].tags}
    assert tags[3].runs == ("b_one",)


def test_a_run_that_never_moves(map_to: Run, tmp_path: Path) -> None:
    log = write_drive(tmp_path / "logs", made_drive([0.0, 0.0, 0.2], [(0.0, 0.0, 5.0)]), TAGS, made_robot("a"))
    outcome = map_to(log)
    assert outcome.code == 0
    assert "a_one never moves" in outcome.out
    result = read_map(tmp_path / "out")
    assert len(result.components[0].tags) >= 2
    for tag in result.components[0].tags:
        x_m, y_m, _ = next(each for each in TAGS if each.tag_id == tag.tag_id).position_m
        turned = np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]])
        np.testing.assert_allclose(tag.position_m, turned @ [x_m, y_m], atol=1e-4)


def test_a_log_with_a_single_wheel_reading_and_nothing_else(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    def first_only(message: Message) -> object:
        if isinstance(message, WheelEncoders):
            return message.stamp_ns == START_NS
        return isinstance(message, RunInfo)

    log = rewritten(logs["a"], tmp_path / "short", first_only)
    outcome = map_to(log)
    assert outcome.code == 0
    assert "never moves" in outcome.out


def test_a_run_with_a_single_tag(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    log = write_drive(tmp_path / "single", DRIVES["b"], TAGS[:1], made_robot("s"))
    outcome = map_to(logs["a"], log)
    assert outcome.code == 3
    assert "s_one saw a single tag, 0; two are needed" in outcome.out
    assert "shares only tag 0 with a_one" in outcome.out


def test_tags_on_a_ceiling(map_to: Run, tmp_path: Path) -> None:
    """A camera that looks up; the tags lie flat above it."""
    mount = {"x_m": 0.2, "y_m": 0.0, "z_m": 0.4, "pitch_rad": -0.7}
    ceiling = [MadeTag(i, (2.0 + 0.8 * i, 0.5 * (-1) ** i, 2.6), 0.3 * i, -np.pi / 2) for i in range(5)]
    drive = made_drive([0.0, 0.0, 0.0], [(0.4, 0.4, 6.0)])
    log = write_drive(tmp_path / "logs", drive, ceiling, made_robot("u", mount=mount), corner_sigma_px=0.2)
    outcome = map_to(log)
    assert outcome.code == 0
    assert "does not hang upright" in outcome.out
    tags = read_map(tmp_path / "out").components[0].tags
    assert len(tags) >= 3
    for tag in tags:
        error_m = tag.position_m - np.array(ceiling[tag.tag_id].position_m[:2])
        assert np.linalg.norm(error_m) < 0.15


def test_a_tag_that_another_robot_carries_about(map_to: Run, tmp_path: Path) -> None:
    """Tag 9 sits on a robot: it was in one place in the first drive, and moves in the second."""
    still = MadeTag(9, (4.0, 0.0, 0.3), np.pi)
    log_a = write_drive(tmp_path / "logs", DRIVES["a"], [*TAGS, still], made_robot("a"))
    parts = []
    for i in range(4):
        carried = replace(still, position_m=(4.0 + 0.3 * i, 1.0 + 0.4 * i, 0.3))
        parts.append(write_drive(tmp_path / f"part{i}", DRIVES["b"], [*TAGS, carried], made_robot("b")))
    outcome = map_to(log_a, spliced(parts, tmp_path / "carried"))
    assert outcome.code == 0
    assert re.search(
        r"suspect: tag 9 \(tag36h11\) moving: by [\d.]+ m \(\d+ sigma\) during b_one: in a_one", outcome.out
    )


def spliced(parts: list[Path], folder: Path) -> Path:
    """Pictures in turn from several versions of one drive: something in them moves."""
    per_part = [list(read_log(part)) for part in parts]
    pictures = [i for i, entry in enumerate(per_part[0]) if isinstance(entry.message, TagDetections)]
    entries = list(per_part[0])
    for n, i in enumerate(pictures):
        entries[i] = per_part[n * len(parts) // len(pictures)][i]
    heads = {entry.topic: entry.message for entry in entries if entry.topic in ("/run", "/camera/calibration", "/tf")}
    log = folder / "one"
    with LogWriter(log, heads, START_NS, durable=False) as writer:
        for entry in entries:
            if entry.topic not in heads:
                writer.write(entry.topic, entry.message, entry.log_time_ns, entry.publish_time_ns)
    return log


def test_two_families_in_one_log(map_to: Run, tmp_path: Path) -> None:
    """The same id in both is two tags."""
    both = [*TAGS, MadeTag(0, (6.0, 0.2, 0.7), np.pi, size_m=0.1, family="tag25h9")]
    small = {"family": "tag25h9", "default_size_m": 0.1, "batch": "small"}
    batches = [{"family": FAMILY, "default_size_m": 0.15}, small]
    robot = made_robot("a", tags=batches, recorder={"families": [FAMILY, "tag25h9"]})
    outcome = map_to(write_drive(tmp_path / "logs", DRIVES["a"], both, robot))
    assert (outcome.code, "warning" in outcome.out) == (0, False)
    tags = {(tag.family, tag.tag_id): tag for tag in read_map(tmp_path / "out").components[0].tags}
    assert set(tags) == {(FAMILY, i) for i in range(4)} | {("tag25h9", 0)}
    turned = np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]])
    np.testing.assert_allclose(tags["tag25h9", 0].position_m, turned @ [6.0, 0.2], atol=1e-5)


def test_a_family_without_a_size_is_refused(refused: Callable[..., str], tmp_path: Path) -> None:
    both = [*TAGS, MadeTag(0, (6.0, 0.2, 0.7), np.pi, family="tag25h9")]
    log = write_drive(tmp_path / "logs", DRIVES["a"], both, made_robot("a"))
    text = refused(log)
    for part in (str(log), "tag25h9", "size"):
        assert part in text
