"""Tags that do not belong: the joint evidence is that of solves, and `map` names, splits or keeps what it finds."""

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.alignment.merging import PairAlignment, merge
from groundsbot.offline.commands.map_drives import exit_code
from groundsbot.offline.commands.map_summary import summary
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.global_map.joint_solve import solve_global_map
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.outliers.evidence import linearise_observations, marginalise, noise_scales
from groundsbot.offline.outliers.false_detections import Views, chances
from groundsbot.offline.outliers.joint_information import rows_of
from groundsbot.offline.outliers.outliers import OutlierSearch, split_together, with_outliers_apart
from groundsbot.offline.outliers.places import NOWHERE, minimise_places
from groundsbot.offline.outliers.tracks import Tracks, instances, tracks_of, with_instances
from groundsbot.offline.sam.arrowhead import covariance
from groundsbot.offline.sam.graph import build_graph
from groundsbot.offline.sam.solver import PLAIN_SQUARES, solve
from tests.support.data.drives import FAMILY, START_NS, S, make_drive, make_positions, make_robot, make_run
from tests.support.data.moved_tags import gain_of, make_scene

HALL = {i: np.array([2.0 * i, 3.0 * (-1) ** i + 0.3 * i]) for i in range(8)}
STARTS = {"a": [0.0, 0.0, 0.0], "b": [5.0, 1.0, 2.0], "c": [9.0, -1.0, -3.0], "d": [4.0, 0.0, 1.0]}
NAMES = tuple(STARTS)
SIGMA_M = 0.05
NOISE = NoiseParameters()


def observe_at(name: str, places: dict[int, FloatArray], seed: int = 0, hours: int = 0) -> Run:
    """A robot that sees each tag once from where it stands, with noise, and then drives on a little."""
    drive = make_drive(STARTS[name], [(0.5, 0.5, 1.0)])
    late_ns = 3600 * S * hours
    track = replace(drive.track, stamps_ns=drive.stamps_ns + late_ns)
    ids = sorted(places)
    x, y, theta = STARTS[name]
    turn = np.array([[np.cos(theta), -np.sin(theta)], [np.sin(theta), np.cos(theta)]])
    noise = SIGMA_M * np.random.default_rng([seed, hours]).standard_normal((len(ids), 2))
    seen = np.array([(places[i] - [x, y]) @ turn for i in ids]) + noise
    positions = make_positions(np.full(len(ids), START_NS + late_ns), np.arange(len(ids)), seen, SIGMA_M)
    tags = [TagKey(FAMILY, i) for i in ids]
    return make_run([track], robot=make_robot(name), tags=tags, positions=positions)


def map_runs(
    *halls: dict[int, FloatArray], hours: Sequence[int] = range(len(NAMES)), keep_suspects: bool = False
) -> MapResult:
    """One run after the other, each in a hall of its own."""
    runs = [observe_at(name, HALL | hall, hours=hour) for name, hall, hour in zip(NAMES, halls, hours, strict=False)]
    return build_map(runs, keep_suspects=keep_suspects)


MOVED = {3: HALL[3] + [0.9, -0.5]}
SWAPPED = {3: HALL[4], 4: HALL[3]}


def test_a_hall_as_it_was_has_no_suspects() -> None:
    result = map_runs({}, {}, {}, {})
    assert result.outliers == ()
    assert all(tag.instance == "" for tag in result.components[0].tags)


def test_a_moved_tag_is_named_and_has_two_places() -> None:
    result = map_runs({}, {}, MOVED, MOVED)
    (suspect,) = result.outliers
    assert (suspect.tag_id, suspect.kind, suspect.runs) == (3, "moved", ("c_one", "d_one"))
    assert "by 1.0" in suspect.evidence
    assert "in a_one and b_one (2 observations), then in c_one and d_one (2 observations)" in suspect.evidence
    a, b = (tag for tag in result.components[0].tags if tag.tag_id == 3)
    assert (a.instance, b.instance, a.runs, b.runs) == ("a", "b", ("a_one", "b_one"), ("c_one", "d_one"))
    assert np.linalg.norm(b.position_m - a.position_m) == pytest.approx(np.hypot(0.9, 0.5), abs=0.2)
    assert exit_code(result) == 0
    assert suspect.has_ordered_places
    assert not [text for text in result.warnings if "tag 3" in text]


def test_runs_at_the_same_time_leave_the_order_of_places_unknown(tmp_path: Path) -> None:
    result = map_runs({}, {}, MOVED, MOVED, hours=[0, 1, 1, 2])
    (suspect,) = result.outliers
    assert (suspect.kind, suspect.has_ordered_places) == ("moved", False)
    assert "in a_one and b_one (2 observations), elsewhere in c_one and d_one (2 observations)" in suspect.evidence
    write_map(result, tmp_path)
    assert read_map(tmp_path).outliers == result.outliers


def test_suspects_can_be_kept(tmp_path: Path) -> None:
    result = map_runs({}, {}, MOVED, MOVED, keep_suspects=True)
    assert [each.kind for each in result.outliers] == ["moved"]
    assert [tag.instance for tag in result.components[0].tags if tag.tag_id == 3] == [""]
    assert any(line.startswith("suspect: tag 3 (tag36h11) moved: by") for line in summary(result, tmp_path))


def test_two_that_changed_places_are_swapped(tmp_path: Path) -> None:
    result = map_runs({}, {}, SWAPPED, SWAPPED)
    assert [(each.tag_id, each.kind, each.swapped_with) for each in result.outliers] == [
        (3, "swapped", 4),
        (4, "swapped", 3),
    ]
    write_map(result, tmp_path)
    entries = json.loads((tmp_path / "map.json").read_text())["suspect_tags"]
    assert [entry["swapped_with"] for entry in entries] == [4, 3]
    assert set(entries[0]) == {"family", "tag_id", "kind", "runs", "evidence", "swapped_with", "has_ordered_places"}
    assert read_map(tmp_path).outliers == result.outliers
    rows = (tmp_path / "tags.csv").read_text().splitlines()
    assert sum(",a," in row or ",b," in row for row in rows) == 4


def test_there_and_back_is_two_tags_with_one_id() -> None:
    far = {3: HALL[3] + [4.0, -2.5]}
    (suspect,) = map_runs({}, far, {}, far).outliers
    assert (suspect.tag_id, suspect.kind) == (3, "duplicated")
    assert suspect.runs == ("a_one", "b_one", "c_one", "d_one")


def test_a_run_that_has_most_of_its_tags_elsewhere_is_wrong_itself() -> None:
    angle = np.linspace(0.0, 6.0, 5)
    shifted = {i: HALL[i] + 1.5 * np.array([np.cos(angle[i]), np.sin(angle[i])]) for i in range(5)}
    suspects = map_runs({}, {}, shifted, {}).outliers
    assert {(each.tag_id, each.kind, each.runs) for each in suspects} == {
        (i, "inconsistent", ("c_one",)) for i in range(5)
    }
    assert "c_one has this tag and 4 more" in suspects[0].evidence
    assert "swapped_with" not in map_as_json(map_runs({}, {}, MOVED, MOVED))["suspect_tags"][0]


@cache
def local_maps() -> tuple[LocalMap, ...]:
    return tuple(solve_local_map(drive.segment) for drive in make_scene(31).drives)


@cache
def search() -> OutlierSearch:
    maps = local_maps()
    graph, solution = solve_global_map(maps, merge(maps).groups[0], Stages())
    found = split_together(graph, solution, maps)
    assert found is not None
    return found


@pytest.mark.parametrize("which", [0, 7, 30])
def test_the_gain_of_a_split_is_that_of_solving_it(which: int) -> None:
    """By one linearisation, all but without slack, against a solve of all runs with that track's tag apart."""
    seen = search()
    own = np.flatnonzero(np.bincount(seen.tracks.id)[seen.tracks.id] > 3)[which]
    plain = linearise_observations(seen.graph, seen.solution.state, np.ones((4, 2)))
    bare = marginalise(plain, seen.tracks, unmodelled_sigma_m=1e-4, reweight=False)
    at = int(np.flatnonzero(bare.which == own)[0])
    gain, _ = gain_of(minimise_places(bare, seen.place[bare.which]), np.array([at]))
    joined = solve(seen.graph.problem, seen.solution.state, losses=PLAIN_SQUARES)
    place = seen.place.copy()
    place[own] = place.max() + 1
    tags = instances(seen.tracks, place)
    apart = build_graph(with_instances(seen.graph.segments, seen.tracks, tags))
    start = apart.start(joined.state.poses, {}, seen.graph.calibration_of(joined.state))
    split = solve(apart.problem, start, losses=PLAIN_SQUARES)
    assert gain == pytest.approx(2.0 * (joined.cost - split.cost), rel=0.02, abs=0.02)


def test_parts_of_the_information_are_those_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few tags keep Z with its zeros, fleets without: blocks, sums and what gives way are the same by dense algebra."""
    seen = search()
    information = seen.evidence.information
    n = len(seen.evidence.score)
    whole = information.times(np.eye(n))
    monkeypatch.setattr(covariance, "_FEW", 0)
    scales = noise_scales([each.goodness for each in local_maps()])
    apart = marginalise(linearise_observations(seen.graph, seen.solution.state, scales), seen.tracks).information
    assert apart.root.below.shape[0] > 0
    assert information.root.below.shape[0] == 0
    gather = np.zeros((2 * int(seen.places.place.max()) + 2, n))
    gather[rows_of(seen.places.place), np.arange(n)] = 1.0
    across = whole @ gather.T
    stiffness = whole - across @ np.linalg.inv(gather @ across + NOWHERE * np.eye(len(gather))) @ across.T
    members = seen.places.tracks[3].members
    rows = rows_of(members)
    for each in (information, apart):
        parts = each.gather(seen.places.place, len(gather) // 2)
        assert_allclose(each.times(np.eye(n)), whole, rtol=0.0, atol=1e-6 * whole.max())
        assert_allclose(each.among(rows), whole[np.ix_(rows, rows)], rtol=0.0, atol=1e-6 * whole.max())
        assert_allclose(parts.whole(), gather @ across, rtol=0.0, atol=1e-6 * whole.max())
        assert_allclose(parts.across(rows), across[rows], rtol=0.0, atol=1e-6 * whole.max())
    found = seen.places.stiffness
    assert_allclose(next(found.among_each([members])), stiffness[np.ix_(rows, rows)], rtol=0.0, atol=1e-6 * whole.max())
    together = stiffness.reshape(n, -1, 2)[:, members].sum(axis=1)
    assert_allclose(found.against(members), together, rtol=0.0, atol=1e-6 * whole.max())


def test_all_splits_of_a_place_are_evaluated_together() -> None:
    places = search().places
    held = next(each for each in places.tracks if len(each.members) > 3)
    masks = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 1.0]])
    masks = np.pad(masks, ((0, 0), (0, len(held.members) - 4)))
    one_by_one = [gain_of(places, held.members[mask > 0.0])[0] for mask in masks]
    assert_allclose(held.gains(masks), one_by_one, rtol=1e-6)


def test_tracks_end_where_a_tag_is_out_of_sight() -> None:
    seen = search()
    for s in range(len(seen.tracks)):
        observations = np.flatnonzero(seen.tracks.of_observation == s)
        assert len(observations) == seen.tracks.n_observations[s]
    again = tracks_of(seen.graph.segments, np.ones(len(seen.tracks.of_observation), dtype=np.bool_))
    assert (again.n_observations == 1).all()


def test_a_tag_is_read_again_from_where_it_was_read() -> None:
    """Once in thirty near views is no tag among tags that are read in seven of ten; once in two is."""
    n = 25
    place = np.r_[np.repeat(np.arange(n), 2), n, n + 1]
    zeros = np.zeros(len(place), dtype=np.int64)
    n_observations = np.r_[np.full(2 * n, 7), 1, 1]
    keys = tuple(TagKey(FAMILY, i) for i in range(n + 2))
    tracks = Tracks(keys, zeros, zeros, place, zeros, zeros, zeros, n_observations, zeros)
    found = chances(tracks, place, Views(n_observations, np.r_[np.full(2 * n, 10), 30, 2]))
    assert (found[: 2 * n] == 1.0).all()
    assert found[-2] < 1e-6
    assert found[-1] > 0.05


def _search_as(halls: list[dict[int, FloatArray]], *, is_noisy: bool) -> OutlierSearch:
    """One run after the other, whose noise was fitted or not, solved together and searched."""
    runs = [observe_at(name, HALL | hall, hours=i) for i, (name, hall) in enumerate(zip(NAMES, halls, strict=False))]
    maps = [replace(solve_local_map(segment), is_noisy=is_noisy) for run in runs for segment in segments_of(run, NOISE)]
    merged = merge(maps)
    maps = with_outliers_apart(maps, merged)
    found = split_together(*solve_global_map(maps, merged.groups[0], Stages()), maps)
    assert found is not None
    return found


@pytest.mark.parametrize(
    ("off_m", "is_noisy", "n_places"), [(1.2, True, 1), (1.2, False, 2), (4.0, True, 2)], ids=["near", "told", "far"]
)
def test_places_within_sight_of_each_other_are_one_where_noise_was_fitted(
    off_m: float, is_noisy: bool, n_places: int
) -> None:
    there = {3: HALL[3] + [off_m, 0.0]}
    found = _search_as([{}, there, {}, there], is_noisy=is_noisy)
    assert sum(tag.whole.tag_id == 3 for tag in found.graph.tags) == n_places


def test_a_tag_that_two_alignments_reject_and_others_join_keeps_its_name() -> None:
    maps = [solve_local_map(segment) for hall in NAMES[:3] for segment in segments_of(observe_at(hall, HALL), NOISE)]
    merged = merge(maps)
    tag = TagKey(FAMILY, 3)

    def doubted(pair: PairAlignment) -> PairAlignment:
        assert pair.alignment is not None
        inlier = np.array([each != tag for each in pair.alignment.shared])
        return replace(pair, alignment=replace(pair.alignment, inlier=inlier))

    pairs = [doubted(each) if (each.a, each.b) == (0, 1) else each for each in merged.pairs]
    assert pairs[0].alignment is not None
    assert pairs[0].alignment.outliers == (tag,)
    one = with_outliers_apart(maps, replace(merged, pairs=tuple(pairs)))
    assert [each.segment.tags for each in one] == [each.segment.tags for each in maps]
    apart = with_outliers_apart(maps, replace(merged, pairs=tuple(doubted(each) for each in merged.pairs)))
    assert [each.segment.tags[3].instance for each in apart] == ["a", "b", "c"]
