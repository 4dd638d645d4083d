"""The report of a fleet stays small and quick, however many drives have seen each tag."""

import re
import time
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from groundsbot.offline.alignment.merging import Group
from groundsbot.offline.local_map.archive import run_without_log, segment_from_arrays
from groundsbot.offline.local_map.local_map import LocalMap
from groundsbot.offline.mapping.workings import Diagnostics, SolvedGroup
from groundsbot.offline.maps.frame import MOST_PAIRED_RUNS, start_vectors
from groundsbot.offline.maps.result import Component, MapResult, RunResult, TagResult
from groundsbot.offline.measurements.segment import Segment
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.report.join_tables import essential_tags
from groundsbot.offline.report.report import write_report
from groundsbot.offline.sam.factors.odometry_and_observations import State
from groundsbot.offline.sam.graph import build_graph
from groundsbot.offline.sam.solver import Solution
from tests.offline.report.conftest import Inside
from tests.support.data.drives import START_NS, S, make_robot
from tests.support.data.maps import make_map
from tests.support.report_reader import Read, data_of

pytest.importorskip("plotly", reason="no plotly: `make setup` installs it; without it there is no report")

N_DRIVES, N_KEYFRAMES, N_TAGS = 100, 1100, 1000  # more keyframes than are drawn, as in a longer drive
TAGS = tuple(TagKey("tag36h11", i) for i in range(N_TAGS))


def segment_of(name: str, rng: np.random.Generator) -> Segment:
    """A drive that reads each tag once."""
    steps, robot = N_KEYFRAMES - 1, make_robot(name)
    motions = np.tile([0.05, 0.0, 0.01], (steps, 1)), np.tile(np.eye(3) * 1e-6, (steps, 1, 1)), np.zeros((steps, 3, 3))
    return segment_from_arrays(
        replace(run_without_log(name, robot, TAGS), run_id="2026-05-01T10-00-00"),
        START_NS + np.arange(N_KEYFRAMES) * S,
        motions,
        TAGS,
        np.sort(rng.integers(0, N_KEYFRAMES, N_TAGS)),
        rng.permutation(N_TAGS),
        np.column_stack([rng.uniform(0.5, 3.0, N_TAGS), rng.uniform(-0.5, 0.5, N_TAGS)]),
        np.tile(np.eye(2) * 1e-4, (N_TAGS, 1, 1)),
        np.zeros((N_TAGS, 2, 5)),
        np.ones(N_TAGS, dtype=np.bool_),
        np.zeros(N_TAGS, dtype=np.bool_),
    )


@pytest.fixture(scope="module")
def fleet() -> Inside:
    """A map of a fleet in which each drive has seen each tag."""
    rng = np.random.default_rng(3)
    names = [f"robot{i:02d}_2026-05-01T10-00-00" for i in range(N_DRIVES)]
    segments = [segment_of(name, rng) for name in names]
    graph = build_graph(segments)
    places = rng.uniform(-50.0, 50.0, (N_TAGS, 2))
    poses = rng.uniform(-50.0, 50.0, (N_DRIVES * N_KEYFRAMES, 3))
    solution = cast("Solution", SimpleNamespace(state=State(poses, places, np.zeros(len(graph.parameters)))))
    runs = tuple(
        RunResult(
            name, name, Path("logs") / name, f"robot{i:02d}", "2026-05-01T10-00-00", own[0], np.eye(3), each.stamps_ns,
            own, 55.0,
        )
        for i, (name, each, own) in enumerate(zip(names, segments, np.split(poses, N_DRIVES), strict=True))
    )  # fmt: skip
    tags = tuple(
        TagResult(*tag, None, place, np.eye(2) * 1e-4, N_DRIVES, tuple(names))
        for tag, place in zip(TAGS, places, strict=True)
    )
    joint = np.eye(3 * N_DRIVES + 2 * N_TAGS) * 1e-4
    component = Component(names[0], runs, tags, joint, 1.0, N_DRIVES * N_TAGS, start_vectors(runs, joint))
    result: MapResult = replace(make_map(component), alignments=(), calibration=(), checks=(), measurements=())
    own_maps = [
        SimpleNamespace(segment=each, T_start_base=run.T_map_base, tags_m=dict(zip(TAGS, places, strict=True)))
        for each, run in zip(segments, runs, strict=True)
    ]
    group = Group(tuple(range(N_DRIVES)), np.array([run.T_map_start for run in runs]))
    return result, Diagnostics(cast("list[LocalMap]", own_maps), [SolvedGroup(group, graph, solution, poses)])


def test_the_report_of_a_fleet_stays_small(fleet: Inside, tmp_path: Path) -> None:
    began_s = time.process_time()
    write_report(*fleet, tmp_path / "report.html")
    assert time.process_time() - began_s < 20.0  # three; with the square of drives and tags it was minutes
    # Two thousand more tags, as a fleet's map may have, take 2 MB.
    assert (tmp_path / "report.html").stat().st_size < 13_000_000
    (component,) = data_of(tmp_path / "report.html")["components"]
    assert {(each["n_runs"], len(each["observations"])) for each in component["tags"]} == {(N_DRIVES, 12)}
    drawn_before = {tuple(each["tags"]["label"]) for each in component["before"]}
    assert len(drawn_before) == 1, "tags of different drives can be linked"
    assert 100 < len(*drawn_before) < N_TAGS
    row = Read((tmp_path / "report.html").read_text()).rows("tags")[0]
    assert re.fullmatch(r"robot00_\S+, (robot\d\d_\S+, ){10}robot11_\S+ and 88 more", row["runs"])


def test_starts_of_many_runs_are_compared_with_the_first_alone(fleet: Inside) -> None:
    (component,) = fleet[0].components
    assert [pair.b for pair in component.start_to_start] == [run.name for run in component.runs[1:]]
    assert {pair.a for pair in component.start_to_start} == {component.runs[0].name}
    few = component.runs[:MOST_PAIRED_RUNS]
    assert len(start_vectors(few, component.joint_covariance)) == MOST_PAIRED_RUNS * (MOST_PAIRED_RUNS - 1) / 2


def test_essential_tags_are_those_whose_removal_disconnects_runs() -> None:
    n_found = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        names = [f"r{i}" for i in range(rng.integers(1, 7))]
        entry = {"family": "f", "instance": "", "component": 0, "n_observations": 1}
        seen = [sorted(rng.permutation(names)[: rng.integers(1, 4)].tolist()) for _ in range(9)]
        tags = [entry | {"tag_id": i, "runs": runs} for i, runs in enumerate(seen[: rng.integers(0, 10)])]
        document = {"components": [{"runs": names}], "tags": tags}
        expected = [tag["tag_id"] for tag in tags if _joined(names, tags) and not _joined(names, tags, without=tag)]
        assert sorted(tag["tag_id"] for tag in essential_tags(document, 0)) == expected
        n_found += len(expected)
    assert n_found > 20


def _joined(names: list[str], tags: list[dict[str, Any]], without: dict[str, Any] | None = None) -> bool:
    reached = {names[0]}
    for _ in names:
        for pair in combinations(names, 2):
            shared = sum(set(pair) <= set(tag["runs"]) for tag in tags if tag is not without)
            if shared >= 2 and reached & set(pair):
                reached |= set(pair)
    return len(reached) == len(names)
