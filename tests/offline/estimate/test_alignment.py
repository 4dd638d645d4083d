"""Drives are placed by tags that agree, and stay apart where too few do."""

from collections.abc import Mapping
from typing import Final

import numpy as np

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.estimate.alignment import place
from groundsbot.offline.estimate.estimate import estimate_jointly
from groundsbot.offline.measurements.tags import TagKey
from tests.offline.estimate.made_drives import PLACES, fit, make_drive
from tests.support.data.drives import FAMILY

T_B_A: Final = np.array([3.0, -1.0, 2.1])
FIVE: Final = (0, 2, 4, 7, 8)


def places_of(ids: tuple[int, ...], T: FloatArray, seed: int = 0) -> dict[TagKey, FloatArray]:
    """Places of tags as a drive alone has them, in another frame, a centimetre off."""
    rng = np.random.default_rng(seed)
    at = se2.apply(T, np.array([PLACES[each] for each in ids])) + 0.01 * rng.standard_normal((len(ids), 2))
    return {TagKey(FAMILY, each): place_m for each, place_m in zip(ids, at, strict=True)}


def off(found: FloatArray, expected: FloatArray) -> tuple[float, float]:
    error = se2.between(expected, found)
    return float(np.hypot(*error[:2])), abs(float(error[2]))


def assert_right(group: Mapping[int, FloatArray], starts: Mapping[int, FloatArray]) -> None:
    """T_map_start with the first of the group in the map's frame."""
    assert group.keys() == starts.keys()
    first = min(starts)
    for k, start in starts.items():
        metres, radians = off(group[k], se2.between(se2.inverse(starts[first]), se2.inverse(start)))
        assert metres < 0.1
        assert radians < 0.02


def test_two_drives_with_five_tags_of_which_one_was_moved_are_placed_by_the_four() -> None:
    none = np.zeros(3)
    a, b = places_of((*FIVE, 1), none, 1), places_of((*FIVE, 9), T_B_A, 2)
    b[TagKey(FAMILY, 4)] += [1.6, -1.2]
    (group,) = place([a, b], [100, 90])
    assert_right(group, {0: none, 1: T_B_A})


def test_the_first_drive_is_the_frame_whichever_has_most_readings() -> None:
    none = np.zeros(3)
    (group,) = place([places_of(FIVE, none, 1), places_of(FIVE, T_B_A, 2)], [10, 90])
    np.testing.assert_allclose(group[0], none, atol=1e-12)
    assert_right(group, {0: none, 1: T_B_A})


def test_drives_that_share_less_than_two_tags_stay_apart() -> None:
    for shared in ((), (4,)):
        a, b = places_of((0, 1, 2, *shared), np.zeros(3)), places_of((5, 6, 7, *shared), T_B_A)
        assert [set(group) for group in place([a, b], [10, 20])] in ([{1}, {0}], [{0}, {1}])


def test_two_tags_apart_join_and_two_with_another_distance_do_not() -> None:
    a, b = places_of((0, 4), np.zeros(3), 1), places_of((0, 4), T_B_A, 2)
    (group,) = place([a, b], [10, 20])
    assert_right(group, {0: np.zeros(3), 1: T_B_A})
    b[TagKey(FAMILY, 4)] += [1.6, -1.2]
    assert len(place([a, b], [10, 20])) == 2


def test_a_drive_joins_by_tags_of_several_others() -> None:
    starts = {0: np.zeros(3), 1: T_B_A, 2: np.array([-2.0, 5.0, -0.4]), 3: np.zeros(3)}
    ids = {0: (0, 1, 2, 3), 1: (2, 3, 4, 5), 2: (0, 5), 3: (6,)}
    groups = place([places_of(ids[k], starts[k], k) for k in range(4)], [10, 40, 20, 30])
    assert [set(group) for group in groups] == [{0, 1, 2}, {3}]
    assert_right(groups[0], {k: starts[k] for k in range(3)})


def test_drives_past_five_tags_of_which_one_was_moved_by_two_metres_are_one_map_with_the_others_in_place() -> None:
    here = {each: PLACES[each] for each in FIVE}
    moved = here | {4: (here[4][0] - 1.6, here[4][1] + 1.2)}
    made = [make_drive("a", 5, 90.0, places=here), make_drive("b", 5, 90.0, places=moved)]
    (joint,) = estimate_jointly([each.segment for each in made]).joints
    others = [i for i, tag in enumerate(joint.tags) if tag.tag_id != 4]
    true = np.array([PLACES[joint.tags[i].tag_id] for i in others])
    assert len(others) == 4
    assert fit(joint.tags_m[others], true).rms_m < 0.03
    placed = fit(joint.tags_m[others], true)
    for i, own in enumerate(joint.problem.layout.own):
        if own.tag.tag_id == 4:
            at = np.array([(here, moved)[own.drive][4]])
            assert placed.errors_m(joint.values.points[i][None], at).max() < 0.2


def test_drives_with_one_tag_in_common_are_two_maps() -> None:
    left = {each: PLACES[each] for each in (0, 1, 2, 8)}
    right = {each: PLACES[each] for each in (4, 5, 6, 8)}
    made = [make_drive("a", 6, 60.0, places=left), make_drive("b", 6, 60.0, places=right)]
    joints = estimate_jointly([each.segment for each in made]).joints
    assert sorted(joint.members for joint in joints) == [[0], [1]]
