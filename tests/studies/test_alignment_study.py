"""The study of alignments in small: right where accepted, both hypotheses reported where tags moved as one."""

from collections import Counter

import numpy as np
import pytest

from tests.benchmarks.trust.alignment_study import AMBIGUOUS, RIGHT, WRONG, Pool, trial


@pytest.fixture(scope="module")
def pool() -> Pool:
    return Pool(2, seed=3, length_m=400.0)


@pytest.mark.parametrize(("share", "least_right"), [((0.0, 0.5), 36), ((0.5, 0.7), 28)])
def test_wrong_tags_each_on_its_own(pool: Pool, share: tuple[float, float], least_right: int) -> None:
    """Of 40; where 99 and 90 % are right, so few are seen less than once in 500 times."""
    rng = np.random.default_rng(0)
    counts = Counter(trial(pool.before, pool.each, rng, share).outcome() for _ in range(40))
    assert counts[WRONG] == 0
    assert counts[RIGHT] >= least_right


def test_tags_that_moved_as_one(pool: Pool) -> None:
    rng = np.random.default_rng(0)
    trials = [trial(pool.before, pool.shelf, rng, (0.4, 0.6), as_one=True) for _ in range(20)]
    outcomes = [each.outcome() for each in trials]
    assert WRONG not in outcomes
    ambiguous = [each for each, outcome in zip(trials, outcomes, strict=True) if outcome == AMBIGUOUS]
    assert len(ambiguous) >= 10
    assert sum(each.lists_both() for each in ambiguous) >= 0.8 * len(ambiguous)
