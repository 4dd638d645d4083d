"""Damaged logs: neighbours of the damage are kept, and no message is ever wrong. Rows of the table of faults."""

import shutil
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC
from mcap_protobuf.decoder import DecoderFactory

from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log.messages import TOPICS
from groundsbot.onboard.log.reading.reader import read_log
from tests.support.data.logs import HEADS, ChunkPlace, Seen, chunks_of, drive, read_all, run_info_of, write_log
from tests.support.programs import Run

PAGE_BYTES = 4096
Damage = Callable[[bytes], bytes]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_log(tmp_path_factory.mktemp("small") / "log.mcap", drive(3.0))


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """About 400 kB of core and 600 kB of pictures."""
    return write_log(tmp_path_factory.mktemp("large") / "run1", drive(40.0, wheel_hz=200, picture_hz=5))


def times(short: int, full: int) -> pytest.MarkDecorator:
    """How often a fault is tried: shortened, and in full behind --long."""
    return pytest.mark.parametrize("count", [short, pytest.param(full, marks=pytest.mark.long)])


def damage_file(source: Path, folder: Path, damage: Damage) -> Path:
    path = folder / source.name
    path.write_bytes(damage(source.read_bytes()))
    return path


def cut(start: int, end: int, filling: bytes = b"") -> Damage:
    """Puts something else in the place of [start, end)."""
    return lambda data: data[:start] + filling + data[end:]


def flip(at: int, bit: int) -> Damage:
    return lambda data: data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]


def messages_of(chunks: list[ChunkPlace]) -> list[Seen]:
    return [message for chunk in chunks for message in chunk.messages]


def apart_from(chunks: list[ChunkPlace], start: int, end: int) -> list[Seen]:
    """The messages of all chunks that [start, end) does not touch."""
    return messages_of([chunk for chunk in chunks if chunk.end <= start or chunk.start >= end])


def offsets(size: int, count: int, seed: int = 3) -> list[int]:
    return sorted(np.random.default_rng(seed).integers(0, size, count).tolist())


@times(300, 1 << 30)
def test_row_02_truncated_at_every_offset_of_a_small_log(small: Path, tmp_path: Path, count: int) -> None:
    chunks = chunks_of(small)
    size = small.stat().st_size
    edges = {place + shift for chunk in chunks for place in chunk[:2] for shift in (-1, 0, 1, 9, 10)}
    for end in sorted({*range(9, size, max(1, size // count)), *edges}):
        path = damage_file(small, tmp_path, cut(end, size))
        found, losses = read_all(path)
        assert found == messages_of([chunk for chunk in chunks if chunk.end <= end])
        assert losses


@times(40, 200)
def test_row_02_truncated_at_places_of_a_large_log(large: Path, tmp_path: Path, count: int) -> None:
    for name in ("0000.core.mcap", "0000.camera.mcap"):
        chunks, size = chunks_of(large / name), (large / name).stat().st_size
        for end in offsets(size, count // 2):
            path = damage_file(large / name, tmp_path, cut(end, size))
            assert read_all(path)[0] == messages_of([chunk for chunk in chunks if chunk.end <= end])


@times(20, 200)
def test_row_03_a_tail_of_zeros(small: Path, tmp_path: Path, count: int) -> None:
    chunks = chunks_of(small)
    for end in offsets(chunks[-1].end, count):
        path = damage_file(small, tmp_path, cut(end, 1 << 30, bytes(100 + 7 * end)))
        whole = [chunk for chunk in chunks if chunk.end <= end]
        found, losses = read_all(path)
        if end < 8:
            continue
        assert found == messages_of(whole)
        assert losses.n_places == 1
        assert losses.n_bytes > 0
        with pytest.raises(LogError, match="damaged at byte"):
            list(read_log(path))


@times(60, 200)
def test_row_04_a_flipped_bit_loses_its_chunk_and_no_other(small: Path, tmp_path: Path, count: int) -> None:
    chunks = chunks_of(small)
    rng = np.random.default_rng(4)
    for at in offsets(small.stat().st_size, count):
        path = damage_file(small, tmp_path, flip(at, int(rng.integers(8))))
        found, losses = read_all(path)
        everything, least = messages_of(chunks), apart_from(chunks, at, at + 1)
        assert found in (everything, least)
        assert found == everything or losses


def test_row_04_every_bit_of_every_record_head(small: Path, tmp_path: Path) -> None:
    """Codes and lengths carry no checksum: one bit makes an end mark of an index, or skips what follows."""
    chunks = chunks_of(small)
    for first, second in pairwise(chunks):
        places = [*range(first.start, first.start + 9), *range(first.end, first.end + 9), second.start - 1]
        for at in places:
            for bit in range(8):
                found, _ = read_all(damage_file(small, tmp_path, flip(at, bit)))
                assert found in (messages_of(chunks), apart_from(chunks, at, at + 1)), (at, bit)


@times(30, 100)
def test_row_05_a_page_of_zeros(large: Path, tmp_path: Path, count: int) -> None:
    for name in ("0000.core.mcap", "0000.camera.mcap"):
        chunks = chunks_of(large / name)
        pages = chunks[-1].end // PAGE_BYTES
        for page in sorted(set(offsets(pages, count // 2))):
            start, end = page * PAGE_BYTES, (page + 1) * PAGE_BYTES
            path = damage_file(large / name, tmp_path, cut(start, end, bytes(PAGE_BYTES)))
            found, losses = read_all(path)
            assert found == apart_from(chunks, start, end)
            assert losses.n_lost


def test_row_06_first_chunk_destroyed_without_a_summary(small: Path, tmp_path: Path, run: Run) -> None:
    first, *rest = chunks_of(small)
    broken = damage_file(small, tmp_path, cut(first.start + 60, first.start + 140, b"\xaa" * 80))
    assert read_all(broken)[0] == messages_of(rest)  # the index still has the channels
    unfinished = damage_file(broken, tmp_path, cut(rest[-1].end, 1 << 30))
    found, losses = read_all(unfinished)
    assert found == []
    assert losses.n_undecodable == len(messages_of(rest))
    for command in (("info", unfinished), ("map", unfinished, "-o", tmp_path / "map")):
        outcome = run(*command)
        assert outcome.code == 1
        assert outcome.err.count("\n") == 1
        assert "cannot be decoded" in outcome.err


def test_row_06_the_other_file_says_whose_run_it_is(large: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run1"
    shutil.copytree(large, folder)
    core = folder / "0000.core.mcap"
    first, *rest = chunks_of(core)
    damage_file(core, folder, cut(first.start + 60, first.start + 140, b"\xaa" * 80))
    assert run_info_of(folder).run_id == "run1"
    found, losses = read_all(folder)
    assert [each for each in found if each[0] != "/camera/image"] == messages_of(rest)
    assert losses.n_places == 1


@pytest.mark.parametrize("kept", [0.0, 0.3, 0.999])
def test_row_07_footer_and_summary_destroyed(small: Path, tmp_path: Path, kept: float) -> None:
    chunks = chunks_of(small)
    end = chunks[-1].end + round((small.stat().st_size - chunks[-1].end) * kept)
    for damage in (cut(end, 1 << 30), cut(end, 1 << 30, b"\xff" * 5000)):
        found, losses = read_all(damage_file(small, tmp_path, damage))
        assert found == messages_of(chunks)
        assert losses


@pytest.mark.parametrize("content", [b"", MCAP0_MAGIC, b"t_s,tag_id\n1,2\n" * 900, bytes(10_000)])
def test_row_08_what_is_no_log_is_one_line(tmp_path: Path, run: Run, content: bytes) -> None:
    path = tmp_path / "some.mcap"
    path.write_bytes(content)
    for command in (("info",), ("map", "-o", tmp_path / "map"), ("salvage", "-o", tmp_path / "new.mcap")):
        outcome = run(command[0], path, *command[1:])
        assert outcome.code == 1, command
        assert (outcome.err.count("\n"), outcome.out) == (1, "")
        assert "some.mcap" in outcome.err
    assert sorted(each.name for each in tmp_path.iterdir()) == ["some.mcap"]


def test_row_44_every_topic_decodes_with_the_plain_library(large: Path) -> None:
    """By the schemas in the file, with no class of ours: Foxglove's tools do the same."""
    topics = set()
    for file in sorted(large.iterdir()):
        with file.open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[DecoderFactory()])
            assert reader.get_summary() is not None
            for schema, channel, message, decoded in reader.iter_decoded_messages():
                topics.add(channel.topic)
                assert schema is not None
                assert schema.name == TOPICS[channel.topic].schema.DESCRIPTOR.full_name
                if channel.topic not in HEADS:
                    stamp = decoded.stamp_ns if hasattr(decoded, "stamp_ns") else decoded.timestamp.ToNanoseconds()
                    assert stamp == message.publish_time
    assert topics == {*HEADS, "/wheels", "/tags/detections", "/clock", "/events", "/camera/image"}
