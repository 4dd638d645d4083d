"""The study of self-calibration's gate in small: tests/benchmarks/trust/gating_study.py."""

from dataclasses import replace

from groundsbot.fixtures.worlds.world import load_world
from groundsbot.offline.maps import CalibrationChoice
from tests.benchmarks.trust.gating_study import Group, Pair, bias_lines, study_group, study_seed, summary

GOOD = Pair("room", 0, 1.0, (0.1, 0.2), (0.1, 0.2), ())


def test_a_seed_of_the_room() -> None:
    (pair,) = study_seed(load_world("room"), 0, factors=(1.0,))
    assert isinstance(pair, Pair)
    assert pair.freed == ()
    assert pair.auto == pair.off
    assert 0.0 < pair.off[0] < 0.5


def test_what_is_promised_is_held_against_each_world_and_noise() -> None:
    assert summary([GOOD, replace(GOOD, seed=1, factor=3.0)])[1]
    assert not summary([GOOD, replace(GOOD, world="nsh", auto=(0.1, 0.22))])[1]
    many = [replace(GOOD, seed=seed) for seed in range(200)]
    lines, good = summary([*many, replace(GOOD, auto=(0.31, 0.2), freed=("track_scale of a",))])
    assert not good
    assert "3.10" in lines[0]
    assert "freed in 1" in lines[0]


def test_several_drives_of_one_robot_are_judged_together() -> None:
    group = study_group(load_world("room"), "a", range(2))
    one = study_group(load_world("room"), "a", range(1))
    sigma, of_one = ({c.name: c.sigma for c in each.choices}["mount_yaw_rad"] for each in (group, one))
    assert sigma < 0.9 * of_one
    assert not any(choice.is_freed for choice in group.choices)


def test_the_mean_error_of_groups_stands_beside_the_predicted_one() -> None:
    def group(value: float, *, is_freed: bool) -> Group:
        choice = CalibrationChoice("a", "time_offset_s", is_freed, value, 0.002, 0.001, 0.0, None, "")
        return Group("nsh", "a", range(4), (choice,))

    (line,) = bias_lines([group(-0.004, is_freed=False), group(-0.006, is_freed=True)])
    assert "mean -0.00500 +- 0.00100, predicted 0.00141; RMS of errors over sigmas 2.55; freed in 1" in line
