"""What is kept of long drives: little, evenly, and the same of their beginning as they grow."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from groundsbot.offline.live import thinning
from groundsbot.offline.live.thinning import thin
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.measurements.run import Run
from groundsbot.onboard.log.reading.reader import find_logs


@pytest.fixture(scope="module")
def runs(room: Path) -> list[Run]:
    return read_runs(find_logs([room / "a", room / "b"]))


def limit(monkeypatch: pytest.MonkeyPatch, observations: int, pictures: int, readings: int) -> None:
    monkeypatch.setattr(thinning, "MOST_OBSERVATIONS", observations)
    monkeypatch.setattr(thinning, "MOST_EMPTY_PICTURES", pictures)
    monkeypatch.setattr(thinning, "MOST_WHEEL_READINGS", readings)


def until(run: Run, end_ns: int) -> Run:
    wheels = run.wheel_segments[0]
    n = int((wheels.stamps_ns <= end_ns).sum())
    return replace(
        run,
        wheel_segments=(
            replace(wheels, stamps_ns=wheels.stamps_ns[:n], left_m=wheels.left_m[:n], right_m=wheels.right_m[:n]),
        ),
        picture_stamps_ns=run.picture_stamps_ns[run.picture_stamps_ns <= end_ns],
        picture_camera=run.picture_camera[run.picture_stamps_ns <= end_ns],
        detections=run.detections.where(run.detections.stamps_ns <= end_ns),
    )


def test_short_drives_are_kept_whole(runs: list[Run]) -> None:
    short = [until(run, int(run.picture_stamps_ns[0]) + 6_000_000_000) for run in runs]
    for run, thinned in zip(short, thin(short), strict=True):
        assert np.array_equal(run.picture_stamps_ns, thinned.picture_stamps_ns)
        assert np.array_equal(run.detections.corners_px, thinned.detections.corners_px)
        assert np.array_equal(run.wheel_segments[0].stamps_ns, thinned.wheel_segments[0].stamps_ns)


def test_of_long_drives_each_tag_keeps_its_share_and_rare_ones_all(
    runs: list[Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    limit(monkeypatch, 120, 60, 1000)
    thinned = thin(runs)
    before, after = (
        np.concatenate([np.bincount(run.detections.tag, minlength=len(run.tags)) for run in each])
        for each in (runs, thinned)
    )
    share = thinning._largest_share(before, 120)
    assert (after >= np.minimum(before, (share + 1) // 2)).all()
    assert after.sum() < 0.5 * before.sum()
    n_readings = sum(len(run.wheel_segments[0].stamps_ns) for run in thinned)
    assert 500 < n_readings <= 1002
    for run, each in zip(runs, thinned, strict=True):
        used = np.isin(run.detections.stamps_ns, each.detections.stamps_ns)
        assert np.array_equal(run.detections.tag[used], each.detections.tag)  # pictures with all their tags
        assert np.isin(each.detections.stamps_ns, each.picture_stamps_ns).all()


def test_observations_of_a_tag_are_kept_at_even_steps() -> None:
    tag = np.array([0, 0, 1] * 3 + [0] * 91)
    kept = thinning._spread(tag, 2, 30)
    assert kept[tag == 1].all()
    assert np.array_equal(np.flatnonzero(kept[tag == 0]), np.arange(0, 97, 4))


def test_the_beginning_stays_the_same_while_steps_do(runs: list[Run], monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, 120, 60, 1000)
    end_ns = int(runs[0].picture_stamps_ns[-20])
    shorter, longer = (thin([until(runs[0], each)])[0] for each in (end_ns, end_ns + 400_000_000))
    common = np.isin(shorter.picture_stamps_ns, longer.picture_stamps_ns)
    assert common.mean() > 0.8


def test_readings_with_covariances_of_their_own_are_kept(runs: list[Run], monkeypatch: pytest.MonkeyPatch) -> None:
    limit(monkeypatch, 120, 60, 100)
    wheels = runs[0].wheel_segments[0]
    known = replace(wheels, covariance=np.zeros((len(wheels.stamps_ns), 3, 3)))
    (thinned,) = thin([replace(runs[0], wheel_segments=(known,))])
    assert thinned.wheel_segments[0] is known
