"""A problem in parts on a cluster: the bytes of this process, also after workers were killed in each of its stages."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from groundsbot.offline.foundation.cluster import ClusterWorkers
from groundsbot.offline.foundation.workers import TaskWorkers
from groundsbot.offline.sam.arrowhead.build import segment_starts
from groundsbot.offline.sam.arrowhead.system import UnderDeterminedError
from groundsbot.offline.sam.minimisation import Stopping
from groundsbot.offline.sam.partition.division import ProblemPart, Whole, divide
from groundsbot.offline.sam.partition.solver import PartitionedSolution, hold_parts, solve_parts
from groundsbot.offline.sam.partition.system import ThisProcess
from groundsbot.offline.sam.solver import Problem
from tests.support.data.graphs import make_graph, with_measured
from tests.support.devices.dying_workers import DyingWorkers
from tests.support.devices.local_cluster import (
    kill_worker_with_results,
    kill_workers,
    local_cluster,
    workers_of,
)

STAGES = ["part", "linearise", "eliminate", "add", "substitute", "covariances"]
LENGTHS = [60, 40, 50, 30, 45, 35, 40, 30, 50, 60]  # more than one level of the tree of sums


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with local_cluster() as made:
        yield made


@pytest.fixture
def workers(cluster: Any) -> Iterator[ClusterWorkers]:
    with workers_of(cluster) as made:
        yield made


@pytest.fixture(scope="module")
def problem() -> Problem:
    made, truth = make_graph(1, LENGTHS, 20)
    return with_measured(made, truth, 1, 3)


@pytest.fixture(scope="module")
def parts(problem: Problem) -> tuple[Whole, list[ProblemPart]]:
    return divide(problem, segment_starts(problem.odometry, sum(LENGTHS))[:-1].tolist())


@pytest.fixture(scope="module")
def here(parts: tuple[Whole, list[ProblemPart]]) -> PartitionedSolution:
    return solve_at(parts, ThisProcess())


def solve_at(parts: tuple[Whole, list[ProblemPart]], workers: TaskWorkers) -> PartitionedSolution:
    _, truth = make_graph(1, LENGTHS, 20)
    return solve_parts(hold_parts(*parts, workers), truth, stopping=Stopping(most_steps=3))


def assert_same_bytes(found: PartitionedSolution, here: PartitionedSolution) -> None:
    assert found.costs == here.costs
    assert found.state.poses.tobytes() == here.state.poses.tobytes()
    assert found.state.tags.tobytes() == here.state.tags.tobytes()
    assert found.state.calibration.tobytes() == here.state.calibration.tobytes()
    assert found.covariance_of_top.tobytes() == here.covariance_of_top.tobytes()
    poses = np.arange(len(here.state.poses))
    assert found.pose_covariances(poses).tobytes() == here.pose_covariances(poses).tobytes()


@pytest.mark.parametrize("stage", STAGES)
def test_a_worker_that_is_killed_in_a_stage_changes_no_byte(
    stage: str, cluster: Any, workers: ClusterWorkers, parts: tuple[Whole, list[ProblemPart]], here: PartitionedSolution
) -> None:
    dying = DyingWorkers(workers, stage, 2, lambda: kill_worker_with_results(cluster))
    assert_same_bytes(solve_at(parts, dying), here)
    assert dying.has_killed


def test_results_lost_with_all_workers_are_computed_again(
    cluster: Any, workers: ClusterWorkers, parts: tuple[Whole, list[ProblemPart]], here: PartitionedSolution
) -> None:
    dying = DyingWorkers(workers, "substitute", 2, lambda: kill_workers(cluster))
    assert_same_bytes(solve_at(parts, dying), here)


def test_a_singular_matrix_on_a_worker_is_one_here(workers: ClusterWorkers) -> None:
    with pytest.raises(UnderDeterminedError) as raised:
        workers.results(lambda _: workers.call("fail", fail_as_singular, 5), ["a"], lambda: None)
    assert raised.value.column == 5


def fail_as_singular(column: int) -> None:
    raise UnderDeterminedError(column)
