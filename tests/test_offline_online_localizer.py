"""The class for the robot: reading by reading, with the sigmas of the batch, and settled with its result."""

from dataclasses import replace

import numpy as np
import pytest

import offline
from calib import se2
from offline.chain import Chain
from offline.errors import OfflineError
from offline.localizing import localize_maps
from offline.online_drive import TagReading
from offline.online_filter import OnlineFilter
from offline.online_localizer import OnlineLocalizer
from tests.benchmarks.localize_study import Scene, against, filtered, judged, made_scene, missed, taken_one_by_one


@pytest.fixture(scope="module")
def scene() -> Scene:
    made = made_scene(4)
    assert made is not None
    return made


def test_the_study_in_small(scene: Scene) -> None:
    """Its bounds, of one seed with moved tags and one without; sigmas of the filter alone, too."""
    moved = made_scene(3)
    assert moved is not None
    rows = [judged(4, scene), judged(3, moved)]
    assert [sentence for sentence in missed(rows) if "NEES" not in sentence] == []
    assert (rows[1].moved_missed, rows[1].falsely_named) == (0, 0)
    assert rows[0].filter_sigma is not None
    assert rows[0].filter_sigma < 0.1  # two to three times too sure without the invariant errors
    for row in rows:
        assert row.found
        assert row.nees is not None
        assert row.nees < 6.9  # chi-square with two degrees of freedom, once in a thousand times, were all poses one
        assert row.settled_off is not None
        assert row.settled_off < 1e-3


def test_it_says_why_it_does_not_know_and_then_where_it_is(scene: Scene) -> None:
    chain = scene.drive.chain
    online = OnlineLocalizer(scene.known, chain.run.robot)
    assert online.reason == "no tag of the map was seen yet"
    reasons = []
    for motion, readings in taken_one_by_one(chain):
        if motion is not None:
            online.add_motion(*motion)
        for reading in readings:
            online.add_reading(reading)
            reasons.append(online.reason)
            assert (online.pose is None) == bool(online.reason)
    assert "one tag of the map was seen; two are needed" in reasons
    assert reasons[-1] == ""


def test_settling_judges_anew_which_tags_stayed() -> None:
    """Of a drive in which the filter took a moved tag for one that stayed, and then one that stayed for moved."""
    made = made_scene(47)
    assert made is not None
    online = OnlineLocalizer(made.known, made.drive.chain.run.robot)
    seen, starts = set[int](), []
    for motion, readings in taken_one_by_one(made.drive.chain):
        if motion is not None:
            online.add_motion(*motion)
        for reading in readings:
            seen.add(reading.tag_id)
            if online.add_reading(reading) is not None:
                starts.append(len(seen))
    assert starts[0] == 3  # two agree by their distance only, which a tag that was moved may keep
    online.settle()
    (run,) = localize_maps([made.local_map], made.known).runs
    off, sigma = against(run, online)
    assert off is not None
    assert sigma is not None
    assert max(off, sigma) < 0.02
    assert {tag.tag_id for tag in online.moved_tags} == made.moved


def test_a_start_that_more_tags_contradict_is_in_doubt(scene: Scene) -> None:
    """All tags but the first three elsewhere, as one: they are more, and may be those that stayed."""
    chain = scene.drive.chain
    online = OnlineLocalizer(scene.known, chain.run.robot)
    first: list[int] = []
    located = 0
    for motion, readings in taken_one_by_one(chain):
        if motion is not None:
            online.add_motion(*motion)
        for reading in readings:
            if reading.tag_id not in first and online.pose is None and not located:
                first.append(reading.tag_id)
            aside = np.zeros(2) if reading.tag_id in first else np.array([1.5, 0.0])
            located += online.add_reading(replace(reading, value=reading.value + aside)) is not None
    assert located
    assert online.pose is None
    assert online.reason == "tags that lie elsewhere than the map has them may as well be those that stayed; settle"


def test_what_was_not_mapped_serves_for_the_motion_only(scene: Scene) -> None:
    """Ids that the map does not have: nothing is located, and nothing breaks."""
    chain = scene.drive.chain
    renamed = tuple(tag._replace(tag_id=tag.tag_id + 500) for tag in chain.tags)
    online, _ = filtered(replace(scene, drive=replace(scene.drive, chain=replace(chain, tags=renamed))))
    assert online.pose is None
    assert online.reason == "no tag of the map was seen; two are needed"
    assert online.settle() is None


def test_readings_that_are_no_numbers_and_components_that_are_not_there_are_refused(scene: Scene) -> None:
    robot = scene.drive.chain.run.robot
    online = OnlineLocalizer(scene.known, robot)
    with pytest.raises(OfflineError, match="holds no numbers"):
        online.add_reading(TagReading("tag36h11", 1, np.array([np.nan, 0.0]), np.eye(2)))
    with pytest.raises(offline.GroundsbotError, match="component 1: the map has 1"):
        OnlineLocalizer(scene.known, robot, component=1)


def test_a_drive_that_goes_on_after_settling_agrees_with_the_batch(scene: Scene) -> None:
    """Settled half way, and at the end."""
    chain: Chain = scene.drive.chain
    online = OnlineLocalizer(scene.known, chain.run.robot)
    half = len(chain.stamps_ns) // 2
    for k, (motion, readings) in enumerate(taken_one_by_one(chain)):
        if motion is not None:
            online.add_motion(*motion)
        for reading in readings:
            online.add_reading(reading)
        if k == half:
            online.settle()
    (run,) = localize_maps([scene.local_map], scene.known).runs
    online.settle()
    off, sigma = against(run, online)
    assert off is not None
    assert sigma is not None
    assert max(off, sigma) < 0.02


def test_a_motion_of_everything_is_not_learned_from_a_reading() -> None:
    """In a frame whose turn nothing tells of, moving the mean keeps that turn's uncertainty."""
    state = OnlineFilter(np.zeros(1), np.zeros((1, 1)))
    state.pose = np.array([30.0, 4.0, 0.3])
    place_m = np.array([32.0, 5.0])
    by_state = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    state.add_tag(place_m, by_state, 0.01 * np.eye(2))
    turn = state._by_motion()  # about the pose
    about_origin = turn @ np.array([-4.0, 30.0, 1.0])
    state.covariance += 0.04**2 * np.outer(about_origin, about_origin) + 1e-4 * np.eye(len(about_origin))
    before = state.covariance.copy()
    columns = state.columns_of([0])
    state.correct(columns, np.eye(2), np.array([0.05, -0.4]), 1e6 * np.eye(2))  # tells as good as nothing
    np.testing.assert_allclose(state.covariance, before, rtol=1e-3, atol=1e-5)
    state._step(0.02 * about_origin)
    moved = state._by_motion() @ np.array([-state.pose[1], state.pose[0], 1.0])
    weight = np.linalg.inv(state.covariance)
    assert moved @ weight @ moved == pytest.approx(about_origin @ np.linalg.inv(before) @ about_origin, rel=0.01)
    np.testing.assert_allclose(np.hypot(*state.pose[:2]), np.hypot(30.0, 4.0), rtol=1e-6)
    assert se2.wrap_angle(state.pose[2] - 0.32) == pytest.approx(0.0, abs=1e-6)
