"""Steps taken motion by motion, and parts of steps: what long drives past few tags need to arrive."""

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.sam.arrowhead.system import Arrowhead
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.graph import build_graph
from groundsbot.offline.sam.solver import PLAIN_SQUARES, solve
from groundsbot.offline.sam.step import StepStart, take_step
from tests.support.data.graphs import make_graph
from tests.support.data.long_drives import make_long_drive


def both_ways(step: float) -> tuple[Arrowhead, State, State, State, FloatArray]:
    """A random step of some size: before, pose by pose, motion by motion, and the step."""
    problem, state = make_graph(3, [40, 25], 6)
    random = step * np.random.default_rng(1).standard_normal(problem.columns.n)
    ordered = problem.arrowhead.in_order(random)
    moved = problem.arrowhead.retract(state, ordered, problem.anchor)
    return (
        problem.arrowhead,
        state,
        moved,
        problem.arrowhead.retract_relative(state, ordered, problem.anchor, moved),
        ordered,
    )


def difference(one: State, other: State) -> float:
    return float(
        max(np.abs(se2.between(one.poses, other.poses)).max(), np.abs(one.tags - other.tags).max())
        + np.abs(one.calibration - other.calibration).max()
    )


def test_tags_move_rigidly_with_their_anchors_and_by_the_rest_of_their_own_step() -> None:
    """The compiled retraction against its definition, written with arrays."""
    problem, state = make_graph(3, [40, 25], 6)
    step = 0.3 * np.random.default_rng(1).standard_normal(problem.columns.n)
    padded = np.append(step, 0.0)  # column -1: fixed
    by_pose, before = padded[problem.columns.poses], state.poses[problem.anchor]
    poses = se2.compose(state.poses, se2.exp(by_pose))
    anchor_step, from_anchor = by_pose[problem.anchor], se2.apply(se2.inverse(before), state.tags)
    rigid = anchor_step[:, :2] + anchor_step[:, 2:] * np.stack([-from_anchor[:, 1], from_anchor[:, 0]], axis=-1)
    own = se2.apply(before * [0.0, 0.0, -1.0], padded[problem.columns.tags]) - rigid
    found = problem.retract(state, step)
    np.testing.assert_allclose(se2.between(poses, found.poses), 0.0, atol=1e-14)
    np.testing.assert_allclose(found.tags, se2.apply(poses[problem.anchor], from_anchor + own), atol=1e-13)
    np.testing.assert_array_equal(found.calibration, state.calibration + padded[problem.columns.calibration])


def test_both_ways_agree_to_first_order() -> None:
    coarse, fine = (difference(*both_ways(step)[2:4]) for step in (1e-3, 1e-4))
    assert 0.0 < coarse < 1.0
    assert fine == pytest.approx(0.01 * coarse, rel=0.2)  # of second order


def test_motion_by_motion_each_motion_takes_its_own_part_of_the_step_alone() -> None:
    """However far the segment as a whole is carried, what a motion changes by is what its two ends disagree in."""
    arrowhead, before, _, after, step = both_ways(0.5)
    poses = step[: 3 * len(before.poses)].reshape(-1, 3)
    for first, last in zip(arrowhead.tree.segment_start[:-1], arrowhead.tree.segment_start[1:], strict=True):
        motion = se2.between(before.poses[first : last - 1], before.poses[first + 1 : last])
        carried = np.einsum("nij,nj->ni", se2.adjoint(se2.inverse(motion)), poses[first : last - 1])
        own = poses[first + 1 : last] - carried
        now = se2.between(after.poses[first : last - 1], after.poses[first + 1 : last])
        np.testing.assert_allclose(se2.between(se2.compose(motion, se2.exp(own)), now), 0.0, atol=1e-12)


def test_a_step_too_long_is_taken_as_far_as_the_lowest_cost_along_it() -> None:
    problem, truth = make_graph(3, [40, 25], 6)
    arrowhead = problem.arrowhead
    optimum = solve(problem, truth, losses=PLAIN_SQUARES).state
    aside = 1e-3 * np.random.default_rng(3).standard_normal(problem.columns.n)
    near = problem.retract(optimum, aside)
    system, cost = arrowhead.linearise(near, *PLAIN_SQUARES)
    step = -arrowhead.factorise(system).solve_in_order(system.gradient)
    decrease = -0.5 * float(system.gradient @ step)
    for times in (1.0, 1.9, 2.5, 6.0):  # the second lowers the cost too, by a fifth as much
        taken = take_step(
            arrowhead,
            PLAIN_SQUARES,
            problem.anchor,
            StepStart(near, cost, False),
            times * step,
            times * decrease,
            arrowhead.empty_system(),
        )
        assert taken.share == pytest.approx(1.0 / times, rel=0.05)
        assert cost - taken.cost == pytest.approx(decrease, rel=0.05)
    for times in (-1.0, 50.0):  # uphill, and far too long
        before = StepStart(near, cost, False)
        spare = arrowhead.empty_system()
        taken = take_step(arrowhead, PLAIN_SQUARES, problem.anchor, before, times * step, abs(times) * decrease, spare)
        assert taken.cost == np.inf
        assert taken.n_linearised <= 4


@pytest.mark.parametrize("relative", [False, True])
def test_the_blocks_of_a_step_are_those_at_its_state(relative: bool) -> None:
    """Also where the other retraction and a shorter step are tried after it, and found worse."""
    problem, truth = make_graph(3, [40, 25], 6)
    arrowhead = problem.arrowhead
    system, cost = arrowhead.linearise(truth, *PLAIN_SQUARES)
    step = -arrowhead.factorise(system).solve_in_order(system.gradient)
    for expected, n_linearised in ((0.0, 1), (1e9, 3)):
        spare = arrowhead.empty_system()
        before = StepStart(truth, cost, relative)
        taken = take_step(arrowhead, PLAIN_SQUARES, problem.anchor, before, step, expected, spare)
        assert taken.n_linearised == n_linearised
        wanted, taken_cost = arrowhead.linearise(taken.state, *PLAIN_SQUARES)
        assert taken.cost == taken_cost
        for found, block in zip(spare, wanted, strict=True):
            np.testing.assert_array_equal(found, block)


def test_a_long_drive_past_few_tags_arrives_in_few_steps() -> None:
    drive = make_long_drive(25, 500.0)
    graph = build_graph([drive.segment])
    solution = solve(graph.problem, drive.true_state(graph))
    assert solution.converged
    assert solution.n_linearised < 40
