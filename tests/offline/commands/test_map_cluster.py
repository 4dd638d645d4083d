"""`map --scheduler`: the files of `map --workers 1`, also where workers are killed; and one line where it cannot be."""

import importlib.util
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from groundsbot.offline.errors import OfflineError
from groundsbot.offline.foundation import cluster as cluster_module
from groundsbot.offline.foundation.cluster import ClusterWorkers, cluster_workers
from groundsbot.offline.foundation.stages import Progress, Stages
from groundsbot.offline.foundation.workers import Workers
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.sam.partition import solver as parts_module
from tests.support.data.drives import make_robot, write_drive
from tests.support.data.map_cases import DRIVES, TAGS, make_logs
from tests.support.devices.dying_workers import DyingWorkers
from tests.support.devices.local_cluster import (
    kill_worker_with_results,
    limit_time,
    local_cluster,
    wait_for_workers,
    wait_until,
)
from tests.support.programs import Run

NOISE = "fitting the noise"


@pytest.fixture(scope="module")
def shared_cluster() -> Iterator[Any]:
    with local_cluster() as made:
        yield made


@pytest.fixture
def cluster(shared_cluster: Any) -> Iterator[Any]:
    wait_for_workers(shared_cluster)
    with limit_time():
        yield shared_cluster


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three short drives: one more than there are workers."""
    folder = tmp_path_factory.mktemp("drives")
    return [*make_logs(folder).values(), write_drive(folder, DRIVES["a"], TAGS, make_robot("c"))]


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def map_files(drives: list[Path], folder: Path, workers: Workers, notify: Progress | None = None) -> dict[str, bytes]:
    """The files of a map, without pictures."""
    stages = Stages(notify)
    result = build_map(read_runs(drives, None, stages, workers), stages=stages, workers=workers)
    folder.mkdir()
    write_map(result, folder)
    return files_in(folder)


@pytest.fixture(scope="module")
def expected(drives: list[Path], tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The files of one process."""
    return map_files(drives, tmp_path_factory.mktemp("expected") / "map", Workers())


def test_files_are_those_of_one_process(
    run: Run, cluster: Any, drives: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = drives[0].parents[1]
    monkeypatch.chdir(folder)  # workers have another one
    logs = [path.relative_to(folder) for path in drives]
    scheduler = ("--scheduler", cluster.scheduler_address)
    for name, options in (("one", ("--workers", 1)), ("cluster", scheduler)):
        outcome = run("map", *logs, "-o", tmp_path / name, *options)
        assert (outcome.code, outcome.err) == (0, "")
        outcome = run("calibrate", *logs, "-o", tmp_path / f"{name}_robots", *options)
        assert (outcome.code, outcome.err) == (0, "")
    assert files_in(tmp_path / "cluster") == files_in(tmp_path / "one")
    assert files_in(tmp_path / "cluster_robots") == files_in(tmp_path / "one_robots")


@pytest.mark.parametrize(
    "stage", ["reading logs", "wiring of the encoders", "keyframes and observations", "local maps", NOISE]
)
def test_a_worker_killed_in_the_middle_of_a_stage_changes_nothing(
    stage: str,
    cluster: Any,
    drives: list[Path],
    expected: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    killed: list[str] = []

    def kill() -> None:
        if not killed:
            kill_worker_with_results(cluster)
            killed.append(stage)

    def notify(name: str, done: int, _total: int) -> None:
        if (name, done) == (stage, 1) and stage != NOISE:
            kill()

    if stage == NOISE:
        before_second_call(monkeypatch, kill)
    with cluster_workers(cluster.scheduler_address) as workers:
        assert map_files(drives, tmp_path / "map", workers, notify) == expected
    assert killed == [stage]


@pytest.mark.parametrize("stage", ["nothing", "part", "linearise", "eliminate", "substitute"])
def test_a_fleet_is_solved_in_parts_as_in_one(
    stage: str,
    cluster: Any,
    drives: list[Path],
    expected: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A worker is killed in the middle of each stage of the solve too."""
    solving: list[DyingWorkers] = []

    def dying(workers: ClusterWorkers) -> DyingWorkers:
        solving.append(DyingWorkers(workers, stage, 2, partial(kill_worker_with_results, cluster)))
        return solving[-1]

    monkeypatch.setattr(parts_module, "LEAST_POSES", 1)
    monkeypatch.setattr(ClusterWorkers, "tasks", property(dying))
    with cluster_workers(cluster.scheduler_address) as workers:
        map_files(drives, tmp_path / "map", workers)
    assert any(each.has_killed for each in solving) == (stage != "nothing")
    (tmp_path / "one").mkdir()
    for name, content in expected.items():
        (tmp_path / "one" / name).write_bytes(content)
    one, parts = (read_map(tmp_path / name).components[0] for name in ("one", "map"))
    for tag, other in zip(one.tags, parts.tags, strict=True):
        np.testing.assert_allclose(other.position_m, tag.position_m, rtol=0.0, atol=1e-7)
    for run, other_run in zip(one.runs, parts.runs, strict=True):
        np.testing.assert_allclose(other_run.T_map_base, run.T_map_base, rtol=0.0, atol=1e-7)
    sigmas, other_sigmas = (np.sqrt(np.diag(each.joint_covariance)) for each in (one, parts))
    np.testing.assert_allclose(other_sigmas, sigmas, rtol=1e-6)


def before_second_call(monkeypatch: pytest.MonkeyPatch, action: Callable[[], None]) -> None:
    """Have something done before the second call of a function for items that stay on the cluster."""
    calls = []
    original = cluster_module._ClusterItems.map

    def count(self: Any, function: Any, argument: Any) -> Any:
        calls.append(function)
        if len(calls) == 2:
            action()
        return original(self, function, argument)

    monkeypatch.setattr(cluster_module._ClusterItems, "map", count)


@pytest.mark.parametrize(
    ("change", "seen"),
    [
        (lambda log: log.rename(log.with_name("elsewhere")), "is not seen there"),
        (lambda log: next(log.glob("*.mcap")).write_bytes(b"short"), r"has 5 bytes there, but \d+ here"),
    ],
    ids=["missing", "another"],
)
def test_a_log_that_a_worker_does_not_see_is_named_with_the_worker(
    change: Callable[[Path], object], seen: str, cluster: Any, logs: dict[str, Path]
) -> None:
    log = logs["b"]

    def notify(_name: str, done: int, _total: int) -> None:
        if done == 0:
            change(log)

    line = rf"^{log}: {seen} \(worker tcp://\S+ on \S+\); put logs where all workers see them as {log}, as in a"
    with cluster_workers(cluster.scheduler_address) as workers, pytest.raises(OfflineError, match=line):
        read_runs(list(logs.values()), None, Stages(notify), workers)


def test_a_damaged_log_is_mapped_as_far_as_it_can_be_read(
    run: Run, cluster: Any, logs: dict[str, Path], tmp_path: Path
) -> None:
    (file,) = logs["b"].glob("*.mcap")
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])
    for name, options in (("one", ("--workers", 1)), ("cluster", ("--scheduler", cluster.scheduler_address))):
        assert run("map", *logs.values(), "-o", tmp_path / name, *options).code == 3
    assert files_in(tmp_path / "cluster") == files_in(tmp_path / "one")


def test_a_cluster_has_workers_of_its_own(refused: Callable[..., str], logs: dict[str, Path]) -> None:
    line = refused(logs["a"], "--scheduler", "tcp://host:8786", "--workers", 2)
    assert line == (
        "error: --scheduler tcp://host:8786: the cluster has workers of its own; leave --workers 2 out, or "
        "--scheduler\n"
    )


def test_a_scheduler_that_is_not_there_leaves_nothing(refused: Callable[..., str], logs: dict[str, Path]) -> None:
    line = refused(logs["a"], "--scheduler", "tcp://127.0.0.1:1")
    assert line.startswith("error: --scheduler tcp://127.0.0.1:1: no scheduler answers there (")


def test_without_the_extra_a_line_says_how_to_install_it(
    refused: Callable[..., str], logs: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _name: None)
    line = refused(logs["a"], "--scheduler", "tcp://host:8786")
    assert line == (
        "error: --scheduler tcp://host:8786: distributed is not installed; pip install 'groundsbot[cluster]', or run "
        "without --scheduler\n"
    )


def test_an_interrupt_leaves_no_map_and_no_tasks(cluster: Any, drives: list[Path], tmp_path: Path) -> None:
    output = tmp_path / "map"
    program = "from groundsbot.offline.cli import main; main()"
    options = [*drives, "-o", output, "--scheduler", cluster.scheduler_address]
    process = subprocess.Popen(
        ["env", "--default-signal=INT", sys.executable, "-c", program, "map", *map(str, options)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    with process:
        wait_until(lambda: cluster.scheduler.tasks or process.poll() is not None)
        process.send_signal(signal.SIGINT)
        said = process.communicate()[0]
    assert (process.returncode, said) == (130, "interrupted\n")
    assert not output.exists()
    wait_until(lambda: not cluster.scheduler.tasks)
