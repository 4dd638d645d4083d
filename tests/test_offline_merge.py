"""Which local maps hang together, and where each one starts."""

from collections.abc import Sequence

import numpy as np
import pytest

from calib import se2
from calib.arrays import FloatArray
from calib.noise import NoiseParameters
from offline.chain import chains_of
from offline.local_map import LocalMap, solve_local_map
from offline.merge import align_pairs, group, reason_apart
from offline.run import TagKey
from tests.made_drives import FAMILY, made_drive, made_positions, made_robot, made_run

HALL = {i: np.array([2.0 * i, 3.0 * (-1) ** i + 0.3 * i]) for i in range(12)}


def local_map(name: str, T_world_start: Sequence[float], tag_ids: Sequence[int], shift_m: float = 0.0) -> LocalMap:
    """One robot standing somewhere in the hall that sees some of its tags exactly."""
    drive = made_drive(T_world_start, [(0.5, 0.5, 1.0)])
    stamps_ns = np.full(len(tag_ids), drive.stamps_ns[0], dtype=np.int64)
    places = np.array([HALL[i] + shift_m * np.random.default_rng(i).standard_normal(2) for i in tag_ids]).reshape(-1, 2)
    seen = se2.apply(se2.inverse(np.array(T_world_start)), places)
    positions = made_positions(stamps_ns, np.arange(len(tag_ids)), seen, 0.05)
    run = made_run(
        [drive.track], robot=made_robot(name), tags=[TagKey(FAMILY, i) for i in tag_ids], positions=positions
    )
    (chain,) = chains_of(run, NoiseParameters())
    return solve_local_map(chain)


STARTS = {"a": [0.0, 0.0, 0.0], "b": [5.0, 1.0, 2.0], "c": [9.0, -1.0, -3.0], "d": [14.0, 0.5, 1.0]}


def chain_of_maps() -> list[LocalMap]:
    """The first and the last share nothing: only those between join them."""
    return [
        local_map("a", STARTS["a"], [0, 1, 2, 3]),
        local_map("b", STARTS["b"], [2, 3, 4, 5]),
        local_map("c", STARTS["c"], [4, 5, 6, 7]),
        local_map("d", STARTS["d"], [6, 7, 8, 9]),
    ]


def joined(maps: list[LocalMap]) -> list[tuple[tuple[str, ...], FloatArray]]:
    groups = group(maps, align_pairs(maps))
    return [(tuple(maps[m].chain.run.robot_id for m in g.members), g.T_frame_start) for g in groups]


def test_maps_are_joined_through_others() -> None:
    ((names, starts),) = joined(chain_of_maps())
    assert names == ("a", "b", "c", "d")
    np.testing.assert_allclose(starts, [STARTS[name] for name in names], atol=1e-6)


@pytest.mark.parametrize("order", [[3, 2, 1, 0], [1, 3, 0, 2], [2, 0, 3, 1]])
def test_the_order_changes_the_frame_only(order: list[int]) -> None:
    maps = chain_of_maps()
    ((names, starts),) = joined([maps[i] for i in order])
    in_frame = se2.between(np.array(STARTS[names[0]]), np.array([STARTS[name] for name in names]))
    assert names == tuple("abcd"[i] for i in order)
    np.testing.assert_allclose(se2.log(se2.between(starts, in_frame)), 0.0, atol=1e-6)


def test_what_nothing_joins_stays_apart_largest_first() -> None:
    lone = local_map("e", [0.0, 0.0, 0.0], [10])
    blind = local_map("f", [0.0, 0.0, 0.0], [])
    maps = [lone, *chain_of_maps()[:2], blind, *chain_of_maps()[3:]]
    assert [names for names, _ in joined(maps)] == [("a", "b"), ("d",), ("e",), ("f",)]


def test_starts_follow_from_the_strongest_alignments() -> None:
    """Where two ways lead to a map, that over more tags is taken: here the weak way is wrong by decimetres."""
    maps = [
        local_map("a", STARTS["a"], [0, 1, 2, 3, 4, 5]),
        local_map("b", STARTS["b"], [0, 1, 2, 3, 4, 5, 8, 9]),
        local_map("c", STARTS["c"], [2, 3, 4, 5, 8, 9, 10, 11]),
        local_map("d", STARTS["d"], [0, 1, 10, 11, 8, 9], shift_m=0.12),
    ]
    ((names, starts),) = joined(maps)
    np.testing.assert_allclose(starts[:3], [STARTS[name] for name in names[:3]], atol=1e-6)


def reason(maps: list[LocalMap], index: int) -> str:
    others = [i for i in range(len(maps)) if i != index]
    return reason_apart(maps[index].chain.name, others, index, maps, align_pairs(maps))


def test_reasons_say_what_is_missing() -> None:
    a = local_map("a", STARTS["a"], [0, 1, 2, 3])
    assert "saw no tag" in reason([a, local_map("e", STARTS["b"], [])], 1)
    assert "shares no tag" in reason([a, local_map("e", STARTS["b"], [7, 8])], 1)
    only_one = reason([a, local_map("e", STARTS["b"], [3, 8])], 1)
    assert "only one tag with a_one" in only_one
    moved = local_map("e", STARTS["b"], [0, 1, 2], shift_m=4.0)
    assert "shares 3 tags with a_one" in reason([a, moved], 1)
    assert "moved" in reason([a, moved], 1)
