"""The class for the robot: observation by observation, with the result of the batch."""

from dataclasses import replace

import numpy as np
import pytest

import groundsbot
from groundsbot.offline.errors import OfflineError
from groundsbot.offline.localization.localization import localize_maps
from groundsbot.offline.localization.online.drive import TagMeasurement
from groundsbot.offline.localization.online.localizer import OnlineLocalizer
from groundsbot.offline.localization.result import LocatedRun
from groundsbot.offline.measurements.segment import Segment
from tests.benchmarks.accuracy.localize_study import (
    Scene,
    against,
    broken_bounds,
    filter_online,
    judge,
    make_scene,
    taken_one_by_one,
)


@pytest.fixture(scope="module")
def scene() -> Scene:
    made = make_scene(4)
    assert made is not None
    return made


def test_the_study_in_small(scene: Scene) -> None:
    """Its bounds, of one seed with moved tags and one without, the online class within 2 % of a sigma of the batch."""
    moved = make_scene(3)
    assert moved is not None
    rows = [judge(4, scene), judge(3, moved)]
    assert [sentence for sentence in broken_bounds(rows) if "NEES" not in sentence and "slowest" not in sentence] == []
    assert (rows[1].moved_missed, rows[1].falsely_named) == (0, 0)
    for row in rows:
        assert row.found
        assert row.nees is not None
        assert row.nees < 6.9  # chi-square with two degrees of freedom, once in a thousand times, were all poses one
        assert row.settled_off is not None
        assert row.settled_off < 1e-3
    assert rows[0].online_off is not None
    assert rows[0].online_off < 1e-3
    # Three of the four tags seen were moved: nothing is reported before all are tested together.
    assert "may be the unmoved ones" in rows[1].online_reason


def test_it_says_why_it_does_not_know_and_then_where_it_is(scene: Scene) -> None:
    segment = scene.drive.segment
    online = OnlineLocalizer(scene.known, segment.run.robot)
    assert online.reason == "no tag of the map was observed yet"
    reasons = []
    for motion, observations in taken_one_by_one(segment):
        if motion is not None:
            online.add_motion(*motion)
        for observation in observations:
            online.add_observation(observation)
            reasons.append(online.reason)
            assert (online.pose is None) == bool(online.reason)
    assert "one tag of the map was observed; two are needed" in reasons
    assert reasons[-1] == ""


def test_a_moved_tag_is_found_after_it_was_accepted_first() -> None:
    """Of two tags the one that stayed is rejected first, until a third one agrees with it."""
    made = make_scene(47)
    assert made is not None
    online = OnlineLocalizer(made.known, made.drive.segment.run.robot)
    seen, starts = set[int](), []
    doubted = set[int]()
    for motion, observations in taken_one_by_one(made.drive.segment):
        if motion is not None:
            online.add_motion(*motion)
        for observation in observations:
            seen.add(observation.tag_id)
            if online.add_observation(observation) is not None:
                starts.append(len(seen))
            doubted |= {tag.tag_id for tag in online.moved_tags}
    assert starts[0] == 3  # two agree by their distance only, which a tag that was moved may keep
    assert doubted - made.moved
    assert {tag.tag_id for tag in online.moved_tags} == made.moved
    (run,) = localize_maps([made.local_map], made.known).runs
    assert _most_off(run, online) < 0.02
    online.settle()
    assert _most_off(run, online) < 1e-3
    assert {tag.tag_id for tag in online.moved_tags} == made.moved


def test_a_start_that_more_tags_contradict_is_doubtful(scene: Scene) -> None:
    """All tags but the first three elsewhere, as one: they are more, and may be those that stayed."""
    segment = scene.drive.segment
    online = OnlineLocalizer(scene.known, segment.run.robot)
    first: list[int] = []
    located = 0
    for motion, observations in taken_one_by_one(segment):
        if motion is not None:
            online.add_motion(*motion)
        for observation in observations:
            if observation.tag_id not in first and online.pose is None and not located:
                first.append(observation.tag_id)
            aside = np.zeros(2) if observation.tag_id in first else np.array([1.5, 0.0])
            located += online.add_observation(replace(observation, value=observation.value + aside)) is not None
    assert located
    assert online.pose is None
    assert (
        online.reason
        == "the tags that contradict the map may be the unmoved ones, so the pose is in doubt; call settle()"
    )


def test_what_was_not_mapped_serves_for_the_motion_only(scene: Scene) -> None:
    """Ids that the map does not have: nothing is located, and nothing breaks."""
    segment = scene.drive.segment
    renamed = tuple(tag._replace(tag_id=tag.tag_id + 500) for tag in segment.tags)
    online, _ = filter_online(replace(scene, drive=replace(scene.drive, segment=replace(segment, tags=renamed))))
    assert online.pose is None
    assert online.reason == "no tag of the map was observed; two are needed"
    assert online.settle() is None


def test_observations_that_are_no_numbers_and_components_that_are_not_there_are_refused(scene: Scene) -> None:
    robot = scene.drive.segment.run.robot
    online = OnlineLocalizer(scene.known, robot)
    with pytest.raises(OfflineError, match="is not finite"):
        online.add_observation(TagMeasurement("tag36h11", 1, np.array([np.nan, 0.0]), np.eye(2)))
    with pytest.raises(groundsbot.GroundsbotError, match="component 1: the map has no such component; give 0 to 0"):
        OnlineLocalizer(scene.known, robot, component=1)


def test_a_drive_continued_after_settle_agrees_with_the_batch(scene: Scene) -> None:
    """With `settle` half way, and at the end."""
    segment: Segment = scene.drive.segment
    online = OnlineLocalizer(scene.known, segment.run.robot)
    half = len(segment.stamps_ns) // 2
    for k, (motion, observations) in enumerate(taken_one_by_one(segment)):
        if motion is not None:
            online.add_motion(*motion)
        for observation in observations:
            online.add_observation(observation)
        if k == half:
            online.settle()
    (run,) = localize_maps([scene.local_map], scene.known).runs
    assert _most_off(run, online) < 0.02
    online.settle()
    assert _most_off(run, online) < 1e-3


def _most_off(run: LocatedRun, online: OnlineLocalizer) -> float:
    off, sigma = against(run, online)
    assert off is not None
    assert sigma is not None
    return max(off, sigma)
