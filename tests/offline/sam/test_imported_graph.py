"""Graphs of imported positions: which numbers are open in them, and that these put right what they stand for."""

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.parameters import (
    CAMERA_PARAMETERS,
    IMPORTED_BATCH,
    MOUNT_PARAMETERS,
    RANGE_OFFSET,
    TAG_SCALE,
    TIME_OFFSET,
    WHEEL_PARAMETERS,
)
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.graph import Graph, build_graph
from tests.support.data.drives import FAMILY, START_NS, S, make_drive, make_positions, make_robot, make_run

DRIVE = make_drive([1.0, 1.5, 0.3], [(0.4, 0.5, 4.0)])
TAGS_M = np.array([[4.0, 2.0], [3.5, 5.0], [1.5, 4.0]])
SIGMAS: Final[dict[str, object]] = {
    "time_offset_s_sigma": 0.3,
    "range_offset_m_sigma": 0.07,
    "imported_tag_scale_sigma": 0.02,
}
ROBOT = make_robot("carl", camera=None, tags=[], **SIGMAS)
forms = pytest.mark.parametrize("polar", [True, False], ids=["polar", "cartesian"])
frames = pytest.mark.parametrize("in_camera", [True, False], ids=["camera", "base"])


def imported_run(*, polar: bool, in_camera: bool, late_s: float = 0.0, too_long_m: float = 0.0) -> Run:
    """Without noise; stamps and ranges may be off."""
    stamps_ns = START_NS + np.arange(S // 10, 4 * S - S // 10, S // 5, dtype=np.int64)
    mount = [ROBOT.mount.x_m, ROBOT.mount.y_m, ROBOT.mount.yaw_rad] if in_camera else [0.0, 0.0, 0.0]
    sensor = np.repeat(se2.compose(DRIVE.at(stamps_ns), np.array(mount)), len(TAGS_M), axis=0)
    tag = np.tile(np.arange(len(TAGS_M)), len(stamps_ns))
    x, y = se2.apply(se2.inverse(sensor), TAGS_M[tag]).T
    range_m, bearing_rad = np.hypot(x, y) + too_long_m, np.arctan2(y, x)
    places = range_m[:, None] * np.column_stack([np.cos(bearing_rad), np.sin(bearing_rad)])
    value = np.column_stack([range_m, bearing_rad]) if polar else places
    positions = replace(
        make_positions(np.repeat(stamps_ns, len(TAGS_M)) + round(late_s * S), tag, value, sigma_m=0.01),
        polar=np.full(len(tag), polar),
        in_camera=np.full(len(tag), in_camera),
    )
    keys = [TagKey(FAMILY, i) for i in range(len(TAGS_M))]
    return make_run([DRIVE.track], robot=ROBOT, camera=None, tags=keys, positions=positions)


def segment_of(run: Run) -> Segment:
    (segment,) = segments_of(run, NoiseParameters())
    assert len(segment.observations) > 20
    return segment


def misfit(graph: Graph, segment: Segment, **calibration: float) -> FloatArray:
    """(M, 2) observations less what they should be, in sigmas, at the true state."""
    numbers = np.array([calibration.get(parameter.name, 0.0) for parameter in graph.parameters])
    assert all(name in [parameter.name for parameter in graph.parameters] for name in calibration)
    return graph.problem.observations.residual(State(DRIVE.at(segment.stamps_ns), TAGS_M, numbers))


@forms
@frames
def test_what_is_open_is_what_positions_depend_on(polar: bool, in_camera: bool) -> None:
    graph = build_graph([segment_of(imported_run(polar=polar, in_camera=in_camera))])
    found = {parameter.name: parameter for parameter in graph.parameters if parameter.name}
    of_sensor = {TIME_OFFSET, RANGE_OFFSET}
    assert set(found) == {*WHEEL_PARAMETERS, TAG_SCALE, *of_sensor, *(MOUNT_PARAMETERS if in_camera else ())}
    sigmas = zip((TIME_OFFSET, RANGE_OFFSET, TAG_SCALE), SIGMAS.values(), strict=True)
    for name, sigma in sigmas:
        assert found[name].sigma == sigma
    assert found[TAG_SCALE].owner == IMPORTED_BATCH + FAMILY
    columns = dict(zip(graph.parameters, graph.problem.columns.calibration.tolist(), strict=True))
    assert all(columns[parameter] >= 0 for parameter in found.values())
    of_observations = [graph.parameters[i].name for i in graph.problem.observations.camera_parameters[0]]
    assert of_observations == [name if name in of_sensor else "" for name in CAMERA_PARAMETERS]


def test_a_robot_at_rest_does_not_determine_its_time_offset() -> None:
    run = imported_run(polar=True, in_camera=True)
    still = make_drive([0.0, 0.0, 0.0], [(0.0, 0.0, 4.0)])
    (segment,) = segments_of(replace(run, wheel_segments=(still.track,)), NoiseParameters())
    names = [parameter.name for parameter in build_graph([segment]).parameters]
    assert TIME_OFFSET not in names
    assert RANGE_OFFSET in names


@forms
@frames
def test_the_time_offset_puts_late_stamps_right_as_retiming_does(polar: bool, in_camera: bool) -> None:
    late_s = 0.01
    late = imported_run(polar=polar, in_camera=in_camera, late_s=late_s)
    segment = segment_of(late)
    graph = build_graph([segment])
    wrong = np.abs(misfit(graph, segment)).max()
    assert wrong > 0.1
    assert np.abs(misfit(graph, segment, time_offset_s=late_s)).max() < 0.02 * wrong
    on_time = segment_of(late.shift_stamps(late_s))
    assert np.abs(misfit(build_graph([on_time]), on_time)).max() < 1e-6


@forms
@frames
def test_the_range_offset_puts_ranges_right_that_are_too_long(polar: bool, in_camera: bool) -> None:
    segment = segment_of(imported_run(polar=polar, in_camera=in_camera, too_long_m=0.05))
    graph = build_graph([segment])
    assert np.abs(misfit(graph, segment)).max() > 3.0
    assert np.abs(misfit(graph, segment, range_offset_m=0.05)).max() < 1e-6
