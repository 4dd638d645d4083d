"""A problem in parts is solved as in one: the same steps, optimum and covariances, whatever its parts share."""

import pickle
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import BoolArray, FloatArray, IntArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.sam.arrowhead.build import segment_starts
from groundsbot.offline.sam.arrowhead.system import UnderDeterminedError
from groundsbot.offline.sam.factors.odometry_and_observations import ObservationFactors, State
from groundsbot.offline.sam.factors.priors import NO_PRIORS, Priors, StartFactors
from groundsbot.offline.sam.minimisation import Stopping
from groundsbot.offline.sam.partition.division import divide
from groundsbot.offline.sam.partition.reduced import add, add_to_front, reduction_of, sum_in_tree
from groundsbot.offline.sam.partition.solver import PartitionedSolution, hold_parts, solve_parts
from groundsbot.offline.sam.partition.system import ThisProcess
from groundsbot.offline.sam.solver import DEFAULT_LOSSES, PLAIN_SQUARES, Problem, Solution, solve
from tests.support.data.graphs import make_graph, with_measured

NONE: IntArray = np.zeros(0, dtype=np.int64)
LENGTHS = [300, 40, 700, 90]  # the longest leaves separators in its own top


class Case(NamedTuple):
    """A problem and where it is solved from."""

    problem: Problem
    start: State
    segment_starts: IntArray


def make_case(seed: int, *, held: float = 0.0, n_measured: int = 0, calibrated: bool = True, n_robots: int = 2) -> Case:
    problem, truth = make_graph(seed, LENGTHS, 25, reach=0.1, held=held, calibrated=calibrated, n_robots=n_robots)
    problem = with_measured(problem, truth, seed, n_measured) if n_measured else problem
    return Case(problem, displaced(problem, truth, seed), segment_starts(problem.odometry, len(truth.poses)))


def displaced(problem: Problem, truth: State, seed: int) -> State:
    return problem.retract(truth, 0.02 * np.random.default_rng(seed).standard_normal(problem.columns.n))


def solve_in_parts(
    case: Case, first_segments: list[int], top_tags: IntArray | None = None, **options: Any
) -> PartitionedSolution:
    whole, parts = divide(case.problem, case.segment_starts[first_segments].tolist(), top_tags)
    return solve_parts(hold_parts(whole, parts, ThisProcess()), case.start, **options)


def some_of(observations: ObservationFactors, which: BoolArray) -> ObservationFactors:
    return ObservationFactors(**{each.name: getattr(observations, each.name)[which] for each in fields(observations)})


def assert_same(found: PartitionedSolution, single: Solution) -> None:
    assert (found.reason, found.converged, found.n_linearised) == (
        single.reason,
        single.converged,
        single.n_linearised,
    )
    np.testing.assert_allclose(found.costs, single.costs, rtol=1e-6)  # rounding moves weak directions of long steps
    assert found.cost == pytest.approx(single.cost, rel=1e-9)
    np.testing.assert_allclose(se2.between(single.state.poses, found.state.poses), 0.0, atol=1e-9)
    np.testing.assert_allclose(found.state.tags, single.state.tags, atol=1e-9)
    np.testing.assert_allclose(found.state.calibration, single.state.calibration, atol=1e-9)


def relative_to_sigmas(difference: FloatArray, covariance: FloatArray) -> float:
    """Largest difference (..., k, k) in units of the sigmas; 1 where fixed."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    sigma = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    return float((np.abs(difference) / (sigma[..., :, None] * sigma[..., None, :])).max())


@pytest.mark.parametrize("top_tags", [None, NONE], ids=["all tags in the top", "tags of one part are its own"])
@pytest.mark.parametrize(
    "first_segments", [[0], [0, 1, 2, 3], [0, 2]], ids=["one part", "segments", "several segments in a part"]
)
@pytest.mark.parametrize(
    "options",
    [{}, {"n_measured": 4}, {"held": 0.2, "n_measured": 3}, {"calibrated": False}, {"n_robots": 4}],
    ids=["calibration", "tape", "held", "no calibration", "a robot for each segment"],
)
def test_steps_and_covariances_are_those_of_one_system(
    options: dict[str, Any], first_segments: list[int], top_tags: IntArray | None
) -> None:
    case = make_case(3, **options)
    single, found = solve(case.problem, case.start), solve_in_parts(case, first_segments, top_tags)
    assert_same(found, single)
    whole, columns = found.linear.whole, case.problem.columns
    n_inside = len(columns.tags) - len(whole.top_tags)
    assert n_inside == 0 if top_tags is None else n_inside > 0 or "n_measured" in options
    wanted = np.concatenate(
        [
            columns.poses[case.segment_starts[:-1]].reshape(-1),
            columns.tags[whole.top_tags].reshape(-1),
            columns.calibration[whole.top_calibration],
        ]
    )
    # Both are compared at one state: their optima differ by rounding, which covariances magnify.
    found = solve_in_parts(case._replace(start=single.state), first_segments, top_tags)
    single = solve(case.problem, single.state)
    assert len(found.costs) == len(single.costs) == 1
    expected = single.covariance(wanted)
    rounding = max(1e-7, 2.0 * single.relative_error())
    assert relative_to_sigmas(found.covariance(wanted) - expected, expected) < rounding
    poses = np.arange(len(columns.poses))[::-1]
    of_poses = single.pose_covariances(poses)
    assert relative_to_sigmas(found.pose_covariances(poses) - of_poses, of_poses) < rounding


@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_damped_steps_and_what_they_promise_are_those_of_one_system(damping: float) -> None:
    case = make_case(3, n_measured=3)
    arrowhead = case.problem.arrowhead
    system, cost = arrowhead.linearise(case.start, *DEFAULT_LOSSES)
    expected, decrease = arrowhead.factorise(system, damping).step(damping)
    whole, parts = divide(case.problem, case.segment_starts[:-1].tolist(), NONE)
    linear = hold_parts(whole, parts, ThisProcess())
    blocks, found_cost = linear.linearise(case.start, *DEFAULT_LOSSES)
    step, found_decrease = linear.factorise(blocks, damping).step(damping)
    assert found_cost == pytest.approx(cost, rel=1e-12)
    assert found_decrease == pytest.approx(decrease, rel=1e-9)
    np.testing.assert_allclose(step, expected, atol=1e-6 * np.abs(expected).max())
    moved, wanted = (each.retract(case.start, expected, case.problem.anchor) for each in (linear, arrowhead))
    np.testing.assert_array_equal(moved.tags, wanted.tags)
    relative, wanted = (
        each.retract_relative(case.start, expected, case.problem.anchor, moved) for each in (linear, arrowhead)
    )
    np.testing.assert_array_equal(relative.poses, wanted.poses)


def test_a_part_without_a_tag_of_others_is_solved_beside_them() -> None:
    """It is held by a measured start; that of a pose within the part, which is not in the top."""
    case = make_case(3, calibrated=False)
    observations, starts = case.problem.observations, case.segment_starts
    in_last = observations.pose >= starts[3]
    own = np.isin(observations.tag, np.unique(observations.tag[in_last])[:4])
    apart = some_of(observations, own == in_last)
    pose = np.array([starts[3] + 20])
    measured = Priors(StartFactors(pose, case.start.poses[pose], 100.0 * np.eye(3)[None]), NO_PRIORS.distances)
    case = case._replace(problem=replace(case.problem, observations=apart, measured=measured))
    assert_same(solve_in_parts(case, [0, 1, 2, 3], NONE), solve(case.problem, case.start))


def test_what_nothing_ties_down_stays_at_its_start() -> None:
    """H is not positive definite then, and damped by as much as rounding needs."""
    case = make_case(3, calibrated=False)
    observations = some_of(case.problem.observations, case.problem.observations.pose < case.segment_starts[3])
    case = case._replace(problem=replace(case.problem, observations=observations))
    found, single = solve_in_parts(case, [0, 1, 2, 3]), solve(case.problem, case.start)
    assert found.cost == pytest.approx(single.cost, rel=1e-9)
    np.testing.assert_allclose(found.state.tags, single.state.tags, atol=1e-6)
    (start,) = found.covariance(case.problem.columns.poses[case.segment_starts[3]])[:1, :1].ravel()
    assert start > 1e6


def test_a_variable_in_no_factor_ends_the_solve_with_a_reason() -> None:
    case = make_case(3)
    columns = case.problem.columns
    tags = np.vstack([columns.tags, columns.n + np.arange(2)])
    unseen = replace(
        case.problem,
        columns=replace(columns, tags=tags, n=columns.n + 2),
        anchor=np.append(case.problem.anchor, 0),
    )
    start = State(case.start.poses, np.vstack([case.start.tags, [1.0, 1.0]]), case.start.calibration)
    found = solve_in_parts(case._replace(problem=unseen, start=start), [0, 2], NONE)
    assert (found.reason, found.converged) == ("a variable is in no factor", False)


def test_a_singular_part_is_named_by_its_error_also_after_it_was_sent() -> None:
    error = pickle.loads(pickle.dumps(UnderDeterminedError(7)))
    assert isinstance(error, UnderDeterminedError)
    assert (error.column, str(error)) == (7, str(UnderDeterminedError(7)))


def test_parts_that_divide_a_segment_are_refused() -> None:
    case = make_case(3)
    for first_poses in ([0, 5], [300], [0, 300, 300], [0, 340, 300]):
        with pytest.raises(ValueError, match="parts must begin with the first pose of a segment"):
            divide(case.problem, first_poses)


def test_a_state_of_other_sizes_is_refused() -> None:
    case = make_case(3)
    with pytest.raises(ValueError, match="another number of poses"):
        solve_in_parts(case._replace(start=replace(case.start, poses=case.start.poses[:-1])), [0, 1])


def test_covariances_are_of_the_top_alone() -> None:
    case = make_case(3)
    found = solve_in_parts(case, [0, 1, 2, 3], NONE, stopping=Stopping(most_steps=1))
    own = np.setdiff1d(np.arange(25), found.linear.whole.top_tags)
    for column in (case.problem.columns.poses[5], case.problem.columns.tags[own[0]]):
        with pytest.raises(
            ValueError, match="covariances are those of starts of segments, and of tags and calibration"
        ):
            found.covariance(column)


def test_a_later_solve_leaves_earlier_covariances_alone() -> None:
    case = make_case(3)
    whole, parts = divide(case.problem, case.segment_starts[[0, 2]].tolist())
    linear = hold_parts(whole, parts, ThisProcess())
    columns = case.problem.columns.tags.reshape(-1)
    first = solve_parts(linear, case.start, PLAIN_SQUARES)
    solve_parts(linear, case.start, PLAIN_SQUARES, Stopping(most_steps=1))
    found = first.covariance(columns)
    np.testing.assert_array_equal(found, solve_parts(linear, case.start, PLAIN_SQUARES).covariance(columns))


def test_the_order_of_a_sum_depends_on_the_number_of_members_alone() -> None:
    def bracket(members: Any) -> str:
        return f"({' '.join(members)})"

    assert sum_in_tree(["a"], bracket) == "a"
    assert sum_in_tree(list("abcdefghi"), bracket) == "((a b c d e f g h) (i))"


def test_reduced_systems_add_up_where_their_columns_meet() -> None:
    rng = np.random.default_rng(0)
    front, gradient = rng.standard_normal((6, 6)), np.zeros(6)
    expected, members = np.triu(front), []
    for columns in (np.array([0, 2, 3]), np.array([2, 5]), NONE):
        complement, own = rng.standard_normal((len(columns),) * 2), rng.standard_normal(len(columns))
        expected[np.ix_(columns, columns)] += np.triu(complement)
        gradient[columns] += own
        members.append(reduction_of(columns, complement, own, 6))
    total = add(members)
    add_to_front(total, front)
    np.testing.assert_allclose(np.triu(front), expected, atol=1e-15)
    np.testing.assert_allclose(total.gradient, gradient, atol=1e-15)
