"""The problem of a segment's beginning, cut out of that of the whole."""

import numpy as np
import pytest

from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.graph import build_graph
from groundsbot.offline.sam.growing_problem import GrowingProblem
from groundsbot.offline.sam.solver import solve
from tests.support.data.long_drives import make_long_drive


def test_each_beginning_has_the_solution_of_a_graph_of_its_own() -> None:
    """From the solution of the beginning before, with the same dead reckoning and the same first guess of new tags."""
    segment = make_long_drive(4, 120.0).segment
    whole = build_graph([segment])
    growing, state = GrowingProblem(whole), GrowingProblem(whole).start()
    for n_keyframes in (40, 41, 300, len(segment.stamps_ns)):
        problem, graph = growing.cut(n_keyframes), build_graph([segment.prefix(n_keyframes)])
        start = growing.extend(state, problem)
        tags = dict(zip(growing.tags, start.tags, strict=False))
        assert set(tags) == set(graph.tags)
        calibration = whole.calibration_of(state)
        own = graph.tags_of(graph.start(start.poses, {}, calibration))
        for tag in graph.tags:
            if tag not in growing.tags[: len(state.tags)]:
                np.testing.assert_allclose(tags[tag], own[tag], atol=1e-12)
        found = solve(problem, start)
        wanted = solve(graph.problem, graph.start(start.poses, tags, calibration))
        assert found.converged
        assert found.cost == pytest.approx(wanted.cost, rel=1e-9)
        np.testing.assert_allclose(found.state.poses, wanted.state.poses, atol=1e-7)
        of_tags = dict(zip(growing.tags, found.state.tags, strict=False))
        for tag, place in graph.tags_of(wanted.state).items():
            np.testing.assert_allclose(of_tags[tag], place, atol=1e-7)
        state = found.state


def test_the_rest_is_by_dead_reckoning_under_the_calibration_so_far() -> None:
    segment = make_long_drive(5, 60.0).segment
    whole = build_graph([segment])
    growing = GrowingProblem(whole)
    problem = growing.cut(50)
    state = solve(problem, growing.extend(growing.start(), problem)).state
    poses = growing.dead_reckon(state, len(segment.stamps_ns))
    np.testing.assert_array_equal(poses[:50], state.poses)
    rest = whole.problem.odometry.part(slice(49, None))
    left = rest.residual(State(poses, np.zeros((len(whole.tags), 2)), state.calibration))
    np.testing.assert_allclose(left, 0.0, atol=1e-6)
