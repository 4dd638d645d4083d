"""A log that is read while it is written: each message once, whatever happens to its files in between."""

from pathlib import Path

import pytest

from groundsbot.onboard.errors import LogError
from groundsbot.onboard.log.reading.decoder import LogMessage
from groundsbot.onboard.log.reading.follower import LogFollower
from groundsbot.onboard.log.reading.reader import read_log
from groundsbot.onboard.log.writing.segments import SegmentLimits
from groundsbot.onboard.log.writing.writer import LogWriter
from tests.support.data.logs import MS, START_NS, Entry, drive, head, wheel_entry

ENTRIES = drive(4.0)
Fact = tuple[str, int, bytes]


def facts(messages: list[LogMessage] | None) -> list[Fact]:
    assert messages is not None
    return [(each.topic, each.log_time_ns, each.message.SerializeToString(deterministic=True)) for each in messages]


def begin(folder: Path, entries: list[Entry], **options: object) -> LogWriter:
    writer = LogWriter(folder, head(), START_NS, durable=False, **options)  # type: ignore[arg-type]
    write(writer, entries)
    return writer


def write(writer: LogWriter, entries: list[Entry]) -> None:
    for entry in entries:
        writer.write(*entry)


def active_file(folder: Path) -> Path:
    (file,) = folder.glob("*.active")
    return file


def without_heads(found: list[Fact]) -> list[Fact]:
    return [each for each in found if each[0] not in head()]


def test_each_message_is_read_once_across_the_rename(tmp_path: Path) -> None:
    follower = LogFollower(tmp_path / "run")
    writer = begin(tmp_path / "run", ENTRIES[:200])
    found = facts(follower.read())
    assert 100 < len(without_heads(found)) < 200
    assert facts(follower.read()) == []
    finished = [follower.is_finished]
    write(writer, ENTRIES[200:])
    found += facts(follower.read())
    writer.close()
    found += facts(follower.read())
    assert [*finished, follower.is_finished] == [False, True]
    assert found == facts(list(read_log(tmp_path / "run")))


def test_a_single_file_is_followed_by_either_of_its_names(tmp_path: Path) -> None:
    log = tmp_path / "drive.mcap"
    writer = begin(log, ENTRIES[:200])
    followers = [LogFollower(log), LogFollower(log.with_name("drive.mcap.active"))]
    found = [facts(each.read()) for each in followers]
    write(writer, ENTRIES[200:])
    writer.close()
    for each, follower in zip(found, followers, strict=True):
        each += facts(follower.read())
        assert each == facts(list(read_log(log)))


def test_a_log_cut_at_any_byte_is_continued_when_the_rest_is_there(tmp_path: Path) -> None:
    begin(tmp_path / "whole", ENTRIES[:120]).flush()
    data = active_file(tmp_path / "whole").read_bytes()
    follower = LogFollower(tmp_path / "cut")
    file = tmp_path / "cut" / "0000.core.mcap.active"
    file.parent.mkdir()
    found: list[Fact] = []
    for end in [*range(40), *range(40, len(data), 97), len(data)]:
        file.write_bytes(data[:end])
        found += facts(follower.read())
    assert without_heads(found) == facts([LogMessage(*each) for each in ENTRIES[:120]])
    assert not follower.losses


def test_a_damaged_place_is_counted_and_passed_over(tmp_path: Path) -> None:
    writer = begin(tmp_path / "run", ENTRIES[:200])
    follower = LogFollower(tmp_path / "run")
    n_before = len(facts(follower.read()))
    size = active_file(tmp_path / "run").stat().st_size
    write(writer, ENTRIES[200:])
    writer.flush()
    with active_file(tmp_path / "run").open("r+b") as stream:
        stream.seek(size + 60)
        stream.write(b"\x00\xff\x00\xff")
    n_after = len(facts(follower.read()))
    assert follower.losses.n_torn == 1
    assert len(ENTRIES) // 4 < n_before + n_after < len(ENTRIES)
    writer.close()
    follower.read()
    assert follower.losses.n_torn == 1


def test_a_run_that_is_not_there_yet_is_read_from_its_beginning(tmp_path: Path) -> None:
    follower = LogFollower(tmp_path / "run")
    with pytest.raises(LogError, match="no such log"):
        follower.read()
    (tmp_path / "run").mkdir()
    with pytest.raises(LogError, match=r"holds no \.mcap file"):
        follower.read()
    begin(tmp_path / "run", ENTRIES).close()
    assert facts(follower.read()) == facts(list(read_log(tmp_path / "run")))


def test_a_log_that_vanished_is_continued_when_it_returns(tmp_path: Path) -> None:
    writer = begin(tmp_path / "run", ENTRIES[:200])
    follower = LogFollower(tmp_path / "run")
    found = facts(follower.read())
    write(writer, ENTRIES[200:])
    writer.close()
    (tmp_path / "run").rename(tmp_path / "away")
    with pytest.raises(LogError):
        follower.read()
    (tmp_path / "away").rename(tmp_path / "run")
    found += facts(follower.read())
    assert found == facts(list(read_log(tmp_path / "run")))


def test_what_was_read_of_one_file_survives_the_failure_of_the_next(tmp_path: Path) -> None:
    begin(tmp_path / "run", ENTRIES, limits=SegmentLimits(2_000 * MS)).close()
    second = tmp_path / "run" / "0001.core.mcap"
    second.rename(tmp_path / "second")
    second.mkdir()  # it cannot be opened
    follower = LogFollower(tmp_path / "run")
    with pytest.raises(LogError, match="cannot be read"):
        follower.read()
    second.rmdir()
    (tmp_path / "second").rename(second)
    assert without_heads(facts(follower.read())) == without_heads(facts(list(read_log(tmp_path / "run"))))


@pytest.mark.parametrize("is_pending", [False, True], ids=["all taken", "messages before an error"])
def test_another_log_in_its_place_is_read_anew(tmp_path: Path, is_pending: bool) -> None:
    begin(tmp_path / "run", ENTRIES).close()
    follower = LogFollower(tmp_path / "run")
    unreadable = tmp_path / "run" / "0001.core.mcap"
    if is_pending:
        unreadable.mkdir()
        with pytest.raises(LogError):
            follower.read()
        unreadable.rmdir()
    else:
        follower.read()
    (tmp_path / "run" / "0000.core.mcap").unlink()
    with LogWriter(tmp_path / "run", head("run2"), START_NS, durable=False) as writer:
        writer.write(*wheel_entry(0, START_NS))
    assert follower.read() is None
    assert facts(follower.read()) == facts(list(read_log(tmp_path / "run")))


def test_pictures_are_not_opened_unless_wanted(tmp_path: Path) -> None:
    begin(tmp_path / "run", ENTRIES, keep_pictures=True).close()
    (tmp_path / "run" / "0000.camera.mcap").write_bytes(b"no log at all")
    assert facts(LogFollower(tmp_path / "run", ["/wheels"]).read())
    with pytest.raises(LogError, match="not an MCAP file"):
        LogFollower(tmp_path / "run").read()
