"""The joint graph takes the measurements of many drives without a copy, and has the same numbers."""

from dataclasses import fields

import numpy as np
import pytest

from groundsbot.offline.local_map.adjacent_arrays import with_adjacent_arrays
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.sam.graph import build_graph
from tests.support.data.long_drives import make_long_drive, make_town


@pytest.fixture(scope="module")
def maps() -> list[LocalMap]:
    town = make_town(0)
    return [solve_local_map(make_long_drive(seed, 60.0, town=town).segment) for seed in range(3)]


@pytest.mark.parametrize(("which", "is_shared"), [([0, 1, 2], True), ([1, 2], True), ([0, 2], False), ([1, 0], False)])
def test_the_joint_graph_shares_the_arrays_of_drives_in_order(
    maps: list[LocalMap], which: list[int], *, is_shared: bool
) -> None:
    found = with_adjacent_arrays(maps)
    graph = build_graph([found[i].segment for i in which])
    expected = build_graph([maps[i].segment for i in which])
    for kind in ("odometry", "observations"):
        one, other = getattr(graph.problem, kind), getattr(expected.problem, kind)
        for each in fields(one):
            np.testing.assert_array_equal(getattr(one, each.name), getattr(other, each.name))
    own = found[which[-1]]
    for kind, name in (("odometry", "jacobian"), ("observations", "by_camera")):
        factors, measured = (getattr(getattr(each, kind), name) for each in (graph.problem, own.segment))
        assert np.shares_memory(factors, measured) == is_shared
        assert np.shares_memory(getattr(getattr(own.solution.problem, kind), name), measured)
