"""Two tags with one id that one picture shows stay two, and the map says so."""

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import IntArray
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.local_map.local_map import LocalMap, solve_local_map
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.segment import segments_of
from groundsbot.offline.measurements.tags import Detections, TagKey
from groundsbot.offline.outliers.duplicate_ids import split_duplicates
from groundsbot.offline.outliers.split_alone import split_alone
from tests.support.data.drives import (
    CAMERA,
    FAMILY,
    MadeDrive,
    MadeTag,
    S,
    make_drive,
    make_robot,
    make_run,
    picture_stamps,
    seen_corners_px,
)

TWINS = (3.2, 0.9), (3.0, -0.8)
TAGS = [
    MadeTag(0, (*TWINS[0], 0.4), np.pi),
    MadeTag(0, (*TWINS[1], 0.4), np.pi),
    MadeTag(1, (3.6, 0.1, 0.4), np.pi),
    MadeTag(2, (4.4, 1.4, 0.4), np.pi + 0.2),
    MadeTag(3, (4.2, -1.5, 0.4), np.pi - 0.2),
]
SIGMA_PX = 0.2
LOOK = (0.2, 0.2, 2.0)


def drive_past(tags: list[MadeTag]) -> Run:
    """Forward, back and forward again, all tags in view."""
    drive = make_drive([0.0, 0.0, 0.0], [(0.3, 0.3, 3.0), (-0.3, -0.28, 3.0), (0.3, 0.3, 3.0)])
    return observe(drive, tags, picture_stamps(drive))


def observe(drive: MadeDrive, tags: list[MadeTag], stamps_ns: IntArray, told: MadeDrive | None = None) -> Run:
    """A drive past tags; `told`: the motion by its wheels, where that is not the true one."""
    robot, rng = make_robot(), np.random.default_rng(1)
    seen = []
    for stamp, pose in zip(stamps_ns, drive.at(stamps_ns), strict=True):
        for tag in rng.permutation(len(tags)):  # a detector's order says nothing
            corners_px = seen_corners_px(tags[tag], pose, robot, CAMERA)
            if corners_px is not None:
                seen.append((stamp, tags[tag].tag_id, corners_px + SIGMA_PX * rng.standard_normal((4, 2))))
    stamps, ids, corners = zip(*seen, strict=True)
    detections = Detections(np.array(stamps), np.array(ids), np.array(corners), np.zeros(len(ids), dtype=np.int64))
    keys = [TagKey(FAMILY, i) for i in range(4)]
    return make_run([(told or drive).track], robot=robot, tags=keys, pictures_ns=stamps_ns, detections=detections)


def test_two_tags_in_one_picture_are_duplicated() -> None:
    result = build_map([drive_past(TAGS)], NoiseParameters())
    (suspect,) = result.outliers
    assert (suspect.tag_id, suspect.kind) == (0, "duplicated")
    places = [tag.position_m[:2] for tag in result.components[0].tags if tag.tag_id == 0]
    assert len(places) == 2
    for place in TWINS:
        assert min(np.linalg.norm(np.array(found) - place) for found in places) < 0.1


def test_each_keeps_its_observations_however_they_are_ordered() -> None:
    (segment,) = (split_duplicates(each) for each in segments_of(drive_past(TAGS), NoiseParameters()))
    first, second = (segment.observations.tag == i for i in (0, 1))
    assert [tag.tag_id for tag in segment.tags] == [0, 0, 1, 2, 3]
    assert first.sum() > 15 and second.sum() > 15  # noqa: PT018
    bearing = segment.observations.value[:, 1]
    assert (bearing[first] > 0.0).all() != (bearing[second] > 0.0).all()
    assert solve_local_map(segment).goodness.fits


def back_and_forth(tags: list[MadeTag], slip_rad: float) -> LocalMap:
    """Tags in view, then 8 m without a picture, in which the wheels do not show a turn, and the same tags again."""
    drive, told = (
        make_drive([0.0, 0.0, 0.0], [LOOK, (-0.4 - turn, -0.4 + turn, 10.0), (0.4, 0.4, 10.0), LOOK])
        for turn in (0.0, slip_rad / 40.0)
    )
    stamps_ns = picture_stamps(drive)
    looks = np.minimum(stamps_ns - drive.stamps_ns[0], drive.stamps_ns[-1] - stamps_ns) < 2 * S
    run = observe(drive, tags, stamps_ns[looks], told)
    noise = NoiseParameters(sigma_heading_rad_per_sqrt_m=0.15)
    (segment,) = (split_duplicates(each) for each in segments_of(run, noise))
    return split_alone(solve_local_map(segment))


@pytest.mark.parametrize("slip_rad", [-0.55, 0.0, 0.55])
def test_two_that_are_passed_again_after_a_long_way_are_two(slip_rad: float) -> None:
    """By the wheels one may lie where the other one was."""
    found = back_and_forth(TAGS[:2], slip_rad)
    assert [tag.tag_id for tag in found.graph.tags] == [0, 0]
    for place in TWINS:
        assert np.linalg.norm(found.solution.state.tags - place, axis=1).min() < 0.1


def test_three_with_one_id_stay_three() -> None:
    third = MadeTag(0, (3.6, 0.1, 0.4), np.pi)
    assert len(back_and_forth([*TAGS[:2], third], 0.3).graph.tags) == 3


def test_a_drive_past_one_of_each_id_is_left_as_it_is() -> None:
    (segment,) = segments_of(drive_past(TAGS[1:]), NoiseParameters())
    assert split_duplicates(segment) is segment
