"""Where a joint solve of several drives starts, and that it ends in the least minimum from there."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment.merging import Group, merge
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.global_map.initial_values import initial_map
from groundsbot.offline.global_map.joint_solve import solve_global_map
from groundsbot.offline.local_map.local_map import solve_local_map
from tests.benchmarks.trust.joint_minima_study import drives_of, solve_from_truth
from tests.support.data.long_drives import make_long_drive


def test_drives_that_bent_apart_are_solved_to_the_least_minimum() -> None:
    """Placed by their alignments alone, these end in one whose cost is 7 % higher."""
    drives = drives_of(8, 6, 500.0)
    maps = [solve_local_map(drive.segment) for drive in drives]
    (group,) = merge(maps).groups
    _, solution = solve_global_map(maps, group, Stages())
    assert solution.converged
    assert solution.cost == pytest.approx(solve_from_truth([drives[m] for m in group.members]).cost, rel=1e-9)


def test_the_result_does_not_depend_on_the_order_of_the_drives() -> None:
    drives = drives_of(0, 4, 400.0)
    maps = [solve_local_map(drive.segment) for drive in drives]
    (group,), (other_way,) = merge(maps).groups, merge(maps[::-1]).groups
    (_, one), (_, other) = solve_global_map(maps, group, Stages()), solve_global_map(maps[::-1], other_way, Stages())
    assert one.converged
    assert other.cost == pytest.approx(one.cost, rel=1e-9)


def test_parts_without_common_tags_stay_where_they_were_placed() -> None:
    drives = [make_long_drive(number, 100.0) for number in range(3)]  # each in a town of its own
    maps = [
        solve_local_map(replace(drive.segment, tags=tuple(tag._replace(instance=str(i)) for tag in drive.segment.tags)))
        for i, drive in enumerate(drives)
    ]
    placed = np.array([[0.0, 0.0, 0.0], [500.0, 10.0, 0.3], [-200.0, 40.0, -2.0]])
    found = initial_map(maps, Group((0, 1, 2), placed))
    for poses, T, each in zip(found.poses, placed, maps, strict=True):
        np.testing.assert_allclose(poses, se2.compose(T, each.T_start_base), atol=1e-9)
