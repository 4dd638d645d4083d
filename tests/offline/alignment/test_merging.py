"""Which local maps are connected, and where each one starts."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.alignment.merging import Merge, merge
from groundsbot.offline.foundation.workers import Workers
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.mapping.merge_report import alignment_results, merge_warnings
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.measurements.tape import Placement
from tests.support.data.drives import FAMILY, make_drive, make_positions, make_robot, make_run

HALL = {i: np.array([2.0 * i, 3.0 * (-1) ** i + 0.3 * i]) for i in range(12)}


def local_map(
    name: str,
    T_world_start: Sequence[float],
    tag_ids: Sequence[int],
    shift_m: float = 0.0,
    places: dict[int, FloatArray] | None = None,
) -> LocalMap:
    """One robot standing somewhere in the hall that sees some of its tags exactly."""
    drive = make_drive(T_world_start, [(0.5, 0.5, 1.0)])
    stamps_ns = np.full(len(tag_ids), drive.stamps_ns[0], dtype=np.int64)
    hall = HALL | (places or {})
    found = np.array([hall[i] + shift_m * np.random.default_rng(i).standard_normal(2) for i in tag_ids]).reshape(-1, 2)
    seen = se2.apply(se2.inverse(np.array(T_world_start)), found)
    positions = make_positions(stamps_ns, np.arange(len(tag_ids)), seen, 0.05)
    run = make_run(
        [drive.track], robot=make_robot(name), tags=[TagKey(FAMILY, i) for i in tag_ids], positions=positions
    )
    (segment,) = segments_of(run, NoiseParameters())
    return solve_local_map(segment)


STARTS = {"a": [0.0, 0.0, 0.0], "b": [5.0, 1.0, 2.0], "c": [9.0, -1.0, -3.0], "d": [14.0, 0.5, 1.0]}


def segment_of_maps() -> list[LocalMap]:
    """The first and the last share nothing: only those between join them."""
    return [
        local_map("a", STARTS["a"], [0, 1, 2, 3]),
        local_map("b", STARTS["b"], [2, 3, 4, 5]),
        local_map("c", STARTS["c"], [4, 5, 6, 7]),
        local_map("d", STARTS["d"], [6, 7, 8, 9]),
    ]


def join_maps(maps: list[LocalMap], merged: Merge | None = None) -> list[tuple[tuple[str, ...], FloatArray]]:
    merged = merged or merge(maps)
    return [(tuple(maps[m].segment.run.robot_id for m in g.members), g.T_frame_start) for g in merged.groups]


def test_maps_are_joined_through_others() -> None:
    ((names, starts),) = join_maps(segment_of_maps())
    assert names == ("a", "b", "c", "d")
    np.testing.assert_allclose(starts, [STARTS[name] for name in names], atol=1e-6)


def test_pairs_are_those_with_a_tag_or_a_measured_start_in_common() -> None:
    maps = segment_of_maps()
    assert [(pair.a, pair.b) for pair in merge(maps).pairs] == [(0, 1), (1, 2), (2, 3)]
    apart = Placement(np.zeros(3), np.eye(3))
    pairs = merge(maps[::-1], {(0, 3): apart, (2, 1): apart}).pairs
    assert [(pair.a, pair.b, pair.placement is not None) for pair in pairs] == [
        (3, 2, False),
        (3, 0, True),
        (2, 1, True),
        (1, 0, False),
    ]


@pytest.mark.parametrize("order", [[3, 2, 1, 0], [1, 3, 0, 2], [2, 0, 3, 1]])
def test_the_order_changes_the_frame_only(order: list[int]) -> None:
    maps = segment_of_maps()
    ((names, starts),) = join_maps([maps[i] for i in order])
    in_frame = se2.between(np.array(STARTS[names[0]]), np.array([STARTS[name] for name in names]))
    assert names == tuple("abcd"[i] for i in order)
    np.testing.assert_allclose(se2.log(se2.between(starts, in_frame)), 0.0, atol=1e-6)


def test_what_nothing_joins_stays_apart_largest_first() -> None:
    lone = local_map("e", [0.0, 0.0, 0.0], [10])
    blind = local_map("f", [0.0, 0.0, 0.0], [])
    maps = [lone, *segment_of_maps()[:2], blind, *segment_of_maps()[3:]]
    assert [names for names, _ in join_maps(maps)] == [("a", "b"), ("d",), ("e",), ("f",)]


def test_starts_follow_from_the_strongest_alignments() -> None:
    """Where two ways lead to a map, that over more tags is taken: here the weak way is wrong by decimetres."""
    maps = [
        local_map("a", STARTS["a"], [0, 1, 2, 3, 4, 5]),
        local_map("b", STARTS["b"], [0, 1, 2, 3, 4, 5, 8, 9]),
        local_map("c", STARTS["c"], [2, 3, 4, 5, 8, 9, 10, 11]),
        local_map("d", STARTS["d"], [0, 1, 10, 11, 8, 9], shift_m=0.03),
    ]
    ((_, starts),) = join_maps(maps)
    np.testing.assert_allclose(starts[:3], [STARTS[name] for name in "abc"], atol=1e-6)


def test_pairs_beyond_the_budget_of_the_logs_are_not_aligned_and_that_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    maps = segment_of_maps()
    monkeypatch.setattr("groundsbot.offline.alignment.merging._FREE_WORK", 250e6)  # of two pairs
    monkeypatch.setattr("groundsbot.offline.alignment.merging._WORK_AT_A_MIB", 0.0)
    merged = merge(maps)
    assert [pair.is_searched for pair in merged.pairs] == [True, False, False]
    together = Workers()
    together.is_this_process = False  # as several processes take them: all at once, each with all that is left
    assert [pair.is_searched for pair in merge(maps, workers=together).pairs] == [True, False, False]
    assert len(merged.groups) == 3
    warnings = merge_warnings(maps, merged)
    assert "2 of 3 pairs of drives that share tags were not aligned with each other, b_one and c_one" in warnings[0]
    assert any("shares 2 tags with" in each and "but was not aligned with it" in each for each in warnings[1:])


def test_a_measured_start_joins_what_no_tag_joins() -> None:
    maps = [local_map("a", STARTS["a"], [0, 1, 2, 3]), local_map("b", STARTS["b"], [7, 8])]
    measured = Placement(np.array([5.1, 0.9, 2.0]), np.diag([0.1, 0.1, 0.05]) ** 2)
    ((names, starts),) = join_maps(maps, merge(maps, {(0, 1): measured}))
    assert names == ("a", "b")
    np.testing.assert_allclose(starts[1], measured.T_a_b)
    ((_, turned),) = join_maps(maps[::-1], merge(maps[::-1], {(1, 0): measured}))
    np.testing.assert_allclose(turned[1], se2.inverse(measured.T_a_b))


def shelf_moved(n_moved: int, n_left: int) -> list[LocalMap]:
    """Between the two runs some tags moved together, by 3 m and a turn."""
    T_moved = np.array([3.0, -1.0, 0.4])
    moved = {i: se2.apply(T_moved, HALL[i]) for i in range(n_moved)}
    ids = range(n_moved + n_left)
    return [local_map("a", STARTS["a"], ids), local_map("b", STARTS["b"], ids, places=moved)]


def test_tags_that_moved_as_one_make_it_ambiguous_and_both_hypotheses_are_reported() -> None:
    maps = shelf_moved(5, 5)
    merged = merge(maps)
    assert len(merged.groups) == 2
    (result,) = alignment_results(maps, merged)
    assert not result.is_accepted
    (rival,) = result.alternatives
    stayed, moved = {(FAMILY, i) for i in range(5, 10)}, {(FAMILY, i) for i in range(5)}
    assert {frozenset(result.outliers), frozenset(rival.tags)} in ({frozenset(stayed)}, {frozenset(moved)})
    ways = [se2.log(se2.between(T, STARTS["b"])) for T in (result.T_from_to, rival.T_from_to)]
    assert min(np.abs(way).max() for way in ways) < 1e-3
    (reason,) = merge_warnings(maps, merged)
    assert "ambiguous, because tags" in reason
    assert "0, 1, 2, 3, 4" in reason
    assert "5, 6, 7, 8, 9" in reason


def test_a_small_group_that_moved_as_one_is_named_tag_by_tag() -> None:
    maps = shelf_moved(3, 8)
    merged = merge(maps)
    ((names, starts),) = join_maps(maps, merged)
    assert names == ("a", "b")
    np.testing.assert_allclose(starts[1], STARTS["b"], atol=1e-3)
    warnings = merge_warnings(maps, merged)
    assert len(warnings) == 3
    for i, warning in enumerate(warnings):
        assert f"tag {i} is" in warning
        assert "elsewhere in b_one than in a_one" in warning


def test_a_third_run_resolves_the_ambiguity_of_two() -> None:
    maps = [*shelf_moved(5, 5), local_map("c", STARTS["c"], [5, 6, 7, 8, 9, 10])]
    merged = merge(maps)
    ((names, starts),) = join_maps(maps, merged)
    assert names == ("a", "b", "c")
    np.testing.assert_allclose(starts[1], STARTS["b"], atol=1e-3)
    assert any("ambiguous" in warning and "joined by other runs" in warning for warning in merge_warnings(maps, merged))


def test_alignments_that_do_not_close_a_cycle_are_reported_and_the_weakest_is_rejected() -> None:
    """The two tags that a and c share were carried away together, so that only the cycle shows it."""
    away = {i: se2.apply([4.0, 2.0, 1.0], HALL[i]) for i in (0, 1)}
    maps = [
        local_map("a", STARTS["a"], [0, 1, 2, 3, 4, 5]),
        local_map("b", STARTS["b"], [2, 3, 4, 5, 6, 7, 8, 9]),
        local_map("c", STARTS["c"], [0, 1, 6, 7, 8, 9], places=away),
    ]
    merged = merge(maps)
    ((names, starts),) = join_maps(maps, merged)
    assert names == ("a", "b", "c")
    np.testing.assert_allclose(starts, [STARTS[name] for name in names], atol=1e-3)
    (told,) = [warning for warning in merge_warnings(maps, merged) if "contradict" in warning]
    assert "a_one, b_one, c_one" in told
    assert "that of a_one with c_one was left out" in told


def reason(*maps: LocalMap) -> str:
    (only,) = [warning for warning in merge_warnings(maps, merge(maps)) if warning.startswith("component 2")]
    return only


def test_reasons_say_what_is_missing() -> None:
    a = local_map("a", STARTS["a"], [0, 1, 2, 3])
    assert "e_one saw no tag" in reason(a, local_map("e", STARTS["b"], []))
    assert "e_one shares no tag" in reason(a, local_map("e", STARTS["b"], [7, 8]))
    only_one = reason(a, local_map("e", STARTS["b"], [3, 8]))
    assert "e_one shares only tag 3 with a_one; one more shared tag would suffice" in only_one
    elsewhere = {i: HALL[i] + 2.0 * i * np.array([1.0, 1.5]) for i in (1, 2)}
    moved = reason(a, local_map("e", STARTS["b"], [0, 1, 2], places=elsewhere))
    assert "e_one shares 3 tags with a_one" in moved
    assert "moved" in moved
    stray = {2: HALL[2] + [9.0, -9.0], 3: HALL[3] + [-7.0, 8.0]}
    by_chance = reason(a, local_map("e", STARTS["b"], [0, 1, 2, 3], places=stray))
    assert "of the 4 tags that e_one shares with a_one only 0, 1 have the same arrangement" in by_chance


def test_a_map_that_does_not_fit_together_is_held_to_less() -> None:
    """What bends it is in no covariance, so a tag a little off is no sign that this tag was moved."""
    tags = list(range(8))
    a = local_map("a", STARTS["a"], tags)
    b = local_map("b", STARTS["b"], tags, places={5: HALL[5] + np.array([0.5, 0.0])})
    bent = replace(b, goodness=replace(b.goodness, chi_square=900.0, expected=30, bound=60.0))
    n_inliers = [
        pair.alignment.n_inliers
        for maps in ([a, b], [a, bent])
        for pair in merge(maps).pairs
        if pair.alignment is not None
    ]
    assert n_inliers == [7, 8]
