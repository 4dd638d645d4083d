"""The online estimate's square root against dense least squares, whatever the slices in which it takes a drive."""

from collections.abc import Iterator

import numpy as np
import pytest

from calib import se2
from calib.arrays import FloatArray
from offline import online_root
from offline.factors import State, stacked
from offline.graph import Graph, build_graph, unheld
from offline.online_bend import bent_step, carried_along
from offline.online_drive import Table
from offline.online_localizer import OnlineLocalizer
from offline.online_prior import OnlinePrior
from offline.online_root import OnlineRoot
from offline.run import TagKey
from offline.solver import HUBER_THRESHOLD
from tests.benchmarks.localize_study import Scene, filtered, made_scene


@pytest.fixture(scope="module")
def scene() -> Scene:
    made = made_scene(4)
    assert made is not None
    return made


@pytest.fixture(scope="module")
def online(scene: Scene) -> OnlineLocalizer:
    return filtered(scene)[0]


def _root(online: OnlineLocalizer, calibration: FloatArray) -> OnlineRoot:
    """Through the whole drive, about where the estimate ended."""
    smoother = online._smoother
    prior = OnlinePrior(online._known, smoother._numbers, calibration)
    root = OnlineRoot(prior, smoother.drive.poses[0], held=False)
    for tag, place_m in enumerate(smoother.places_m):
        root.add_tag(place_m, smoother.held.get(tag))
    while not root.is_at_end_of(smoother.drive):
        root.advance(smoother.drive)
    return root


def _dense(online: OnlineLocalizer, calibration: FloatArray) -> tuple[FloatArray, FloatArray, Graph, State]:
    """Information and gradient by the solver's own factors, of the same drive about the same points."""
    smoother, tags = online._smoother, online._index
    graph = unheld(build_graph([smoother.drive.chain(tags)]))
    names = {tag: smoother.held[i] for tag, i in tags.items() if i in smoother.held}
    numbers = dict(zip(online._parameters, calibration.tolist(), strict=True))
    graph = online._known.held_in(graph, names)
    problem = graph.problem
    state = graph.start(smoother.drive.poses.copy(), dict(zip(tags, smoother.places_m, strict=True)), numbers)
    residual = problem.readings.residual(state)
    root_weight = np.sqrt(np.minimum(1.0, HUBER_THRESHOLD / np.linalg.norm(residual, axis=1)))
    readings = problem.readings.linearise(state, problem.columns)
    weighed = type(readings)(
        root_weight[:, None] * readings.residual,
        tuple((columns, root_weight[:, None, None] * each) for columns, each in readings.blocks),
    )
    kinds = (
        problem.odometry.linearise(state, problem.columns),
        weighed,
        problem.prior.linearise(state, problem.columns),
    )
    jacobian, residuals = stacked(kinds, problem.columns.n)
    information, gradient = (jacobian.T @ jacobian).toarray(), jacobian.T @ residuals
    factor = problem.measured.known
    at = factor.columns(problem.columns)
    information[np.ix_(at, at)] += factor.whitening.T @ factor.whitening
    gradient[at] += factor.whitening.T @ factor.residual(state)
    return information, gradient, graph, state


@pytest.mark.parametrize("most", [1, 7, 64])
def test_a_root_takes_the_step_of_dense_least_squares(
    online: OnlineLocalizer, monkeypatch: pytest.MonkeyPatch, most: int
) -> None:
    monkeypatch.setattr(online_root, "_MOST_MOTIONS", most)
    calibration = online._smoother.calibration + np.where(online._smoother._numbers.columns >= 0, 1e-3, 0.0)
    root = _root(online, calibration)
    information, gradient, graph, state = _dense(online, calibration)
    covariance = np.linalg.inv(information)
    step = -covariance @ gradient
    last, columns = graph.problem.columns.poses[-1], graph.problem.columns
    np.testing.assert_allclose(root.step[:3], step[last], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(root.pose_covariance(), covariance[np.ix_(last, last)], rtol=1e-6)
    order = [graph.tags.index(_called(online, tag)) for tag in online._index]
    tags = columns.tags[order].reshape(-1)
    np.testing.assert_allclose(root.places_m.reshape(-1) - state.tags[order].reshape(-1), step[tags], atol=1e-9)
    np.testing.assert_allclose(root.tags_covariance(), covariance[np.ix_(tags, tags)], rtol=1e-5, atol=1e-12)


def test_poses_are_substituted_back_to_the_step_of_dense_least_squares(online: OnlineLocalizer) -> None:
    smoother = online._smoother
    calibration = smoother.calibration + np.where(smoother._numbers.columns >= 0, 1e-3, 0.0)
    information, gradient, graph, state = _dense(online, calibration)
    step = -np.linalg.solve(information, gradient)
    expected = se2.compose(state.poses, se2.exp(step[graph.problem.columns.poses]))
    root = _root(online, calibration)
    before, is_placed = smoother.drive.poses.copy(), smoother.is_placed
    smoother.is_placed = False  # a plain step, without the bend
    try:
        _finish(smoother._substitute_back(root))
        np.testing.assert_allclose(smoother.drive.poses, expected, atol=1e-8)
    finally:
        smoother.is_placed, smoother.drive.poses[:] = is_placed, before


def test_a_prior_is_the_maps_joint_information(online: OnlineLocalizer) -> None:
    smoother, known = online._smoother, online._known
    prior = OnlinePrior(known, smoother._numbers, smoother.calibration)
    tags = list(known.tags[:4])
    for tag in [tags[2], tags[0], tags[3], tags[1]]:
        prior.add(np.zeros(2), tag)
    of_map = np.flatnonzero(prior._in_map[: prior.n] >= 0)
    rows = prior._in_map[of_map]
    information = (prior.root.T @ prior.root)[np.ix_(of_map, of_map)]
    np.testing.assert_allclose(information @ known.covariance[np.ix_(rows, rows)], np.eye(len(rows)), atol=1e-5)


def test_places_that_turn_with_the_pose_go_along_arcs(online: OnlineLocalizer) -> None:
    """To second order, what `bent_step` counts: phi J (dx - dp) + phi^2 (x - p) / 2."""
    root = _root(online, online._smoother.calibration)
    step = 1e-3 * np.random.default_rng(0).standard_normal(3 + root.prior.n)
    cos, sin = np.cos(root.point[2]), np.sin(root.point[2])
    along = np.array([[cos, -sin], [sin, cos]]) @ step[:2]
    straight = root.prior.places_m + step[3 + root.prior.first_tag :].reshape(-1, 2)
    turned = straight - root.prior.places_m - along
    bend = step[2] * np.column_stack([-turned[:, 1], turned[:, 0]])
    bend += 0.5 * step[2] ** 2 * (root.prior.places_m - root.point[:2])
    found = carried_along(root, step) - straight
    np.testing.assert_allclose(found, bend, atol=5e-8)
    assert np.abs(bend).max() > 1e-6


def test_a_bent_step_solves_with_the_bend(online: OnlineLocalizer) -> None:
    """The gradient of the quadratic cost with the bend's term vanishes there."""
    root = _root(online, online._smoother.calibration + np.where(online._smoother._numbers.columns >= 0, 1e-3, 0.0))
    n, first = root.prior.n, 3 + root.prior.first_tag
    information = np.linalg.inv(root.variance_of(np.eye(3 + n)))
    step = root.step
    pull = (root.prior.root.T @ (root.prior.root @ (step[3:] - root.prior.off)))[root.prior.first_tag :].reshape(-1, 2)
    cos, sin = np.cos(root.pose[2]), np.sin(root.pose[2])
    from_pose = root.places_m - root.pose[:2]

    def bent(at: FloatArray) -> float:
        moved = at[first:].reshape(-1, 2) - np.array([[cos, -sin], [sin, cos]]) @ at[:2]
        turned = np.column_stack([-moved[:, 1], moved[:, 0]])
        off = at - step
        return float(0.5 * off @ information @ off + (pull * (at[2] * turned + 0.5 * at[2] ** 2 * from_pose)).sum())

    found = bent_step(root)
    for way in np.eye(3 + n)[[0, 1, 2, first, first + 1]]:
        slope = (bent(found + 1e-4 * way) - bent(found - 1e-4 * way)) / 2e-4
        plain = (bent(step + 1e-4 * way) - bent(step - 1e-4 * way)) / 2e-4
        assert abs(slope) < max(1e-6, 1e-4 * abs(plain))


def test_a_table_keeps_its_rows_when_it_grows() -> None:
    table = Table(number=((), int), pair=((2,), float))
    for i in range(2500):
        table.append(number=i, pair=(i, -i))
    np.testing.assert_array_equal(table["number"], np.arange(2500))
    np.testing.assert_array_equal(table["pair"][:, 1], -np.arange(2500))


def test_a_call_does_a_bounded_share_of_a_round(online: OnlineLocalizer) -> None:
    """However long the drive: a slice ends after so many motions and readings."""
    smoother = online._smoother
    root = OnlineRoot(OnlinePrior(online._known, smoother._numbers, smoother.calibration), np.zeros(3), held=False)
    for place_m in smoother.places_m:
        root.add_tag(place_m, None)
    while not root.is_at_end_of(smoother.drive):
        before = root.keyframe, root.n_readings
        root.advance(smoother.drive)
        assert root.keyframe - before[0] <= 64
        assert (root.n_readings - before[1] - 1) * 4 * root.prior.n**2 <= online_root.SLICE
        assert (root.keyframe, root.n_readings) != before


def _called(online: OnlineLocalizer, tag: TagKey) -> TagKey:
    """In this scene tags bear the map's names."""
    return online._smoother.held.get(online._index[tag], tag)


def _finish(work: Iterator[None]) -> None:
    for _ in work:
        pass
