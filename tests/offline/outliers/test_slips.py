"""Motions that the wheels do not explain are freed where they are, and nothing else is."""

from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.measurements.segment import Segment
from groundsbot.offline.outliers.slips import slip_warning, without_slips
from groundsbot.offline.sam.graph import build_graph
from groundsbot.offline.sam.solver import solve
from tests.support.data.long_drives import LongDrive, make_long_drive, make_town

TURNED_RAD = np.radians(25.0)


def _drive(seed: int) -> LongDrive:
    return make_long_drive(seed, 60.0, town=make_town(seed, (0.6, 1.2)))


def _rotate(segment: Segment, keyframe: int) -> Segment:
    """The drive whose robot was turned after a keyframe, of which its wheels know nothing."""
    motion = segment.odometry.motion.copy()
    motion[keyframe] = se2.compose(motion[keyframe], np.array([0.0, 0.0, -TURNED_RAD]))
    return replace(segment, odometry=replace(segment.odometry, motion=motion))


def _solve(segment: Segment, drive: LongDrive) -> LocalMap:
    """Near the truth, as a drive is found whose noise was fitted."""
    graph = build_graph([segment])
    found = solve_local_map(drive.segment)
    return replace(found, segment=segment, graph=graph, solution=solve(graph.problem, drive.true_state(graph)))


@pytest.mark.parametrize("seed", range(3))
def test_a_turn_that_the_wheels_do_not_know_is_freed(seed: int) -> None:
    drive = _drive(seed)
    observations = np.unique(drive.segment.observations.keyframe)
    keyframe = int(observations[len(observations) // 2])
    whole = _solve(_rotate(drive.segment, keyframe), drive)
    found, slips = without_slips(whole)
    (slip,) = [each for each in slips if each.first <= keyframe < each.end]
    assert np.degrees(slip.jump[2]) == pytest.approx(25.0, abs=3.0)
    assert len(slips) == 1
    assert found.solution.converged
    assert found.solution.cost < 1.05 * _solve(drive.segment, drive).solution.cost < 0.9 * whole.solution.cost
    assert "in 1 place the robot moved in a way that its wheels do not explain:" in slip_warning(found, slips)


@pytest.mark.parametrize("seed", range(5))
def test_nothing_is_freed_where_wheels_are_right(seed: int) -> None:
    whole = _solve(_drive(seed).segment, _drive(seed))
    found, slips = without_slips(whole)
    assert not slips
    assert found is whole


def test_a_jump_farther_than_a_robot_can_be_pushed_is_no_slip() -> None:
    """It would lower the cost all the same, as it does where a map is in a wrong local minimum."""
    drive = _drive(0)
    observations = np.unique(drive.segment.observations.keyframe)
    keyframe = int(observations[len(observations) // 2])
    for jump_m, is_slip in ((0.6, True), (3.0, False)):
        motion = drive.segment.odometry.motion.copy()
        motion[keyframe, 1] += jump_m
        segment = replace(drive.segment, odometry=replace(drive.segment.odometry, motion=motion))
        _, slips = without_slips(_solve(segment, drive))
        assert any(each.first <= keyframe < each.end for each in slips) == is_slip


def test_many_slips_are_counted_and_the_largest_named() -> None:
    drive = _drive(1)
    segment = drive.segment
    observations = np.unique(segment.observations.keyframe)
    for share in (0.2, 0.4, 0.6, 0.8):
        segment = _rotate(segment, int(observations[int(share * len(observations))]))
    found, slips = without_slips(_solve(segment, drive))
    assert len(slips) == 4
    said = slip_warning(found, slips)
    assert "in 4 places" in said
    assert said.count(" deg") == 3
