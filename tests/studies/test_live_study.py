"""The study of maps while driving, in small."""

import pytest

from tests.benchmarks.trust import live_study
from tests.benchmarks.trust.live_study import main, worst_sigmas


def test_tags_of_interim_maps_are_within_their_sigmas() -> None:
    sigmas, at_s, n_maps = worst_sigmas(3, "room", ["a", "b"], 6.0)
    assert 0.0 < sigmas < live_study.MOST_SIGMAS
    assert at_s > 0.0
    assert n_maps > 1


def test_a_missed_bound_is_said(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(live_study, "worst_sigmas", lambda *_: (4.5, 20.0, 3))
    assert main(["--seeds", "7"]) == 1
    assert "missed: seed 7: a tag is off by 4.50 sigma, at most 4" in capsys.readouterr().out
