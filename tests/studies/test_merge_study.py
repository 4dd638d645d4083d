"""The study of merging in small: order does not matter, and no undetermined alignment is accepted."""

from groundsbot.offline.local_map.local_map import solve_local_map
from tests.benchmarks.trust.merge_study import SAME_M, apart, corridor, drives_of, in_other_building, spread_over_orders

LENGTH_M = 200.0


def test_shuffled_orders_give_the_same_map() -> None:
    maps = [solve_local_map(drive.segment) for drive in drives_of(4, seed=2, length_m=LENGTH_M)]
    assert spread_over_orders(maps, 3, seed=0) <= SAME_M


def test_two_groups_that_share_nothing_stay_apart() -> None:
    drives = drives_of(4, seed=2, length_m=LENGTH_M)
    maps = [solve_local_map(drive.segment) for drive in drives[:2]] + [in_other_building(drive) for drive in drives[2:]]
    (reason,) = apart(maps)
    assert "shares no tag with the others; drive it past two tags that another run saw" in reason


def test_a_corridor_whose_pattern_repeats_is_ambiguous() -> None:
    (reason,) = apart(corridor(1))
    assert "ambiguous, because" in reason
