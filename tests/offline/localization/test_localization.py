"""A run in a finished map: where it drove, the reason where that is ambiguous, and each bad input in one line."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import groundsbot
from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.offline.localization.localization import localize
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.result import Component, MapResult
from groundsbot.offline.measurements.run import Run
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.sam.solver import Solution, solve
from tests.support.data.drives import FAMILY, HALL, make_drive, make_positions, make_robot, make_run, write_drive
from tests.support.programs import Run as Program

LEGS = [(0.5, 0.5, 2.0), (0.4, 0.5, 2.0), (0.5, 0.4, 2.0)]
PLACES = {1: (2.0, 1.0), 2: (1.0, -2.0), 3: (7.0, 1.0), 4: (8.0, 3.0), 5: (0.0, 4.0), 6: (4.0, 5.0)}
STARTS = {"a": (0.0, 0.0, 0.0), "b": (5.0, 0.0, 2.0), "c": (4.0, 3.0, -1.0)}
SIGMA_M = 0.02


def run_of(
    name: str, tags: tuple[int, ...], moved: dict[int, tuple[float, float]] | None = None, *, seed: int = 0
) -> Run:
    """A drive that reads each of some tags ten times, with noise."""
    drive = make_drive(STARTS[name], LEGS, step_ns=100_000_000)
    at, tag = (index.reshape(-1) for index in np.mgrid[0:50:5, 0 : len(tags)])
    places = PLACES | (moved or {})
    tag_m = np.array([places[key] for key in tags]).reshape(-1, 2)[tag]
    seen = se2.apply(se2.inverse(drive.T_world_base[at]), tag_m)
    noisy = seen + SIGMA_M * np.random.default_rng([seed, ord(name)]).standard_normal(seen.shape)
    keys = [TagKey(FAMILY, key) for key in tags]
    positions = make_positions(drive.stamps_ns[at], tag, noisy, SIGMA_M)
    return make_run([drive.track], robot=make_robot(name), tags=keys, positions=positions)


@pytest.fixture(scope="module")
def known() -> MapResult:
    """Of two drives past all tags."""
    return groundsbot.build_map([run_of("a", (1, 2, 3, 4)), run_of("b", (3, 4, 5, 6, 1))])


def sigmas_off(estimate: FloatArray, covariance: FloatArray, true: FloatArray) -> float:
    error = estimate - true
    error[2] = se2.wrap_angle(error[2])
    return float(np.sqrt(error @ np.linalg.solve(covariance, error)))


def test_the_trajectory_is_that_of_the_joint_solve_but_for_the_runs_information_about_the_map(known: MapResult) -> None:
    run = run_of("c", (1, 2, 4, 5, 6))
    found = localize(run, known)
    (located,) = found.runs
    assert not found.not_located
    assert [tag.tag_id for tag in located.tags] == [1, 2, 4, 5, 6]
    true = make_drive(STARTS["c"], LEGS, step_ns=100_000_000).at(located.stamps_ns)
    for k in (0, -1):
        assert sigmas_off(located.T_map_base[k], located.covariance[k], true[k]) < 4.0
    joint = groundsbot.build_map([run], extending=known).components[0].runs[2]
    sigma = np.sqrt(np.diag(located.covariance[0]))
    # The joint solve is the same estimate: the map's runs enter it whole, here condensed to their tags.
    assert (np.abs(joint.T_map_start - located.T_map_base[0]) < 0.05 * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.diag(joint.covariance)), sigma, rtol=0.02)


def test_the_maps_own_uncertainty_is_in_the_covariance(known: MapResult) -> None:
    component = known.components[0]
    n = 3 * len(component.runs)
    joint = component.joint_covariance.copy()
    joint[n:, n:] += 0.5**2 * np.kron(np.ones((len(component.tags),) * 2), np.eye(2))  # all tags off together
    loose = replace(known, components=(replace(component, joint_covariance=joint, calibration=None),))
    (located,) = localize(run_of("c", (1, 2, 4, 5, 6)), loose).runs
    np.testing.assert_allclose(np.sqrt(np.diag(located.covariance[-1]))[:2], 0.5, rtol=0.02)


def test_a_tag_that_was_moved_is_named_and_costs_nothing(known: MapResult) -> None:
    moved = localize(run_of("c", (1, 2, 4, 5, 6), {4: (8.3, 3.2)}), known)
    (tag,) = moved.moved
    assert tag.tag.tag_id == 4
    assert tag.shift_m == pytest.approx(np.hypot(0.3, 0.2), abs=0.06)
    assert "tag 4 (tag36h11) moved: c_one observed it" in tag.line()
    without = localize(run_of("c", (1, 2, 5, 6)), known)
    (with_it,), (without_it,) = moved.runs, without.runs
    assert sigmas_off(with_it.T_map_base[-1], with_it.covariance[-1], without_it.T_map_base[-1].copy()) < 2.0
    assert TagKey(FAMILY, 4) not in with_it.tags


def test_two_groups_of_tags_in_different_places_are_ambiguous(known: MapResult) -> None:
    """Half of what it saw was moved as a whole: it is unknown which half."""
    shift = {key: (PLACES[key][0] + 3.0, PLACES[key][1] - 1.0) for key in (4, 5, 6)}
    found = localize(run_of("c", (1, 2, 3, 4, 5, 6), shift), known)
    assert not found.is_located
    (told,) = found.not_located
    assert "is ambiguous, because" in told.reason
    starts = np.array([candidate.T_map_start for candidate in told.candidates])
    for wanted in ((4.0, 3.0), (1.0, 4.0)):
        assert np.linalg.norm(starts[:, :2] - wanted, axis=1).min() < 0.3


def test_an_id_in_two_places_is_used_where_it_fits(known: MapResult) -> None:
    doubled = with_second_places(known, {1: (2.0, 9.0), 2: (1.0, 6.0)})
    (located,) = localize(run_of("c", (1, 2, 4, 5)), doubled).runs
    assert [(tag.tag_id, tag.instance) for tag in located.tags] == [(1, "a"), (2, "a"), (4, ""), (5, "")]
    alone = localize(run_of("c", (1, 2)), doubled)
    assert not alone.is_located
    assert "1b, 2b" in alone.not_located[0].reason


def with_second_places(known: MapResult, places: dict[int, tuple[float, float]]) -> MapResult:
    """The map, with more tags of ids that it has, as well known as the first ones."""
    component = known.components[0]
    tags = list(component.tags)
    rows = [*range(3 * len(component.runs) + 2 * len(tags))]
    first = 3 * len(component.runs)
    for tag_id, place in places.items():
        i = next(i for i, tag in enumerate(tags) if tag.tag_id == tag_id)
        tags.append(replace(tags[i], instance="b", position_m=np.array(place)))
        tags[i] = replace(tags[i], instance="a")
        rows += [first + 2 * i, first + 2 * i + 1]
    joint = component.joint_covariance[np.ix_(rows, rows)] + 1e-5 * np.eye(len(rows))
    return replace(known, components=(replace(component, tags=tuple(tags), joint_covariance=joint, calibration=None),))


@pytest.mark.parametrize(
    ("tags", "told"),
    [
        ((7, 8), "none of the 2 tags that c_one observed (7 (tag36h11), 8 (tag36h11)) is in"),
        ((1, 7, 8), "c_one shares only tag 1 with the map; one more shared tag would suffice"),
        ((), "c_one observed no tag"),
    ],
)
def test_a_run_that_cannot_be_placed_is_refused(known: MapResult, tags: tuple[int, ...], told: str) -> None:
    places = {7: (3.0, 2.0), 8: (2.0, 3.0)}
    with pytest.raises(groundsbot.GroundsbotError) as caught:
        localize(run_of("c", tags, places), known, Path("map"))
    assert told in str(caught.value)


def test_a_run_whose_tags_are_all_elsewhere_is_in_the_wrong_map(known: MapResult) -> None:
    otherwise = {1: (0.0, 0.0), 2: (3.0, 3.0), 4: (6.0, -1.0)}
    with pytest.raises(groundsbot.GroundsbotError, match="no two of them fit together in both maps"):
        localize(run_of("c", (1, 2, 4), otherwise), known)


def test_both_components_of_a_map_are_tried(known: MapResult) -> None:
    other = moved_component(known.components[0], 20)
    both = replace(known, components=(other, known.components[0]))
    found = localize(run_of("c", (1, 2, 4)), both)
    assert (found.component, len(found.runs)) == (1, 1)
    twice = replace(known, components=known.components * 2)
    told = localize(run_of("c", (1, 2, 4)), twice).not_located[0]
    assert "in component 1 and tags 1, 2, 4 in component 2" in told.reason
    assert localize(run_of("c", (1, 2, 4)), twice, component=1).is_located
    with pytest.raises(groundsbot.GroundsbotError, match=r"--component 3: .* has 2 components, 1 to 2"):
        localize(run_of("c", (1, 2, 4)), twice, Path("map"), component=2)


def moved_component(component: Component, by: int) -> Component:
    """The same with other ids."""
    return replace(component, tags=tuple(replace(tag, tag_id=tag.tag_id + by) for tag in component.tags))


TAGS = [HALL[i] for i in (0, 1, 2, 6)]


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`map`, of two logs, and a third log beside it."""
    folder = tmp_path_factory.mktemp("kept")
    logs = {}
    for name, start in (("a", [1.0, 1.5, 0.3]), ("b", [4.0, 2.5, 2.9]), ("c", [2.0, 2.0, -1.0])):
        drive = make_drive(start, [(0.4, 0.4, 1.5), (-0.3, 0.3, 5.0)], step_ns=50_000_000)
        logs[name] = write_drive(folder / "logs", drive, TAGS, make_robot(name), corner_sigma_px=0.2)
    (folder / "map").mkdir()
    write_map(groundsbot.build_map([groundsbot.load_run(logs[name]) for name in "ab"]), folder / "map")
    return folder


def test_the_command_writes_a_trajectory_with_covariances(run: Program, kept: Path, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in (kept / "map").iterdir()}
    done = run("localize", kept / "logs" / "c", "--map", kept / "map", "-o", tmp_path / "out")
    assert (done.code, done.err) == (0, "")
    assert "c_one: " in done.out
    assert {path.name: path.read_bytes() for path in (kept / "map").iterdir()} == before
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["c_one.csv", "c_one.tum", "localization.json"]
    table = np.genfromtxt(tmp_path / "out" / "c_one.csv", delimiter=",", names=True)
    told = json.loads((tmp_path / "out" / "localization.json").read_text())
    (entry,) = told["runs"]
    assert (table["x_m"][-1], table["covariance_yy_m2"][-1]) == pytest.approx(
        (entry["T_map_end"][0], entry["end_covariance"][1][1]), abs=1e-8
    )
    again = run("localize", kept / "logs" / "c", "--map", kept / "map", "-o", tmp_path / "out")
    assert (again.code, again.err.count("\n")) == (1, 1)


def test_several_drives_are_localised_as_each_alone(run: Program, kept: Path, tmp_path: Path) -> None:
    other = make_drive([3.0, 2.0, 0.5], [(0.4, 0.3, 3.0), (-0.3, 0.3, 4.0)], step_ns=50_000_000)
    logs = [kept / "logs" / "c", write_drive(tmp_path / "logs", other, TAGS, make_robot("d"), corner_sigma_px=0.2)]
    known = ("--map", kept / "map")
    for n in (1, 2):
        done = run("localize", *logs, *known, "-o", tmp_path / f"by_{n}", "--workers", n)
        assert (done.code, done.err) == (0, "")
        assert [done.out.count(part) for part in ("c_one: ", "d_one: ", "trajectories: ")] == [1, 1, 1]
    files = [{path.name: path.read_bytes() for path in (tmp_path / f"by_{n}").iterdir()} for n in (1, 2)]
    assert files[0] == files[1]
    both = json.loads(files[0].pop("localization.json"))
    for log, name, entry in zip(logs, ("c_one", "d_one"), both["drives"], strict=True):
        alone = tmp_path / name
        assert run("localize", log, *known, "-o", alone).code == 0
        expected = json.loads((alone / "localization.json").read_text())
        assert {"drive": name} | expected == {"format_version": 1} | entry
        for file in (f"{name}.csv", f"{name}.tum"):
            assert files[0].pop(file) == (alone / file).read_bytes()
    assert not files[0]


def test_a_drive_that_cannot_be_placed_is_named_among_several(refused: Callable[..., str], kept: Path) -> None:
    logs = [kept / "logs" / name for name in ("c", "a")]
    assert "run one of robot a is in the map already" in refused(*logs, "--map", kept / "map")
    assert "run one of robot c is given twice" in refused(logs[0], logs[0], "--map", kept / "map")


def test_a_solve_that_did_not_converge_is_no_success(run: Program, kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stop_early(*arguments: Any, **options: Any) -> Solution:
        return replace(solve(*arguments, **options), converged=False, reason="stopped after 100 steps")

    monkeypatch.setattr("groundsbot.offline.localization.solve_in_map.solve", stop_early)
    done = run("localize", kept / "logs" / "c", "--map", kept / "map")
    assert done.code == 3
    assert "the solve did not converge (stopped after 100 steps); do not use this trajectory" in done.out


@pytest.fixture
def refused(run: Program, kept: Path, tmp_path: Path) -> Callable[..., str]:
    """The one line of a call that fails and writes nothing."""

    def call(*arguments: object) -> str:
        outcome = run("localize", *arguments, "-o", tmp_path / "out")
        assert outcome.code == 1
        assert outcome.err.count("\n") == 1
        assert not (tmp_path / "out").exists()
        return outcome.err

    return call


def test_bad_inputs_are_refused_in_one_line(refused: Callable[..., str], kept: Path, tmp_path: Path) -> None:
    log, folder = kept / "logs" / "c", kept / "map"
    assert "map.json: cannot be read" in refused(log, "--map", tmp_path)
    assert f"run one of robot a is in the map already, with its trajectory in {folder / 'a_one'}.tum" in refused(
        kept / "logs" / "a", "--map", folder
    )
    assert "has size 0.2 m in the robot.yaml of c_one but 0.15 m in the map" in refused(
        with_sizes(tmp_path, 0.2), "--map", folder
    )
    broken = read_map(folder)
    (component,) = broken.components
    joint = component.joint_covariance.copy()
    joint[-1, -1] = np.nan
    (tmp_path / "nan").mkdir()
    write_map(replace(broken, components=(replace(component, joint_covariance=joint),)), tmp_path / "nan")
    assert "a tag's position or covariance is not finite" in refused(log, "--map", tmp_path / "nan")


def with_sizes(folder: Path, size_m: float) -> Path:
    """A log of a robot that takes the tags for others."""
    drive = make_drive([2.0, 2.0, -1.0], [(-0.3, 0.3, 5.0)], step_ns=50_000_000)
    robot = make_robot("c", tags=[{"family": FAMILY, "default_size_m": size_m}])
    return write_drive(folder / "logs", drive, TAGS, robot)
