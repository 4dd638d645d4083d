"""Runs that share one tag: joined over its pose where it is seen well, and left apart with the reason where not."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.maps.files import read_map, write_map
from groundsbot.offline.maps.json_document import map_as_json
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.run import Run, load_run
from groundsbot.offline.measurements.tape import TapeOptions
from groundsbot.offline.report.tables import tables
from tests.benchmarks.trust.tag_join_study import study_seed
from tests.support.data.drives import HALL, make_drive, make_robot, write_drive

ROUND = [(0.4, 0.4, 2.0), (0.5, 0.3, 2.0), (-0.3, 0.3, 5.0)]
STARTS = {"a": [1.0, 1.5, 0.3], "b": [1.4, 2.2, -0.2], "c": [1.2, 1.0, 0.6]}
NOISE = NoiseParameters()
RAISED = [replace(tag, position_m=(*tag.position_m[:2], tag.position_m[2] + 0.15)) for tag in HALL]
SHIFTED = [*HALL[:6], replace(HALL[6], position_m=(2.2, *HALL[6].position_m[1:])), HALL[7]]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Run]:
    """Of a, b and c in the hall; of c also with its tags higher, or tag 6 to the side."""
    folder, found = tmp_path_factory.mktemp("runs"), {}
    worlds = {"a": HALL, "b": HALL, "c": HALL, "raised": RAISED, "shifted": SHIFTED}
    for seed, (name, tags) in enumerate(worlds.items()):
        robot = name if name in STARTS else "c"
        drive = make_drive(STARTS[robot], ROUND)
        log = write_drive(folder / name, drive, tags, make_robot(robot), corner_sigma_px=0.2, seed=seed)
        found[name] = load_run(log)
    return found


def seeing(run: Run, *tag_ids: int, looks: dict[int, int] | None = None) -> Run:
    """The run as if it had seen these tags only, of some of them only its first looks."""
    found = run.detections
    ids = np.array([run.tags[i].tag_id for i in found.tag])
    kept = np.isin(ids, tag_ids)
    for tag_id, n in (looks or {}).items():
        kept[np.flatnonzero(ids == tag_id)[n:]] = False
    tags = tuple(tag for i, tag in enumerate(run.tags) if (found.tag[kept] == i).any())
    index = np.array([tags.index(tag) if tag in tags else -1 for tag in run.tags])
    return replace(run, tags=tags, detections=replace(found.where(kept), tag=index[found.tag[kept]]))


@pytest.fixture(scope="module")
def joined(runs: dict[str, Run]) -> MapResult:
    return build_map([seeing(runs["a"], 0, 1, 4), seeing(runs["b"], 4, 5, 6, 7)], NOISE, corners=True)


def off_sigmas(result: MapResult) -> float:
    """Squared, of the only alignment's transform."""
    (alignment,) = result.alignments
    true = se2.between(STARTS[alignment.from_run[0]], STARTS[alignment.to_run[0]])
    off = alignment.T_from_to - true
    assert alignment.covariance is not None
    return float(off @ np.linalg.solve(alignment.covariance, off))


def test_one_tag_seen_well_joins_two_runs_and_is_reported_as_weak(joined: MapResult) -> None:
    assert len(joined.components) == 1
    (alignment,) = joined.alignments
    assert (alignment.is_accepted, alignment.is_weak, alignment.n_shared) == (True, True, 1)
    assert off_sigmas(joined) < chi2.isf(1e-4, 3)
    assert any("by tag 4 alone (weak: its start is known to" in warning for warning in joined.warnings)
    assert not any(warning.startswith("component") for warning in joined.warnings)
    second = next(run for run in joined.components[0].runs if run.name == "b_one")
    np.testing.assert_allclose(second.T_map_start, alignment.T_from_to, atol=1e-9)
    # The frame is a's start, so that this is the covariance of b's.
    assert alignment.covariance is not None
    np.testing.assert_allclose(second.covariance, alignment.covariance, rtol=1e-6, atol=1e-12)


def test_a_weak_join_is_written_read_and_shown(joined: MapResult, tmp_path: Path) -> None:
    write_map(joined, tmp_path)
    (entry,) = json.loads((tmp_path / "map.json").read_text())["alignments"]
    assert entry["is_weak"] is True
    (again,) = read_map(tmp_path).alignments
    assert again.is_weak
    assert again.covariance is not None
    np.testing.assert_allclose(again.covariance, np.array(entry["covariance"]))
    shown = [row for table in tables(map_as_json(joined)) for row in table.rows if "weak: one tag; sigma" in row[-1]]
    assert len(shown) == 1


def test_errors_of_the_transform_agree_with_its_covariance() -> None:
    """A world with noisy wheels and calibration, one seed of the study: each of four tags joins within 99.99 %."""
    found = list(study_seed(71))
    assert len(found) > 2
    for each in found:
        assert not each.reason, each
        assert 3.0 * each.nees < chi2.isf(1e-4 / len(found), 3), each


@pytest.mark.parametrize(
    ("other", "tag", "looks", "reason"),
    [
        (
            "b",
            1,
            1,
            "b_one shares only tag 1 with a_one, seen too poorly to join them: it gives their",
        ),
        ("b", 0, 5, "b_one shares only tag 0 with a_one, whose corners allow"),
        (
            "raised",
            4,
            99,
            "c_one shares only tag 4 with a_one, which has another height or another tilt there",
        ),
    ],
)
def test_an_ambiguous_single_tag_joins_nothing(
    runs: dict[str, Run], other: str, tag: int, looks: int, reason: str
) -> None:
    few = {tag: looks}
    pair = [seeing(runs["a"], 2, 3, tag, looks=few), seeing(runs[other], 5, 6, 7, tag, looks=few)]
    result = build_map(pair, NOISE, corners=True)
    assert len(result.components) == 2
    assert any(reason in warning for warning in result.warnings), result.warnings
    assert all(not alignment.is_accepted for alignment in result.alignments)


def test_both_poses_of_an_ambiguous_tag_are_reported(runs: dict[str, Run]) -> None:
    few = {0: 5}
    pair = [seeing(runs["a"], 2, 3, 0, looks=few), seeing(runs["b"], 5, 6, 7, 0, looks=few)]
    (alignment,) = build_map(pair, NOISE, corners=True).alignments
    true = se2.between(STARTS[alignment.from_run[0]], STARTS[alignment.to_run[0]])
    ways = [alignment.T_from_to, *(rival.T_from_to for rival in alignment.alternatives)]
    assert len(ways) > 1
    assert min(abs(float(se2.wrap_angle(way[2] - true[2]))) for way in ways) < np.radians(5.0)


def test_on_the_floor_one_tag_joins_nothing_but_the_way_out_is_reported(runs: dict[str, Run]) -> None:
    result = build_map([seeing(runs["a"], 0, 1, 4), seeing(runs["b"], 4, 5, 6, 7)], NOISE)
    assert len(result.components) == 2
    said = "shares only tag 4 with b_one; one more shared tag would suffice, and with --model corners the one may"
    assert any(said in warning for warning in result.warnings), result.warnings


def test_a_measured_start_and_two_shared_tags_join_as_before(runs: dict[str, Run]) -> None:
    x, y, theta = se2.between(STARTS["a"], STARTS["b"])
    tape = TapeOptions(starts=(f"b_one={x},{y},{theta},0.02,0.02,0.01",))
    pair = [seeing(runs["a"], 0, 1, 4), seeing(runs["b"], 4, 5, 6, 7)]
    taped = build_map(pair, NOISE, tape=tape, corners=True)
    assert len(taped.components) == 1
    assert taped.alignments == ()
    two = build_map([seeing(runs["a"], 0, 1, 4, 6), seeing(runs["b"], 4, 5, 6, 7)], NOISE, corners=True)
    assert len(two.components) == 1
    assert [alignment.is_weak for alignment in two.alignments] == [False]
    assert not any("alone" in warning for warning in two.warnings)


def test_three_runs_in_a_ring_bear_each_other_out(runs: dict[str, Run]) -> None:
    """Each pair shares one tag: the second join is over two, and nothing of it is weak."""
    ring = [seeing(runs["a"], 0, 4, 6), seeing(runs["b"], 1, 4, 5), seeing(runs["c"], 2, 5, 6)]
    result = build_map(ring, NOISE, corners=True)
    assert len(result.components) == 1
    assert sorted(alignment.n_shared for alignment in result.alignments) == [1, 2]


def test_a_ring_that_does_not_close_joins_nothing(runs: dict[str, Run]) -> None:
    ring = [seeing(runs["a"], 0, 4, 6), seeing(runs["b"], 1, 4, 5), seeing(runs["shifted"], 2, 5, 6)]
    result = build_map(ring, NOISE, corners=True)
    told = [warning for warning in result.warnings if warning.startswith("component")]
    assert not any(alignment.is_accepted and not alignment.is_weak for alignment in result.alignments)
    assert told
