"""What is held of a drive while a map is made: measurements only as long as a later stage reads them."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.alignment.merging import merge
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.foundation.workers import Workers
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.workings import Diagnostics
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.noise.reweighing import fit_noise_of
from groundsbot.offline.outliers.local_maps_without_outliers import local_maps_of, remove_outliers_under_own_noise
from groundsbot.offline.sam.graph import build_graph
from groundsbot.onboard.log.reading.reader import find_logs


@pytest.fixture(scope="module")
def runs(room: Path) -> list[Run]:
    return read_runs(find_logs([room / "a", room / "c"]))


def _segments(runs: list[Run]) -> list[Segment]:
    return [segment for run in runs for segment in segments_of(run, NoiseParameters())]


def has_systems(local_map: LocalMap) -> bool:
    problems = local_map.graph.problem, local_map.solution.problem
    return any("arrowhead" in vars(each) for each in problems) or "_factorisation_and_floor" in vars(local_map.solution)


@pytest.mark.parametrize("corners", [False, True])
def test_what_no_later_stage_reads_is_dropped(runs: list[Run], corners: bool) -> None:
    workings = Diagnostics()
    build_map(runs, workings=workings, corners=corners)
    assert all(len(run.detections.tag) and run.wheel_segments for run in runs)  # the caller's are as they were
    assert workings.freed is not None
    for run in [*workings.runs, *workings.freed.runs]:
        assert (len(run.detections.tag), len(run.wheel_segments), len(run.picture_stamps_ns)) == (0, 0, 0)
    for each in workings.maps:
        assert bool(each.segment.run.wheel_segments) == corners
        assert (each.segment.speeds is None) == corners  # which the report draws
        assert not len(each.segment.run.detections.tag)
        assert bool(each.segment.observations.parts.names) == corners
        assert bool(each.segment.odometry.parts.names) == corners
        assert each.segment.observations.from_corners.any() == corners
        assert (each.segment.observations.face.strides[0] > 0) == corners
        assert not has_systems(each)
    for solved in workings.components:
        assert "scratch" not in vars(solved.graph.problem.arrowhead)
        assert "_factorisation_and_floor" not in vars(solved.solution)


def test_alignment_keeps_no_map_factorised(runs: list[Run]) -> None:
    maps = [solve_local_map(segment) for segment in _segments(runs)]
    assert all(has_systems(each) for each in maps)
    thin = [each.without_systems() for each in maps]
    assert len(merge(thin).links) == 1
    assert not any(has_systems(each) for each in thin)


def test_no_drive_is_held_twice(runs: list[Run]) -> None:
    """As a segment and a map, or under the prior and under the fitted noise."""
    segments = _segments(runs)
    names = [each.name for each in segments]
    maps, noisy, _ = local_maps_of(segments, Stages())
    assert not segments
    fitted = fit_noise_of(maps, NoiseParameters())
    found = remove_outliers_under_own_noise(maps, noisy, Stages(), noise=fitted).maps
    assert not maps
    assert [each.segment.name for each in found] == names
    assert not any(has_systems(each) for each in found)


def test_items_are_taken_when_they_are_begun() -> None:
    held = [1, 2, 3]

    def items() -> Iterator[int]:
        while held:
            yield held.pop(0)

    def n_left(item: int, _stages: Stages) -> int:
        return item + 10 * len(held)

    assert Workers().map(n_left, items(), ["a", "b", "c"], Stages(), "") == [21, 12, 3]


def test_the_problem_of_a_single_segment_has_no_copies_of_its_arrays(runs: list[Run]) -> None:
    for segment in _segments(runs):
        problem = build_graph([segment]).problem
        assert problem.odometry.jacobian is segment.odometry.jacobian
        assert problem.observations.by_camera is segment.observations.by_camera
