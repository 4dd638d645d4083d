"""What is left out of a map, and when: tags that are others, whose codes were misread."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.outliers import left_out
from groundsbot.offline.outliers.kinds import IdPlace, SeveralPlaces
from groundsbot.offline.outliers.left_out import read_as_another, stray_passes, without_tags
from groundsbot.offline.outliers.outliers import OutlierSearch
from groundsbot.offline.sam.graph import Graph, build_graph
from tests.support.data.drives import FAMILY, START_NS, S, make_drive, make_positions, make_robot, make_run

PLACES = {0: np.array([3.0, 1.0]), 1: np.array([4.0, -1.0]), 2: np.array([2.0, 2.0])}
ONCE = TagKey(FAMILY, 2)


MISREAD_M = np.array([3.02, 1.01])  # where tag 0 is
APART = 1  # of ten pictures, the one that shows tag 1 and what is read as tag 2


def _run(once_m: NDArray[np.float64]) -> Run:
    """A robot that stands before tags 0 and 1, reads them in ten pictures, and tag 2 in one, there without tag 0."""
    drive = make_drive([0.0, 0.0, 0.0], [(0.3, 0.3, 2.0), (0.3, 0.3, 2.0)])
    seen = [(START_NS + (k + 1) * S // 10, i) for k in range(10) for i in (0, 1) if (k, i) != (APART, 0)]
    seen.append((START_NS + (APART + 1) * S // 10, 2))
    places = PLACES | {2: once_m}
    rng = np.random.default_rng(0)
    moved_m = np.array([0.03 * (stamp - START_NS) / (S // 10) for stamp, _ in seen])
    xy_m = np.array([places[i] for _, i in seen]) + 0.02 * rng.standard_normal((len(seen), 2))
    xy_m[:, 0] -= moved_m
    stamps_ns = np.array([stamp for stamp, _ in seen])
    positions = make_positions(stamps_ns, np.array([i for _, i in seen]), xy_m)
    return make_run([drive.track], robot=make_robot(), tags=[TagKey(FAMILY, i) for i in PLACES], positions=positions)


def _map(once_m: NDArray[np.float64], n_misread: int) -> LocalMap:
    (segment,) = segments_of(_run(once_m), NoiseParameters())
    return replace(solve_local_map(segment), n_misread=n_misread)


def _misread(local_map: LocalMap, graph: Graph | None = None) -> set[TagKey]:
    return read_as_another(graph or local_map.graph, local_map.solution, [local_map])


def test_a_tag_of_one_observation_where_another_is_was_misread() -> None:
    local_map = _map(MISREAD_M, 1)
    assert _misread(local_map) == {ONCE}
    graph, solution = without_tags(local_map.graph, local_map.solution, {ONCE})
    assert graph.tags == (TagKey(FAMILY, 0), TagKey(FAMILY, 1))
    assert solution.converged


@pytest.mark.parametrize(
    ("once_m", "n_misread"),
    [(PLACES[2], 1), (MISREAD_M, 0), (np.array([4.0, -0.98]), 1)],
    ids=["a place of its own", "no other was misread", "beside the other in one picture"],
)
def test_other_tags_of_one_observation_are_placed(once_m: NDArray[np.float64], n_misread: int) -> None:
    assert _misread(_map(once_m, n_misread)) == set()


def test_a_tag_of_a_known_map_is_no_misread_code() -> None:
    local_map = _map(MISREAD_M, 1)
    graph = build_graph([local_map.segment])
    measured = graph.problem.measured
    known = replace(measured.known, tags=np.array([graph.tags.index(ONCE)]))
    graph = replace(graph, problem=replace(graph.problem, measured=replace(measured, known=known)))
    assert _misread(local_map, graph) == set()


N_TRACKS = 30  # of each of fifteen ids


def _search(monkeypatch: pytest.MonkeyPatch, n_elsewhere: dict[int, int]) -> OutlierSearch:
    """A search whose ids have this many tracks, of ten observations each, at another place."""
    ids = np.repeat(np.arange(15), N_TRACKS)
    place, found = ids.copy(), []
    for each, n in n_elsewhere.items():
        label = 15 + each
        place[np.flatnonzero(ids == each)[:n]] = label
        places = (IdPlace(each, (0, 1), 10 * (N_TRACKS - n), N_TRACKS - n), IdPlace(label, (0,), 10 * n, n))
        found.append(
            SeveralPlaces(
                TagKey(FAMILY, each),
                places,
                {0: (1, 0), 1: (0,)},
                has_ordered_segments=False,
                has_ordered_places=False,
                at_once=False,
            )
        )
    monkeypatch.setattr(left_out, "cases", lambda *_: found)
    return cast(
        OutlierSearch,
        SimpleNamespace(
            evidence=SimpleNamespace(which=np.arange(len(ids))),
            tracks=SimpleNamespace(id=ids),
            places=SimpleNamespace(place=place),
            tags=[TagKey(FAMILY, int(each), "a" if at >= 15 else "") for each, at in zip(ids, place, strict=True)],
            picture=np.full(len(ids), -1),
        ),
    )


def test_three_tracks_elsewhere_are_a_moved_tag_where_no_other_tag_has_any(monkeypatch: pytest.MonkeyPatch) -> None:
    assert stray_passes(_search(monkeypatch, {4: 3})) == set()


def test_three_tracks_elsewhere_are_stray_where_other_tags_have_as_many(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = _search(monkeypatch, dict.fromkeys(range(9), 1) | {11: 3})
    assert stray_passes(searched) == {TagKey(FAMILY, each, "a") for each in (*range(9), 11)}


def test_a_tag_that_half_of_the_tracks_place_elsewhere_moved_however_many_others_stray(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched = _search(monkeypatch, dict.fromkeys(range(9), 1) | {11: N_TRACKS // 2 - 1})
    assert TagKey(FAMILY, 11, "a") not in stray_passes(searched)
