"""Maps of drives under way: what they hold, what they keep, and what does not stop them."""

from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.fixtures.simulate import TRUTH_FILE
from groundsbot.offline.evaluation.against_truth import evaluate
from groundsbot.offline.evaluation.truth import read_truth
from groundsbot.offline.foundation.workers import Workers
from groundsbot.offline.live import thinning
from groundsbot.offline.live.live_map import LiveMap, Update
from groundsbot.offline.local_map import local_map
from groundsbot.offline.local_map.incremental_solve import solve_incrementally
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import read_robot_file
from groundsbot.onboard.log.reading.reader import find_logs
from tests.support.data.played_logs import PlayedLog, play_all


@pytest.fixture
def drives(room: Path, tmp_path: Path) -> list[PlayedLog]:
    """Two drives in the room, of which nothing is recorded yet."""
    return [PlayedLog(log, tmp_path / log.parent.name) for log in find_logs([room / "a", room / "b"])]


def map_of(update: Update) -> MapResult:
    assert update.result is not None, update
    return update.result


def states(update: Update) -> list[str]:
    return [run.state for run in update.runs]


def test_the_map_grows_with_the_drives_and_is_right_at_each_time(
    drives: list[PlayedLog], room: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("MOST_OBSERVATIONS", "MOST_EMPTY_PICTURES", "MOST_WHEEL_READINGS"):
        monkeypatch.setattr(thinning, name, 1_000_000)
    truth, live = read_truth(room / TRUTH_FILE), LiveMap([each.copy for each in drives])
    n_tags, goes_on, until_s = [], True, 0.0
    while goes_on:
        until_s += 4.0
        goes_on = play_all(drives, until_s)
        result = map_of(live.update())
        n_tags.append(sum(len(each.tags) for each in result.components))
        for errors in evaluate(result, truth).components:
            assert errors.nees_tags_per_dim is None or errors.nees_tags_per_dim < 5.0
    assert len(n_tags) > 2
    assert n_tags[0] < n_tags[-1]
    assert [run.n_keyframes for run in map_of(live.update()).runs] == [
        run.n_keyframes for run in build_map(read_runs([each.copy for each in drives])).runs
    ]


def test_runs_are_under_way_until_their_last_file_is_finished(drives: list[PlayedLog]) -> None:
    live = LiveMap([each.copy for each in drives])
    play_all(drives, 4.0)
    assert states(live.update()) == ["under way", "under way"]
    drives[0].play(100.0)
    update = live.update()
    assert (states(update), update.is_finished) == (["finished", "under way"], False)
    drives[1].play(100.0)
    update = live.update()
    assert (states(update), update.is_finished) == (["finished", "finished"], True)


def test_without_new_data_the_map_stays(drives: list[PlayedLog]) -> None:
    live = LiveMap([drives[0].copy])
    drives[0].play(4.0)
    first, second = live.update(), live.update()
    assert (first.is_new, second.is_new) == (True, False)
    assert second.result is first.result


def test_a_run_that_is_not_there_yet_is_waited_for(drives: list[PlayedLog], tmp_path: Path) -> None:
    live = LiveMap([drives[0].copy, tmp_path / "late"])
    drives[0].play(100.0)
    update = live.update()
    assert states(update) == ["finished", "waiting"]
    assert "no such log" in update.runs[1].reason
    assert not update.is_finished
    drives[1].play(100.0)
    drives[1].copy.rename(tmp_path / "late")
    update = live.update()
    assert update.is_finished
    assert len(map_of(update).runs) == 2


def test_a_run_whose_disk_is_away_stays_in_the_map_and_goes_on(drives: list[PlayedLog], tmp_path: Path) -> None:
    live = LiveMap([each.copy for each in drives])
    play_all(drives, 4.0)
    before = map_of(live.update())
    drives[0].copy.rename(tmp_path / "away")
    update = live.update()
    assert states(update) == ["away", "under way"]
    assert "no such log" in update.runs[0].reason
    assert len(map_of(update).runs) == 2
    (tmp_path / "away").rename(drives[0].copy)
    play_all(drives, 100.0)
    update = live.update()
    assert update.is_finished
    assert map_of(update).runs[0].n_keyframes > before.runs[0].n_keyframes


def test_new_runs_in_a_folder_are_found(drives: list[PlayedLog], tmp_path: Path) -> None:
    folder = tmp_path / "recordings"
    folder.mkdir()
    live = LiveMap([folder])
    assert states(live.update()) == ["waiting"]
    for n, each in enumerate(drives, start=1):
        each.play(100.0)
        each.copy.rename(folder / each.copy.name)
        assert len(map_of(live.update()).runs) == n


def test_a_run_that_cannot_be_mapped_does_not_keep_others_from_it(drives: list[PlayedLog], tmp_path: Path) -> None:
    play_all(drives, 0.0)  # heads only
    live = LiveMap([each.copy for each in drives])
    update = live.update()
    assert update.result is None
    assert ["no wheel readings" in run.reason for run in update.runs] == [True, True]
    drives[0].play(8.0)
    update = live.update()
    assert len(map_of(update).runs) == 1
    assert [bool(run.reason) for run in update.runs] == [False, True]


def test_each_local_solve_begins_at_the_last_one(drives: list[PlayedLog], monkeypatch: pytest.MonkeyPatch) -> None:
    live = LiveMap([each.copy for each in drives], noise=NoiseParameters())
    play_all(drives, 6.0)
    live.update()
    live.update()
    n_solves, whole = [0], solve_incrementally

    def count(*given: Any) -> object:
        n_solves[0] += 1
        return whole(*given)

    monkeypatch.setattr(local_map, "solve_incrementally", count)
    play_all(drives, 7.0)
    continued = map_of(live.update())
    assert n_solves == [0]
    anew = map_of(LiveMap([each.copy for each in drives], noise=NoiseParameters()).update())
    assert n_solves[0] > 0
    for one, other in zip(continued.components, anew.components, strict=True):
        places = [np.array([tag.position_m for tag in each.tags]) for each in (one, other)]
        assert np.abs(places[0] - places[1]).max() < 0.1 * np.sqrt(np.diag(other.tag_covariance).max())


def test_a_wrong_robot_file_is_corrected(drives: list[PlayedLog], room: Path, tmp_path: Path) -> None:
    text = (room / "a" / "robot.yaml").read_text()
    assert "ticks_per_turn: 4096" in text
    for name in ("robot.yaml", "camera.yaml"):
        (tmp_path / name).write_text((room / "a" / name).read_text())
    (tmp_path / "robot.yaml").write_text(text.replace("ticks_per_turn: 4096", "ticks_per_turn: 3700"))
    given = {"a": read_robot_file(tmp_path / "robot.yaml")}
    live = LiveMap([drives[0].copy], given)
    drives[0].play(100.0)
    found, whole = map_of(live.update()), build_map(read_runs([drives[0].copy], given))
    assert any(each.is_freed for each in whole.choices)
    assert [(each.name, each.is_freed) for each in found.choices] == [
        (each.name, each.is_freed) for each in whole.choices
    ]
    assert [each.value for each in found.calibration] == pytest.approx(
        [each.value for each in whole.calibration], rel=0.05, abs=1e-4
    )


class SlowFits(Workers):
    """A process whose fits end when the test says so."""

    def __init__(self) -> None:
        super().__init__()
        self.begun: list[tuple[Any, Any, Future[Any]]] = []

    def begin(self, function: Any, item: Any) -> Future[Any]:
        self.begun.append((function, item, Future()))
        return self.begun[-1][2]

    def end(self) -> None:
        from groundsbot.offline.live.fitting import fit

        _, item, future = self.begun[-1]
        future.set_result(fit(item))


def test_maps_do_not_wait_for_a_fit_and_take_it_when_it_is_there(drives: list[PlayedLog]) -> None:
    workers = SlowFits()
    live = LiveMap([each.copy for each in drives], workers=workers)
    play_all(drives, 4.0)
    assert map_of(live.update()).noise == NoiseParameters()
    play_all(drives, 9.0)
    assert map_of(live.update()).noise == NoiseParameters()
    assert len(workers.begun) == 1
    workers.end()
    update = live.update()
    assert update.is_new
    assert map_of(update).noise_fit is not None
    assert len(workers.begun) == 2  # the drives have doubled since


def test_a_fit_that_is_killed_or_refused_is_said_and_maps_go_on(drives: list[PlayedLog]) -> None:
    workers = SlowFits()
    live = LiveMap([each.copy for each in drives], workers=workers)
    play_all(drives, 4.0)
    live.update()
    workers.begun[0][2].set_exception(BrokenProcessPool("killed"))
    play_all(drives, 8.0)
    update = live.update()
    assert "killed" in update.trouble
    assert update.is_new
