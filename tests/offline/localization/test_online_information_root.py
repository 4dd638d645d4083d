"""The online estimate's square root against dense least squares, whatever the slices in which it takes a drive."""

from collections.abc import Iterator
from itertools import repeat

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.localization.online import information_root
from groundsbot.offline.localization.online.drive import GrowingArrays
from groundsbot.offline.localization.online.information_root import OnlineRoot
from groundsbot.offline.localization.online.localizer import OnlineLocalizer
from groundsbot.offline.localization.online.moving_frame import BorderPrior, pose_among, rotate_step
from groundsbot.offline.localization.online.prior import OnlinePrior
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.sam.factors.odometry_and_observations import State, stack
from groundsbot.offline.sam.graph import Graph, build_graph, unheld
from groundsbot.offline.sam.solver import HUBER_THRESHOLD
from tests.benchmarks.accuracy.localize_study import Scene, taken_one_by_one
from tests.support.online_drives import feed, root_about, straight_step, whole_root


def _dense(online: OnlineLocalizer, calibration: FloatArray) -> tuple[FloatArray, FloatArray, Graph, State]:
    """Information and gradient by the solver's own factors, of the same drive about the same points."""
    smoother, tags = online._smoother, online._index
    graph = unheld(build_graph([smoother.drive.segment(tags)]))
    names = {tag: smoother.map_tags[i] for tag, i in tags.items() if i in smoother.map_tags}
    numbers = dict(zip(online._parameters, calibration.tolist(), strict=True))
    graph = online._known.constrain(graph, names)
    problem = graph.problem
    state = graph.start(smoother.drive.poses.copy(), dict(zip(tags, smoother.places_m, strict=True)), numbers)
    residual = problem.observations.residual(state)
    root_weight = np.sqrt(np.minimum(1.0, HUBER_THRESHOLD / np.linalg.norm(residual, axis=1)))
    observations = problem.observations.linearise(state, problem.columns)
    weighed = type(observations)(
        root_weight[:, None] * observations.residual,
        tuple((columns, root_weight[:, None, None] * each) for columns, each in observations.blocks),
    )
    kinds = (
        problem.odometry.linearise(state, problem.columns),
        weighed,
        problem.prior.linearise(state, problem.columns),
    )
    jacobian, residuals = stack(kinds, problem.columns.n)
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
    monkeypatch.setattr(information_root, "_MOST_MOTIONS", most)
    calibration = online._smoother.calibration + np.where(online._smoother._numbers.columns >= 0, 1e-3, 0.0)
    root = whole_root(online, calibration)
    information, gradient, graph, _ = _dense(online, calibration)
    covariance = np.linalg.inv(information)
    step = -covariance @ gradient
    last, columns = graph.problem.columns.poses[-1], graph.problem.columns
    in_straight_lines = straight_step(root)
    np.testing.assert_allclose(in_straight_lines[:3], step[last], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(root.pose_covariance(), covariance[np.ix_(last, last)], rtol=1e-6)
    order = [graph.tags.index(_map_name(online, tag)) for tag in online._index]
    tags = columns.tags[order].reshape(-1)
    np.testing.assert_allclose(in_straight_lines[3 + root.prior.first_tag :], step[tags], atol=1e-9)
    np.testing.assert_allclose(root.tags_covariance(), covariance[np.ix_(tags, tags)], rtol=1e-5, atol=1e-12)


def test_poses_are_substituted_back_to_the_step_of_dense_least_squares(online: OnlineLocalizer) -> None:
    smoother = online._smoother
    calibration = smoother.calibration + np.where(smoother._numbers.columns >= 0, 1e-3, 0.0)
    information, gradient, graph, state = _dense(online, calibration)
    step = -np.linalg.solve(information, gradient)
    expected = se2.compose(state.poses, se2.exp(step[graph.problem.columns.poses]))
    root = whole_root(online, calibration)
    before = smoother.drive.poses.copy()
    root._step = straight_step(root)
    try:
        _finish(smoother._substitute_back(root))
        np.testing.assert_allclose(smoother.drive.poses, expected, atol=1e-8)
    finally:
        smoother.drive.poses[:] = before


def test_a_prior_is_the_maps_joint_information(online: OnlineLocalizer) -> None:
    known = online._known
    prior = OnlinePrior(online._known, online._smoother._numbers, online._smoother.calibration)
    tags = list(known.tags[:4])
    for tag in [tags[2], tags[0], tags[3], tags[1]]:
        prior.add(np.zeros(2), tag)
    of_map = np.flatnonzero(prior._in_map[: prior.n] >= 0)
    rows = prior._in_map[of_map]
    information = (prior.root.T @ prior.root)[np.ix_(of_map, of_map)]
    np.testing.assert_allclose(information @ known.covariance[np.ix_(rows, rows)], np.eye(len(rows)), atol=1e-5)


@pytest.mark.parametrize("turn_rad", [0.03, -0.3])
def test_a_drive_turned_in_its_map_has_the_same_answer(online: OnlineLocalizer, turn_rad: float) -> None:
    """About points turned by as much as a map's bend: the first step already ends where it did."""
    smoother, calibration = online._smoother, online._smoother.calibration
    straight = whole_root(online, calibration)
    before = smoother.drive.poses.copy()
    T = np.array([0.5, -0.2, turn_rad])
    try:
        smoother.drive.poses[:] = se2.compose(T, before)
        root = root_about(online, calibration, se2.apply(T, smoother.places_m))
        steps_m = straight_step(root)[3 + root.prior.first_tag :].reshape(-1, 2)
    finally:
        smoother.drive.poses[:] = before
    sigmas = np.sqrt(np.diag(straight.pose_covariance()))
    assert np.abs(root.pose - straight.pose).max() < 1e-3 * sigmas.max()
    np.testing.assert_allclose(root.places_m, straight.places_m, atol=1e-3 * sigmas.max())
    np.testing.assert_allclose(root.calibration, straight.calibration, atol=1e-5)
    assert np.abs(root.prior.places_m + steps_m - straight.places_m).max() > 1e-2  # as a step in straight lines ends


def test_what_is_read_after_a_turn_is_linearised_among_its_tags(scene: Scene) -> None:
    """Half way all points turn; where the robot is at the end, and where among the points, does not depend on it."""
    taken = list(taken_one_by_one(scene.drive.segment))

    def went_on(T: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        online = OnlineLocalizer(scene.known, scene.drive.segment.run.robot)
        feed(online, taken[: len(taken) // 2])
        smoother = online._smoother
        smoother.drive.poses[:] = se2.compose(T, smoother.drive.poses)
        smoother._places = list(se2.apply(T, smoother.places_m))
        smoother.front, smoother._work = whole_root(online, smoother.calibration), repeat(None)
        feed(online, taken[len(taken) // 2 :])
        assert online.pose is not None
        return online.pose.T_map_base, smoother.drive.poses[-1], np.sqrt(np.diag(online.pose.covariance))

    T = np.array([1.0, -0.5, 0.2])
    (pose, among, sigmas), (turned_pose, turned_among, _) = went_on(np.zeros(3)), went_on(T)
    assert np.abs((turned_pose - pose) / sigmas).max() < 0.01
    np.testing.assert_allclose(turned_among, se2.compose(T, among), atol=2e-3)


def test_a_relaxed_step_is_where_the_cost_with_arcs_is_least(online: OnlineLocalizer) -> None:
    """Against central differences of the cost, written down once more."""
    smoother = online._smoother
    calibration = smoother.calibration + np.where(smoother._numbers.columns >= 0, 1e-3, 0.0)
    places_m = se2.apply(np.array([0.1, 0.1, 0.05]), smoother.places_m)
    root = root_about(online, calibration, places_m)  # of poses that do not fit: it has to bend
    prior, n = root.prior, root.prior.n
    S, d = np.tril(root._root[:n, :n]), root._right[:n]

    def cost(step: FloatArray) -> float:
        straight, arcs = (prior.root @ (each - prior.off) for each in (step, _rotate(root, step)))
        return float(((S @ step - d) ** 2).sum() + (arcs**2).sum() - (straight**2).sum()) / 2.0

    found, unit = root.step[3:], np.linalg.inv(S)
    slopes = [(cost(found + 1e-3 * way) - cost(found - 1e-3 * way)) / 2e-3 for way in unit.T]
    began = straight_step(root)[3:]
    before = [(cost(began + 1e-3 * way) - cost(began - 1e-3 * way)) / 2e-3 for way in unit.T]
    assert np.linalg.norm(slopes) < 1e-3
    assert np.linalg.norm(before) > 1e-2
    assert cost(found) < cost(began)


@pytest.mark.parametrize("twist", [(0.3, -0.1, 0.2), (1.0, 2.0, 1.5), (0.1, 0.2, 0.0)])
def test_tags_that_turn_together_go_along_arcs(twist: tuple[float, float, float]) -> None:
    """A twist in straight lines is the motion of its exponential, and what a tag does besides turns with it."""
    rng = np.random.default_rng(0)
    places_m, first = rng.uniform(-10.0, 10.0, (5, 2)), 2
    middle = places_m.mean(axis=0)
    quarter = np.column_stack([-(places_m - middle)[:, 1], (places_m - middle)[:, 0]])
    straight = twist[2] * quarter + twist[:2]
    known = BorderPrior(np.zeros((12, 12)), np.zeros(12), np.concatenate([places_m, np.full((7, 2), np.nan)]))

    def went(steps_m: FloatArray) -> FloatArray:
        return rotate_step(known, np.concatenate([np.zeros(first), steps_m.reshape(-1)]), first)[first:].reshape(-1, 2)

    along_arcs = se2.apply(se2.exp(np.array(twist)), places_m - middle) + middle - places_m
    np.testing.assert_allclose(went(straight), along_arcs, atol=1e-12)
    aside = 0.1 * rng.standard_normal((5, 2))
    aside -= aside.mean(axis=0)
    aside -= (aside * quarter).sum() / (quarter**2).sum() * quarter
    turned_aside = se2.apply([0.0, 0.0, twist[2]], aside)
    np.testing.assert_allclose(went(straight + aside), along_arcs + turned_aside, atol=1e-12)


def test_a_pose_moves_along_with_the_tags_near_it() -> None:
    before_m = np.array([[0.0, 0.0], [2.0, 0.0], [1.0, 1.0], [40.0, 0.0]])
    T = np.array([0.3, -0.5, 0.2])
    pose = np.array([1.0, -1.0, 3.1])
    after_m = se2.apply(T, before_m)
    np.testing.assert_allclose(pose_among(before_m, after_m, se2.compose(T, pose), pose), pose, atol=1e-12)
    after_m[3] += [0.0, 1.0]  # far away, where the map bends
    np.testing.assert_allclose(pose_among(before_m, after_m, se2.compose(T, pose), pose), pose, atol=0.03)
    np.testing.assert_allclose(pose_among(np.zeros((0, 2)), np.zeros((0, 2)), se2.compose(T, pose), pose), pose)


@pytest.mark.parametrize("n_tags", [1, 2, 4])
@pytest.mark.parametrize("turn_rad", [0.0, 0.3])
def test_a_pose_does_not_turn_by_the_noise_of_tags_close_together(n_tags: int, turn_rad: float) -> None:
    """Of a single tag the rounding, of a few within 5 cm the noise of 1 cm, is no rotation."""
    rng = np.random.default_rng(0)
    for _ in range(500):
        point = np.append(rng.uniform(-3.0, 3.0, 2), rng.uniform(-np.pi, np.pi))
        T = np.append(rng.uniform(-1.0, 1.0, 2), turn_rad)
        before_m = rng.uniform(-6.0, 6.0, 2) + rng.uniform(-0.05, 0.05, (n_tags, 2)) * (n_tags > 1)
        after_m = se2.apply(T, before_m) + 0.01 * rng.standard_normal((n_tags, 2))
        moved = pose_among(before_m, after_m, se2.compose(T, point), point)
        np.testing.assert_allclose(moved[:2], point[:2], atol=0.1)
        assert abs(se2.wrap_angle(moved[2] - point[2])) < 0.02


def test_a_table_keeps_its_rows_when_it_grows() -> None:
    table = GrowingArrays(number=((), int), pair=((2,), float))
    for i in range(2500):
        table.append(number=i, pair=(i, -i))
    np.testing.assert_array_equal(table["number"], np.arange(2500))
    np.testing.assert_array_equal(table["pair"][:, 1], -np.arange(2500))


def test_a_call_does_a_bounded_share_of_a_round(online: OnlineLocalizer) -> None:
    """However long the drive: a slice ends after so many motions and observations."""
    smoother = online._smoother
    root = OnlineRoot(
        OnlinePrior(online._known, online._smoother._numbers, online._smoother.calibration), np.zeros(3), held=False
    )
    for place_m in smoother.places_m:
        root.add_tag(place_m, None)
    while not root.is_at_end_of(smoother.drive):
        before = root.keyframe, root.n_observations
        root.advance(smoother.drive)
        assert root.keyframe - before[0] <= 128
        assert (root.n_observations - before[1] - 1) * 4 * root.prior.n**2 <= information_root.SLICE
        assert (root.keyframe, root.n_observations) != before


def _rotate(root: OnlineRoot, step: FloatArray) -> FloatArray:
    return rotate_step(root._prior, step, root.prior.first_tag)


def _map_name(online: OnlineLocalizer, tag: TagKey) -> TagKey:
    """In this scene tags bear the map's names."""
    return online._smoother.map_tags.get(online._index[tag], tag)


def _finish(work: Iterator[None]) -> None:
    for _ in work:
        pass
