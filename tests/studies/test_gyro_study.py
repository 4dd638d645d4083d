"""The study of gyros in small: tests/benchmarks/accuracy/gyro_study.py."""

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks.accuracy.accuracy_study import Figures
from tests.benchmarks.accuracy.cramer_rao import Bound
from tests.benchmarks.accuracy.gyro_study import Tally, main
from tests.support.data.gyros import TIMES_TRACK, on_skid_steer
from tests.support.data.simulated_runs import simulated_runs

FIGURES = Figures(0, 1.0, 0.1, 0.1, 0.1, 0.2, 0.03, 0.1, 1.0, 1.0)


def bound(start_m: float, tags_m: float) -> Bound:
    """Of one tag and one other start."""
    return Bound(np.array([0]), 0.5 * tags_m**2 * np.eye(2), 0.5 * start_m**2 * np.eye(2)[None], np.ones((1, 2)))


@pytest.mark.parametrize(
    ("gyro", "figures", "least", "missed"),
    [
        ("good", FIGURES, (0.092, 0.184), []),
        ("good", FIGURES, (0.090, 0.184), ["start is 1.111"]),
        ("restless", FIGURES, (0.092, 0.180), ["tags is 1.111"]),
        ("none", FIGURES, (0.050, 0.100), []),
        ("good", replace(FIGURES, nees_tags=0.84), (0.1, 0.2), ["NEES"]),
        ("good", replace(FIGURES, nees_tags=np.nan), (0.1, 0.2), ["NEES"]),
        ("good", replace(FIGURES, tags_rmse_m=0.26), (0.1, 0.26), ["median"]),
        ("gaps", replace(FIGURES, tags_rmse_m=0.26), (0.1, 0.26), []),
    ],
)
def test_a_promise_that_is_missed(gyro: str, figures: Figures, least: tuple[float, float], missed: list[str]) -> None:
    tally = Tally("nsh", gyro, 2 * [figures], 2 * [bound(*least)])
    found = tally.broken_promises()
    assert len(found) == len(missed)
    assert all(word in sentence for word, sentence in zip(missed, found, strict=True))


@pytest.mark.parametrize(
    ("figures", "least", "missed"),
    [
        (FIGURES, (0.077, 0.05), []),
        (FIGURES, (0.0765, 0.05), ["start is 1.307"]),
        (replace(FIGURES, nees_tags=1.26), (0.1, 0.2), ["NEES"]),
    ],
)
def test_a_promise_of_wheels_that_skid(figures: Figures, least: tuple[float, float], missed: list[str]) -> None:
    found = Tally("nsh", "good", [figures], [bound(*least)], skids=True).broken_promises()
    assert len(found) == len(missed)
    assert all(word in sentence for word, sentence in zip(missed, found, strict=True))


def test_wheels_that_skid_overstate_turns_by_the_floor_and_no_distances() -> None:
    runs, truth = simulated_runs("room", 0)
    skidding = on_skid_steer(runs, truth, 0)
    times = []
    for run, other in zip(runs, skidding, strict=True):
        (wheels,), (found,) = run.wheel_segments, other.wheel_segments
        assert found.left_m + found.right_m == pytest.approx(wheels.left_m + wheels.right_m)
        turned_m, overstated_m = (np.diff(each.right_m - each.left_m) for each in (wheels, found))
        turns = np.abs(turned_m) > 1e-3
        times.append(overstated_m[turns] / turned_m[turns])
        assert other.robot.wheels.track_m == pytest.approx(1.55 * run.robot.wheels.track_m)
    ratio = np.concatenate(times)
    assert TIMES_TRACK[0] <= ratio.min() < ratio.max() <= TIMES_TRACK[1]


def test_a_map_of_several_components_is_reported() -> None:
    assert Tally("nsh", "good", in_parts=[7]).broken_promises() == ["nsh good, seed 7: the map is in parts"]


def test_one_seed_of_a_room(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["--world", "room", "--seeds", "0", "--gyro", "good"])
    seed, of_all, *missed = capsys.readouterr().out.splitlines()
    assert seed.startswith("room good seed 0: start ")
    assert "times the bound" in of_all
    assert code == (1 if missed else 0)
