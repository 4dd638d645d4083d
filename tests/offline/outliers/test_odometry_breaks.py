"""Odometry that broke is found where tags show it, split there, and as accurate as two runs; nothing else is split."""

import re
from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.geometry import se2
from groundsbot.offline.local_map.local_map import solve_local_map
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.outliers.grown_segments import SolvedPart
from groundsbot.offline.outliers.odometry_breaks import _places, _seconds_between, find_break
from groundsbot.offline.outliers.split_drives import split_at_breaks
from tests.benchmarks.trust.breaks_study import broken_drive, outcome_of, summary
from tests.support.data.broken_odometry import make_clean_drive
from tests.support.data.drives import FAMILY, make_drive, make_positions, make_robot, make_run
from tests.support.data.long_drives import with_a_moved_tag


@pytest.mark.parametrize(("kind", "moved_m", "turned_deg"), [("carried", 2.0, 0.0), ("slipped", 3.0, 0.0)])
def test_a_break_is_found_where_it_is(kind: str, moved_m: float, turned_deg: float) -> None:
    broken = broken_drive(kind, 1)
    found = find_break(solve_local_map(broken.drive.segment))
    assert found is not None
    assert found.reach[0] <= broken.end - 1
    assert found.reach[1] >= broken.begin
    assert np.hypot(*found.jump[:2]) == pytest.approx(moved_m, abs=0.5)
    assert np.degrees(found.jump[2]) == pytest.approx(turned_deg, abs=10.0)
    assert found.chi_square > 10.0 * found.bound


def test_a_slip_for_which_the_solve_gives_up_observations_is_found() -> None:
    broken = broken_drive("slipped", 11)
    found = find_break(solve_local_map(broken.drive.segment))
    assert found is not None
    assert found.reach[0] <= broken.end - 1
    assert found.reach[1] >= broken.begin


def test_a_break_that_is_significant_from_one_end_only_is_found() -> None:
    """Observations with persistent errors scatter by far less than their variances: here by a tenth."""
    broken = broken_drive("carried", 1)
    segment = broken.drive.segment
    wide = segment.observations.inflate(np.full((len(segment.observations), 2), 10.0))
    found = find_break(solve_local_map(replace(segment, observations=wide)))
    assert found is not None
    assert found.reach[0] <= broken.end - 1
    assert found.reach[1] >= broken.begin


def test_the_map_is_as_accurate_as_that_of_two_runs() -> None:
    outcome = outcome_of("turned", 1)
    assert (outcome.can_be_told, outcome.n_segments) == (True, 2)
    assert outcome.rms_m < 1.1 * outcome.two_runs_rms_m
    assert "1 of 1 drives split; of 1 that two tags tell of, 1 found" in summary([outcome])


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_split_where_nothing_broke(seed: int) -> None:
    local_map = solve_local_map(make_clean_drive(seed).segment)
    mended = split_at_breaks([local_map])
    assert mended.maps == [local_map]
    assert not mended.warnings


def test_a_tag_that_was_moved_is_no_break() -> None:
    drive = make_clean_drive(1)
    assert find_break(solve_local_map(with_a_moved_tag(drive))) is None


@pytest.mark.parametrize("where", [[5], [0], [9], [0, 9]])
def test_no_break_is_searched_for_where_all_was_read_on_one_side(where: list[int]) -> None:
    drive = make_clean_drive(0).segment
    observations = drive.observations.where(np.arange(len(where)))
    segment = replace(drive.part(0, 10), observations=replace(observations, keyframe=np.array(where)))
    whole = SolvedPart(0, 10, np.zeros((10, 3)), np.zeros((0, 3)), {}, {}, 0.0, 0)
    places = _places(segment, whole, whole)
    assert all(0 < place.end <= place.begin < 10 for place in places)
    assert all(np.isfinite(_seconds_between(segment, place)) for place in places)
    assert (places == []) == (len(where) == 1)


PLACES = {1: (2.0, 1.0), 2: (4.0, -2.0), 3: (7.0, 1.0), 4: (8.0, 3.0), 5: (0.0, 4.0)}
ROUND = [(0.5, 0.5, 6.0), (0.4, 0.5, 3.0), (0.5, 0.3, 4.0), (0.5, 0.5, 4.0)]


def map_runs(T_moved: tuple[float, float, float]) -> MapResult:
    """Drives round, is moved while its wheels stand, and drives round again; all tags are seen all the time."""
    first = make_drive((0.0, 0.0, 0.0), [*ROUND, (0.0, 0.0, 2.0)], step_ns=100_000_000)
    T_world_again = se2.compose(first.T_world_base[-1], np.array(T_moved))
    second = make_drive(T_world_again.tolist(), [(0.0, 0.0, 2.0), *ROUND], step_ns=100_000_000)
    shift = first.stamps_ns[-1] - second.stamps_ns[0]
    stamps_ns = np.concatenate([first.stamps_ns, second.stamps_ns[1:] + shift])
    left_m, right_m = (
        np.concatenate([getattr(first, side), getattr(first, side)[-1] + getattr(second, side)[1:]])
        for side in ("left_m", "right_m")
    )
    poses = np.concatenate([first.T_world_base, second.T_world_base[1:]])
    at, tag = (index.reshape(-1) for index in np.mgrid[0 : len(stamps_ns) : 3, 0 : len(PLACES)])
    seen = se2.apply(se2.inverse(poses[at]), np.array(list(PLACES.values()))[tag])
    run = make_run(
        [WheelSegment(stamps_ns, left_m, right_m)],
        robot=make_robot("carl"),
        tags=[TagKey(FAMILY, key) for key in PLACES],
        positions=make_positions(stamps_ns[at], tag, seen),
    )
    return build_map([run])


@pytest.mark.parametrize("T_moved", [(0.0, 0.0, np.pi / 2), (-1.6, 1.2, 0.0)])
def test_a_robot_carried_while_its_wheels_stand_becomes_two_segments(T_moved: tuple[float, float, float]) -> None:
    result = map_runs(T_moved)
    (component,) = result.components
    assert [(run.name, run.run) for run in component.runs] == [
        ("carl_one", "carl_one"),
        ("carl_one_stretch2", "carl_one"),
    ]
    places = {tag.tag_id: tag.position_m for tag in component.tags}
    for tag_id, place in PLACES.items():
        np.testing.assert_allclose(places[tag_id], place, atol=0.01)
    (said,) = [warning for warning in result.warnings if "its wheels do not explain" in warning]
    figures = re.search(r"between ([\d.]+) s and ([\d.]+) s after its start .* by ([\d.]+) m and (-?\d+) deg", said)
    assert figures is not None
    begin_s, end_s, moved_m, turned_deg = map(float, figures.groups())
    assert begin_s <= 19.0 <= end_s < begin_s + 5.0
    # What was driven in between, a quarter of a metre, it drove in another direction.
    assert moved_m == pytest.approx(np.hypot(*T_moved[:2]), abs=0.3)
    assert turned_deg == round(np.degrees(T_moved[2]))


def test_a_robot_is_not_split_where_it_would_have_moved_faster_than_a_person_carries_it() -> None:
    result = map_runs((60.0, 0.0, 0.0))
    assert [run.name for run in result.runs] == ["carl_one"]
    assert any("contradict each other" in warning for warning in result.warnings)


def test_a_robot_that_was_not_moved_stays_one() -> None:
    assert [run.name for run in map_runs((0.0, 0.0, 0.0)).runs] == ["carl_one"]


def test_segments_of_several_runs_keep_their_names() -> None:
    one, other = (
        solve_local_map(replace(make_clean_drive(seed).segment.prefix(200), name=f"r{seed}")) for seed in (0, 1)
    )
    assert [each.segment.name for each in split_at_breaks([one, other]).maps] == ["r0", "r1"]
