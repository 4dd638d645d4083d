"""Odd and damaged logs that `map` makes a map of all the same, with a sentence where it matters."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.message import Message
from mcap.reader import make_reader

from groundsbot.calib.foundation.command_line import EXIT_WITH_LOSSES
from groundsbot.offline.maps.files import read_map
from groundsbot.onboard.log.messages import RunInfo, WheelEncoders
from tests.support.data.drives import FAMILY, START_NS, MadeTag, make_drive, make_robot, write_drive
from tests.support.data.map_cases import DRIVES, TAGS, rewritten, splice
from tests.support.programs import Run

ZSTD_MAGIC = bytes.fromhex("28b52ffd")  # where a chunk's messages begin


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
    assert "0000.core.mcap.active: was never finished; read up to its end" in outcome.out
    assert {run.log for run in read_map(tmp_path / "out").runs} == {runs / "a", runs / "b"}
    active.write_bytes(data[: end - 7])
    outcome = map_to(runs, "--overwrite")
    assert outcome.code == EXIT_WITH_LOSSES
    assert "lost: b_" in outcome.out


def test_a_run_that_never_moves(map_to: Run, tmp_path: Path) -> None:
    log = write_drive(tmp_path / "logs", make_drive([0.0, 0.0, 0.2], [(0.0, 0.0, 5.0)]), TAGS, make_robot("a"))
    outcome = map_to(log)
    assert outcome.code == 0
    assert "a_one never moves" in outcome.out
    result = read_map(tmp_path / "out")
    assert len(result.components[0].tags) >= 2
    for tag in result.components[0].tags:
        x_m, y_m, _ = next(each for each in TAGS if each.tag_id == tag.tag_id).position_m
        turned = np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]])
        np.testing.assert_allclose(tag.position_m, turned @ [x_m, y_m], atol=1e-4)


def test_a_log_with_a_single_wheel_observation_and_nothing_else(
    map_to: Run, logs: dict[str, Path], tmp_path: Path
) -> None:
    def first_only(message: Message) -> object:
        if isinstance(message, WheelEncoders):
            return message.stamp_ns == START_NS
        return isinstance(message, RunInfo)

    log = rewritten(logs["a"], tmp_path / "short", first_only)
    outcome = map_to(log)
    assert outcome.code == 0
    assert "never moves" in outcome.out


def test_a_run_with_a_single_tag(map_to: Run, logs: dict[str, Path], tmp_path: Path) -> None:
    log = write_drive(tmp_path / "single", DRIVES["b"], TAGS[:1], make_robot("s"))
    outcome = map_to(logs["a"], log)
    assert outcome.code == 3
    assert "s_one saw a single tag, 0; two are needed to align" in outcome.out
    assert "shares only tag 0 with a_one" in outcome.out


def test_tags_on_a_ceiling(map_to: Run, tmp_path: Path) -> None:
    """A camera that looks up; the tags lie flat above it."""
    mount = {"x_m": 0.2, "y_m": 0.0, "z_m": 0.4, "pitch_rad": -0.7}
    ceiling = [MadeTag(i, (2.0 + 0.8 * i, 0.5 * (-1) ** i, 2.6), 0.3 * i, -np.pi / 2) for i in range(5)]
    drive = make_drive([0.0, 0.0, 0.0], [(0.4, 0.4, 6.0)])
    log = write_drive(tmp_path / "logs", drive, ceiling, make_robot("u", mount=mount), corner_sigma_px=0.2)
    outcome = map_to(log)
    assert outcome.code == 0
    assert "is not mounted upright" in outcome.out
    tags = read_map(tmp_path / "out").components[0].tags
    assert len(tags) >= 3
    for tag in tags:
        error_m = tag.position_m - np.array(ceiling[tag.tag_id].position_m[:2])
        assert np.linalg.norm(error_m) < 0.15


def test_a_tag_that_another_robot_carries_about(map_to: Run, tmp_path: Path) -> None:
    """Tag 9 sits on a robot: it was in one place in the first drive, and moves in the second."""
    still = MadeTag(9, (4.0, 0.0, 0.3), np.pi)
    log_a = write_drive(tmp_path / "logs", DRIVES["a"], [*TAGS, still], make_robot("a"))
    parts = []
    for i in range(4):
        carried = replace(still, position_m=(4.0 + 0.3 * i, 1.0 + 0.4 * i, 0.3))
        parts.append(write_drive(tmp_path / f"part{i}", DRIVES["b"], [*TAGS, carried], make_robot("b")))
    outcome = map_to(log_a, splice(parts, tmp_path / "carried"))
    assert outcome.code == 0
    assert re.search(
        r"suspect: tag 9 \(tag36h11\) moving: by [\d.]+ m \(\d+ sigma\) during b_one: in a_one", outcome.out
    )


def test_two_families_in_one_log(map_to: Run, tmp_path: Path) -> None:
    """The same id in both is two tags."""
    both = [*TAGS, MadeTag(0, (6.0, 0.2, 0.7), np.pi, size_m=0.1, family="tag25h9")]
    small = {"family": "tag25h9", "default_size_m": 0.1, "batch": "small"}
    batches = [{"family": FAMILY, "default_size_m": 0.15}, small]
    robot = make_robot("a", tags=batches, recorder={"families": [FAMILY, "tag25h9"]})
    outcome = map_to(write_drive(tmp_path / "logs", DRIVES["a"], both, robot))
    assert (outcome.code, "warning" in outcome.out) == (0, False)
    tags = {(tag.family, tag.tag_id): tag for tag in read_map(tmp_path / "out").components[0].tags}
    assert set(tags) == {(FAMILY, i) for i in range(4)} | {("tag25h9", 0)}
    turned = np.array([[np.cos(0.2), np.sin(0.2)], [-np.sin(0.2), np.cos(0.2)]])
    np.testing.assert_allclose(tags["tag25h9", 0].position_m, turned @ [6.0, 0.2], atol=1e-5)
