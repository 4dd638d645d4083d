"""Weakly observable and unobservable directions are warnings; none ends in a traceback, and no map holds NaN."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from groundsbot.calib.errors import GroundsbotError
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.parameters import CAMERA_PARAMETERS
from groundsbot.offline.global_map.weak_constraints import weak_constraint_warnings
from groundsbot.offline.importing.csv.importer import import_folder
from groundsbot.offline.importing.robot import ImportOptions
from groundsbot.offline.mapping.inputs import read_runs
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.segment import Segment, segments_of
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.sam.factors.odometry_and_observations import (
    CalibrationPrior,
    Columns,
    ObservationFactors,
    OdometryFactors,
    State,
)
from groundsbot.offline.sam.graph import Graph, build_graph
from groundsbot.offline.sam.solver import PLAIN_SQUARES, Problem, Solution, solve
from tests.benchmarks.speed.plain_solver import plain_normal_equations
from tests.support.data.drives import FAMILY, MadeDrive, make_drive, make_positions, make_robot, make_run
from tests.support.data.graphs import make_graph, with_measured

LEGS = [(0.5, 0.5, 2.0), (0.4, 0.5, 2.0), (0.5, 0.4, 2.0)]


def segment_past(name: str, start: Sequence[float], tags: dict[int, tuple[float, float]]) -> Segment:
    """A drive that reads each of some tags ten times, exactly."""
    drive: MadeDrive = make_drive(start, LEGS, step_ns=100_000_000)
    keys = sorted(tags)
    at, tag = (index.reshape(-1) for index in np.mgrid[0:50:5, 0 : len(keys)])
    places = np.array([tags[key] for key in keys]).reshape(-1, 2)[tag]
    read = se2.apply(se2.inverse(drive.T_world_base[at]), places)
    run = make_run(
        [drive.track],
        robot=make_robot(name),
        tags=[TagKey(FAMILY, key) for key in keys],
        positions=make_positions(drive.stamps_ns[at], tag, read),
    )
    return replace(segments_of(run, NoiseParameters())[0], name=name)


STARTS = {"a": (0.0, 0.0, 0.0), "b": (3.0, 1.0, 2.0), "c": (-1.0, 2.0, -1.0), "d": (1.0, -3.0, 0.5)}
PLACES = {1: (2.0, 1.0), 2: (1.0, -2.0), 3: (-1.0, 1.0), 4: (3.0, 3.0), 5: (0.0, 4.0), 6: (-2.0, -2.0)}


def solve_drives(tags_of: dict[str, Sequence[int]]) -> tuple[Graph, Solution]:
    """Segments that read some tags each, solved from the truth in the frame of the first one's start."""
    segments = [segment_past(name, STARTS[name], {tag: PLACES[tag] for tag in tags}) for name, tags in tags_of.items()]
    graph = build_graph(segments)
    poses = [make_drive(STARTS[c.name], LEGS, step_ns=100_000_000).at(c.stamps_ns) for c in segments]
    start = graph.start(se2.compose(se2.inverse(np.array(STARTS["a"])), np.concatenate(poses)), {}, {})
    return graph, solve(graph.problem, start)


def test_a_run_that_shares_no_tag_is_named_and_its_covariance_says_that_nothing_is_known() -> None:
    graph, solution = solve_drives({"a": (1, 2), "b": (3, 4)})
    assert solution.unobservable.segments == (1,)
    assert solution.rank == graph.problem.columns.n - 3
    (sentence,) = [s for s in weak_constraint_warnings(graph, solution) if s.startswith("b ")]
    assert "b shares no tag with the others" in sentence
    first_of_b = graph.problem.columns.poses[graph.first_pose[1]]
    assert (np.sqrt(solution.covariance(first_of_b).diagonal()) > 100.0).all()
    # What is tied down is as well known as without b, which knows a little of the scale of tags too.
    alone, by_itself = solve_drives({"a": (1, 2)})
    for tag in range(2):
        together, apart = (
            s.covariance(g.problem.columns.tags[tag]) for g, s in ((graph, solution), (alone, by_itself))
        )
        np.testing.assert_allclose(together.diagonal(), apart.diagonal(), rtol=0.05)


def test_a_run_that_shares_one_tag_can_turn_about_it() -> None:
    graph, solution = solve_drives({"a": (1, 2), "b": (2, 3)})
    assert solution.unobservable.n_directions == 1
    assert any(
        "b shares only tag 2 with the others, about which it can turn" in s
        for s in weak_constraint_warnings(graph, solution)
    )


@pytest.mark.parametrize(
    ("tags_of", "n_untied", "segments"),
    [
        ({"a": (1, 2), "b": (1, 2)}, 0, ()),
        ({"a": (1, 2), "b": (2, 3), "c": (3, 1)}, 0, ()),  # three bars, three joints
        ({"a": (1, 2), "b": (2, 3), "c": (3, 4), "d": (4, 1)}, 1, (1, 2, 3)),  # four bars: a linkage
        ({"a": (1,), "b": ()}, 3, (1,)),
        ({"a": (1, 2), "b": (3, 4), "c": (3, 4)}, 3, (1, 2)),
    ],
)
def test_segments_and_shared_tags_are_bars_and_joints(
    tags_of: dict[str, Sequence[int]], n_untied: int, segments: tuple[int, ...]
) -> None:
    graph, solution = solve_drives(tags_of)
    assert solution.unobservable.n_directions == n_untied
    assert solution.unobservable.segments == segments
    assert np.isfinite(solution.covariance(np.arange(graph.problem.columns.n))).all()


@given(
    seed=st.integers(0, 10**6),
    lengths=st.lists(st.integers(1, 8), min_size=1, max_size=4),
    n_kept=st.integers(0, 12),
    held=st.sampled_from([0.0, 0.1]),
    n_measured=st.integers(0, 3),
)
@settings(max_examples=60, deadline=None)
def test_rank_is_that_of_the_dense_jacobian(
    seed: int, lengths: list[int], n_kept: int, held: float, n_measured: int
) -> None:
    problem, truth = make_graph(seed, lengths, 5, held=held)
    keep = np.random.default_rng(seed).permutation(len(problem.observations.pose))[:n_kept]
    names = problem.observations.__dataclass_fields__
    few = ObservationFactors(**{name: getattr(problem.observations, name)[keep] for name in names})
    sparse_problem = with_measured(replace(problem, observations=few), truth, seed, n_measured)
    # Where the solve ends: a triangle of distances may lie flat there, and then ties less than at the truth.
    solution = solve(sparse_problem, truth, losses=PLAIN_SQUARES)
    hessian = plain_normal_equations(sparse_problem, solution.state)[0].toarray()
    # Compared in sigmas' own units, dependencies stand far from rounding.
    scale = 1.0 / np.sqrt(np.maximum(hessian.diagonal(), 1e-12))
    eigenvalues = np.linalg.eigvalsh(hessian * np.outer(scale, scale))
    # Where a triangle of distances ends nearly flat, how flat is a matter of the tolerance of the solve.
    assume(not ((eigenvalues > 1e-13) & (eigenvalues < 1e-9)).any())
    rank = int((eigenvalues > 1e-11).sum())
    assert solution.rank == rank


def test_a_long_drive_past_one_tag_is_solved_and_says_what_rounding_does() -> None:
    """A kilometre without a tag: the far end is known to hundreds of metres, neighbours to millimetres."""
    n = 20_000
    sigma = np.array([0.003, 0.001, 0.0005])
    motion = np.tile([0.05, 0.0, 2e-4], (n, 1))
    poses = np.zeros((n + 1, 3))
    for i, (here, step) in enumerate(zip(poses[:-1], motion, strict=True)):
        poses[i + 1] = se2.compose(here, step)
    one = np.zeros(1, dtype=np.int64)
    jacobian = np.tile([[0.05, 0.0, 0.0], [0.0, 0.0, 0.0], [2e-4, 0.1, -2e-4]], (n, 1, 1))
    whitening, parameters = np.tile(np.diag(1.0 / sigma), (n, 1, 1)), np.tile([1, 2, 3], (n, 1))
    observation, no_mount = np.array([[2.0, 1.0]]), np.zeros((1, 3), dtype=np.int64)
    columns = np.concatenate([[-1, -1, -1], np.arange(3 * n + 2), [-1], 3 * n + np.arange(2, 5)])
    by_kind = np.split(columns, [3 * n + 3, 3 * n + 5])
    problem = Problem(
        OdometryFactors(np.arange(n), motion, whitening, jacobian, parameters),
        ObservationFactors(
            one,
            one,
            observation,
            one > 0,
            20.0 * np.eye(2)[None],
            np.zeros((1, 3)),
            no_mount,
            one,
            np.zeros((1, 2, len(CAMERA_PARAMETERS))),
            np.zeros((1, len(CAMERA_PARAMETERS)), dtype=np.int64),
            np.zeros(1),
        ),
        CalibrationPrior(np.array([0.0, 0.005, 0.007, 0.01])),
        Columns(by_kind[0].reshape(-1, 3), by_kind[1].reshape(-1, 2), by_kind[2], 3 * n + 5),
        one,
    )
    found = solve(problem, State(poses, np.array([[2.1, 0.9]]), np.zeros(4)))
    assert found.converged
    assert found.rank == problem.columns.n
    assert found.relative_error() > 0.01
    np.testing.assert_allclose(found.state.tags, [[2.0, 1.0]], atol=1e-9)
    np.testing.assert_allclose(found.covariance(problem.columns.tags[0]), np.eye(2) / 400.0, rtol=1e-6)
    assert np.isfinite(found.pose_covariances(np.arange(n + 1))).all()


def drive_csv(n: int = 60, turn: float = 0.3) -> tuple[str, FloatArray]:
    """odometry.csv of a weave at 0.5 m/s, ten rows a second, and the poses at its rows."""
    omega = turn * np.sin(np.arange(n) / 20)
    rows = "".join(f"{i / 10},0.5,{w!r}\n" for i, w in enumerate(omega.tolist()))
    poses = [np.zeros(3)]
    for w in omega[1:].tolist():
        poses.append(se2.compose(poses[-1], se2.exp(np.array([0.05, 0.0, w / 10]))))
    return "t_s,v_m_s,omega_rad_s\n" + rows, np.array(poses)


def observations_csv(
    poses: FloatArray, tags: dict[int, tuple[float, float]], scale: float = 1.0
) -> list[tuple[float, ...]]:
    """(t_s, tag, x_m, y_m) every half second."""
    rows: list[tuple[float, ...]] = []
    for i in range(0, len(poses), 5):
        for tag, place in tags.items():
            x, y = scale * se2.apply(se2.inverse(poses[i]), np.array(place))
            rows.append((i / 10, tag, float(x), float(y)))
    return rows


def map_runs(folder: Path, runs: dict[str, tuple[str, list[tuple[float, ...]], str]]) -> MapResult:
    """Imports and maps runs of (odometry.csv, rows of observations.csv, its sigma columns)."""
    logs = []
    for name, (odometry, rows, sigmas) in runs.items():
        csv = folder / "csv" / name
        csv.mkdir(parents=True)
        (csv / "odometry.csv").write_text(odometry)
        lines = [f"{row[0]},{int(row[1])}," + ",".join(map(repr, row[2:])) for row in sorted(rows)]
        (csv / "observations.csv").write_text("\n".join([f"t_s,tag_id,x_m,y_m{sigmas}", *lines]) + "\n")
        import_folder(csv, folder / "logs", ImportOptions(run_id=name, robot_id=name, track_width_m=0.5))
        logs.append(folder / "logs" / name)
    return build_map(read_runs(logs))


WEAVE, POSES = drive_csv()
READ = observations_csv(POSES, {1: (2.0, 1.0), 2: (3.0, -1.0)})
STILL = "t_s,v_m_s,omega_rad_s\n" + "".join(f"{i / 10},0.0,0.0\n" for i in range(60))
SIGMAS = ",sigma_x_m,sigma_y_m"

CASES: dict[str, tuple[dict[str, tuple[str, list[tuple[float, ...]], str]], str]] = {
    "one observation": ({"a": (WEAVE, READ[:1], "")}, "tag 1 was seen once, from 2.2 m, by a_a"),
    "seen once from afar": ({"a": (WEAVE, [*READ, (2.0, 17, 6.0, 1.1)], "")}, "tag 17 was seen once, from 6.1 m"),
    "two seen once": ({"a": (WEAVE, READ[:2], "")}, "tags 1 (from 2.2 m, a_a), 2 (from 3.2 m, a_a) were seen once"),
    "no tag": ({"a": (WEAVE, [], "")}, "a_a saw no tag"),
    "no tag beside another": ({"a": (WEAVE, READ, ""), "b": (WEAVE, [], "")}, "b_b saw no tag"),
    "nothing shared": (
        {"a": (WEAVE, READ, ""), "b": (WEAVE, observations_csv(POSES, {8: (2.0, 1.0)}), "")},
        "b_b shares no tag with the others",
    ),
    "standing still": ({"a": (STILL, [(i / 2, 1, 2.0, 1.0) for i in range(9)], "")}, "a_a never moves"),
    "a single row": ({"a": (WEAVE[: WEAVE.index("0.1,")], READ[:1], "")}, "a_a never moves"),
    "millimetres": ({"a": (WEAVE, observations_csv(POSES, {1: (2.0, 1.0)}, 0.001), "")}, "tag positions left out"),
    "a thousand million metres": ({"a": (WEAVE, [(t, k, x + 1e9, y) for t, k, x, y in READ], "")}, "left out"),
    "sigmas of micrometres": ({"a": (WEAVE, [(*row, 2e-6, 2e-6) for row in READ], SIGMAS)}, ""),
    "sigmas of nothing at all": ({"a": (WEAVE, [(*row, 1e-12, 1e-12) for row in READ], SIGMAS)}, "left out"),
    "sigmas of a kilometre": ({"a": (WEAVE, [(*row, 900.0, 900.0) for row in READ], SIGMAS)}, ""),
    "sigmas of every size": ({"a": (WEAVE, [(*row, 2e-6, 900.0) for row in READ], SIGMAS)}, ""),
}


@pytest.mark.parametrize("case", CASES)
def test_weak_input_makes_a_finite_map_and_is_named(tmp_path: Path, case: str) -> None:
    runs, words = CASES[case]
    result = map_runs(tmp_path, runs)
    assert any(words in warning for warning in result.warnings) or not words, result.warnings
    json.dumps(map_as_json(result), allow_nan=False)
    for component in result.components:
        values = np.linalg.eigvalsh(component.joint_covariance)
        assert values.min(initial=0.0) >= -1e-9 * values.max(initial=0.0)
        assert all(np.isfinite(run.T_map_base).all() for run in component.runs)


def test_a_sigma_of_zero_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(GroundsbotError, match=r"observations\.csv line 2, column sigma_x_m"):
        map_runs(tmp_path, {"a": (WEAVE, [(*row, 0.0, 0.1) for row in READ], SIGMAS)})


def test_sound_maps_say_nothing(tmp_path: Path) -> None:
    result = map_runs(tmp_path, {"a": (WEAVE, READ, ""), "b": (WEAVE, READ, "")})
    assert result.warnings == ()
