"""Tags that are passed very often: fewer tracks, and a move is still found to the pass."""

from functools import cache

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.outliers import grouping
from groundsbot.offline.outliers.grouping import few_of_each_tag
from groundsbot.offline.outliers.split_alone import split_alone
from groundsbot.offline.outliers.tracks import tracks_of
from groundsbot.offline.sam.graph import Graph, build_graph
from tests.support.data.drives import FAMILY, S, make_drive, make_positions, make_run

TAGS_M = np.array([[0.0, 3.0], [3.0, 1.0], [-3.0, 1.0], [0.5, -1.5]])
N_LAPS = 24
MOVED_AFTER = 10
SIGMA_M = 0.02


@cache
def laps() -> Segment:
    """Round and round, each tag read once a lap; the last one is moved by a metre while a lap goes on."""
    drive = make_drive([0.0, 0.0, 0.0], [(0.4, 0.6, N_LAPS * 5.0 * np.pi)], step_ns=S // 10)
    lap_ns = int((drive.stamps_ns[-1] - drive.stamps_ns[0]) / N_LAPS)
    each = np.arange(N_LAPS)
    ids = np.tile(np.arange(4), N_LAPS)
    stamps_ns = drive.stamps_ns[0] + (each[:, None] * lap_ns + lap_ns // 5 * np.arange(1, 5)).reshape(-1)
    places = np.tile(TAGS_M, (N_LAPS, 1))
    places[3 + 4 * MOVED_AFTER :: 4] += [0.8, 0.6]
    seen = se2.apply(se2.inverse(drive.at(stamps_ns)), places)
    seen = seen + SIGMA_M * np.random.default_rng(4).standard_normal(seen.shape)
    positions = make_positions(stamps_ns, ids, seen, SIGMA_M)
    tags = [TagKey(FAMILY, i) for i in range(4)]
    (segment,) = segments_of(make_run([drive.track], tags=tags, positions=positions), NoiseParameters())
    return segment


@cache
def graph() -> Graph:
    return build_graph([laps()])


@cache
def solve_drives() -> LocalMap:
    return solve_local_map(laps())


def test_a_tag_that_is_seen_a_few_times_keeps_its_tracks() -> None:
    whole = tracks_of([laps()])
    assert len(whole) == 4 * N_LAPS
    assert few_of_each_tag(graph(), whole) is whole


@pytest.mark.parametrize("most", [20, 8, 1])
def test_passings_of_one_tag_are_taken_together(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In order, each observation once, and no more than are allowed; their number is returned."""
    monkeypatch.setattr(grouping, "_MOST_OF_A_TAG", most)
    whole = tracks_of([laps()])
    few = few_of_each_tag(graph(), whole)
    assert (np.bincount(few.id) <= most).all()
    assert len(few) < len(whole)
    assert (few.ungrouped == whole.of_observation).all()
    assert (few.id[few.of_observation] == whole.id[whole.of_observation]).all()
    assert (few.n_observations == np.bincount(few.of_observation)).all()
    for s in range(len(few)):
        own = np.unique(whole.of_observation[few.of_observation == s])
        assert (np.diff(own) == 1).all()
        assert (few.first_ns[s], few.last_ns[s]) == (whole.first_ns[own].min(), whole.last_ns[own].max())
    assert (np.lexsort((few.first_ns, few.segment, few.id)) == np.arange(len(few))).all()


def test_few_tags_leave_room_to_those_that_are_seen_often() -> None:
    counts = np.array([3, 500, 90, 40])
    assert grouping._most_of_each(counts, 2048) == 128
    assert grouping._most_of_each(counts, 193) == 75
    assert np.minimum(counts, grouping._most_of_each(counts, 20)).sum() <= 20


@pytest.mark.parametrize("most", [128, 8])
def test_a_move_is_found_to_the_passing(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Gathered or not: two places, of the observations before and after."""
    monkeypatch.setattr(grouping, "_MOST_OF_A_TAG", most)
    found = split_alone(solve_drives())
    tags = found.segment.tags
    assert [(tag.tag_id, bool(tag.instance)) for tag in tags] == [
        (0, False), (1, False), (2, False), (3, True), (3, True),
    ]  # fmt: skip
    observations = found.segment.observations
    moved = np.array([tags[i].instance for i in observations.tag])[observations.tag >= 3]
    assert (moved[:MOVED_AFTER] == moved[0]).all()
    assert (moved[MOVED_AFTER:] == moved[-1]).all()
    assert moved[0] != moved[-1]
