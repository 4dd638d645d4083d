"""What is predicted of one more pass or tag is what a solve with it would find, and the best of them is advised."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.offline.advice.advice import advise, best_candidates, find_candidates, tag_joint_covariance
from groundsbot.offline.advice.new_tags import TagSite, new_tag_gain, site_beside
from groundsbot.offline.advice.passes import max_repeat_length_m, repeat_drive_gain
from groundsbot.offline.advice.visibility import expected_sigmas_m, visibility_probabilities
from groundsbot.offline.measurements.segment import Segment
from groundsbot.offline.measurements.sensor_model.observations import concatenate_observations
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.report.sentences import advice_sentence
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.graph import Graph, build_graph
from groundsbot.offline.sam.solver import Solution
from tests.benchmarks.trust.advice_study import Scene, make_scene, sigmas_among, trial

NEW = TagKey("tag36h11", 500)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(0)


def sigmas_at(graph: Graph, state: State, tags: Sequence[TagKey]) -> FloatArray:
    """Exact ones of some tags, where a graph is linearised at a state."""
    return sigmas_among(graph, Solution(state, (0.0,), "", True, graph.problem), tags)


def test_one_more_pass_has_the_predicted_effect(scene: Scene) -> None:
    candidates = find_candidates(scene.graph, scene.solution.state)
    wanted = candidates.repeat_drives[len(candidates.repeat_drives) // 2]
    gain = repeat_drive_gain(scene.graph, scene.solution.state, wanted)
    predicted = tag_joint_covariance(scene.solution, [gain]).predicted_sigmas_m(gain)
    part = scene.graph.segments[wanted.segment].part(wanted.first, wanted.last + 1)
    graph = build_graph([*scene.graph.segments, replace(part, name="again")])
    state = scene.solution.state
    driven = scene.graph.poses_of(state, wanted.segment)[wanted.first : wanted.last + 1]
    after = State(np.concatenate([state.poses, driven]), state.tags, state.calibration)
    np.testing.assert_allclose(predicted, sigmas_at(graph, after, scene.graph.tags), rtol=1e-5)
    assert predicted.max() < 0.999 * tag_joint_covariance(scene.solution, []).sigmas_m().max()


def test_a_pass_tells_nothing_of_calibrations_that_it_does_not_use(scene: Scene) -> None:
    """A fleet has a hundred times as many, and the cost of advice would grow with their cube."""
    columns, state = scene.graph.problem.columns, scene.solution.state
    free, n = columns.calibration >= 0, columns.n
    others = np.arange(n, n + 30)
    more = replace(columns, calibration=np.concatenate([columns.calibration, others]), n=n + len(others))
    fleet = replace(scene.graph, problem=replace(scene.graph.problem, columns=more))
    fleet_state = replace(state, calibration=np.append(state.calibration, np.zeros(len(others))))
    for wanted in find_candidates(scene.graph, state).repeat_drives[:3]:
        gain = repeat_drive_gain(fleet, fleet_state, wanted)
        assert np.isin(columns.calibration[free], gain.columns).any()
        assert not np.isin(others, gain.columns).any()


def test_one_more_tag_has_the_predicted_effect(scene: Scene) -> None:
    found = find_candidates(scene.graph, scene.solution.state)
    place = max(found.tag_sites, key=lambda each: each.n_tracks)
    gain = new_tag_gain(found.paths, found.view_statistics, place)
    predicted = tag_joint_covariance(scene.solution, [gain]).predicted_sigmas_m(gain)
    state, segments = scene.solution.state, list(scene.graph.segments)
    for i, segment in enumerate(segments):
        first = int(scene.graph.first_pose[i])
        keyframe = place.viewers[(place.viewers >= first) & (place.viewers < first + len(segment.stamps_ns))] - first
        if not len(keyframe):
            continue
        like = segment.observations.where(np.zeros(len(keyframe), dtype=np.int64))
        n_each = max(found.view_statistics.observations_per_track * place.n_tracks / len(place.viewers), 1.0)
        new = replace(
            like,
            keyframe=keyframe,
            tag=np.full(len(keyframe), len(segment.tags)),
            value=_tags_seen(found.paths.sensors[first + keyframe], place),
            covariance=like.covariance / n_each,  # all observations of these drives have the same
        )
        both = concatenate_observations(segment.observations, new)
        both = both.where(np.argsort(both.keyframe, kind="stable"))
        segments[i] = replace(segment, tags=(*segment.tags, NEW), observations=both)
    after = State(state.poses, np.vstack([state.tags, place.position_m]), state.calibration)
    np.testing.assert_allclose(predicted, sigmas_at(build_graph(segments), after, scene.graph.tags), rtol=1e-4)


def test_no_tag_is_advised_beside_a_drive_that_read_none(scene: Scene) -> None:
    """Its mount and scale would be another robot's."""
    found = find_candidates(scene.graph, scene.solution.state)
    place = found.tag_sites[0]
    pose = int(scene.graph.first_pose[place.segment]) + place.keyframe
    assert pose in site_beside(found.paths, found.view_statistics, place.segment, place.keyframe, 1.0).viewers
    lengths = [len(each.stamps_ns) for each in scene.graph.segments]
    is_silent = np.repeat(np.arange(len(lengths)), lengths) == place.segment
    drives = found.paths._replace(example_observation=np.where(is_silent, -1, found.paths.example_observation))
    assert not len(site_beside(drives, found.view_statistics, place.segment, place.keyframe, 1.0).viewers)


def _tags_seen(sensors: FloatArray, place: TagSite) -> FloatArray:
    away = place.position_m - sensors[:, :2]
    return np.column_stack([np.hypot(*away.T), np.arctan2(away[:, 1], away[:, 0]) - sensors[:, 2]])


def test_the_best_of_each_kind_is_advised(scene: Scene) -> None:
    told = advise(scene.graph, scene.solution, 0)
    best = best_candidates(scene.graph, scene.solution)
    assert sorted(each.kind for each in told) == ["pass", "tag"]
    assert told[0].sigma_then_m <= told[1].sigma_then_m < told[0].sigma_m == pytest.approx(best[0].sigmas_m.max())
    found = find_candidates(scene.graph, scene.solution.state)
    gains = {"pass": [repeat_drive_gain(scene.graph, scene.solution.state, each) for each in found.repeat_drives]}
    drives, view = found.paths, found.view_statistics
    gains["tag"] = [new_tag_gain(drives, view, each) for each in found.tag_sites]
    known = tag_joint_covariance(scene.solution, gains["tag"])
    shares = [visibility_probabilities(drives, view, each, known) for each in found.tag_sites]
    assert {float(each.max()) for each in shares} == {1.0}  # from the pose beside it
    assert min(float(each.min()) for each in shares) < 0.9  # some may have passed too far away
    expected = [expected_sigmas_m(drives, view, each, known).max() for each in found.tag_sites]
    for certain, doubtful in zip(gains["tag"], expected, strict=True):
        assert (
            known.predicted_sigmas_m(certain).max() <= doubtful * (1.0 + 1e-9) <= known.sigmas_m().max() * (1.0 + 1e-9)
        )
    by_pass = tag_joint_covariance(scene.solution, gains["pass"])
    predicted = {"tag": expected, "pass": [by_pass.predicted_sigmas_m(gain).max() for gain in gains["pass"]]}
    for each in told:
        assert each.sigma_then_m == pytest.approx(min(predicted[each.kind]))
    (advised,) = [each for each in told if each.kind == "pass"]
    assert advised.length_m is not None
    assert 0.0 < advised.length_m <= max_repeat_length_m(found.paths.along_m) <= 50.0
    assert np.hypot(*np.diff(advised.way_m, axis=0).T).sum() <= 1.01 * advised.length_m


def test_the_same_map_gets_the_same_advice(scene: Scene) -> None:
    first, second = (advise(scene.graph, scene.solution, 0) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.way_m, b.way_m)
        assert (a.tags, a.sigma_then_m) == (b.tags, b.sigma_then_m)


def test_covariances_that_mean_nothing_give_no_advice(scene: Scene) -> None:
    assert advise(scene.graph, replace(scene.solution, converged=False), 0) == []
    alone = build_graph([replace(segment, name=str(i)) for i, segment in enumerate(_strangers(scene))])
    state = State(
        np.concatenate([each.T_start_base for each in scene.maps[:2]]),
        np.zeros((len(alone.tags), 2)),
        np.zeros(len(alone.parameters)),
    )
    assert advise(alone, Solution(state, (0.0,), "", True, alone.problem), 0) == []


def _strangers(scene: Scene) -> list[Segment]:
    first, second, *_ = (each.segment for each in scene.maps)
    return [first, replace(second, tags=tuple(TagKey(tag.family, tag.tag_id + 200) for tag in second.tags))]


def test_the_advice_in_words() -> None:
    advice = {
        "kind": "pass",
        "run": "blue_two",
        "tags": [{"family": "f", "tag_id": 3, "instance": ""}, {"family": "f", "tag_id": 7, "instance": "b"}],
        "way_m": [[0.0, 1.0], [4.0, 1.0]],
        "length_m": 14.2,
        "worst_tag": {"family": "f", "tag_id": 12, "instance": ""},
        "sigma_m": 0.314,
        "sigma_then_m": 0.181,
        "of_shape": True,
    }
    assert advice_sentence(advice, several_families=False) == (
        "One more pass from tag 3 to tag 7b, 14 m along the path of blue_two, would reduce the largest sigma relative "
        "to the other tags, tag 12's, from 0.31 m to about 0.18 m."
    )
    one = {"kind": "tag", "way_m": [[4.04, -1.0]], "tags": advice["tags"][:1]}  # type: ignore[index]
    tag = advice | one | {"of_shape": False}
    assert advice_sentence(tag, several_families=True) == (
        "One more tag at x 4.0 m, y -1.0 m (beside the path of blue_two; nearest is tag f:3), and the same drives "
        "again, would reduce the largest sigma, tag f:12's, from 0.31 m to about 0.18 m."
    )
    assert advice_sentence(advice | {"sigma_then_m": 0.29}, several_families=False) == (
        "One more pass would hardly help: the largest sigma relative to the other tags, tag 12's, would fall from "
        "0.31 m to 0.29 m at best."
    )


def test_taking_the_advice_helps_more_than_chance(scene: Scene) -> None:
    """The study in small."""
    outcome = trial(scene, 0, 3)
    assert outcome.n_beaten(0, ["pass", "tag"]) >= 5
    assert outcome.found_m[0] == pytest.approx(outcome.foretold_m[0], rel=0.15)


def test_the_prediction_for_a_tag_that_may_be_missed_lies_between_seen_and_not(scene: Scene) -> None:
    """Observations that count by their probability would promise nearly all the information of certain ones."""
    found = find_candidates(scene.graph, scene.solution.state)
    drives, view = found.paths, found.view_statistics
    known = tag_joint_covariance(scene.solution, [new_tag_gain(drives, view, each) for each in found.tag_sites])
    shares = [visibility_probabilities(drives, view, each, known) for each in found.tag_sites]
    place, share = min(zip(found.tag_sites, shares, strict=True), key=lambda each: float(each[1].min()))
    without = known.predicted_sigmas_m(new_tag_gain(drives, view, place, share > share.min()))
    with_it = known.predicted_sigmas_m(new_tag_gain(drives, view, place))
    expected = expected_sigmas_m(drives, view, place, known)
    worst = int(np.argmax(without - with_it))
    assert with_it[worst] < expected[worst] < known.sigmas_m()[worst]
    # Where not all see it, those that may have been farthest off do not.
    assert expected[worst] >= share.min() * with_it[worst] + (1.0 - share.min()) * without[worst] - 1e-9
