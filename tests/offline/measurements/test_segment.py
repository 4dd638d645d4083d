"""Keyframes: enough of them, none for standing still, and no tag lost between them."""

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import IntArray
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.measurements.keyframes import KEYFRAME_DISTANCE_M, KEYFRAME_TURN_RAD
from groundsbot.offline.measurements.motion_model.motion_model import WheelSegment
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.tags import TagKey
from tests.support.data.drives import FAMILY, START_NS, MadeDrive, S, make_drive, make_positions, make_run

NOISE = NoiseParameters()


def pictures(drive: MadeDrive, period_ns: int = S // 15, first_ns: int = 1_234_567) -> IntArray:
    return np.arange(drive.stamps_ns[0] + first_ns, drive.stamps_ns[-1], period_ns, dtype=np.int64)


def segment_of(
    drive: MadeDrive, pictures_ns: IntArray, seen: dict[int, list[int]] | None = None, n_tags: int = 9
) -> Segment:
    """A drive whose pictures (by index) show tags (by index); positions stand in for corners."""
    shown = [(pictures_ns[i], tag) for i, tags in sorted((seen or {}).items()) for tag in tags]
    positions = make_positions(
        np.array([stamp for stamp, _ in shown], dtype=np.int64),
        np.array([tag for _, tag in shown], dtype=np.int64),
        np.tile([3.0, 1.0], (len(shown), 1)),
    )
    tags = [TagKey(FAMILY, i) for i in range(n_tags)]
    (segment,) = segments_of(make_run([drive.track], tags=tags, pictures_ns=pictures_ns, positions=positions), NOISE)
    return segment


def test_keyframes_are_pictures_but_for_the_first_which_is_the_first_wheel_observation() -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(0.5, 0.5, 4.0)])
    stamps = pictures(drive)
    segment = segment_of(drive, stamps)
    assert segment.stamps_ns[0] == drive.stamps_ns[0]
    assert set(segment.stamps_ns[1:].tolist()) <= set(stamps.tolist())
    assert len(segment.odometry) == len(segment.stamps_ns) - 1


def test_a_slow_robot_has_keyframes_by_distance() -> None:
    """At 0.1 m/s and 15 pictures a second every sixth or seventh picture is enough."""
    drive = make_drive([0.0, 0.0, 0.0], [(0.1, 0.1, 20.0)])
    segment = segment_of(drive, pictures(drive))
    moved = np.diff((segment.stamps_ns - START_NS) * 1e-9) * 0.1
    assert (moved >= KEYFRAME_DISTANCE_M - 1e-9).all()
    assert (moved < KEYFRAME_DISTANCE_M + 0.1 / 15 + 1e-6).all()


def test_a_turning_robot_has_keyframes_by_angle() -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(-0.02, 0.02, 20.0)])  # 4.6 deg/s
    segment = segment_of(drive, pictures(drive))
    turned = np.diff((segment.stamps_ns - START_NS) * 1e-9) * 0.08
    assert (turned >= KEYFRAME_TURN_RAD - 1e-9).all()
    assert (turned < KEYFRAME_TURN_RAD + 0.08 / 15 + 1e-6).all()


def test_a_fast_robot_makes_a_keyframe_of_every_picture() -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(0.9, 0.9, 3.0)])
    stamps = pictures(drive)
    assert len(segment_of(drive, stamps).stamps_ns) == len(stamps) + 1 - 1  # the first picture is nearly at the start


def test_a_robot_that_stands_adds_no_keyframe() -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(0.5, 0.5, 1.0), (0.0, 0.0, 30.0), (0.5, 0.5, 1.0)])
    stamps = pictures(drive)
    seen = {i: [i % 3] for i in range(len(stamps))}  # even though tags come and go
    segment = segment_of(drive, stamps, seen)
    standing = (segment.stamps_ns > START_NS + 1.1 * S) & (segment.stamps_ns < START_NS + 31 * S)
    assert standing.sum() <= 1
    assert len(segment.stamps_ns) < 2 * 0.5 / KEYFRAME_DISTANCE_M + 10


def test_observations_from_one_stationary_pose_belong_to_its_keyframe() -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(0.0, 0.0, 2.0), (0.5, 0.5, 1.0)])
    stamps = pictures(drive)
    segment = segment_of(drive, stamps, {2: [0], 9: [1], 20: [0, 2]})
    assert segment.observations.keyframe.tolist() == [0, 0, 0, 0]
    assert [tag.tag_id for tag in segment.tags] == [0, 1, 2]


def test_a_tag_seen_between_keyframes_only_gets_one() -> None:
    """A creeping robot glimpses tag 5 once, a centimetre after a keyframe."""
    drive = make_drive([0.0, 0.0, 0.0], [(0.1, 0.1, 6.0)])
    stamps = pictures(drive)
    plain = segment_of(drive, stamps)
    at = int(np.searchsorted(stamps, plain.stamps_ns[5])) + 2
    assert stamps[at] not in plain.stamps_ns
    segment = segment_of(drive, stamps, {at: [5]})
    assert [tag.tag_id for tag in segment.tags] == [5]
    assert stamps[at] in segment.stamps_ns
    np.testing.assert_array_equal(segment.stamps_ns[segment.observations.keyframe], [stamps[at]])


def test_every_tag_seen_within_the_drive_is_kept() -> None:
    rng = np.random.default_rng(0)
    for speed in (0.05, 0.3, 1.0):
        drive = make_drive([0.0, 0.0, 0.0], [(speed, speed, 3.0), (0.0, 0.0, 2.0), (-speed, speed, 3.0)])
        stamps = pictures(drive)
        seen = {int(i): [int(tag)] for tag, i in enumerate(rng.choice(len(stamps), 9, replace=False))}
        assert [tag.tag_id for tag in segment_of(drive, stamps, seen).tags] == list(range(9))


def test_a_tag_without_a_usable_observation_is_named() -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(0.5, 0.5, 1.0)])
    segment = segment_of(drive, pictures(drive), {3: [0, 1]}, n_tags=3)
    assert [tag.tag_id for tag in segment.tags] == [0, 1]
    (warning,) = segment.warnings
    assert "tag 2 (tag36h11) was detected, but no observation of it can be used" in warning


def test_without_pictures_stamps_of_the_log_are_candidates() -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(0.5, 0.5, 2.0)], step_ns=S // 10)
    stamps = drive.stamps_ns[3:6] + 7_000_000
    positions = make_positions(stamps, np.zeros(3, dtype=np.int64), np.tile([3.0, 1.0], (3, 1)))
    (segment,) = segments_of(make_run([drive.track], tags=[TagKey(FAMILY, 0)], positions=positions), NOISE)
    np.testing.assert_array_equal(segment.stamps_ns[segment.observations.keyframe], stamps)
    assert segment.stamps_ns[0] == drive.stamps_ns[0]


def test_what_is_seen_outside_the_wheels_time_is_not_used() -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(0.5, 0.5, 2.0)])
    stamps = pictures(drive)
    outside = np.concatenate([stamps[:1] - S, stamps, stamps[-1:] + S])
    segment = segment_of(drive, outside, {0: [1], 5: [0], len(outside) - 1: [2]}, n_tags=3)
    assert [tag.tag_id for tag in segment.tags] == [0]
    assert segment.stamps_ns[0] == drive.stamps_ns[0]
    assert segment.stamps_ns[-1] <= drive.stamps_ns[-1]


def test_each_part_of_a_run_is_a_segment_with_its_own_name() -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(0.5, 0.5, 4.0)])
    tracks = [
        WheelSegment(drive.stamps_ns[part], drive.left_m[part], drive.right_m[part])
        for part in (slice(0, 150), slice(250, 401))
    ]
    stamps = pictures(drive)
    first, second = segments_of(make_run(tracks, pictures_ns=stamps), NOISE)
    assert (first.name, second.name) == ("carl_one", "carl_one_stretch2")
    assert first.stamps_ns[-1] <= drive.stamps_ns[149]
    assert second.stamps_ns[0] == drive.stamps_ns[250]


@pytest.mark.parametrize("n", [1, 2, 7])
def test_the_beginning_of_a_segment_is_a_segment(n: int) -> None:
    drive = make_drive([0.0, 0.0, 0.0], [(0.5, 0.5, 2.0)])
    stamps = pictures(drive)
    whole = segment_of(drive, stamps, {i: [i % 4] for i in range(len(stamps))})
    part = whole.prefix(n)
    np.testing.assert_array_equal(part.stamps_ns, whole.stamps_ns[:n])
    assert len(part.odometry) == n - 1
    inside = whole.observations.keyframe < n
    named = [whole.tags[i] for i in whole.observations.tag[inside]]
    assert [part.tags[i] for i in part.observations.tag] == named
    assert part.tags == tuple(sorted(set(named)))
