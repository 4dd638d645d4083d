"""The study of suspects in small: what was done to tags is named, nothing else is, and the map stands."""

import pytest

from tests.benchmarks.trust.outlier_study import Counts, missed_bounds, trial
from tests.support.data.moved_tags import CLEAN, DUPLICATED, MOVED, MOVING, SWAPPED, make_scene


@pytest.mark.parametrize(
    ("kind", "shift_m", "n_tags", "seed"),
    [(MOVED, 1.0, 4, 11), (MOVED, 0.3, 5, 5), (MOVING, 1.0, 2, 2), (SWAPPED, 0.0, 2, 3), (DUPLICATED, 0.0, 2, 5)],
)
def test_what_was_done_is_named(kind: str, shift_m: float, n_tags: int, seed: int) -> None:
    """Six sigmas are named in 19 of 20 cases; here all are, and no other."""
    counts = Counts()
    suspects = trial(make_scene(seed, kind, n_tags, shift_m), counts, compare=False)
    assert len(counts.clear) >= 1
    assert all(each.right for each in counts.clear)
    assert counts.n_false == 0
    for suspect in suspects:
        assert suspect.evidence
        assert suspect.runs


def test_a_clean_map_names_nobody() -> None:
    counts = Counts()
    assert trial(make_scene(3, CLEAN), counts, compare=False) == []
    assert missed_bounds({(CLEAN, 0.0): counts}) == []


def test_the_rest_of_the_map_is_as_good_as_without_the_tags() -> None:
    counts = Counts()
    trial(make_scene(21, MOVED, 3, 1.0), counts, compare=True)
    assert counts.map_factor < 1.1
