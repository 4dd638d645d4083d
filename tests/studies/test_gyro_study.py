"""The study of gyros in small: tests/benchmarks/accuracy/gyro_study.py."""

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks.accuracy.accuracy_study import Figures
from tests.benchmarks.accuracy.cramer_rao import Bound
from tests.benchmarks.accuracy.gyro_study import Tally, main

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


def test_a_map_of_several_components_is_reported() -> None:
    assert Tally("nsh", "good", in_parts=[7]).broken_promises() == ["nsh good, seed 7: the map is in parts"]


def test_one_seed_of_a_room(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["--world", "room", "--seeds", "0", "--gyro", "good"])
    seed, of_all, *missed = capsys.readouterr().out.splitlines()
    assert seed.startswith("room good seed 0: start ")
    assert "times the bound" in of_all
    assert code == (1 if missed else 0)
