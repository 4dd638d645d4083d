"""Wheels compared with tags: the difference is found, with a consistent sigma, and reported where it is too large."""

from collections.abc import Sequence

import numpy as np
import pytest

from groundsbot.calib.foundation.arrays import FloatArray
from groundsbot.calib.geometry import se2
from groundsbot.calib.robot.noise import NoiseParameters
from groundsbot.calib.robot.parameters import TAG_SCALE
from groundsbot.offline.foundation.stages import Stages
from groundsbot.offline.global_map.scale_checks import comparison_warnings
from groundsbot.offline.mapping.pipeline import build_map
from groundsbot.offline.mapping.warnings import calibration_warnings
from groundsbot.offline.maps.parameter_results import CalibrationResult, ConsistencyCheck
from groundsbot.offline.maps.result import MapResult
from groundsbot.offline.measurements.tags import TagKey
from groundsbot.offline.measurements.tape import TapeOptions
from groundsbot.offline.self_calibration.option import Calibrate
from tests.support.data.drives import FAMILY, make_drive, make_positions, make_robot, make_run

ROUND = [(0.5, 0.5, 4.0), (0.3, 0.5, 7.85), (0.5, 0.5, 4.0), (0.5, 0.3, 7.85), (0.2, -0.2, 7.85)]
STRAIGHT = [(0.5, 0.5, 10.0)]
PLACES = np.array([[2.0, 1.0], [1.0, -2.0], [4.0, 4.0], [-1.0, 3.0], [3.0, 0.5], [-2.0, 1.0]])
SIGMA_M = 0.03


def map_it(
    size: float = 1.0,
    track: float = 1.0,
    seed: int | None = None,
    distance: str | None = None,
    legs: Sequence[tuple[float, float, float]] = ROUND,
) -> MapResult:
    """A drive past six tags; these are `size` times the given size, the track is `track` times the given one.

    Args:
        size: of the tags.
        track: of the robot.
        seed: of noise of the given sigma; none where None.
        distance: --distance.
        legs: of the drive.
    """
    drive = make_drive([0.0, 0.0, 0.0], legs, track_m=0.5 * track, step_ns=50_000_000)
    at, tag = (index.reshape(-1) for index in np.mgrid[0 : len(drive.stamps_ns) : 4, 0 : len(PLACES)])
    seen: FloatArray = se2.apply(se2.inverse(drive.T_world_base[at]), PLACES[tag]) / size
    if seed is not None:
        seen = seen + SIGMA_M * np.random.default_rng(seed).standard_normal(seen.shape)
    run = make_run(
        [drive.track],
        robot=make_robot("carl"),
        tags=[TagKey(FAMILY, i) for i in range(len(PLACES))],
        positions=make_positions(drive.stamps_ns[at], tag, seen, SIGMA_M),
    )
    tape = TapeOptions(distances=[distance] if distance else [])
    return build_map([run], NoiseParameters(), Stages(), tape, calibrate=Calibrate())


def check(result: MapResult, name: str) -> ConsistencyCheck:
    (found,) = [each for each in result.checks if each.name == name]
    return found


def contradictions(result: MapResult) -> list[str]:
    return [warning for warning in result.warnings if warning.startswith("wheels and tags contradict each other")]


@pytest.mark.parametrize("size", [0.98, 1.0, 1.05])
def test_a_straight_drive_shows_the_size_of_tags_too(size: float) -> None:
    """Only the priors determine the scale of all together there, which must not show in the comparison."""
    found = [check(map_it(size=size, seed=seed, legs=STRAIGHT), "scale") for seed in range(3)]
    assert all(each.sigma < 0.01 for each in found)
    assert all(abs(each.value - (size - 1.0)) < 3.0 * each.sigma for each in found)


def test_tags_of_another_size_than_given_are_reported() -> None:
    result = map_it(size=1.10)
    scale = check(result, "scale")
    assert scale.value == pytest.approx(0.10, abs=0.01)
    assert scale.sigma < 0.01
    assert scale.batch == f"default {FAMILY}"
    (said,) = contradictions(result)
    assert "a metre by the tags (default tag36h11) is" in said
    assert "longer by the wheels of carl" in said
    assert "the tags are larger than their given size" in said
    assert "outer edge of the black border" in said


def test_a_track_of_another_width_than_given_is_reported() -> None:
    result = map_it(track=1.15)
    turn = check(result, "turn")
    assert turn.value == pytest.approx(1.0 / 1.15 - 1.0, abs=0.03)
    (said,) = contradictions(result)
    assert "less than by its wheels" in said
    assert "track_m" in said


def test_exact_parameters_contradict_nothing() -> None:
    result = map_it()
    for name in ("scale", "turn"):
        assert check(result, name).value == pytest.approx(0.0, abs=1e-6)
    assert not contradictions(result)


def test_values_are_off_by_as_much_as_their_sigmas_say() -> None:
    """Observations are noisy, wheels are not; so what the wheels' sigma adds is no error here."""
    found = [check(map_it(seed=seed), "scale") for seed in range(5)]
    assert all(abs(each.value) < 4.0 * each.sigma for each in found)


def test_a_tape_between_tags_changes_nothing_that_observations_compare() -> None:
    apart_m = float(np.linalg.norm(PLACES[2] - PLACES[5]))
    one, other = (
        check(map_it(size=1.02), "scale"),
        check(map_it(size=1.02, distance=f"2,5={apart_m!r},0.001"), "scale"),
    )
    assert other.value == pytest.approx(one.value, abs=0.2 * one.sigma)
    assert other.sigma == pytest.approx(one.sigma, rel=0.2)


def test_sigmas_count_both_what_observations_and_what_robot_yaml_leave_open() -> None:
    checks = [ConsistencyCheck("scale", 0, "carl", "b", 0.05, 0.003, prior) for prior in (0.01, 0.02)]
    assert checks[0].sigmas == pytest.approx(0.05 / np.hypot(0.003, 0.01))
    assert len(comparison_warnings(checks)) == 1


def test_a_contradiction_concerns_its_own_robot_and_batch_only() -> None:
    """What a check reports is not reported twice; another robot's wheels and other prints are another matter."""
    told = ConsistencyCheck("scale", 0, "carl", "printed", value=0.1, sigma=0.001, prior_sigma=0.005)
    corrections = [
        CalibrationResult(owner, name, 0, value=0.05, sigma=0.001, prior_sigma=0.005)
        for owner, name in (
            ("carl", "wheel_scale"),
            ("printed", TAG_SCALE),
            ("dora", "wheel_scale"),
            ("new", TAG_SCALE),
        )
    ]
    warnings = calibration_warnings(corrections, [told])
    assert [warning.partition(" is ")[0] for warning in warnings] == ["wheel_scale of dora", "tag_scale of new"]
