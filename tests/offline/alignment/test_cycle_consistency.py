"""Cycles of alignments: which do not close, and which link is to blame."""

from itertools import combinations

import numpy as np

from groundsbot.calib.geometry import se2
from groundsbot.offline.alignment.cycle_consistency import (
    _GATE,
    Link,
    closure_error,
    consistent_links,
    three_cycles,
)

SIGMA = np.array([0.05, 0.05, 0.01])


def link_between(a: int, b: int, off_sigmas: float, certainty: float = 10.0) -> Link:
    """A link between two of some places on a circle; each end may be the first map."""
    places = np.array([[5.0 * np.cos(i), 5.0 * np.sin(i), 0.7 * i] for i in (a, b)])
    error = off_sigmas * SIGMA * np.random.default_rng([a, b]).standard_normal(3)
    T_a_b = se2.compose(se2.between(places[0], places[1]), se2.exp(error))
    return Link(a, b, T_a_b, np.diag(SIGMA**2), certainty, (f"map{a}", f"map{b}"))


def test_cycles_close_as_each_does_alone() -> None:
    ends = [(a, b) if (a + b) % 3 else (b, a) for a, b in combinations(range(9), 2) if (a, b) not in ((0, 4), (2, 7))]
    links = [link_between(a, b, off_sigmas=4.0) for a, b in ends]
    cycles, is_open = three_cycles(links)
    of = {frozenset(each): link for each, link in zip(ends, links, strict=True)}
    expected = {}
    for i, j, k in combinations(range(9), 3):
        pairs = [frozenset(pair) for pair in ((i, j), (j, k), (k, i))]
        if all(pair in of for pair in pairs):
            expected[i, j, k] = closure_error([of[pair] for pair in pairs], i)[1] > _GATE
    found = {
        tuple(sorted({end for m in cycle for end in (links[m].a, links[m].b)})): open_
        for cycle, open_ in zip(cycles, is_open.tolist(), strict=True)
    }
    assert found == expected
    assert 0 < sum(found.values()) < len(found)


def test_two_links_make_no_cycle() -> None:
    links = [link_between(0, 1, 0.0), link_between(0, 2, 0.0)]
    kept, contradictions = consistent_links(links)
    assert (kept, contradictions) == (links, [])
    assert consistent_links([]) == ([], [])


def test_a_link_that_closes_no_long_way_round_is_rejected() -> None:
    # Seven maps in a ring with a branch: no three of them form a cycle.
    ring = [(0, 1), (2, 1), (2, 3), (4, 3), (4, 5), (5, 6)]
    links = [link_between(a, b, 0.1, certainty=20.0) for a, b in [*ring, (3, 7)]]
    good, wrong = link_between(0, 6, 0.1), link_between(7, 1, 300.0)
    kept, (contradiction,) = consistent_links([*links, good, wrong])
    assert {each.names for each in kept} == {each.names for each in [*links, good]}
    assert contradiction.link is wrong
    assert contradiction.cycle == (1, 2, 3, 7)
