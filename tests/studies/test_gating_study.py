"""The study of self-calibration's gate in small: tests/benchmarks/trust/gating_study.py."""

from dataclasses import replace

from groundsbot.fixtures.worlds.world import load_world
from tests.benchmarks.trust.gating_study import Pair, study_seed, summary

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
