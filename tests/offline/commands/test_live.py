"""`live` as a person meets it: lines while drives go on, then the files of `map`."""

import json
import re
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest

from groundsbot.offline.commands import live_drives
from groundsbot.offline.commands.live_drives import Clock, LiveOptions, follow
from groundsbot.offline.errors import OfflineError
from groundsbot.onboard.log.reading.reader import find_logs
from tests.fixtures.simulated_logs import digests
from tests.support.data.played_logs import PlayedLog, play_all
from tests.support.hostile.page_attacks import free_port
from tests.support.programs import Run


@pytest.fixture
def drives(room: Path, tmp_path: Path) -> list[PlayedLog]:
    return [PlayedLog(log, tmp_path / log.parent.name) for log in find_logs([room / "a", room / "b"])]


class PlayedClock:
    """Time that passes in pauses only, in which logs grow as in a real drive."""

    def __init__(self, drives: list[PlayedLog], seconds_an_update: float = 0.0) -> None:
        self.now_s, self._drives, self._seconds = 0.0, drives, seconds_an_update
        self.pauses: list[float] = []
        self.on_pause: Callable[[], None] = lambda: None

    def clock(self) -> Clock:
        return Clock(self._now_s, self._pause)

    def _now_s(self) -> float:
        self.now_s += self._seconds
        return self.now_s

    def _pause(self, seconds: float) -> None:
        self.pauses.append(seconds)
        self.now_s += 4.0
        play_all(self._drives, self.now_s)
        self.on_pause()


def test_at_the_end_the_files_are_those_of_map(
    drives: list[PlayedLog], run: Run, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    played, output = PlayedClock(drives), tmp_path / "live"
    n_tags: list[int] = []
    played.on_pause = lambda: n_tags.append(len(_interim(output)["tags"])) if output.exists() else None
    follow(LiveOptions([each.copy for each in drives], output, workers=1), played.clock())
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "2 under way: no map yet; 0.00 s"
    assert len([each for each in lines if each.endswith("has observed no tag of a_seed3: 2 join them")]) == 1
    assert [each for each in lines if re.match(r"2 under way, \d+ m: \d tags in ", each)]
    assert [each for each in lines if re.match(r"2 finished, \d+ m: 8 tags in 2 components, shape .*; 0.00 s$", each)]
    assert len(n_tags) > 1
    assert run("map", *(each.copy for each in drives), "-o", tmp_path / "map", "--workers", 1).code in (0, 3)
    assert digests(output) == digests(tmp_path / "map")


def _interim(output: Path) -> dict[str, list[object]]:
    assert [each.name for each in output.iterdir()] == ["map.json"]
    document: dict[str, list[object]] = json.loads((output / "map.json").read_text())
    return document


def test_a_slow_update_is_said_and_followed_by_the_next_at_once(
    drives: list[PlayedLog], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    played = PlayedClock(drives[:1], seconds_an_update=2.5)
    follow(LiveOptions([drives[0].copy], tmp_path / "live", period_s=1.0, workers=1), played.clock())
    assert "2.50 s, longer than the period of 1 s" in capsys.readouterr().out
    assert set(played.pauses) == {0.0}


def test_what_ends_it_leaves_the_last_map(drives: list[PlayedLog], tmp_path: Path) -> None:
    class EndedError(BaseException):
        """As a signal's."""

    def end() -> None:
        if (tmp_path / "live").exists():
            raise EndedError

    played = PlayedClock(drives)
    played.on_pause = end
    with pytest.raises(EndedError):
        follow(LiveOptions([each.copy for each in drives], tmp_path / "live"), played.clock())
    assert _interim(tmp_path / "live")["tags"]
    assert not list(tmp_path.glob("*.partial"))


def test_a_folder_with_content_is_refused_and_an_older_map_replaced_on_demand(
    drives: list[PlayedLog], run: Run, tmp_path: Path
) -> None:
    output = tmp_path / "live"
    output.mkdir()
    (output / "notes.txt").write_text("mine")
    assert "not empty" in run("live", drives[0].copy, "-o", output).err
    assert "no map.json in it" in run("live", drives[0].copy, "-o", output, "--overwrite").err
    (output / "map.json").write_text("an older map")
    drives[0].play(100.0)
    outcome = run("live", drives[0].copy, "-o", output, "--overwrite")
    assert outcome.code in (0, 3)
    assert "1 finished" in outcome.out
    assert f"report: {output / 'report.html'}" in outcome.out
    assert not (output / "notes.txt").exists()


def test_a_full_disk_ends_it_with_one_line(
    drives: list[PlayedLog], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    played = PlayedClock(drives[:1])
    monkeypatch.setattr(live_drives, "atomic_write", fails)
    with pytest.raises(OfflineError, match=r"^-o .*live: cannot be written \(No space left on device\); is the disk"):
        follow(LiveOptions([drives[0].copy], tmp_path / "live"), played.clock())


def test_what_is_missing_is_said_once(
    drives: list[PlayedLog], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = tmp_path / "late"
    played = PlayedClock(drives[:1])

    def arrive() -> None:
        if played.now_s > 30.0 and not late.exists():
            drives[1].play(100.0)
            drives[1].copy.rename(late)

    played.on_pause = arrive
    follow(LiveOptions([drives[0].copy, late], tmp_path / "live", workers=1, page=str(free_port())), played.clock())
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("page: http://127.0.0.1:")
    assert lines[0].endswith(f"/?token={(tmp_path / '.live_token').read_text().strip()}")
    assert len([each for each in lines if each.startswith(f"{late}: no such log")]) == 1
    before_would = [each.partition(" would ")[0] for each in lines if each.startswith("advice: ")]
    assert all(one != other for one, other in pairwise(before_would))
